"""Distinguishes spikes of the load cell from noise by a running median, counts them, and removes them.

A spike is a short excursion of the force. At least one of its samples is farther from the running median
than a threshold, which noise alone exceeds in one of twenty recordings. The neighbouring samples that are
more than two standard deviations away on the same side belong to the spike too. An excursion of half the
median's window or longer moves the median and is not a spike. The running median never crosses a break (a
corner of the protocol, a step of the load cell's zero). Odd reflection continues the force beyond a break.
The median therefore follows any monotone force, however curved it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_propagation, label, median_filter
from scipy.stats import norm

from bayeskin.types import Array, FreezesArrays

_HUBER = 2.5  # number of sd at which residuals are winsorised
# This is E min(z^2, k^2) of a standard normal z. Dividing by it makes the winsorised variance consistent.
_CONSISTENT = 1 - 2 * norm.sf(_HUBER) - 2 * _HUBER * norm.pdf(_HUBER) + 2 * _HUBER**2 * norm.sf(_HUBER)


@dataclass(frozen=True)
class SpikeSettings:
    """Settings of the search for spikes.

    family_wise : probability that noise alone shows any spike in a whole recording
    window_s : width of the running median [s]
    scale_s : length of blocks [s] over which the sd of the noise is estimated, since the noise changes even
        within a hold
    tail : neighbouring samples that are this many sd away on the same side belong to the spike too
    passes : number of passes; spikes may be dense, so each pass takes the median of the force without the
        last pass's spikes
    finest : least sd of the noise, as a share of the force's range
    """

    family_wise: float = 0.05
    window_s: float = 0.5
    scale_s: float = 2.5
    tail: float = 2.0
    passes: int = 3
    finest: float = 1e-4


@dataclass(frozen=True)
class Despiked(FreezesArrays):
    """A recording's force without its spikes; all arrays have shape (n,).

    force_n : force [N] in which the running median replaces spikes
    median_n : running median [N]
    sd_n : local sd [N] of the noise about the running median
    spike : +1 or -1 on the samples of a spike, 0 elsewhere
    threshold_sd : a spike is farther than this many local sds from the running median
    """

    force_n: Array
    median_n: Array
    sd_n: Array
    spike: NDArray[np.int8]
    threshold_sd: float

    def events(self, start: int, stop: int) -> Array:
        """Returns the sign (events,) of each spike in samples start..stop.

        Consecutive samples of the same sign are one spike.
        """
        return np.concatenate(
            [np.full(label(self.spike[start:stop] == sign)[1], float(sign)) for sign in (-1, 1)]
        )


def despike(
    time_s: Array, force_n: Array, breaks: Sequence[int], settings: SpikeSettings = SpikeSettings()
) -> Despiked:
    """Finds spikes in force_n (n,) and removes them.

    `breaks` are sample indices, including 0 and n, that the running median must not cross.
    """
    interval_s = float(np.median(np.diff(time_s)))
    half = max(2, round(0.5 * settings.window_s / interval_s))
    block = max(50, round(settings.scale_s / interval_s))
    threshold = float(norm.isf(0.5 * settings.family_wise / len(force_n)))
    # Rounding alone gives every force some noise, and no load cell is better than `finest` of its range.
    finest_n = settings.finest * float(np.ptp(force_n))
    least = max(_least_step(force_n) / np.sqrt(12.0), finest_n, 1e-12)
    median, sd, spike = np.empty_like(force_n), np.empty_like(force_n), np.zeros(len(force_n), dtype=np.int8)
    for a, b in pairwise(breaks):
        force = force_n[a:b]
        for _ in range(settings.passes):
            cleaned = np.where(spike[a:b] != 0, median[a:b], force) if spike[a:b].any() else force
            median[a:b] = running_median(cleaned, half)
            residual = force - median[a:b]
            sd[a:b] = _local_sd(residual, spike[a:b] == 0, block, least)
            spike[a:b] = _excursions(residual / sd[a:b], threshold, settings.tail)
    return Despiked(np.where(spike != 0, median, force_n), median, sd, spike, threshold)


def running_median(values: Array, half: int) -> Array:
    """Returns the median (n,) over 2 half + 1 samples.

    At both ends, odd reflection about the level of the end continues the values.
    """
    half = min(half, (len(values) - 1) // 2)
    if half < 1:
        return values.copy()
    anchored = values.copy()
    # A spike may lie on the end itself, so a robust line gives the level of the end.
    for end in (slice(None), slice(None, None, -1)):
        inward = values[end]
        if len(inward) >= 9:
            anchored[end][0] = 1.5 * np.median(inward[:5]) - 0.5 * np.median(inward[4:9])
    padded = np.pad(anchored, half, mode="reflect", reflect_type="odd")
    return median_filter(padded, 2 * half + 1)[half:-half]


def huber_sd(residual: Array, start_sd: float) -> float:
    """Returns the sd of the Gaussian core of residual (n,), winsorised at 2.5 sd (Huber 1964, proposal 2)."""
    sd = start_sd
    for _ in range(10):
        sd = float(np.sqrt(np.mean(np.clip(residual, -_HUBER * sd, _HUBER * sd) ** 2) / _CONSISTENT))
    return sd


def _least_step(force_n: Array) -> float:
    levels = np.unique(force_n)
    return float(np.min(np.diff(levels))) if len(levels) > 1 else 0.0


def _local_sd(residual: Array, kept: NDArray[np.bool_], block: int, least: float) -> Array:
    """Returns the sd (n,) of the residual, block by block.

    The estimate starts from the side with the smaller deviations, because spikes are one-sided.
    """
    out = np.empty_like(residual)
    count = max(1, len(residual) // block)
    for part in np.array_split(np.arange(len(residual)), count):
        r = residual[part][kept[part]]
        sides = [np.median(np.abs(side)) for side in (r[r < 0], r[r > 0]) if len(side) > 5]
        quiet = 1.4826 * float(min(sides, default=0.0))
        out[part] = max(huber_sd(r, max(quiet, least)) if len(r) else 0.0, least)
    return out


def _excursions(z: Array, threshold: float, tail: float) -> NDArray[np.int8]:
    out = np.zeros(len(z), dtype=np.int8)
    for sign in (-1, 1):
        seeds = sign * z > threshold
        if seeds.any():
            out[binary_propagation(seeds, mask=sign * z > tail)] = sign
    return out
