"""Analyses the noise of a recording: its spikes, its correlation, its sd along each phase, and its steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from bayeskin.errors import InputError
from bayeskin.recordings.correlation import (
    WHITE,
    NoiseShape,
    effective_windows,
    expected_products,
    fit_shape,
    lagged_products,
    residual_windows,
)
from bayeskin.recordings.spikes import Despiked, despike
from bayeskin.recordings.steps import Step, find_steps
from bayeskin.types import Array, Phase, PhaseKind, Recording


@dataclass(frozen=True)
class NoiseSettings:
    """Settings of the analysis of noise.

    window_s : time [s] over which a parabola describes the force without noise
    least_window : least number of samples in a window
    least_window_slow : the same for a recording with fewer than `least_window` samples in `window_s`
    longest_share : longest window, as a share of the longest time between breaks
    after_break_s : time [s] that is left out after a corner or step, where the force changes too fast
    lag_s : longest lag [s] at which the correlation is measured
    capped : multiple of the median at which the variance of a window is capped in the mean over a phase
    """

    window_s: float = 2.5
    least_window: int = 20
    least_window_slow: int = 10
    longest_share: float = 0.7
    after_break_s: float = 1.0
    lag_s: float = 1.0
    capped: float = 3.0


NOISE = NoiseSettings()


@dataclass(frozen=True)
class LocalSd:
    """The noise's sd along one phase: log sd (k,) at window centres time_s (k,), and the sd of the phase."""

    time_s: Array
    log_sd: Array
    phase_sd_n: float

    def at(self, time_s: Array) -> Array:
        """Returns the sd [N] at the given times, in the same shape."""
        if not len(self.time_s):
            return np.full(np.shape(time_s), self.phase_sd_n)
        return np.exp(np.interp(time_s, self.time_s, self.log_sd))


@dataclass(frozen=True)
class NoiseAnalysis:
    """A recording's force without spikes, and its noise.

    `shapes` holds the correlation for each kind of phase, `local` the sd along each phase, and `steps` the
    steps of the load cell's zero in each phase.
    """

    despiked: Despiked
    shapes: Mapping[PhaseKind, NoiseShape]
    local: tuple[LocalSd, ...]
    steps: tuple[tuple[Step, ...], ...]
    bounds: NDArray[np.int64]  # (phases + 1,) sample indices


@dataclass(frozen=True)
class _Windows:
    """Residual windows (k, size) of one phase, their samples outside spikes, and their mean times (k,)."""

    residual: Array
    kept: NDArray[np.bool_]
    middle_s: Array


def analyse(recording: Recording, phases: Sequence[Phase], window_s: float = NOISE.window_s) -> NoiseAnalysis:
    """Returns the spikes, the correlation and local sd of the noise, and the steps of a recording.

    If the first round finds steps, a second round treats them as breaks of the force.

    window_s : time over which a parabola describes the force without noise, at least 20 samples, or 10 where
        they are more than an eighth of a second apart. With a long window, slow variations of the force count
        as noise. With a shorter window they do not.

    Raises InputError for a force that never changes, or in which no phase is long enough (about 30 samples,
    15 of a slow recording) to distinguish noise from force.
    """
    if np.ptp(recording.force_n) == 0.0:
        raise InputError(
            f"{recording.name}: force", f"it is {recording.force_n[0]:g} N throughout", "it must change"
        )
    time_s = recording.time_s
    bounds = np.searchsorted(time_s, [*(p.start_s for p in phases), np.inf])
    bounds[0] = 0
    first_round = _analyse_once(recording, phases, bounds, np.empty(0, dtype=np.int64), window_s)
    steps = _all_steps(time_s, first_round, phases)
    indices = np.searchsorted(time_s, [step.time_s for phase_steps in steps for step in phase_steps])
    last_round = _analyse_once(recording, phases, bounds, indices, window_s) if len(indices) else first_round
    return NoiseAnalysis(last_round.despiked, last_round.shapes, last_round.local, steps, bounds)


def _all_steps(
    time_s: Array, analysis: NoiseAnalysis, phases: Sequence[Phase]
) -> tuple[tuple[Step, ...], ...]:
    """Returns the steps of each phase.

    The first second after a corner is left out, because the force itself changes too fast there. A step
    raises the sd of the windows around it. The sd of a phase is therefore at most the median sd of its kind.
    """
    usual = {
        phase.kind: np.concatenate(
            [x.log_sd for x, p in zip(analysis.local, phases, strict=True) if p.kind == phase.kind]
        )
        for phase in phases
    }
    steps = []
    for phase, local, (a, b) in zip(phases, analysis.local, pairwise(analysis.bounds), strict=True):
        start = (
            a
            if a == 0
            else int(np.searchsorted(time_s, time_s[min(a, len(time_s) - 1)] + NOISE.after_break_s))
        )
        inside = slice(start, max(start, b))
        log_sds = usual[phase.kind]
        sd_n = min(local.phase_sd_n, float(np.exp(np.median(log_sds)))) if len(log_sds) else local.phase_sd_n
        shape, force_n = analysis.shapes[phase.kind], analysis.despiked.force_n
        steps.append(find_steps(time_s[inside], force_n[inside], sd_n, shape, len(time_s)))
    return tuple(steps)


