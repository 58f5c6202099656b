"""A fine model's surrogate from a coarse one's: what the finer mesh changes, learnt from few of its runs.

The fine model's latents are the coarse one's plus a correction, Gaussian processes over the same inputs:

    z_fine(x) = z_coarse(x) + d(x)

The first latent is the logarithm of the force's amplitude, so there d is the factor of autoregressive
co-kriging (Kennedy & O'Hagan, Biometrika 87, 2000, 1), free to vary over the inputs; in the others it
corrects the shape. Both parts' variances add up: the correction is uncertain, and said to be so.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bayeskin.errors import InputError
from bayeskin.surrogates.gp import LatentGPs
from bayeskin.surrogates.hyperparameters import fit_latent
from bayeskin.surrogates.shapes import split
from bayeskin.surrogates.surrogate import Latents, ShapeSurrogate
from bayeskin.surrogates.validate import Validation, compare, validate
from bayeskin.types import Array, Design

FEWEST_MORE = 3  # fine runs more than inputs


@dataclass(frozen=True)
class CorrectedLatents:
    """Latents of the fine model: those of the coarse one and their correction."""

    coarse: Latents
    correction: LatentGPs

    @property
    def inputs(self) -> Array:
        """Of the fine runs, (n, dim)."""
        return self.correction.inputs

    def predict(self, unit: Array) -> tuple[Array, Array]:
        """Mean and variance (n, q) at inputs (n, dim)."""
        mean, variance = self.coarse.predict(unit)
        change, its_variance = self.correction.predict(unit)
        return mean + change, variance + its_variance

    def predict_mean(self, unit: Array) -> Array:
        """The mean (n, q) of `predict` alone."""
        return self.coarse.predict_mean(unit) + self.correction.predict_mean(unit)

    def leave_one_out(self) -> tuple[Array, Array]:
        """Mean and variance (n, q) at each fine run, its correction as the other fine runs predict it."""
        mean, variance = self.coarse.predict(self.inputs)
        change, its_variance = self.correction.leave_one_out()
        return mean + change, variance + its_variance


def correct(
    surrogate: ShapeSurrogate, fine: Design, focus: Array | None = None
) -> tuple[ShapeSurrogate, Validation]:
    """The fine model's surrogate: the coarse one's, corrected by the training rows of `fine`.

    A correction that `surrogate` has already is replaced. The held-out rows of `fine` only measure the
    error (leave-one-out without any). focus: weights (n,) of the rows in errors and fits. Raises
    InputError for too few rows.
    """
    coarse = (
        surrogate.latents.coarse if isinstance(surrogate.latents, CorrectedLatents) else surrogate.latents
    )
    focus = np.ones(len(fine.theta)) if focus is None else np.asarray(focus, dtype=float)
    inside = surrogate.space.contains(fine.theta)
    training, testing = fine.training & inside, fine.testing & inside
    similarity = surrogate.similarity
    fewest = len(surrogate.active) + FEWEST_MORE
    if training.sum() < fewest:
        raise InputError("fine design", f"{training.sum()} finished training rows", f"at least {fewest}")
    theta, force_n = fine.theta[training], fine.force_n[training]
    own = surrogate.transform.keep(len(surrogate.transform.components), split(force_n)[1])
    transform = replace(own, truncation=np.maximum(own.truncation, surrogate.transform.truncation))
    inputs = surrogate.inputs(theta)
    change = transform.encode(force_n) - coarse.predict(inputs)[0]
    change[:, 0] -= similarity.log_scale(theta)
    fits = [fit_latent(inputs, column, focus[training]) for column in change.T]
    provenance = {**surrogate.provenance, "model_hash": fine.model_hash, "fine_rows": int(training.sum())}
    found = replace(
        surrogate,
        transform=transform,
        latents=CorrectedLatents(coarse, LatentGPs.assemble(inputs, change, fits)),
        provenance=provenance,
    )
    if testing.any():
        return found, validate(found, fine.theta[testing], fine.force_n[testing], focus[testing])
    left_out = found.leave_one_out(theta)
    return found, compare(found, left_out, theta, force_n, "leave-one-out", focus[training])
