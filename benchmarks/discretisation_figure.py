"""Draws the figure of the discretisation study (benchmarks/discretisation_study.py)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayeskin.report.style import (
    FAINT,
    GREY,
    INK,
    PAGE_IN,
    new_figure,
    panel_title,
    plain_log,
    state_finding,
    styled,
)
from bayeskin.types import Simulation

PEAK_S, CYCLE_END_S = 19.0, 88.5  # first peak and end of the first cycle of the healthy-skin protocol
COLOURS = {"A": "#0072B2", "C": "#D55E00", "soft": "#009E73"}
MESH_COLOURS = (INK, "#0072B2", "#D55E00", "#009E73", "#E69F00", "#CC79A7", "#56B4E9")


@styled
def figure_discretisation(
    space: Mapping[tuple[int, str, str], float],
    times: Mapping[str, Mapping[tuple[float, str], float]],
    histories: Sequence[tuple[str, Simulation, Simulation]],
    time_target: float,
) -> Figure:
    """Returns the figure: errors against cells and tolerance, and both observations of force on every mesh.

    space : RMS error over the peak by (cells, mesh, point)
    times : RMS error over the peak by protocol, then by (tolerance, point)
    histories : mesh, reaction and face stress over the first cycle
    time_target : RMS error over the peak that the tolerance has to reach
    """
    figure = new_figure(PAGE_IN, 5.0)
    axes = figure.subplots(2, 2)
    _draw_space(axes[0][0], space)
    _draw_times(axes[0][1], times, time_target)
    _draw_histories(axes[1][0], [(mesh, force) for mesh, force, _ in histories], "c", "reaction [N]")
    _draw_histories(axes[1][1], [(mesh, stress) for mesh, _, stress in histories], "d", "face stress [N]")
    if histories:
        axes[1][0].legend(loc="lower center")
    state_finding(
        figure, _finding(histories),
        "a, b: RMS difference from the reference over the reference's peak, at three points of the prior "
        "box; a over the first cycle. Squares: bricks-1, all halved; triangles: the "
        "article's. c, d: first cycle; the face stress is the integral of sigma_xx - p over the pad's face.",
    )  # fmt: skip
    return figure


def _finding(histories: Sequence[tuple[str, Simulation, Simulation]]) -> str:
    """Returns the figure's headline: how much both observations vary over the meshes at the first peak."""
    if len(histories) < 2:
        return "Error of the discretisation"
    reaction, stress = (
        [float(history.at([PEAK_S])[0]) for history in column if history.time_s[-1] >= PEAK_S]
        for column in ([force for _, force, _ in histories], [stress for _, _, stress in histories])
    )
    return (
        f"At the first peak the reaction varies by {100 * (max(reaction) / min(reaction) - 1):.1f} % over "
        f"{len(reaction)} meshes, the face stress from {min(stress):.2f} to {max(stress):.2f} N"
    )


def _draw_space(ax: Axes, space: Mapping[tuple[int, str, str], float]) -> None:
    """Draws the errors against the number of cells, and connects the refinements of the default bricks."""
    for (cells, mesh, point), rms in sorted(space.items()):
        marker = "^" if mesh.endswith(".msh") else "s" if "halved" in mesh else "o"
        ax.plot(cells, 100 * rms, marker, color=COLOURS[point], ms=4)
    for point, colour in COLOURS.items():
        graded = {
            key: rms for key, rms in space.items() if key[1].startswith("bricks") and "halved" not in key[1]
        }
        line = sorted((cells, 100 * rms) for (cells, _, p), rms in graded.items() if p == point)
        if line:
            ax.plot(*zip(*line, strict=True), color=colour, lw=0.8, label=f"point {point}")
    panel_title(ax, "a", "space")
    ax.set(xscale="log", yscale="log", xlabel="cells", ylabel="RMS error [% of peak]")
    if space:
        ax.set_xlim(0.6 * min(k[0] for k in space), 1.6 * max(k[0] for k in space))
        plain_log(ax.xaxis)
        plain_log(ax.yaxis)
        ax.legend(loc="lower left")


def _draw_times(ax: Axes, times: Mapping[str, Mapping[tuple[float, str], float]], target: float) -> None:
    """Draws the errors against the tolerance."""
    for (protocol, errors), dashes, is_filled in zip(times.items(), ("-", "--"), (True, False), strict=False):
        for point in dict.fromkeys(p for _, p in errors):
            line = sorted((t, 100 * e) for (t, p), e in errors.items() if p == point)
            name = f"{point}, {protocol.split(',')[0]}"
            colour = COLOURS[point]
            fill = colour if is_filled else "white"
            ax.plot(*zip(*line, strict=True), dashes, marker="o", mfc=fill, color=colour, label=name)
    ax.axhline(100 * target, color=FAINT, lw=0.8, zorder=0)
    ax.annotate(
        "target", (0.01, 100 * target), xycoords=ax.get_yaxis_transform(), ha="left", va="bottom", color=GREY
    )
    panel_title(ax, "b", "time, bricks-1")
    ax.set(xscale="log", yscale="log", xlabel="tolerance", ylabel="RMS error [% of peak]")
    if times:
        plain_log(ax.xaxis)
        plain_log(ax.yaxis)
        smallest = min(error for errors in times.values() for error in errors.values())
        ax.set_ylim(bottom=30 * smallest)  # room for the legend below the lines [%]
        ax.legend(loc="lower right", fontsize=6, ncols=2, handlelength=2.6)


def _draw_histories(ax: Axes, histories: Sequence[tuple[str, Simulation]], letter: str, label: str) -> None:
    """Draws one observation of force over time on every mesh."""
    for (mesh, history), colour in zip(histories, MESH_COLOURS, strict=False):
        time_s = np.linspace(0.0, CYCLE_END_S, 886)
        ax.plot(time_s, history.at(time_s), color=colour, lw=0.9, label=mesh.removesuffix(".msh"))
    panel_title(ax, letter, "point C")
    ax.set(xlabel="time [s]", ylabel=label)
