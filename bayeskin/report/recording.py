"""Draws the recording as measured: displacement of the pads, force of the load cell, and their loops."""

from __future__ import annotations

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayeskin.number_format import number
from bayeskin.report.style import (
    INK,
    PAGE_IN,
    RECORDED,
    literal,
    new_figure,
    panel_title,
    state_finding,
    styled,
)
from bayeskin.report.timeline import phase_legend, shade_phases
from bayeskin.types import Array, BinnedForce, Recording

_MANY = 4000  # number of samples above which an SVG stores a line as pixels


@styled
def figure_recording(recording: Recording, binned: BinnedForce) -> Figure:
    """Returns a figure of displacement and force over time, and of the bins' force over displacement.

    The phases are shaded.
    """
    phases = binned.phases
    figure = new_figure(PAGE_IN, 3.6)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.9, 1), height_ratios=(1, 1.6))
    motion = figure.add_subplot(grid[0, 0])
    force = figure.add_subplot(grid[1, 0], sharex=motion)
    loops = figure.add_subplot(grid[:, 1])
    many = len(recording.time_s) > _MANY
    displacement_mm = 1e3 * recording.displacement_m
    motion.plot(recording.time_s, displacement_mm, color=INK, lw=0.9, rasterized=many)
    force.plot(recording.time_s, recording.force_n, color=RECORDED, lw=0.4, rasterized=many)
    for ax in (motion, force):
        shade_phases(ax, phases, cycles=ax is motion)
    low, high = displacement_mm.min(), displacement_mm.max()
    reach = (high - low) or 1.0
    motion.set_ylim(low - 0.06 * reach, high + 0.28 * reach)
    phase_legend(motion, phases)
    motion.tick_params(labelbottom=False)
    motion.set_ylabel("displacement [mm]")
    force.set(xlabel="time [s]", ylabel="force [N]")
    _draw_loops(loops, recording, binned)
    panel_title(motion, "a")
    panel_title(force, "b")
    panel_title(loops, "c", "loops, bin means")
    cycles = len({p.cycle for p in phases if p.kind in ("load", "unload")})
    finding = (
        f"{literal(recording.name)}: {cycles} cycle{'s' * (cycles != 1)} to {number(high, 3)} mm, "
        f"forces from {number(recording.force_n.min(), 3)} to {number(recording.force_n.max(), 3)} N"
    )
    rate_hz = 1.0 / np.median(np.diff(recording.time_s))
    width_s = np.median(np.diff(binned.edges_s))
    caption = (
        f"a, b: as recorded, without smoothing, {len(recording.time_s)} samples at {number(rate_hz, 4)} Hz. "
        f"c: robust means over {number(width_s, 3)} s."
    )
    state_finding(figure, finding, caption)
    return figure


def _draw_loops(ax: Axes, recording: Recording, binned: BinnedForce) -> None:
    displacement_mm = 1e3 * _bin_displacement(recording, binned)
    kinds = [p.kind for p in binned.phases]
    cycle_of_bin = np.array([p.cycle for p in binned.phases])[binned.phase]
    moving = np.array([kind != "rest" for kind in kinds])[binned.phase]
    cycles = np.unique(cycle_of_bin[moving])
    shades = colormaps["viridis"](np.linspace(0.05, 0.8, max(len(cycles), 2)))
    for cycle, shade in zip(cycles, shades, strict=False):
        inside = moving & (cycle_of_bin == cycle)
        ax.plot(displacement_mm[inside], binned.force_n[inside], ".-", ms=2.5, lw=0.7, color=shade,
                label=f"cycle {cycle}")  # fmt: skip
    if len(cycles) == 0:
        ax.plot(displacement_mm, binned.force_n, ".", ms=2.5, color=RECORDED)
    else:
        ax.legend(loc="upper left")
    ax.set(xlabel="displacement [mm]", ylabel="force [N]")


def _bin_displacement(recording: Recording, binned: BinnedForce) -> Array:
    """Returns the mean displacement (m,) [m] of the samples in each bin; NaN in an empty bin."""
    counts, _ = np.histogram(recording.time_s, binned.edges_s)
    sums, _ = np.histogram(recording.time_s, binned.edges_s, weights=recording.displacement_m)
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
