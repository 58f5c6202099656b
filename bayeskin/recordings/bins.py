"""Bin means of a recording's force, spikes taken out, with the variance that correlated noise leaves them.

The mean over a bin is the integral of the straight lines between samples, divided by the bin's width: it
is the bin's mean of any force, whether a slope, a corner or a step lies in the bin, and wherever the
samples fall. A spike's samples are replaced by the running median, not dropped, so that neither a slope nor
the spike's sign moves the mean. Under Gaussian noise next to nothing is replaced, and the mean keeps the
efficiency of the plain one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bayeskin.errors import InputError
from bayeskin.recordings.correlation import NoiseShape, weighted_covariance
from bayeskin.recordings.noise import NoiseAnalysis, analyse
from bayeskin.types import Array, BinnedForce, PadMotion, Phase, Recording

MOST_BINS = 1_000_000


def uniform_edges(recording_or_end_s: Recording | float, width_s: float = 0.5) -> Array:
    """Edges [s] (m+1,) of the whole bins of `width_s` from 0 to the recording's end, or to the time given.

    Raises InputError where there would be more than `MOST_BINS`.
    """
    last = recording_or_end_s
    end_s = float(last.time_s[-1]) if isinstance(last, Recording) else float(last)
    if not end_s < MOST_BINS * width_s:
        found = f"{width_s:g} s for {end_s:g} s"
        raise InputError("bin_width_s", found, f"bins so wide that they are fewer than {MOST_BINS}")
    return width_s * np.arange(int(end_s / width_s + 1e-6) + 1, dtype=float)


def covered_s(recording: Recording, motion: PadMotion) -> float:
    """Until when [s] samples stand for the force within a protocol: each for an interval, the last too."""
    return float(min(recording.time_s[-1] + _interval_s(recording), motion.time_s[-1]))


def _interval_s(recording: Recording) -> float:
    return float(np.median(np.diff(recording.time_s)))


def bin_recording(
    recording: Recording, phases: Sequence[Phase], edges_s: Array, analysis: NoiseAnalysis | None = None
) -> BinnedForce:
    """Robust bin means of the force with their variances and the correlation of neighbours.

    Each bin takes the correlation of noise of its phase's kind, and the local sd of noise at its middle.

    Parameters
    ----------
    edges_s : (m+1,) increasing, within the recording or an interval after it, over which its last sample
        stays; every bin holds two samples at least
    analysis : `analyse(recording, phases)`, where it is at hand already

    Raises
    ------
    InputError : edges that leave the recording or do not increase, or bins with fewer than two samples.
    """
    edges_s = np.asarray(edges_s, dtype=float)
    _refuse_edges(recording, edges_s)
    analysis = analysis or analyse(recording, phases)
    force_n = _integral(recording.time_s, analysis.despiked.force_n, edges_s)
    phase = _covering_phase(phases, edges_s)
    variance, correlation = _noise_of_means(recording, phases, analysis, edges_s, phase)
    return BinnedForce(edges_s, force_n, variance, correlation, phase, tuple(phases))


def _refuse_edges(recording: Recording, edges_s: Array) -> None:
    time_s = recording.time_s
    where = f"{recording.name}: bin edges"
    if edges_s.ndim != 1 or len(edges_s) < 2 or not np.all(np.diff(edges_s) > 0):
        raise InputError(where, "edges that do not increase", "at least two increasing times")
    slack = 1e-6 * (edges_s[1] - edges_s[0])
    last_s = time_s[-1] + _interval_s(recording)
    if edges_s[0] < time_s[0] - slack or edges_s[-1] > last_s + slack:
        found = f"{edges_s[0]:g} to {edges_s[-1]:g} s"
        raise InputError(where, found, f"times within {time_s[0]:g} to {last_s:g} s")
    counts = np.diff(np.searchsorted(time_s, edges_s - slack))
    if counts.min() < 2:
        thin = int(np.argmin(counts))
        raise InputError(
            where, f"{counts[thin]} samples in {edges_s[thin]:g}-{edges_s[thin + 1]:g} s", "at least 2"
        )


def _integral(time_s: Array, values: Array, edges_s: Array) -> Array:
    """Mean over each bin, (m,), of the straight lines between samples (n,), and of the last one after it."""
    origin = values.mean()  # keeps the running sum small, and its rounding with it
    y = values - origin
    sums = np.concatenate([[0.0], np.cumsum(0.5 * (y[1:] + y[:-1]) * np.diff(time_s))])
    i = np.clip(np.searchsorted(time_s, edges_s, side="right") - 1, 0, len(time_s) - 2)
    past = np.clip(edges_s - time_s[i], 0.0, None)
    slope = (y[i + 1] - y[i]) / (time_s[i + 1] - time_s[i])
    at_edges = sums[i] + y[i] * past + 0.5 * slope * past**2
    after = edges_s > time_s[-1]
    at_edges[after] = sums[-1] + y[-1] * (edges_s[after] - time_s[-1])
    return origin + np.diff(at_edges) / np.diff(edges_s)


def _covering_phase(phases: Sequence[Phase], edges_s: Array) -> NDArray[np.int64]:
    """Index of the phase that covers most of each bin, (m,)."""
    start = np.array([p.start_s for p in phases])[:, None]
    end = np.array([p.end_s for p in phases])[:, None]
    overlap = np.minimum(end, edges_s[1:]) - np.maximum(start, edges_s[:-1])
    return np.argmax(overlap, axis=0)


def _noise_of_means(
    recording: Recording,
    phases: Sequence[Phase],
    analysis: NoiseAnalysis,
    edges_s: Array,
    phase: NDArray[np.int64],
) -> tuple[Array, Array]:
    """Variance [N^2] (m,) of each mean and correlation (m-1,) of neighbours.

    Where spikes were replaced, the white part is that of the samples that are left.
    """
    time_s = recording.time_s
    interval_s = _interval_s(recording)
    middle = 0.5 * (edges_s[1:] + edges_s[:-1])
    sd = np.empty(len(middle))
    for i in np.unique(phase):
        sd[phase == i] = analysis.local[i].at(middle[phase == i])
    bounds = np.searchsorted(time_s, edges_s - 1e-6 * interval_s)
    count = np.diff(bounds)
    spiked = np.diff(np.concatenate([[0], np.cumsum(analysis.despiked.spike != 0)])[bounds])
    kinds = np.array([phases[i].kind for i in phase])
    variance, neighbour = np.empty(len(middle)), np.empty(len(middle))
    for kind, n in {(str(k), int(c)) for k, c in zip(kinds, count, strict=True)}:
        own = (kinds == kind) & (count == n)
        shape = analysis.shapes[kind]  # type: ignore[index]
        white, slow, neighbour[own] = _unit_mean(shape, n, interval_s)
        variance[own] = sd[own] ** 2 * (white * n / np.maximum(n - spiked[own], 1) + slow)
    return variance, np.sqrt(neighbour[1:] * neighbour[:-1])


def _unit_mean(shape: NoiseShape, count: int, interval_s: float) -> tuple[float, float, float]:
    """White and correlated variance of a bin's mean under unit noise, and the correlation of neighbours."""
    first = np.zeros(2 * count + 1)
    first[: count + 1] = 1.0 / count
    first[[0, count]] *= 0.5
    second = first[::-1]
    lag_s = interval_s * np.arange(len(first))
    total = weighted_covariance(first, first, shape.at(lag_s))
    white = shape.white_share * float(first @ first)
    return white, total - white, weighted_covariance(first, second, shape.at(lag_s)) / total
