"""Where a recording leaves the model, which mechanisms make up for it, and the fit before and after."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bayeskin.report.style import (
    ACCENT,
    FAINT,
    GREY,
    MODEL,
    PAGE_IN,
    RECORDED,
    new_figure,
    panel_title,
    state_finding,
    styled,
)
from bayeskin.report.timeline import shade_phases
from bayeskin.types import Array, BinnedForce, PadMotion


class _Window(Protocol):
    @property
    def start_s(self) -> float: ...
    @property
    def end_s(self) -> float: ...
    @property
    def mean_n(self) -> float: ...


class _Located(Protocol):
    @property
    def windows(self) -> Sequence[_Window]: ...
    @property
    def bins(self) -> NDArray[np.int64]: ...
    @property
    def residual_n(self) -> Array: ...
    @property
    def allowed_n(self) -> Array: ...


@styled
def figure_located(binned: BinnedForce, motion: PadMotion, located: _Located, force_n: Array) -> Figure:
    """Windows on the recording, the residual and force over displacement; force_n (m,) the model's."""
    figure = new_figure(PAGE_IN, 4.2)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.9, 1))
    force = figure.add_subplot(grid[0, 0])
    residual = figure.add_subplot(grid[1, 0], sharex=force)
    loops = figure.add_subplot(grid[:, 1])
    time_s, bins = binned.time_s, located.bins
    force.plot(time_s, 1e3 * binned.force_n, ".", ms=1.5, color=RECORDED, label="recorded")
    force.plot(time_s, 1e3 * force_n, color=MODEL, label="model")
    residual.fill_between(
        time_s[bins], -1.645e3 * located.allowed_n, 1.645e3 * located.allowed_n, color=FAINT, lw=0,
        label="allowed, 90 %",
    )  # fmt: skip
    residual.plot(time_s[bins], 1e3 * located.residual_n, color=RECORDED, lw=0.8)
    displacement_mm = 1e3 * motion.at(time_s)
    loops.plot(displacement_mm, 1e3 * binned.force_n, ".", ms=1.5, color=GREY)
    loops.plot(displacement_mm, 1e3 * force_n, color=MODEL, lw=0.8)
    for window in located.windows:
        color = ACCENT if window.mean_n > 0 else MODEL
        residual.axvspan(window.start_s, window.end_s, ymax=0.04, color=color, lw=0)
        inside = (time_s >= window.start_s) & (time_s <= window.end_s)
        loops.plot(displacement_mm[inside], 1e3 * binned.force_n[inside], ".", ms=2.5, color=color)
    for ax in (force, residual):
        shade_phases(ax, binned.phases, cycles=ax is force)
    force.legend(loc="upper right")
    residual.legend(loc="upper right")
    force.tick_params(labelbottom=False)
    force.set_ylabel("force [mN]")
    residual.set(xlabel="time [s]", ylabel="recorded − model [mN]")
    loops.set(xlabel="displacement [mm]", ylabel="force [mN]")
    for ax, letter in zip((force, residual, loops), "abc", strict=True):
        panel_title(ax, letter)
    count = len(located.windows)
    state_finding(
        figure,
        f"The recording leaves what the model allows in {count} window{'s' * (count != 1)}"
        if count
        else "The recording stays within what the model allows",
        "Orange: recorded force above the model's; blue: below. Allowed: measured noise, the surrogate's "
        "error, the parameters' uncertainty. One search in twenty finds a window where nothing is missing.",
    )
    return figure


@styled
def figure_candidates(candidates: Sequence[Mapping[str, Any]]) -> Figure:
    """Log evidence that each mechanism gains by itself, with the standard error over phases."""
    rows = list(reversed(candidates))
    figure = new_figure(PAGE_IN, 0.9 + 0.2 * max(len(rows), 3))
    ax = figure.subplots()
    gain = np.array([row["delta_score"] for row in rows])
    error = np.array([row["standard_error"] for row in rows])
    place = np.arange(len(rows))
    ax.barh(place, gain, color=[MODEL if value > 0 else GREY for value in gain], height=0.6)
    ax.errorbar(gain, place, xerr=error, fmt="none", ecolor=RECORDED, elinewidth=0.7)
    ax.axvline(0.0, color=GREY, lw=0.6)
    ax.set_yticks(place, [row["name"] for row in rows])
    ax.set_xlabel("log evidence gained over the base model [nats]")
    finding = (
        f"{rows[-1]['name']} alone gains most" if len(rows) and gain[-1] > 0 else "No mechanism alone gains"
    )
    state_finding(
        figure, finding, "All other parameters free again for each. Lines: standard error over phases."
    )
    return figure


@styled
def figure_before_after(binned: BinnedForce, motion: PadMotion, before_n: Array, after_n: Array) -> Figure:
    """Force and residual over time and force over displacement, without and with the best set; (m,) each."""
    figure = new_figure(PAGE_IN, 4.2)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.9, 1))
    force = figure.add_subplot(grid[0, 0])
    residual = figure.add_subplot(grid[1, 0], sharex=force)
    loops = figure.add_subplot(grid[:, 1])
    time_s, displacement_mm = binned.time_s, 1e3 * motion.at(binned.time_s)
    force.plot(time_s, 1e3 * binned.force_n, ".", ms=1.5, color=RECORDED, label="recorded")
    loops.plot(displacement_mm, 1e3 * binned.force_n, ".", ms=1.5, color=RECORDED)
    for values, color, label in ((before_n, GREY, "before"), (after_n, MODEL, "after")):
        force.plot(time_s, 1e3 * values, color=color, lw=0.9, label=label)
        residual.plot(time_s, 1e3 * (binned.force_n - values), color=color, lw=0.8)
        loops.plot(displacement_mm, 1e3 * values, color=color, lw=0.8)
    for ax in (force, residual):
        shade_phases(ax, binned.phases, cycles=ax is force)
    force.legend(loc="upper right")
    force.tick_params(labelbottom=False)
    force.set_ylabel("force [mN]")
    residual.set(xlabel="time [s]", ylabel="recorded − model [mN]")
    loops.set(xlabel="displacement [mm]", ylabel="force [mN]")
    for ax, letter in zip((force, residual, loops), "abc", strict=True):
        panel_title(ax, letter)
    rms = [1e3 * float(np.sqrt(np.nanmean((binned.force_n - values) ** 2))) for values in (before_n, after_n)]
    state_finding(figure, f"RMS residual {rms[0]:.1f} mN before, {rms[1]:.1f} mN after", "")
    return figure
