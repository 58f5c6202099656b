"""Averages a recording's force in bins, without spikes, and computes the variance of these means.

The variance takes the correlation of the noise in time into account. The mean over a bin is the integral of
the straight lines between samples, divided by the bin's width. It is therefore the mean of any force over the
bin, whether the bin contains a slope, a corner or a step, and wherever the samples lie. The running median
replaces the samples of a spike. They are not dropped, so that neither a slope nor the spike's sign changes
the mean. Under Gaussian noise almost no sample is replaced, so the mean is as efficient as the ordinary mean.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bayeskin.errors import InputError
from bayeskin.recordings.correlation import NoiseShape, weighted_covariance
from bayeskin.recordings.noise_analysis import NoiseAnalysis, analyse
from bayeskin.types import Array, BinnedForce, PadMotion, Phase, Recording

MOST_BINS = 1_000_000
BIN_WIDTH_S = 0.5
_WIDER_S = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0)


def fitting_width_s(recording: Recording) -> float:
    """Returns the width [s] of bins that suits a recording: 0.5 s, or more where samples are far apart."""
    least = 2 * _interval_s(recording) * (1 - 1e-6)
    return next((width for width in (BIN_WIDTH_S, *_WIDER_S) if width >= least), _WIDER_S[-1])


def uniform_edges(recording_or_end_s: Recording | float, width_s: float = BIN_WIDTH_S) -> Array:
    """Returns the edges [s] (m+1,) of whole bins of `width_s`, from 0 to the recording's end or a given time.

    Raises InputError if there would be `MOST_BINS` bins or more.
    """
    source = recording_or_end_s
    end_s = float(source.time_s[-1]) if isinstance(source, Recording) else float(source)
    if not end_s < MOST_BINS * width_s:
        problem = f"{width_s:g} s is too short for a recording of {end_s:g} s"
        raise InputError("bin_width_s", problem, f"use a width that gives fewer than {MOST_BINS} bins")
    return width_s * np.arange(int(end_s / width_s + 1e-6) + 1, dtype=float)


def covered_s(recording: Recording, motion: PadMotion) -> float:
    """Returns the time [s] until which samples represent the force, at most the end of the protocol.

    Each sample, the last one included, represents the force over one sampling interval.
    """
    return float(min(recording.time_s[-1] + _interval_s(recording), motion.time_s[-1]))


def _interval_s(recording: Recording) -> float:
    return float(np.median(np.diff(recording.time_s)))


def bin_recording(
    recording: Recording, phases: Sequence[Phase], edges_s: Array, analysis: NoiseAnalysis | None = None
) -> BinnedForce:
    """Returns robust bin means of the force, their variances and the correlation of neighbouring bins.

    For each bin, the correlation of the noise is that of the phase's kind. The sd of the noise is the local
    sd in the middle of the bin.

    Parameters
    ----------
    edges_s : (m+1,) increasing edges. They lie within the recording or at most one sampling interval after
        it, where the force of the last sample is held. Every bin contains at least two samples.
    analysis : the result of `analyse(recording, phases)`, if it has already been computed

    Raises
    ------
    InputError : the edges leave the recording or do not increase, or a bin has fewer than two samples.
    """
    edges_s = np.asarray(edges_s, dtype=float)
    _refuse_edges(recording, edges_s)
    analysis = analysis or analyse(recording, phases)
    force_n = _bin_means(recording.time_s, analysis.despiked.force_n, edges_s)
    phase = _covering_phase(phases, edges_s)
    variance, correlation = _noise_of_means(recording, phases, analysis, edges_s, phase)
    return BinnedForce(edges_s, force_n, variance, correlation, phase, tuple(phases))


def _refuse_edges(recording: Recording, edges_s: Array) -> None:
    time_s = recording.time_s
    where = f"{recording.name}: bin edges"
    if edges_s.ndim != 1 or len(edges_s) < 2 or not np.all(np.diff(edges_s) > 0):
        raise InputError(where, "the edges do not increase", "at least two increasing times are needed")
    slack = 1e-6 * (edges_s[1] - edges_s[0])
    last_s = time_s[-1] + _interval_s(recording)
    if edges_s[0] < time_s[0] - slack or edges_s[-1] > last_s + slack:
        problem = f"the edges reach from {edges_s[0]:g} to {edges_s[-1]:g} s"
        raise InputError(where, problem, f"they must lie within {time_s[0]:g} to {last_s:g} s")
    counts = np.diff(np.searchsorted(time_s, edges_s - slack))
    if counts.min() < 2:
        fewest = int(np.argmin(counts))
        bin_s = f"the bin from {edges_s[fewest]:g} to {edges_s[fewest + 1]:g} s"
        problem = f"the number of samples in {bin_s} is {counts[fewest]}"
        raise InputError(
            where, problem, "each bin needs at least 2, and fit.bin_width_s is the width of a bin"
        )


def _bin_means(time_s: Array, values: Array, edges_s: Array) -> Array:
    """Returns the mean (m,) over each bin of the straight lines between samples (n,).

    After the last sample, its value is held.
    """
    origin = values.mean()  # subtracting the mean keeps the running sum and its rounding error small
    centred = values - origin
    sums = np.concatenate([[0.0], np.cumsum(0.5 * (centred[1:] + centred[:-1]) * np.diff(time_s))])
    i = np.clip(np.searchsorted(time_s, edges_s, side="right") - 1, 0, len(time_s) - 2)
    past = np.clip(edges_s - time_s[i], 0.0, None)
    slope = (centred[i + 1] - centred[i]) / (time_s[i + 1] - time_s[i])
    at_edges = sums[i] + centred[i] * past + 0.5 * slope * past**2
    after = edges_s > time_s[-1]
    at_edges[after] = sums[-1] + centred[-1] * (edges_s[after] - time_s[-1])
    return origin + np.diff(at_edges) / np.diff(edges_s)


def _covering_phase(phases: Sequence[Phase], edges_s: Array) -> NDArray[np.int64]:
    """Returns the index (m,) of the phase that covers most of each bin."""
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
    """Returns the variance [N^2] (m,) of each mean and the correlation (m-1,) of neighbouring bins.

    Where spikes were replaced, only the remaining samples reduce the white part of the variance.
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
        selected = (kinds == kind) & (count == n)
        shape = analysis.shapes[kind]  # type: ignore[index]
        white, slow, neighbour[selected] = _unit_variance_of_mean(shape, n, interval_s)
        variance[selected] = sd[selected] ** 2 * (white * n / np.maximum(n - spiked[selected], 1) + slow)
    return variance, np.sqrt(neighbour[1:] * neighbour[:-1])


def _unit_variance_of_mean(shape: NoiseShape, count: int, interval_s: float) -> tuple[float, float, float]:
    """Returns the white and the correlated variance of a bin's mean, and the correlation of neighbours.

    The noise has unit variance and a bin has `count` samples.
    """
    first = np.zeros(2 * count + 1)
    first[: count + 1] = 1.0 / count
    first[[0, count]] *= 0.5
    second = first[::-1]
    lag_s = interval_s * np.arange(len(first))
    total = weighted_covariance(first, first, shape.at(lag_s))
    white = shape.white_share * float(first @ first)
    return white, total - white, weighted_covariance(first, second, shape.at(lag_s)) / total
