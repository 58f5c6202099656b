"""Draws the force that a model leaves unexplained, and the further tests that would show its cause."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from bayeskin.report.mismatch import Z90
from bayeskin.report.style import (
    ACCENT,
    FAINT,
    GREY,
    INK,
    MODEL,
    PAGE_IN,
    RECORDED,
    new_figure,
    panel_title,
    plain_log,
    state_finding,
    styled,
)
from bayeskin.report.timeline import phase_legend, shade_phases
from bayeskin.types import Array, BinnedForce, PadMotion, PhaseKind

COLORS = {"load": ACCENT, "unload": MODEL, "hold": "#009E73", "rest": GREY}


class _Discrepancy(Protocol):
    """Lists what the figure needs of a `bayeskin.mismatch.discrepancy.Discrepancy`."""

    @property
    def bins(self) -> NDArray[np.int64]: ...
    @property
    def mean_n(self) -> Array: ...
    @property
    def sd_n(self) -> Array: ...
    @property
    def beyond_n(self) -> Array: ...
    @property
    def size_n(self) -> float: ...
    @property
    def noticeable(self) -> bool: ...
    @property
    def features(self) -> Sequence[str]: ...


class _Test(Protocol):
    """Lists what the figure needs of a `bayeskin.experiments.protocols.Protocol`."""

    @property
    def name(self) -> str: ...
    @property
    def motion(self) -> PadMotion: ...


class _Experiment(Protocol):
    """Lists what the figure needs of a `bayeskin.experiments.choice.Experiment`."""

    @property
    def protocol(self) -> _Test: ...
    @property
    def gain_bits(self) -> float: ...
    @property
    def standard_error(self) -> float: ...
    @property
    def named(self) -> float: ...
    @property
    def possible_bits(self) -> float: ...


@styled
def figure_discrepancy(binned: BinnedForce, motion: PadMotion, discrepancy: _Discrepancy) -> Figure:
    """Returns a figure of the discrepancy over time, over displacement by direction, and after a corner.

    motion : motion of the pads in the recording
    found : the discrepancy at a fit
    """
    figure = new_figure(PAGE_IN, 4.6)
    grid = figure.add_gridspec(2, 2, height_ratios=(1.15, 1))
    over_time = figure.add_subplot(grid[0, :])
    over_displacement, over_memory = (figure.add_subplot(grid[1, i]) for i in (0, 1))
    _draw_over_time(over_time, binned, discrepancy)
    _draw_phases(over_displacement, binned, motion, discrepancy, ("load", "unload"))
    _draw_phases(over_memory, binned, motion, discrepancy, ("hold", "rest"))
    for ax in (over_displacement, over_memory):
        ax.axhline(0.0, color=GREY, lw=0.6, zorder=1)
        ax.set_ylabel("unexplained [mN]")
    over_displacement.set_xlabel("displacement [mm]")
    over_memory.set(xlabel="time since the start of the phase [s]", xscale="log")
    plain_log(over_memory.xaxis)
    panel_title(over_time, "a")
    panel_title(over_displacement, "b", "while the pads move")
    panel_title(over_memory, "c", "while the pads are still")
    finding = (
        f"The model leaves {1e3 * discrepancy.size_n:.1f} mN RMS unexplained"
        if discrepancy.noticeable
        else "The model leaves nothing but noise unexplained"
    )
    features = "; ".join(discrepancy.features)
    state_finding(
        figure, finding,
        "Dots: the part of the residual that no change of the parameters can explain. Lines and bands: the "
        "discrepancy and its 90 % interval; in b and c, later cycles are fainter. "
        f"{features[:1].upper()}{features[1:]}.",
    )  # fmt: skip
    return figure


def _draw_over_time(ax: Axes, binned: BinnedForce, discrepancy: _Discrepancy) -> None:
    time_s = binned.time_s[discrepancy.bins]
    shade_phases(ax, binned.phases, cycles=True)
    phase_legend(ax, binned.phases)
    ax.plot(
        time_s, 1e3 * discrepancy.beyond_n, ".", ms=1.8, color=RECORDED, alpha=0.5, lw=0, label="residual"
    )
    low, high = (1e3 * (discrepancy.mean_n + sign * Z90 * discrepancy.sd_n) for sign in (-1, 1))
    for part in _unbroken(discrepancy.bins):
        ax.fill_between(time_s[part], low[part], high[part], color=MODEL, alpha=0.3, lw=0)
        ax.plot(time_s[part], 1e3 * discrepancy.mean_n[part], color=MODEL, lw=0.9)
    ax.axhline(0.0, color=GREY, lw=0.6, zorder=1)
    ax.margins(y=0.12)
    ax.set(xlabel="time [s]", ylabel="unexplained force [mN]")


def _draw_phases(
    ax: Axes, binned: BinnedForce, motion: PadMotion, discrepancy: _Discrepancy, kinds: Sequence[PhaseKind]
) -> None:
    """Draws a line with its band for each phase of `kinds`. Later cycles are fainter."""
    last = max((phase.cycle for phase in binned.phases), default=1)
    drawn_kinds = set()
    for index, phase in enumerate(binned.phases):
        part = np.flatnonzero(binned.phase[discrepancy.bins] == index)
        if phase.kind not in kinds or not len(part) or (phase.kind == "rest" and phase.cycle == 0):
            continue
        time_s = binned.time_s[discrepancy.bins[part]]
        still = phase.kind in ("hold", "rest")
        x = np.maximum(time_s - phase.start_s, 0.1) if still else 1e3 * motion.at(time_s)
        mean, half = 1e3 * discrepancy.mean_n[part], 1e3 * Z90 * discrepancy.sd_n[part]
        color, strength = COLORS[phase.kind], 1.0 - 0.6 * max(phase.cycle - 1, 0) / max(last - 1, 1)
        ax.plot(x, 1e3 * discrepancy.beyond_n[part], ".", ms=1.5, color=color, alpha=0.35 * strength)
        ax.fill_between(x, mean - half, mean + half, color=color, alpha=0.18 * strength, lw=0)
        ax.plot(x, mean, color=color, alpha=strength, lw=1.1)
        drawn_kinds.add(phase.kind)
    handles = [Line2D([], [], color=COLORS[kind], label=kind) for kind in kinds if kind in drawn_kinds]
    if handles:
        ax.legend(
            handles=handles,
            loc="lower right",
            bbox_to_anchor=(1.0, 1.0),
            ncols=len(handles),
            columnspacing=1.0,
        )


def _unbroken(bins: NDArray[np.int64]) -> list[slice]:
    """Returns a slice for each sequence of neighbouring bins."""
    cuts = [0, *(np.flatnonzero(np.diff(bins) != 1) + 1).tolist(), len(bins)]
    return [slice(a, b) for a, b in pairwise(cuts)]


@styled
def figure_experiments(table: Sequence[_Experiment]) -> Figure:
    """Returns a figure of each protocol's expected information [bits], with a sketch of its motion.

    table : experiments, the most informative first, which stands at the top; those without a finite
        estimate are not drawn
    """
    rows = [experiment for experiment in reversed(table) if np.isfinite(experiment.gain_bits)]
    figure = new_figure(PAGE_IN, 1.1 + 0.3 * max(len(rows), 3))
    sketch, ax = figure.subplots(1, 2, sharey=True, width_ratios=(1, 2.2))
    position = np.arange(len(rows))
    gain = np.array([experiment.gain_bits for experiment in rows])
    ax.barh(position, gain, color=[MODEL if i == len(rows) - 1 else FAINT for i in position], height=0.55)
    ax.errorbar(
        gain,
        position,
        xerr=[experiment.standard_error for experiment in rows],
        fmt="none",
        ecolor=INK,
        elinewidth=0.8,
    )
    reach = max((float(experiment.protocol.motion.displacement_m.max()) for experiment in rows), default=1.0)
    for y, experiment in zip(position, rows, strict=True):
        end_s = float(experiment.protocol.motion.time_s[-1])
        sketch.plot(
            experiment.protocol.motion.time_s / end_s,
            y - 0.28 + 0.56 * experiment.protocol.motion.displacement_m / reach,
            color=INK,
            lw=0.8,
        )
        sketch.text(1.03, y, f"{end_s:.0f} s", va="center", color=GREY, fontsize=6.5)
        ax.text(
            1.0, y, f"{100 * experiment.named:.0f} %", va="center", ha="right", color=GREY, fontsize=6.5,
            transform=ax.get_yaxis_transform(),
        )  # fmt: skip
    possible = table[0].possible_bits if table else 0.0
    ax.axvline(possible, color=ACCENT, lw=0.8, ls=(0, (4, 2)))
    ax.text(possible, len(rows) - 0.45, "certainty ", color=ACCENT, ha="right", va="bottom", fontsize=6.5)
    ax.set(
        xlabel="expected information about the true explanation [bits]", xlim=(0.0, 1.15 * possible or 1.0)
    )
    ax.set_ylim(-0.6, max(len(rows), 1) - 0.1)
    ax.tick_params(left=False)
    sketch.set_yticks(position, [experiment.protocol.name for experiment in rows])
    sketch.set(xlim=(-0.02, 1.3), xticks=[], xlabel="displacement over the test")
    sketch.spines[["left", "bottom"]].set_visible(False)
    sketch.tick_params(left=False)
    finding = (
        f"“{rows[-1].protocol.name[0].upper()}{rows[-1].protocol.name[1:]}” is the most informative next test"
        if len(rows) and gain[-1] > 0.0
        else "None of these tests is expected to show what is missing"
    )
    state_finding(
        figure, finding,
        "Lines: standard error over posterior draws. Percentages: expected probability of the right "
        "explanation after the test. Times: duration of the test.",
    )  # fmt: skip
    return figure
