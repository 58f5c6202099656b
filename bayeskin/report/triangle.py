"""Axes for every pair of parameters: a lower triangle of equal cells."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import MaxNLocator

from bayeskin.report.style import COLUMN_IN, PAGE_IN, new_figure, parameter_label, state_finding
from bayeskin.types import Parameter

_LEFT_IN, _RIGHT_IN = 0.72, 0.12


def triangle(
    across: Sequence[Parameter], gap: float, finding: str, caption: str
) -> tuple[Figure, list[list[Axes]]]:
    """A figure with a column of axes for each parameter, row i holding i + 1, with finding and caption.

    Cells are equal, which automatic layout does not promise; `gap` between rows is in parts of a cell.
    """
    cells = len(across)
    label_in = 0.5 + 0.13 * max(parameter_label(p).count("\n") + 1 for p in across)
    cell_in = min(1.9, max(0.8, (PAGE_IN - _LEFT_IN - _RIGHT_IN) / cells))
    width_in = max(COLUMN_IN, _LEFT_IN + cells * cell_in + _RIGHT_IN)
    figure = new_figure(width_in, 1.0)
    figure.set_layout_engine("none")
    head, foot = state_finding(figure, finding, caption)
    top_in, bottom_in = 0.26 + 0.17 * _lines(head), label_in + 0.14 * _lines(foot)
    height_in = top_in + cells * 0.9 * cell_in + bottom_in
    figure.set_figheight(height_in)
    head.set_y(1 - 0.05 / height_in)
    foot.set_y(0.05 / height_in)
    grid = figure.add_gridspec(
        cells, cells, left=_LEFT_IN / width_in, right=1 - _RIGHT_IN / width_in,
        bottom=bottom_in / height_in, top=1 - top_in / height_in, wspace=0.14, hspace=gap,
    )  # fmt: skip
    return figure, [[figure.add_subplot(grid[i, j]) for j in range(i + 1)] for i in range(cells)]


def _lines(text: Text) -> int:
    return text.get_text().count("\n") + 1


def label_edges(
    figure: Figure, axes: Sequence[Sequence[Axes]], across: Sequence[Parameter], down: Sequence[Parameter]
) -> None:
    """Names and numbers along the outer edges only; `across` and `down` are the parameters of both."""
    ticks = 4 if len(axes) <= 4 else 3
    for i, row in enumerate(axes):
        last = i == len(axes) - 1
        for j, ax in enumerate(row):
            ax.xaxis.set_major_locator(MaxNLocator(ticks, prune="both", steps=[1, 2, 5, 10]))
            ax.tick_params(axis="x", labelbottom=last, rotation=0 if len(axes) <= 3 else 45)
            if last:
                ax.set_xlabel(parameter_label(across[j]))
            if across[j] is not down[i]:  # the diagonal of a corner plot has no second parameter
                ax.yaxis.set_major_locator(MaxNLocator(ticks, prune="both", steps=[1, 2, 5, 10]))
                ax.tick_params(axis="y", labelleft=j == 0)
                if j == 0:
                    ax.set_ylabel(parameter_label(down[i]))
    figure.align_labels()
