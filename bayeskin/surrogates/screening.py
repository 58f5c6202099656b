"""Which inputs a force depends on, as cross-validation sees it.

A Gaussian process over inputs that do nothing needs rows to find that out, a trend and an oblique map over
them still more. Inputs are left out one after the other, those first that are missed least, as long as the
squared error of rows not learnt from hardly grows.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from bayeskin.surrogates.hyperparameters import fit_latent
from bayeskin.surrogates.similarity import Similarity
from bayeskin.surrogates.train import fit_latents
from bayeskin.types import Array, Design

GROWN = 1.2  # of the squared error, by which it may grow for fewer inputs: chance moves it as much
ROWS = 640  # at most: every trial is a fit of its own


def active_inputs(design: Design, focus: Array) -> NDArray[np.int64]:
    """Columns of the inputs of `Similarity` that matter, in order; focus: weights (n,) of the rows."""
    rows = np.flatnonzero(design.training & (focus > 0.0))
    rows = rows[:: -(-len(rows) // ROWS)]
    similarity = Similarity(design.space)
    inputs, log_scale = similarity.inputs(design.theta[rows]), similarity.log_scale(design.theta[rows])

    @cache
    def error(*columns: int) -> float:
        force_n = design.force_n[rows]
        transform, _, fits = fit_latents(fit_latent, inputs[:, columns], log_scale, force_n, focus[rows])
        of_shapes = sum(fit.error for fit in fits[1:]) + float(transform.truncation.sum())
        return fits[0].error * force_n.shape[1] + of_shapes

    active = list(range(inputs.shape[1]))
    least = error(*active)
    missed = {column: error(*(c for c in active if c != column)) for column in active}
    for column in sorted(missed, key=lambda c: missed[c]):
        without = [c for c in active if c != column]
        if without and (found := error(*without)) <= GROWN * least:
            active, least = without, min(least, found)
    return np.array(active)
