"""Draws the points at which the full model was run, wave by wave."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike

from bayeskin.number_format import number
from bayeskin.report.style import (
    ACCENT,
    GREY,
    INK,
    axis_values,
    parameter_label,
    plain_log,
    styled,
)
from bayeskin.report.triangle import label_edges, triangle
from bayeskin.types import Array, Design, Parameter


@styled
def figure_waves(design: Design, kept_volume: ArrayLike) -> Figure:
    """Returns a figure of the design's points in each pair of parameters, with a colour for each wave.

    kept_volume (w,) : fraction of the prior box that was still plausible when the wave was drawn (1 for the
        first); it has its own panel where there are more than three parameters
    """
    kept = np.asarray(kept_volume, dtype=float)
    parameters, d, last = design.space.parameters, design.space.dim, int(design.wave.max(initial=0))
    shades = colormaps["cividis_r"](np.linspace(0.15, 1.0, last + 1) if last else [0.85])
    values = np.column_stack([axis_values(p, design.theta[:, j]) for j, p in enumerate(parameters)])
    caption = "Axes span the prior box. Held-out runs are never used to train the surrogate."
    figure, axes = triangle(parameters[: max(d - 1, 1)], 0.14, _finding(design, kept), caption)
    for i in range(1, d):
        for j in range(i):
            ax = axes[i - 1][j]
            _draw_pair(ax, design, values, (j, i), shades)
            ax.set(xlim=_span(parameters[j]), ylim=_span(parameters[i]))
    if d > 1:
        label_edges(figure, axes, parameters[:-1], parameters[1:])
    else:
        axes[0][0].scatter(values[:, 0], design.wave, s=8, c=shades[design.wave])
        axes[0][0].set(xlabel=parameter_label(parameters[0]), ylabel="wave")
    _draw_key(axes, design, shades)
    if d > 3:
        _draw_volume(figure, axes, kept, shades)
    return figure


def _span(parameter: Parameter) -> Array:
    return axis_values(parameter, [parameter.lower, parameter.upper])


def _draw_pair(ax: Axes, design: Design, values: Array, pair: tuple[int, int], shades: Array) -> None:
    x, y, colors = values[:, pair[0]], values[:, pair[1]], shades[design.wave]
    train, test, failed = design.training, design.testing, ~design.ok
    ax.scatter(x[train], y[train], s=5, c=colors[train], lw=0)
    ax.scatter(x[test], y[test], s=7, facecolors="none", edgecolors=list(colors[test]), lw=0.6)
    ax.scatter(x[failed], y[failed], s=11, marker="x", c=ACCENT, lw=0.8)


def _draw_volume(figure: Figure, axes: Sequence[Sequence[Axes]], kept: Array, shades: Array) -> None:
    """Draws the share of the box that was still plausible at each wave, in the space above the diagonal."""
    last_row, first = axes[-1], axes[0][0].get_position()
    left = last_row[-2].get_position().x0 + 0.03
    below = axes[1][0].get_position()
    bottom = below.y0 + 0.7 * below.height
    ax = figure.add_axes((left, bottom, last_row[-1].get_position().x1 - left, first.y1 - bottom))
    waves = np.arange(len(kept))
    ax.plot(waves, 100 * kept, "-", color=GREY, lw=0.8)
    ax.scatter(waves, 100 * kept, s=22, c=shades[np.minimum(waves, len(shades) - 1)], zorder=3)
    for wave, fraction in enumerate(kept):
        ax.annotate(_percent(fraction), (wave, 100 * fraction), xytext=(5, 3), textcoords="offset points")
    if np.all(kept > 0):
        ax.set_yscale("log")
        ax.set_ylim(60 * kept.min(), 250)
        plain_log(ax.yaxis)
    ax.set_xlim(-0.25, max(len(kept) - 1, 1) + 0.5)
    ax.set_xticks(waves)
    ax.set(xlabel="wave", ylabel="volume kept [%]")


def _draw_key(axes: Sequence[Sequence[Axes]], design: Design, shades: Array) -> None:
    dot = {"lw": 0, "marker": "o", "ms": 4}
    handles = [Line2D([], [], color=c, label=f"wave {w}", **dot) for w, c in enumerate(shades)]  # type: ignore[arg-type]
    if design.testing.any():
        handles.append(Line2D([], [], color=INK, mfc="none", label="held out", **dot))  # type: ignore[arg-type]
    if not design.ok.all():
        handles.append(Line2D([], [], color=ACCENT, lw=0, marker="x", ms=4, label="failed"))
    axes[0][0].legend(handles=handles, loc="upper left", bbox_to_anchor=(1.03, 1.0))


def _finding(design: Design, kept: Array) -> str:
    waves, failed = len(np.unique(design.wave)), int(np.sum(~design.ok))
    closing = f"close in on {_percent(kept[-1])} of the prior box" if len(kept) > 1 else "fill the prior box"
    return (
        f"{len(design.theta)} runs in {waves} wave{'s' * (waves != 1)} {closing}; {failed or 'none'} failed"
    )


def _percent(fraction: float) -> str:
    return f"{number(100 * fraction, 2)} %" if fraction < 0.995 else "100 %"
