"""Lays out axes for every pair of parameters, as a lower triangle of equal cells."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text

from bayeskin.report.style import COLUMN_IN, PAGE_IN, new_figure, parameter_label, state_finding
from bayeskin.types import Parameter

_RIGHT_IN = 0.12


def triangle(
    across: Sequence[Parameter], gap: float, finding: str, caption: str
) -> tuple[Figure, list[list[Axes]]]:
    """Returns a figure with a column of axes for each parameter of `across`, and its axes by row.

    Row i holds i + 1 axes. `finding` stands above them, `caption` below. All cells have the same size, which
    automatic layout does not guarantee. `gap` is the space between rows, as a fraction of a cell's height.
    """
    cells = len(across)
    lines = max(parameter_label(p).count("\n") for p in across) + 1
    left_in, label_in = 0.57 + 0.13 * lines, 0.47 + 0.13 * lines
    cell_in = min(1.9, max(0.8, (PAGE_IN - left_in - _RIGHT_IN) / cells))
    width_in = max(COLUMN_IN, left_in + cells * cell_in + _RIGHT_IN)
    figure = new_figure(width_in, 1.0)
    figure.set_layout_engine("none")
    head, foot = state_finding(figure, finding, caption)
    top_in, bottom_in = 0.26 + 0.17 * _lines(head), label_in + 0.14 * _lines(foot)
    height_in = top_in + cells * 0.9 * cell_in + bottom_in
    figure.set_figheight(height_in)
    head.set_y(1 - 0.05 / height_in)
    foot.set_y(0.05 / height_in)
    grid = figure.add_gridspec(
        cells, cells, left=left_in / width_in, right=1 - _RIGHT_IN / width_in,
        bottom=bottom_in / height_in, top=1 - top_in / height_in, wspace=0.14, hspace=gap,
    )  # fmt: skip
    return figure, [[figure.add_subplot(grid[i, j]) for j in range(i + 1)] for i in range(cells)]


def _lines(text: Text) -> int:
    return text.get_text().count("\n") + 1


def label_edges(
    figure: Figure, axes: Sequence[Sequence[Axes]], across: Sequence[Parameter], down: Sequence[Parameter]
) -> None:
    """Labels the outer edges only; `across` and `down` are the parameters of the columns and of the rows."""
    most = 4 if len(axes) <= 4 else 3
    size = 7.5 if len(axes) <= 8 else 6.0  # a name must not be longer than its panel is high
    for i, row in enumerate(axes):
        last = i == len(axes) - 1
        for j, ax in enumerate(row):
            ax.set_xticks(inner_ticks(*ax.get_xlim(), most))
            ax.tick_params(axis="x", labelbottom=last, rotation=0 if len(axes) <= 3 else 45)
            if last:
                ax.set_xlabel(parameter_label(across[j]), size=size)
            if across[j] is not down[i]:  # the diagonal of a corner plot has no second parameter
                ax.set_yticks(inner_ticks(*ax.get_ylim(), most))
                ax.tick_params(axis="y", labelleft=j == 0)
                if j == 0:
                    ax.set_ylabel(parameter_label(down[i]), size=size)
    figure.align_labels()


def inner_ticks(low: float, high: float, most: int) -> list[float]:
    """Returns at most `most` round numbers between two limits.

    They keep away from both limits, where they would touch the numbers of the neighbouring panel.
    """
    margin = 0.06 * (high - low)
    power = np.floor(np.log10(high - low)) - 1
    for step in (
        factor * 10.0**exponent
        for exponent in (power, power + 1, power + 2)
        for factor in (1, 2, 2.5, 3, 4, 5)
    ):
        first, last = np.ceil((low + margin) / step), np.floor((high - margin) / step)
        if last - first + 1 <= most:
            return [float(round(k * step, int(max(0, 2 - power)))) for k in np.arange(first, last + 1)]
    return []
