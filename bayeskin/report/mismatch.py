"""Draws where a recording differs from the model, and which mechanisms explain the difference."""

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
    legend_above,
    new_figure,
    panel_title,
    state_finding,
    styled,
)
from bayeskin.report.timeline import PHASE_COLORS, phase_legend, shade_phases
from bayeskin.types import Array, BinnedForce, PadMotion

Z90 = 1.645
BELOW = "#882255"  # windows where the recording lies below the model; ACCENT marks those above it


class _Window(Protocol):
    """Lists what the figures need of a `bayeskin.mismatch.locate.Window`."""

    @property
    def start_s(self) -> float: ...
    @property
    def end_s(self) -> float: ...
    @property
    def mean_n(self) -> float: ...


class _Contribution(Protocol):
    """Lists what the figures need of a `bayeskin.mismatch.contributions.Contribution`."""

    @property
    def name(self) -> str: ...
    @property
    def along(self) -> Sequence[str]: ...
    @property
    def force_n(self) -> Array: ...
    @property
    def size_n(self) -> float: ...


class Located(Protocol):
    """Lists what the figures need of a `bayeskin.mismatch.locate.Located`."""

    @property
    def windows(self) -> Sequence[_Window]: ...
    @property
    def bins(self) -> NDArray[np.int64]: ...
    @property
    def residual_n(self) -> Array: ...
    @property
    def allowed_n(self) -> Array: ...


@styled
def figure_located(binned: BinnedForce, motion: PadMotion, located: Located, force_n: Array) -> Figure:
    """Returns a figure of the windows in which the recording differs from the model.

    The windows are marked on the residual over time and on the force over displacement.
    force_n (m,) : force [N] of the model's best fit
    """
    figure = new_figure(PAGE_IN, 4.2)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.9, 1))
    force = figure.add_subplot(grid[0, 0])
    residual = figure.add_subplot(grid[1, 0], sharex=force)
    loops = figure.add_subplot(grid[:, 1])
    time_s, bins = binned.time_s, located.bins
    force.plot(time_s, 1e3 * binned.force_n, ".", ms=1.5, color=RECORDED, label="recorded")
    force.plot(time_s, 1e3 * force_n, color=MODEL, label="model")
    residual.fill_between(
        time_s[bins], -1e3 * Z90 * located.allowed_n, 1e3 * Z90 * located.allowed_n, color=FAINT, lw=0,
        label="allowed, 90 %",
    )  # fmt: skip
    residual.plot(time_s[bins], 1e3 * located.residual_n, color=RECORDED, lw=0.8)
    displacement_mm = 1e3 * motion.at(time_s)
    loops.plot(displacement_mm, 1e3 * binned.force_n, ".", ms=1.5, color=GREY)
    loops.plot(displacement_mm, 1e3 * force_n, color=MODEL, lw=0.8)
    for window in located.windows:
        color = ACCENT if window.mean_n > 0 else BELOW
        residual.axvspan(window.start_s, window.end_s, ymax=0.04, color=color, lw=0)
        inside = (time_s >= window.start_s) & (time_s <= window.end_s)
        loops.plot(displacement_mm[inside], 1e3 * binned.force_n[inside], ".", ms=2.5, color=color)
    for ax in (force, residual):
        shade_phases(ax, binned.phases, cycles=ax is force)
    force.margins(y=0.14)  # leaves space for the names of the cycles
    legend_above(force)
    legend_above(residual)
    force.tick_params(labelbottom=False)
    force.set_ylabel("force [mN]")
    residual.set(xlabel="time [s]", ylabel="residual [mN]")
    loops.set(xlabel="displacement [mm]", ylabel="force [mN]")
    panel_title(force, "a", "best fit")
    panel_title(residual, "b", "recorded − model")
    panel_title(loops, "c")
    count = len(located.windows)
    state_finding(
        figure,
        f"The recording differs from the model in {count} window{'s' * (count != 1)}"
        if count
        else "The recording stays within what the model allows",
        "Orange: windows where the recording lies above the model by more than is allowed and by more than "
        "other parameter values can explain. Purple: the same, but below the model. Grey: outside these "
        "windows. Allowed: measured noise, the model's own error and the uncertainty of the parameters. "
        "Where nothing is missing, one search in twenty still finds a window.",
    )
    return figure


