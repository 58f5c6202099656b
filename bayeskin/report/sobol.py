"""Draws Sobol' indices, which show which parameter changes the force, and when."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike

from bayeskin.report.style import (
    FAINT,
    GREY,
    INK,
    PAGE_IN,
    new_figure,
    panel_title,
    parameter_colors,
    state_finding,
    styled,
    symbol,
)
from bayeskin.report.timeline import draw_motion
from bayeskin.types import Array


@styled
def figure_sobol(
    names: Sequence[str],
    time_s: ArrayLike,
    displacement_m: ArrayLike,
    first: ArrayLike,
    total: ArrayLike,
    first_aggregated: ArrayLike,
    total_aggregated: ArrayLike,
    inputs: str,
) -> Figure:
    """Returns a figure of first-order and total Sobol' indices of the force, over time and aggregated.

    names (d,) : of the parameters
    time_s, displacement_m (m,) : centres of the bins and the displacement there
    first, total (3, m, d) : lower end of the interval, estimate, and upper end; NaN where the force has no
        variance
    first_aggregated, total_aggregated (3, d) : the same, aggregated over the recording
    inputs : distribution of the parameters (the prior box or the posterior) as the caption names it
    """
    series = [np.asarray(values, dtype=float) for values in (first, total)]
    aggregated = [np.asarray(values, dtype=float) for values in (first_aggregated, total_aggregated)]
    colors = parameter_colors(names)
    figure = new_figure(PAGE_IN, max(3.4, 1.6 + 0.24 * len(names)))
    grid = figure.add_gridspec(2, 2, width_ratios=(2.3, 1))
    upper = figure.add_subplot(grid[0, 0])
    lower = figure.add_subplot(grid[1, 0], sharex=upper)
    bars = figure.add_subplot(grid[:, 1])
    for ax, values in zip((upper, lower), series, strict=True):
        _draw_series(ax, np.asarray(time_s, dtype=float), values, colors)
        draw_motion(ax, time_s, displacement_m)
    upper.tick_params(labelbottom=False)
    upper.set_ylabel("first-order index")
    lower.set(xlabel="time [s]", ylabel="total index")
    guide = [Line2D([], [], color=FAINT, lw=1.2, label="displacement (scaled)")]
    upper.legend(handles=guide, loc="lower right", bbox_to_anchor=(1, 1))
    _draw_aggregated(bars, names, aggregated, colors)
    panel_title(upper, "a", "each parameter alone")
    panel_title(lower, "b", "with all its interactions")
    panel_title(bars, "c", "over the whole recording")
    caption = (
        f"Inputs: {inputs}. Bands and whiskers: intervals of the estimates. c: indices weighted by the "
        "variance of the force over the whole recording. There is no line where the force does not vary."
    )
    state_finding(figure, _finding(names, aggregated[0][1], aggregated[1][1]), caption)
    return figure


def _draw_series(ax: Axes, time_s: Array, values: Array, colors: Sequence[str]) -> None:
    for j, color in enumerate(colors):
        low, middle, high = values[:, :, j]
        ax.fill_between(time_s, low, high, color=color, alpha=0.22, lw=0)
        ax.plot(time_s, middle, color=color, lw=1.1)
    ax.axhline(0, color=GREY, lw=0.5)
    ax.set_xlim(time_s[0], time_s[-1])
    top = np.nanmax(np.append(values, 1.0))
    ax.set_ylim(min(-0.03, np.nanmin(np.append(values, 0.0))), 1.03 * top)


def _draw_aggregated(
    ax: Axes, names: Sequence[str], aggregated: Sequence[Array], colors: Sequence[str]
) -> None:
    rows = np.arange(len(names))
    for offset, values, filled in ((-0.19, aggregated[0], True), (0.19, aggregated[1], False)):
        low, middle, high = values
        known = np.isfinite(middle)
        ax.barh(
            rows[known] + offset, middle[known], 0.34, lw=0.9, edgecolor=np.array(colors)[known],
            color=np.array(colors)[known] if filled else "white",
        )  # fmt: skip
        whiskers = np.clip([middle - low, high - middle], 0, None)[:, known]
        ax.errorbar(
            middle[known], rows[known] + offset, xerr=whiskers, fmt="none", ecolor=INK, elinewidth=0.8
        )
    for row in range(len(names)):
        best, reach = aggregated[1][1, row], np.nanmax(np.append(aggregated[1][2, row], 0.0))
        text = f" {_share(aggregated[0][1, row])} | {_share(best)}" if np.isfinite(best) else " not defined"
        ax.text(max(reach, 0.0), row, text, va="center", fontsize=6.5)
    ax.set_yticks(rows, [symbol(name) for name in names])
    for label, color in zip(ax.get_yticklabels(), colors, strict=True):
        label.set(color=color, fontsize=9)
    ax.set(xlim=(0, 1.35), ylim=(len(names) - 0.4, -0.6), xlabel="first-order (filled) | total (open)")
    ax.set_xticks([0, 0.5, 1.0])
    ax.tick_params(axis="y", length=0)


def _share(index: float) -> str:
    return f"{index:.2f}" if abs(index) >= 0.005 else "<0.01"


def _finding(names: Sequence[str], first: Array, total: Array) -> str:
    if not np.isfinite(first).any():
        return "The force does not vary: no parameter has an index"
    order = [j for j in np.argsort(-np.nan_to_num(first)) if np.isfinite(first[j])]
    leading = " and ".join(f"{symbol(names[j])} ({100 * first[j]:.0f} %)" for j in order[:2])
    inert = [symbol(names[j]) for j in range(len(names)) if np.isfinite(total[j]) and total[j] < 0.005]
    tail = f"; {' and '.join(inert)} below 0.5 %, interactions included" if inert else ""
    return f"Largest shares of the force's variance: {leading}{tail}"
