"""Weights the runs of a design so that a surrogate is most accurate where the posterior can be."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayeskin.surrogates.similarity import Similarity
from bayeskin.types import Array, BinnedForce, Design

# With a smaller weighted number of training runs per input, components and error estimates are unreliable.
FEWEST_COUNTING = 5


def noise_floor_n(binned: BinnedForce, fitted: NDArray[np.bool_]) -> float:
    """Returns the RMS [N] of the noise in the means of the fitted bins."""
    return float(np.sqrt(np.mean(binned.variance_n2[fitted])))


def focus(design: Design, binned: BinnedForce, fitted: NDArray[np.bool_]) -> Array:
    """Returns weights (n,) with which a surrogate becomes most accurate where the posterior can be.

    The weight of a run is the inverse of its mean square distance to the recording; the noise keeps this
    distance above zero. Where too few runs would carry the weight, the weights are made more even.

    fitted : whether each bin enters the fit, (m,)
    """
    square = np.mean((design.force_n[:, fitted] - binned.force_n[fitted]) ** 2, axis=1)
    inverse = 1.0 / (noise_floor_n(binned, fitted) ** 2 + square)
    inverse = np.where(design.ok, inverse, 0.0) / np.max(inverse[design.ok])
    needed = FEWEST_COUNTING * Similarity(design.space).dim
    for evenness in (1.0, 0.5, 0.25, 0.125):
        weight = inverse**evenness
        if weight[design.training].sum() ** 2 / np.sum(weight[design.training] ** 2) >= needed:
            return weight
    return design.ok.astype(float)
