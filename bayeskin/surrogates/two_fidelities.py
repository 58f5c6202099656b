"""Corrects the surrogate of a coarse model for a finer mesh, with few runs of the fine model.

The latents of the fine model are the latents of the coarse model plus a correction. The correction consists
of Gaussian processes over the same inputs:

    z_fine(x) = z_coarse(x) + d(x)

The first latent is the logarithm of the force's amplitude. For this latent, d corresponds to the factor of
autoregressive co-kriging (Kennedy & O'Hagan, Biometrika 87, 2000, 1), which may vary over the inputs. In the
other latents, d corrects the shape. The variances of both parts are added, so that the uncertainty of the
correction is included.

The components of the coarse shapes leave out a part of the fine shapes. This part has its own components, on
which the coarse model has no information. As a variance of single bins it would count as noise, which would
reduce the likelihood in every bin.
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


@dataclass(frozen=True)
class CorrectionSettings:
    """Settings of a correction.

    fewest_beyond : least number of fine runs beyond the number of inputs
    left : the fine shapes' own components are added until the remainder is at most this share of the shapes'
        squared error
    """

    fewest_beyond: int = 3
    left: float = 1e-4


@dataclass(frozen=True)
class CorrectedLatents:
    """Latents of the fine model: the coarse latents, their correction, and further latents beyond these."""

    coarse: Latents
    correction: LatentGPs

    @property
    def inputs(self) -> Array:
        """Returns the inputs (n, dim) of the fine runs."""
        return self.correction.inputs

    def predict(self, unit: Array) -> tuple[Array, Array]:
        """Returns the mean and the variance (n, q) at inputs (n, dim)."""
        return self._add_coarse(unit, *self.correction.predict(unit))

    def predict_mean(self, unit: Array) -> Array:
        """Returns only the mean (n, q) of `predict`."""
        mean, coarse = self.correction.predict_mean(unit), self.coarse.predict_mean(unit)
        mean[:, : coarse.shape[1]] += coarse
        return mean

    def leave_one_out(self) -> tuple[Array, Array]:
        """Returns the mean and the variance (n, q) at each fine run.

        The correction at each fine run is predicted from the other fine runs.
        """
        return self._add_coarse(self.inputs, *self.correction.leave_one_out())

    def _add_coarse(self, unit: Array, mean: Array, variance: Array) -> tuple[Array, Array]:
        """Adds the coarse latents to the correction's mean and variance (n, q), in place."""
        for total, coarse in zip((mean, variance), self.coarse.predict(unit), strict=True):
            total[:, : coarse.shape[1]] += coarse
        return mean, variance


def correct(
    surrogate: ShapeSurrogate, fine: Design, focus: Array | None = None,
    settings: CorrectionSettings = CorrectionSettings(),
) -> tuple[ShapeSurrogate, Validation]:  # fmt: skip
    """Returns the surrogate of the fine model, and its validation.

    The training rows of `fine` correct the coarse `surrogate`. If `surrogate` already has a correction, the
    new correction replaces it. The held-out rows of `fine` only measure the error. Without held-out rows, the
    error is measured by leave-one-out. `focus` (n,) are the weights of the rows in errors and fits. Raises
    InputError for too few rows.
    """
    coarse = (
        surrogate.latents.coarse if isinstance(surrogate.latents, CorrectedLatents) else surrogate.latents
    )
    focus = np.ones(len(fine.theta)) if focus is None else np.asarray(focus, dtype=float)
    inside = surrogate.space.contains(fine.theta)
    training, testing = fine.training & inside, fine.testing & inside
    similarity = surrogate.similarity
    fewest = len(surrogate.active) + settings.fewest_beyond
    if training.sum() < fewest:
        raise InputError(
            "fine design", f"it has {training.sum()} finished training rows", f"at least {fewest} are needed"
        )
    theta, force_n = fine.theta[training], fine.force_n[training]
    inputs, weights = surrogate.inputs(theta), focus[training]
    coarse_latents = coarse.predict(inputs)[0]
    transform = surrogate.transform.keep(coarse_latents.shape[1] - 1, split(force_n)[1], weights, fitted=0)
    change = transform.encode(force_n) - coarse_latents
    change[:, 0] -= similarity.log_scale(theta)
    fits = [fit_latent(inputs, column, weights) for column in change.T]
    transform, further_fits = _add_components(
        transform, inputs, force_n, weights, sum(fit.error for fit in fits[1:]), settings.left
    )
    change = np.concatenate([change, transform.encode(force_n)[:, len(fits) :]], axis=1)
    fits += further_fits
    provenance = {**surrogate.provenance, "model_hash": fine.model_hash, "fine_rows": int(training.sum())}
    corrected = replace(
        surrogate,
        transform=transform,
        latents=CorrectedLatents(coarse, LatentGPs.assemble(inputs, change, fits)),
        provenance=provenance,
    )
    if testing.any():
        return corrected, validate(corrected, fine.theta[testing], fine.force_n[testing], focus[testing])
    left_out = corrected.leave_one_out(theta)
    return corrected, compare(corrected, left_out, theta, force_n, "leave-one-out", focus[training])


def _add_components(
    transform: ShapeTransform, inputs: Array, force_n: Array, weights: Array, error: float, left: float
) -> tuple[ShapeTransform, list[LatentFit]]:
    """Returns the transform with added components for the remainder of histories (n, m), and their fits.

    Components are added until the remainder is below the share `left` of the squared `error` of the shapes.
    The total number of components is at most a third of the rows.
    """
    shapes = split(force_n)[1]
    centred = shapes - transform.mean
    remainder = centred - (centred @ transform.components.T) @ transform.components
    share = np.sqrt(weights / weights.sum())[:, None]
    _, singular, directions = np.linalg.svd(share * remainder, full_matrices=False)
    squares, fits = singular**2, []
    most = min(len(inputs) // 3, len(squares)) - len(transform.components)
    for k in range(max(most, 0)):
        if np.sum(squares[k:]) <= left * error:
            break
        fits.append(fit_latent(inputs, remainder @ directions[k], weights))
        error += fits[-1].error
    whole = replace(transform, components=np.concatenate([transform.components, directions[: len(fits)]]))
    return whole.keep(len(whole.components), shapes, weights, fitted=len(fits)), fits
