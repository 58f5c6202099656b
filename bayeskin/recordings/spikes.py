"""Spikes of the load cell: told from noise by a running median, counted, and taken out.

A spike is a short excursion: at least one sample further from the running median than a threshold that
noise alone passes once in twenty recordings, with the samples beside it that are beyond two standard
deviations on the same side. An excursion of half the median's window or longer moves the median and is
no spike. The running median never crosses a break (a corner of the protocol, a step of the cell's zero),
and is continued past a break by odd reflection, so that it follows any monotone force, however curved.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_propagation, label, median_filter
from scipy.stats import norm

from bayeskin.types import Array, _FreezesArrays

FAMILY_WISE = 0.05  # probability that noise alone shows any spike in a whole recording
_WINDOW_S = 0.5
_SCALE_S = 2.5  # noise differs from one moment of a hold to another: its sd is local over this
_TAIL_SD = 2.0
_PASSES = 3  # spikes crowd: each pass takes the median of what the last one left
_FINEST = 1e-4
_HUBER = 2.5
# E min(z^2, k^2) of a standard normal z: what makes the winsorised variance consistent.
_CONSISTENT = 1 - 2 * norm.sf(_HUBER) - 2 * _HUBER * norm.pdf(_HUBER) + 2 * _HUBER**2 * norm.sf(_HUBER)


@dataclass(frozen=True)
class Despiked(_FreezesArrays):
    """A recording's force without its spikes, arrays (n,).

    force_n with the running median in place of spikes; median_n the running median; sd_n the local sd about
    it; spike +1 or -1 on samples of a spike, 0 elsewhere. A spike passes threshold_sd of those sds.
    """

    force_n: Array
    median_n: Array
    sd_n: Array
    spike: NDArray[np.int8]
    threshold_sd: float

    def events(self, start: int, stop: int) -> Array:
        """Sign of each spike (a run of samples is one) that begins in samples start..stop, (events,)."""
        return np.concatenate(
            [np.full(label(self.spike[start:stop] == sign)[1], float(sign)) for sign in (-1, 1)]
        )


def despike(time_s: Array, force_n: Array, breaks: Sequence[int]) -> Despiked:
    """Finds and removes spikes in force_n (n,).

    `breaks` are sample indices, 0 and n among them, that the running median must not cross.
    """
    interval_s = float(np.median(np.diff(time_s)))
    half = max(2, round(0.5 * _WINDOW_S / interval_s))
    block = max(50, round(_SCALE_S / interval_s))
    threshold = float(norm.isf(0.5 * FAMILY_WISE / len(force_n)))
    # A force has at least its rounding's noise, and no load cell is better than this share of its range.
    least = max(_least_step(force_n) / np.sqrt(12.0), _FINEST * float(np.ptp(force_n)), 1e-12)
    median, sd, spike = np.empty_like(force_n), np.empty_like(force_n), np.zeros(len(force_n), dtype=np.int8)
    for a, b in pairwise(breaks):
        x = force_n[a:b]
        for _ in range(_PASSES):
            left = np.where(spike[a:b] != 0, median[a:b], x) if spike[a:b].any() else x
            median[a:b] = running_median(left, half)
            residual = x - median[a:b]
            sd[a:b] = _local_sd(residual, spike[a:b] == 0, block, least)
            spike[a:b] = _excursions(residual / sd[a:b], threshold)
    return Despiked(np.where(spike != 0, median, force_n), median, sd, spike, threshold)


def running_median(values: Array, half: int) -> Array:
    """Median over 2 half + 1 samples, (n,); the ends continued by odd reflection about the end's level."""
    half = min(half, (len(values) - 1) // 2)
    if half < 1:
        return values.copy()
    ended = values.copy()
    for end in (slice(None), slice(None, None, -1)):  # a spike may stand on the end: its level by robust line
        inward = values[end]
        if len(inward) >= 9:
            ended[end][0] = 1.5 * np.median(inward[:5]) - 0.5 * np.median(inward[4:9])
    padded = np.pad(ended, half, mode="reflect", reflect_type="odd")
    return median_filter(padded, 2 * half + 1)[half:-half]


def huber_sd(residual: Array, start_sd: float) -> float:
    """The sd of the Gaussian core of residual (n,): winsorised at 2.5 sd (Huber 1964, proposal 2)."""
    sd = start_sd
    for _ in range(10):
        sd = float(np.sqrt(np.mean(np.clip(residual, -_HUBER * sd, _HUBER * sd) ** 2) / _CONSISTENT))
    return sd


def _least_step(force_n: Array) -> float:
    levels = np.unique(force_n)
    return float(np.min(np.diff(levels))) if len(levels) > 1 else 0.0


def _local_sd(residual: Array, kept: NDArray[np.bool_], block: int, least: float) -> Array:
    """The sd of residual block by block, (n,), begun from the quieter side: spikes are one-sided."""
    out = np.empty_like(residual)
    count = max(1, len(residual) // block)
    for part in np.array_split(np.arange(len(residual)), count):
        r = residual[part][kept[part]]
        sides = [np.median(np.abs(side)) for side in (r[r < 0], r[r > 0]) if len(side) > 5]
        quiet = 1.4826 * float(min(sides, default=0.0))
        out[part] = max(huber_sd(r, max(quiet, least)) if len(r) else 0.0, least)
    return out


def _excursions(z: Array, threshold: float) -> NDArray[np.int8]:
    out = np.zeros(len(z), dtype=np.int8)
    for sign in (-1, 1):
        seeds = sign * z > threshold
        if seeds.any():
            out[binary_propagation(seeds, mask=sign * z > _TAIL_SD)] = sign
    return out
