"""A fine model's surrogate from a coarse one's: what the finer mesh changes, learnt from few of its runs.

The fine model's latents are the coarse one's plus a correction, Gaussian processes over the same inputs:

    z_fine(x) = z_coarse(x) + d(x)

The first latent is the logarithm of the force's amplitude, so there d is the factor of autoregressive
co-kriging (Kennedy & O'Hagan, Biometrika 87, 2000, 1), free to vary over the inputs; in the others it
corrects the shape. Both parts' variances add up: the correction is uncertain, and said to be so.

What the coarse shapes' components leave of the fine ones has components of its own, of which the coarse model
knows nothing. Left as a variance of single bins it would be noise, which a likelihood pays for in each bin.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bayeskin.errors import InputError
from bayeskin.surrogates.gp import LatentGPs
from bayeskin.surrogates.hyperparameters import LatentFit, fit_latent
from bayeskin.surrogates.shapes import ShapeTransform, split
from bayeskin.surrogates.surrogate import Latents, ShapeSurrogate
from bayeskin.surrogates.validate import Validation, compare, validate
from bayeskin.types import Array, Design

FEWEST_MORE = 3  # fine runs more than inputs
LEFT = 1e-4  # of the shape's squared error, by what remains after the fine shapes' own components


@dataclass(frozen=True)
class CorrectedLatents:
    """Latents of the fine model: those of the coarse one, their correction, and further ones beyond these."""

    coarse: Latents
    correction: LatentGPs

    @property
    def inputs(self) -> Array:
        """Of the fine runs, (n, dim)."""
        return self.correction.inputs

    def predict(self, unit: Array) -> tuple[Array, Array]:
        """Mean and variance (n, q) at inputs (n, dim)."""
        return self._added(unit, *self.correction.predict(unit))

    def predict_mean(self, unit: Array) -> Array:
        """The mean (n, q) of `predict` alone."""
        mean, coarse = self.correction.predict_mean(unit), self.coarse.predict_mean(unit)
        mean[:, : coarse.shape[1]] += coarse
        return mean

    def leave_one_out(self) -> tuple[Array, Array]:
        """Mean and variance (n, q) at each fine run, its correction as the other fine runs predict it."""
        return self._added(self.inputs, *self.correction.leave_one_out())

    def _added(self, unit: Array, mean: Array, variance: Array) -> tuple[Array, Array]:
        """The coarse latents come to the correction's mean and variance (n, q), in place."""
        for whole, coarse in zip((mean, variance), self.coarse.predict(unit), strict=True):
            whole[:, : coarse.shape[1]] += coarse
        return mean, variance


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
    inputs, weights = surrogate.inputs(theta), focus[training]
    known = coarse.predict(inputs)[0]
    transform = surrogate.transform.keep(known.shape[1] - 1, split(force_n)[1], weights, fitted=0)
    change = transform.encode(force_n) - known
    change[:, 0] -= similarity.log_scale(theta)
    fits = [fit_latent(inputs, column, weights) for column in change.T]
    transform, more = _beyond(transform, inputs, force_n, weights, sum(fit.error for fit in fits[1:]))
    change = np.concatenate([change, transform.encode(force_n)[:, len(fits) :]], axis=1)
    fits += more
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


def _beyond(
    transform: ShapeTransform, inputs: Array, force_n: Array, weights: Array, error: float
) -> tuple[ShapeTransform, list[LatentFit]]:
    """A transform with components of what it leaves of histories (n, m), and the fits of these.

    As many as bring what is still left below `LEFT` of the squared `error` of the shapes, and at most a third
    of the rows.
    """
    shapes = split(force_n)[1]
    centred = shapes - transform.mean
    rest = centred - (centred @ transform.components.T) @ transform.components
    share = np.sqrt(weights / weights.sum())[:, None]
    _, singular, found = np.linalg.svd(share * rest, full_matrices=False)
    squares, fits = singular**2, []
    most = min(len(inputs) // 3, len(squares)) - len(transform.components)
    for k in range(max(most, 0)):
        if np.sum(squares[k:]) <= LEFT * error:
            break
        fits.append(fit_latent(inputs, rest @ found[k], weights))
        error += fits[-1].error
    whole = replace(transform, components=np.concatenate([transform.components, found[: len(fits)]]))
    return whole.keep(len(whole.components), shapes, weights, fitted=len(fits)), fits
