"""Bounds of the noise of a diagnosis, from the recording itself.

The noise of a diagnosis contains only what an instrument does from moment to moment. Its sd is bounded by the
scatter that the recording shows within bins, and its memory is at most ten seconds. Anything larger or longer
must be explained by physics, because noise that could explain it would leave no mismatch to find. Therefore
swings of the force that are slower than a second, such as those by breathing, must not count as noise within
bins.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bayeskin.inference import NoisePriors
from bayeskin.types import Array, BinnedForce


@dataclass(frozen=True)
class NoiseBounds:
    """Settings of the bounds of the noise.

    share : largest sd of the noise with a memory, over the median sd of a bin's own mean
    quick_s, quick_times : the sd of a bin's mean may be at most `quick_times` times the sd by noise that is
        quicker than `quick_s` [s]
    tails : smallest tail index: nearly normal, because robust means of bins contain no spikes
    """

    share: float = 3.0
    quick_s: float = 1.0
    quick_times: float = 2.5
    tails: float = 50.0


NOISE_BOUNDS = NoiseBounds()


def without_swings(binned: BinnedForce, quick_n2: Array) -> BinnedForce:
    """Returns the bins with smaller variances where slow swings of the force have enlarged them.

    For each kind of phase, the median sd of the means is then at most `quick_times` times the sd by quick
    noise. No variance changes if this is already true of the median over all bins.

    quick_n2 (m,) : variance of the means by noise that is quicker than `quick_s` [N^2]
    """
    variance, kinds = binned.variance_n2.copy(), np.array([binned.phases[i].kind for i in binned.phase])

    def share(selected: NDArray[np.bool_]) -> float:
        usual, quick = float(np.median(variance[selected])), float(np.median(quick_n2[selected]))
        return min(1.0, NOISE_BOUNDS.quick_times**2 * quick / usual) if usual > 0.0 else 1.0

    if share(np.full(len(kinds), True)) < 1.0:
        for selected in (kinds == kind for kind in np.unique(kinds)):
            variance[selected] *= share(selected)
    return replace(binned, variance_n2=variance)


def instrument_noise(binned: BinnedForce) -> NoisePriors:
    """Returns the bounds of the noise of a diagnosis, from the scatter within the recording's bins.

    With several recordings, the bounds are those of the noisiest one.
    """
    typical = max(float(np.sqrt(np.nanmedian(part.variance_n2))) for part in binned.parts)
    lowest = NoisePriors().sd_n[0]
    return NoisePriors(
        sd_n=(lowest, max(NOISE_BOUNDS.share * typical, 2.0 * lowest)),
        nu=(NOISE_BOUNDS.tails, NoisePriors().nu[1]),
    )
