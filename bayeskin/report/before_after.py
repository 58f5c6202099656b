"""Draws the fit of a recording without and with the best set of mechanisms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from bayeskin import inference
from bayeskin.inference.noise_model import bins_in_windows
from bayeskin.report.mismatch import Z90, Located
from bayeskin.report.style import (
    FAINT,
    GREY,
    INK,
    MODEL,
    PAGE_IN,
    RECORDED,
    axis_values,
    legend_above,
    list_symbols,
    new_figure,
    panel_title,
    parameter_label,
    plain_log,
    state_finding,
    styled,
)
from bayeskin.report.timeline import shade_phases
from bayeskin.types import PHASE_IN_WORDS, Array, BinnedForce, PadMotion, Parameter, Phase, PhaseKind

Summaries = Mapping[str, Mapping[str, Any]]  # "mean" and "interval90" of each parameter, by its name
BAND = "#B9D6EA"  # bands around lines in the colour MODEL
PANELS: tuple[PhaseKind, ...] = ("load", "unload", "hold", "rest")


class _DrawnFit(Protocol):
    """Lists what the figures need of a fit.

    force_n (m,) [N]; band_n : lower and upper edge (m,) [N] of the predictive band
    held_out_n (m,) : force [N] of a fit to the beginning of the recording alone, or None
    """

    @property
    def force_n(self) -> Array: ...
    @property
    def band_n(self) -> tuple[Array, Array]: ...
    @property
    def held_out_n(self) -> Array | None: ...


@styled
def figure_before_after(
    binned: BinnedForce, motion: PadMotion, before: _DrawnFit, after: _DrawnFit, split_s: float | None
) -> Figure:
    """Returns a figure of force and residual without and with the best set of mechanisms.

    split_s : time [s] up to which the fits to the beginning alone use the recording; None without such fits
    """
    rows = 2 if split_s is None else 3
    figure = new_figure(PAGE_IN, 1.5 + 1.4 * rows)
    grid = figure.add_gridspec(rows, 2, width_ratios=(1.9, 1))
    force = figure.add_subplot(grid[0, 0])
    residual = figure.add_subplot(grid[1, 0], sharex=force)
    loops = figure.add_subplot(grid[:2, 1])
    time_s, displacement_mm = binned.time_s, 1e3 * motion.at(binned.time_s)
    force.plot(time_s, 1e3 * binned.force_n, ".", ms=1.5, color=RECORDED, label="recorded")
    loops.plot(displacement_mm, 1e3 * binned.force_n, ".", ms=1.5, color=RECORDED)
    for fit, color, label in ((before, GREY, "before"), (after, MODEL, "after")):
        force.plot(time_s, 1e3 * fit.force_n, color=color, lw=0.9, label=label)
        residual.plot(time_s, 1e3 * (binned.force_n - fit.force_n), color=color, lw=0.8)
        loops.plot(displacement_mm, 1e3 * fit.force_n, color=color, lw=0.8)
    for ax, zero_n in ((force, 0.0), (residual, after.force_n)):
        low_mn, high_mn = (1e3 * (edge_n - zero_n) for edge_n in after.band_n)
        ax.fill_between(time_s, low_mn, high_mn, color=BAND, lw=0, zorder=0.5, label="90 % band")
    over_time = [force, residual]
    if split_s is not None:
        over_time.append(figure.add_subplot(grid[2, 0], sharex=force))
        _draw_held_out(
            over_time[-1], figure.add_subplot(grid[2, 1]), binned, motion, (before, after), split_s
        )
    for ax in over_time:
        shade_phases(ax, binned.phases, cycles=ax is force)
        ax.tick_params(labelbottom=ax is over_time[-1])
    force.margins(y=0.14)  # leaves space for the names of the cycles
    legend_above(force)
    force.set_ylabel("force [mN]")
    residual.set_ylabel("recorded − model [mN]")
    over_time[-1].set_xlabel("time [s]")
    loops.set(xlabel="displacement [mm]", ylabel="force [mN]")
    covered = [100.0 * inference.coverage(binned, *fit.band_n) for fit in (before, after)]
    panel_title(force, "a")
    panel_title(residual, "b", "bins inside the 90 % bands: {:.0f} → {:.0f} %".format(*covered))
    panel_title(loops, "c")
    rms = [1e3 * inference.rmse(binned, fit.force_n).whole_n for fit in (before, after)]
    state_finding(
        figure,
        "RMS residual {:.1f} mN before, {:.1f} mN after".format(*rms),
        "Before: best fit of the base model. After: best fit with the best set of mechanisms. Bands: "
        "predictive bands after, including noise; in b, minus the force after."
        + (" d, e: both fits, chosen and fitted up to the dashed line only." if split_s else ""),
    )
    return figure


def _draw_held_out(
    over_time: Axes,
    loops: Axes,
    binned: BinnedForce,
    motion: PadMotion,
    both: Sequence[_DrawnFit],
    split_s: float,
) -> None:
    """Draws the residual of the fits to the beginning over time.

    `loops` shows it over displacement, for the bins after the beginning only.
    """
    not_fitted = [(split_s, float(binned.edges_s[-1]))]
    bins = bins_in_windows(binned, not_fitted) >= 0
    sizes = []
    for fit, color in zip(both, (GREY, MODEL), strict=True):
        assert fit.held_out_n is not None
        residual_n = binned.force_n - fit.held_out_n
        over_time.plot(binned.time_s, 1e3 * residual_n, color=color, lw=0.8)
        loops.plot(1e3 * motion.at(binned.time_s[bins]), 1e3 * residual_n[bins], ".", ms=1.5, color=color)
        sizes.append(1e3 * inference.rmse(binned, fit.held_out_n, not_fitted).by_window_n[0])
    over_time.axvline(split_s, color=INK, lw=0.8, ls="--")
    over_time.set_ylabel("recorded − model [mN]")
    loops.set(xlabel="displacement [mm]", ylabel="recorded − model [mN]")
    title = "fitted up to {:.0f} s; later {:.1f} → {:.1f} mN RMS".format(split_s, *sizes)
    panel_title(over_time, "d", title)
    panel_title(loops, "e", "the part not fitted")


@styled
def figure_base_parameters(parameters: Sequence[Parameter], before: Summaries, after: Summaries) -> Figure:
    """Returns a figure of the base parameters' means and 90 % intervals, without and with the best set."""
    figure = new_figure(PAGE_IN, 1.0 + 0.42 * len(parameters))
    panels = np.atleast_1d(figure.subplots(len(parameters), 1))
    moved = []
    for ax, parameter in zip(panels, parameters, strict=True):
        for height, summaries, color in ((1, before, GREY), (0, after, MODEL)):
            summary = summaries[parameter.name]
            low, mean, high = axis_values(
                parameter, [summary["interval90"][0], summary["mean"], summary["interval90"][1]]
            )
            ax.plot([low, high], [height, height], color=color, lw=2.0, solid_capstyle="butt")
            ax.plot(mean, height, "o", ms=3.0, color=color)
        ax.set_xlim(*axis_values(parameter, [parameter.lower, parameter.upper]))
        ax.set_ylim(-0.7, 1.7)
        ax.set_yticks([])
        ax.spines["left"].set_visible(False)
        ax.set_ylabel(parameter_label(parameter), rotation=0, ha="right", va="center")
        if not _overlap(before[parameter.name], after[parameter.name]):
            moved.append(parameter.name)
    handles = [Line2D([], [], color=GREY, label="before"), Line2D([], [], color=MODEL, label="after")]
    panels[0].legend(
        handles=handles, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, borderaxespad=0.2
    )
    predicate = "moves out of its 90 % interval" if len(moved) == 1 else "move out of their 90 % intervals"
    state_finding(
        figure,
        f"{list_symbols(moved)} {predicate}" if moved else "No base parameter moves out of its 90 % interval",
        "Posterior means and 90 % intervals without (before) and with (after) the best set of mechanisms. A "
        "parameter moves out if its two intervals do not overlap. Axes: the range of the prior.",
    )
    return figure