def _analyse_once(
    recording: Recording, phases: Sequence[Phase], bounds: NDArray[np.int64], steps: NDArray[np.int64],
    window_s: float,
) -> NoiseAnalysis:  # fmt: skip
    """Returns the analysis without a search for steps.

    `bounds` (phases + 1,) are the sample indices of the phases. `steps` are sample indices that count as
    breaks of the force.
    """
    time_s = recording.time_s
    interval_s = float(np.median(np.diff(time_s)))
    breaks = np.unique(np.concatenate([bounds, steps]))
    despiked = despike(time_s, recording.force_n, breaks.tolist())
    longest = int(np.max(np.diff(breaks)))
    least = min(NOISE.least_window, max(NOISE.least_window_slow, round(NOISE.window_s / interval_s)))
    size = min(max(round(window_s / interval_s), least), int(NOISE.longest_share * longest))
    if size < least:
        problem = f"the number of samples in the longest phase is {longest}"
        fewest = round(least / NOISE.longest_share) + 1
        raise InputError(recording.name, problem, f"at least {fewest} are needed to estimate the noise")
    windows = [
        _phase_windows(time_s, despiked, breaks[(breaks >= a) & (breaks <= b)], size, interval_s)
        for a, b in pairwise(bounds)
    ]
    shapes = _shapes_by_kind(phases, windows, interval_s, size)
    local = _local_sds(phases, windows, shapes, interval_s, size)
    return NoiseAnalysis(despiked, shapes, local, (), bounds)


def _phase_windows(
    time_s: Array, despiked: Despiked, breaks: NDArray[np.int64], size: int, interval_s: float
) -> _Windows:
    """Returns the residual windows between the breaks of one phase, without the time soon after a break."""
    residual, kept, middle = [np.empty((0, size))], [np.empty((0, size), dtype=bool)], [np.empty(0)]
    for a, b in pairwise(breaks):
        a = a if a == 0 else a + min(round(NOISE.after_break_s / interval_s), (b - a) // 5)
        count = (b - a) // size
        start = a + (b - a - count * size) // 2
        inside = slice(start, start + count * size)
        residual.append(residual_windows(despiked.force_n[inside], size))
        kept.append((despiked.spike[inside] == 0).reshape(count, size))
        middle.append(time_s[inside].reshape(count, size).mean(axis=1))
    return _Windows(np.concatenate(residual), np.concatenate(kept), np.concatenate(middle))


def _shapes_by_kind(
    phases: Sequence[Phase], windows: Sequence[_Windows], interval_s: float, size: int
) -> dict[PhaseKind, NoiseShape]:
    """Returns the correlation of the noise for each kind of phase, from all windows of that kind.

    A kind without windows gets the correlation that all windows together have.
    """
    lags = min(round(NOISE.lag_s / interval_s), size // 2) + 1

    def fit(chosen: Sequence[_Windows]) -> NoiseShape:
        used = [w for w in chosen if len(w.residual)]
        products = [lagged_products(w.residual, w.kept, lags) for w in used]
        relative = [p / p[0] for p in products if p[0] > 0]
        weights = [int(np.count_nonzero(w.kept)) for w, p in zip(used, products, strict=True) if p[0] > 0]
        if not relative:
            return WHITE
        correlogram = np.average(relative, axis=0, weights=weights)
        return fit_shape(correlogram, sum(weights), interval_s, size)

    kinds = {phase.kind for phase in phases}
    of_kind = {k: [w for w, p in zip(windows, phases, strict=True) if p.kind == k] for k in kinds}
    return {k: fit(ws if any(len(w.residual) for w in ws) else windows) for k, ws in of_kind.items()}


def _local_sds(
    phases: Sequence[Phase],
    windows: Sequence[_Windows],
    shapes: Mapping[PhaseKind, NoiseShape],
    interval_s: float,
    size: int,
) -> tuple[LocalSd, ...]:
    """Returns the sd along each phase; a phase without windows gets the median sd of the other phases."""
    local: list[LocalSd | None] = []
    for phase, w in zip(phases, windows, strict=True):
        correlation = shapes[phase.kind].at(interval_s * np.arange(size))
        # Subtracting a parabola leaves this share of the variance.
        share_left = float(expected_products(correlation, 1)[0])
        variance = np.sum(w.residual**2 * w.kept, axis=1) / np.maximum(w.kept.sum(axis=1), 1) / share_left
        local.append(_shrink(w.middle_s, variance, effective_windows(shapes[phase.kind], interval_s, size)))
    usual = float(np.median([sd.phase_sd_n for sd in local if sd is not None]))
    return tuple(sd or LocalSd(np.empty(0), np.empty(0), usual) for sd in local)


def _shrink(middle_s: Array, variance: Array, freedom: float) -> LocalSd | None:
    """Returns the local sd from window variances (k,), which are shrunk towards the phase's variance.

    The more of their scatter chance explains, the stronger is the shrinkage. The result is None if no
    variance is positive. `freedom` is the number of degrees of freedom of a window.
    """
    positive = variance > 0
    if not positive.any():
        return None
    middle_s, log = middle_s[positive], np.log(variance[positive])
    centre = float(np.log(np.mean(np.exp(log)))) if len(log) < 5 else float(np.log(_capped_mean(np.exp(log))))
    excess = max(0.0, float(np.var(log)) - 2.0 / freedom)
    trust = excess / (excess + 2.0 / freedom)
    return LocalSd(middle_s, 0.5 * (centre + trust * (log - centre)), float(np.exp(0.5 * centre)))


def _capped_mean(values: Array) -> float:
    return float(np.mean(np.minimum(values, NOISE.capped * np.median(values))))