@styled
def figure_candidates(candidates: Sequence[Mapping[str, Any]]) -> Figure:
    """Returns a figure of the log-evidence that each mechanism gains by itself, with its standard error.

    candidates : "name", "delta_score" [nats] and "standard_error" (over phases) of each mechanism, with the
        largest gain first
    """
    rows = list(reversed(candidates))
    figure = new_figure(PAGE_IN, 0.9 + 0.2 * max(len(rows), 3))
    ax = figure.subplots()
    gain = np.array([row["delta_score"] for row in rows])
    error = np.array([row["standard_error"] for row in rows])
    position = np.arange(len(rows))
    ax.barh(position, gain, color=[MODEL if value > 0 else GREY for value in gain], height=0.6)
    ax.errorbar(gain, position, xerr=error, fmt="o", ms=2.2, color=RECORDED, elinewidth=0.7)
    ax.axvline(0.0, color=GREY, lw=0.6)
    ax.set_yticks(position, [row["name"] for row in rows])
    numbers = ax.secondary_yaxis("right")  # beside a bar of hundreds of nats, a bar of a few is invisible
    digits = [0 if abs(a) >= 100.0 else 1 for a in gain]
    labels = [f"{round(a, d) + 0.0:+.{d}f} ± {b:.{d}f}" for a, b, d in zip(gain, error, digits, strict=True)]
    numbers.set_yticks(position, [label.replace("-", "−") for label in labels])
    numbers.tick_params(length=0.0)
    numbers.spines["right"].set_visible(False)
    ax.set_xlabel("gain in log-evidence over the base model [nats]")
    finding = "No mechanism gains on its own"
    if len(rows) and gain[-1] > 0:
        ties = int(np.sum(gain[:-1] > gain[-1] - np.hypot(error[:-1], error[-1])))
        finding = f"{rows[-1]['name']} gains most on its own" + (
            f", {ties} {'other' if ties == 1 else 'others'} as much within the error" if ties else ""
        )
    state_finding(
        figure,
        finding,
        "For each mechanism, all other parameters are fitted again. Lines: standard error over phases. "
        "Mechanisms whose predicted gain was too small for a fit, and mechanisms that the samples of the "
        "recording contradict, are not shown.",
    )
    return figure


@styled
def figure_contributions(binned: BinnedForce, motion: PadMotion, parts: Sequence[_Contribution]) -> Figure:
    """Returns a figure of the force that each mechanism adds, over time and over displacement.

    parts : contributions, at least one, the largest first
    """
    figure = new_figure(PAGE_IN, 0.9 + 1.15 * len(parts))
    panels = figure.subplots(len(parts), 2, sharex="col", sharey="row", squeeze=False, width_ratios=(1.9, 1))
    displacement_mm = 1e3 * motion.at(binned.time_s)
    kind = np.array([phase.kind for phase in binned.phases])[binned.phase]
    for (over_time, loops), part in zip(panels, parts, strict=True):
        force_mn = 1e3 * part.force_n
        shade_phases(over_time, binned.phases, cycles=part is parts[0])
        over_time.plot(binned.time_s, force_mn, color=MODEL, lw=0.9)
        for name, color in PHASE_COLORS.items():
            inside = kind == name
            loops.plot(displacement_mm[inside], force_mn[inside], ".", ms=2.0, color=color)
        for ax in (over_time, loops):
            ax.axhline(0.0, color=GREY, lw=0.6, zorder=1)
        along = f" with {', '.join(part.along)}" if part.along else ""
        over_time.set_title(f"{part.name}{along}: {1e3 * part.size_n:.1f} mN RMS")
        over_time.set_ylabel("force [mN]")
        low, high = min(force_mn.min(), 0.0), max(force_mn.max(), 0.0)
        reach = max(high - low, 0.1)  # rounding errors must not fill the panel
        over_time.set_ylim(low - 0.08 * reach, high + 0.22 * reach)
    phase_legend(panels[0, 1], binned.phases)
    panels[-1, 0].set_xlabel("time [s]")
    panels[-1, 1].set_xlabel("displacement [mm]")
    state_finding(
        figure,
        f"{parts[0].name} moves the force most, by {1e3 * parts[0].size_n:.1f} mN RMS",
        "Force at the best fit minus the force without the mechanism, with all other parameters unchanged.",
    )
    return figure