def _overlap(parameter: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Returns whether the 90 % intervals of two parameter summaries overlap."""
    (low, high), (other_low, other_high) = parameter["interval90"], other["interval90"]
    return bool(low <= other_high and other_low <= high)


@styled
def figure_residual_by_phase(
    binned: BinnedForce, motion: PadMotion, before: Located, after: Located
) -> Figure:
    """Returns a figure of the residual in each kind of phase, without and with the best set.

    Each cycle has its own line.
    """
    kinds = [kind for kind in PANELS if any(phase.kind == kind for phase in binned.phases)]
    rows = (len(kinds) + 1) // 2
    figure = new_figure(PAGE_IN, 0.7 + 1.9 * rows)
    panels = list(figure.subplots(rows, 2, squeeze=False).flat)
    for spare in panels[len(kinds) :]:
        spare.set_visible(False)
    sizes = {}
    for ax, kind, letter in zip(panels, kinds, "abcd", strict=False):
        sizes[kind] = [_draw_kind(ax, kind, binned, motion, fit, fit is after) for fit in (before, after)]
        panel_title(ax, letter, "{}: {:.1f} → {:.1f} mN RMS".format(PHASE_IN_WORDS[kind], *sizes[kind]))
    handles = [Line2D([], [], color=GREY, label="before"), Line2D([], [], color=MODEL, label="after")]
    panels[0].margins(y=0.22)  # leaves space for the legend
    panels[0].legend(handles=[*handles, Patch(color=FAINT, label="allowed, 90 %")], loc="upper left", ncols=3)
    for ax in panels[::2]:
        ax.set_ylabel("recorded − model [mN]")
    most = max(sizes, key=lambda kind: sizes[kind][1])
    state_finding(
        figure,
        "Largest residual {}: {:.1f} mN RMS before, {:.1f} mN after".format(
            PHASE_IN_WORDS[most], *sizes[most]
        ),
        "Before: best fit of the base model. After: best fit with the best set of mechanisms. Later cycles "
        "are fainter. Allowed (after): measured noise, the model's own error and the uncertainty of the "
        "parameters.",
    )
    return figure


def _draw_kind(
    ax: Axes, kind: PhaseKind, binned: BinnedForce, motion: PadMotion, located: Located, last: bool
) -> float:
    """Draws the residual in all phases of a kind, and returns its RMS [mN].

    With `last`, it also draws the allowed range.
    """
    cycles = max(phase.cycle for phase in binned.phases)
    residual, allowed = 1e3 * located.residual_n, 1e3 * Z90 * located.allowed_n
    of_kind = np.zeros(len(residual), dtype=bool)
    for index, phase in enumerate(binned.phases):
        part = binned.phase[located.bins] == index
        if phase.kind != kind or not part.any():
            continue
        of_kind |= part
        x = _axis_position(phase, binned.time_s[located.bins[part]], motion)
        strength = 1.0 - 0.65 * max(phase.cycle - 1, 0) / max(cycles - 1, 1)
        ax.plot(x, residual[part], color=MODEL if last else GREY, alpha=strength, lw=0.8)
        if last:
            ax.fill_between(x, -allowed[part], allowed[part], color=FAINT, lw=0, zorder=0.5)
    if kind in ("hold", "rest"):
        ax.set(xlabel="time since the start of the phase [s]", xscale="log")
        plain_log(ax.xaxis)
    else:
        ax.set_xlabel("displacement [mm]")
    return float(np.sqrt(np.mean(residual[of_kind] ** 2))) if of_kind.any() else 0.0


def _axis_position(phase: Phase, time_s: Array, motion: PadMotion) -> Array:
    """Returns the positions of times (k,) [s] on the axis of the phase's kind.

    This is the displacement [mm] while the pads move, and the time since the phase's start [s] otherwise.
    """
    if phase.kind in ("hold", "rest"):
        return np.maximum(time_s - phase.start_s, 0.1)
    return 1e3 * motion.at(time_s)
