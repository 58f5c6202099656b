"""Draws the elements that figures over time share: shaded phases, fitted windows, bands of uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.patches import Patch
from numpy.typing import ArrayLike
from scipy.special import ndtri

from bayeskin.report.style import FAINT, GREY, INK, MODEL
from bayeskin.types import Array, Phase

PHASE_COLORS = {"rest": "#B0B0B0", "load": "#E69F00", "hold": "#009E73", "unload": "#CC79A7"}
LEVELS = (0.5, 0.9)
_OPACITY = {0.5: 0.42, 0.9: 0.2}


@dataclass(frozen=True)
class ForceBands:
    """Holds central predictive intervals [N] of the force in each bin, and the parts of the uncertainty.

    median_n (m,) : of the force without noise
    low_n, high_n (2, m) : ends of the intervals for LEVELS
    parts_n : half-width (m,) of the 90 % interval that each part of the uncertainty would give alone; "all"
        is the half-width of the whole 90 % interval
    """

    median_n: Array
    low_n: Array
    high_n: Array
    parts_n: dict[str, Array]


def predictive_bands(
    mean_n: ArrayLike, surrogate_sd_n: ArrayLike, noise_sd_n: ArrayLike, force_n: ArrayLike
) -> ForceBands:
    """Returns pointwise intervals in each bin from posterior predictive draws (s, m) [N].

    mean_n : force without noise at each draw
    surrogate_sd_n, noise_sd_n : sd of the surrogate's own error and of the noise at each draw, or (m,) where
        it is the same at all draws
    force_n : force with noise at each draw

    The intervals are quantiles of force_n. The parts of the surrogate and of the noise are treated as normal.
    """
    mean, force = (np.atleast_2d(np.asarray(values, dtype=float)) for values in (mean_n, force_n))
    tails = np.array([(1 - level) / 2 for level in LEVELS])
    low, high = np.quantile(force, tails, axis=0), np.quantile(force, 1 - tails, axis=0)
    model_low, model_high = np.quantile(mean, [tails[1], 1 - tails[1]], axis=0)
    z = ndtri(0.5 + LEVELS[1] / 2)
    surrogate, noise = (
        z * np.sqrt(np.mean(np.atleast_2d(np.asarray(sd, dtype=float)) ** 2, axis=0))
        for sd in (surrogate_sd_n, noise_sd_n)
    )
    parts = {
        "model": 0.5 * (model_high - model_low),
        "surrogate": surrogate,
        "noise": noise,
        "all": 0.5 * (high[1] - low[1]),
    }
    return ForceBands(np.median(mean, axis=0), low, high, parts)


def shade_phases(ax: Axes, phases: Sequence[Phase], cycles: bool = False) -> None:
    """Shades the axes by phase. With `cycles`, it writes the number of each cycle along the top."""
    for phase in phases:
        if phase.kind != "rest":
            tint = tuple(1 - 0.1 * (1 - c) for c in to_rgb(PHASE_COLORS[phase.kind]))
            ax.axvspan(phase.start_s, phase.end_s, color=tint, lw=0, zorder=0)
    if phases:
        ax.set_xlim(min(p.start_s for p in phases), max(p.end_s for p in phases))
    if cycles:
        for cycle in sorted({p.cycle for p in phases if p.cycle > 0}):
            moving = [p for p in phases if p.cycle == cycle and p.kind != "rest"]
            span = moving or [p for p in phases if p.cycle == cycle]
            middle = 0.5 * (min(p.start_s for p in span) + max(p.end_s for p in span))
            ax.text(
                middle, 0.98, f"cycle {cycle}", ha="center", va="top", color=GREY, fontsize=6.5,
                transform=ax.get_xaxis_transform(),
            )  # fmt: skip


def phase_legend(ax: Axes, phases: Sequence[Phase]) -> None:
    """Adds a one-line legend of the kinds of phase that occur, above the axes at the right."""
    present = [kind for kind in PHASE_COLORS if kind != "rest" and any(p.kind == kind for p in phases)]
    handles = [Patch(facecolor=PHASE_COLORS[kind], alpha=0.35, label=kind) for kind in present]
    if handles:
        key = ax.legend(
            handles=handles, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=len(handles),
            handlelength=1.0, columnspacing=1.0, handletextpad=0.4,
        )  # fmt: skip
        ax.add_artist(key)
        ax.legend_ = None  # allows a second legend inside the axes


def draw_bands(ax: Axes, x: ArrayLike, low: Array, high: Array) -> None:
    """Fills the 50 % and 90 % bands between low and high (2, m) for LEVELS, in the unit of the axes."""
    for level, lower, upper in reversed(list(zip(LEVELS, low, high, strict=True))):
        name = f"{100 * level:.0f} % band"
        ax.fill_between(np.asarray(x), lower, upper, color=MODEL, alpha=_OPACITY[level], lw=0, label=name)


def runs_of(mask: ArrayLike) -> list[tuple[int, int]]:
    """Returns start and end (exclusive) of each unbroken sequence of True in a mask (m,)."""
    padded = np.concatenate([[False], np.asarray(mask, dtype=bool), [False]]).astype(np.int8)
    steps = np.diff(padded)
    starts, ends = np.flatnonzero(steps == 1).tolist(), np.flatnonzero(steps == -1).tolist()
    return list(zip(starts, ends, strict=True))


def mark_windows(ax: Axes, edges_s: Array, chosen: ArrayLike, label: str) -> None:
    """Draws a labelled bar along the bottom of the axes for chosen bins; edges_s (m+1,), chosen (m,)."""
    for start, end in runs_of(chosen):
        ax.plot(
            [edges_s[start], edges_s[end]], [0, 0], transform=ax.get_xaxis_transform(), color=INK,
            lw=3, solid_capstyle="butt", clip_on=False, zorder=5,
        )  # fmt: skip
        ax.annotate(
            label, (edges_s[start], 0), xycoords=ax.get_xaxis_transform(), xytext=(2, 2.5),
            textcoords="offset points", fontsize=6.5, va="bottom",
        )  # fmt: skip


def draw_motion(ax: Axes, time_s: ArrayLike, displacement_m: ArrayLike) -> None:
    """Draws the displacement as a faint line, scaled to the height of the axes, without its own axis."""
    displacement = np.asarray(displacement_m, dtype=float)
    low, reach = np.min(displacement), np.ptp(displacement)
    scaled = 0.04 + 0.86 * (displacement - low) / (reach or 1.0)
    ax.plot(
        np.asarray(time_s), scaled, transform=ax.get_xaxis_transform(), color=FAINT, lw=1.0, zorder=0.5,
        label="displacement (scaled)",
    )  # fmt: skip
