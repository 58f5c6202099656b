"""Finds the surrogate's error at one point from the residual: the most probable error, and draws of it.

The residual and the columns of the surrogate's factor are whitened to innovations (`noise_model`), whose
errors follow a t-distribution. They are solved by reweighted least squares. The prior of the error is that of
the likelihood: normal within three sd, and stiffer beyond.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, solve_triangular

from bayeskin.inference.gauss_newton_settings import GaussNewtonSettings
from bayeskin.inference.likelihood import ERROR_PRIOR
from bayeskin.types import Array


def t_weight(left: Array, nu: float) -> Array:
    """Returns weights of innovations in a regression whose errors follow a t-distribution."""
    return np.asarray((nu + 1.0) / (nu + left**2))


def drawn_errors(
    residual: Array, factor: Array, nu: float, normals: Array,
    settings: GaussNewtonSettings = GaussNewtonSettings(),
) -> Array:  # fmt: skip
    """Returns draws (r, s) of the force's error given the residual, normal about the most probable error.

    The draws are in sd of each column of the factor, and are made from standard normals (r, s). Residual (k,)
    and factor (k, r) are whitened to innovations of t noise with `nu` degrees of freedom.
    """
    latent, weight = np.zeros(factor.shape[1]), np.ones(len(residual))
    for _ in range(settings.quick_reweighted):
        weight = t_weight(residual - factor @ latent, nu)
        weighted = factor * np.sqrt(weight)[:, None]
        gram, target = weighted.T @ weighted, factor.T @ (weight * residual)
        for _ in range(settings.sides):
            stiffness, offset = prior_stiffness(latent)
            lower = np.linalg.cholesky(gram + np.diag(stiffness + settings.rounding * np.trace(gram)))
            latent, before = cho_solve((lower, True), target + offset), latent
            if np.array_equal(_is_beyond(latent), _is_beyond(before)):
                break
    return np.asarray(latent[:, None] + solve_triangular(lower.T, normals))


def surrogate_error(
    residual: Array, factor: Array, nu: float, settings: GaussNewtonSettings = GaussNewtonSettings()
) -> Array:
    """Returns the most probable error of the surrogate (r,), in sd of each column of its factor.

    residual (k,) and factor (k, r) are whitened to innovations of t noise with `nu` degrees of freedom.
    """
    latent: Array = np.zeros(factor.shape[1])
    for _ in range(settings.reweighted):
        root = np.sqrt(t_weight(residual - factor @ latent, nu))
        stiffness, offset = prior_stiffness(latent)
        columns, prior_rows, triangle = orthonormal(root[:, None] * factor, stiffness)
        target = columns.T @ (root * residual) + prior_rows.T @ (offset / np.sqrt(stiffness))
        latent = np.asarray(solve_triangular(triangle, target), dtype=float)
    return latent


def orthonormal(factor: Array, stiffness: Array) -> tuple[Array, Array, Array]:
    """Returns the QR decomposition of the columns (k, r) and the roots of their prior's stiffness (r,) below.

    The result is Q in two blocks, (k, r) and (r, r), and R (r, r). Normal equations would lose the prior to
    rounding where a surrogate knows next to nothing, since the squares of its columns are so large there.
    """
    q, triangle = np.linalg.qr(np.concatenate([factor, np.diag(np.sqrt(stiffness))]))
    return q[: len(factor)], q[len(factor) :], triangle


def prior_stiffness(latent: Array) -> tuple[Array, Array]:
    """Returns stiffness (r,) of the prior of the surrogate's error, and its pull (r,) at an error of zero.

    The pull is extrapolated linearly from the error `latent` (r,). The prior is stiffer beyond three sd.
    """
    beyond, (farthest, stiff) = _is_beyond(latent), ERROR_PRIOR
    return np.where(beyond, 1.0 + stiff, 1.0), np.where(beyond, stiff * farthest * np.sign(latent), 0.0)


def _is_beyond(latent: Array) -> NDArray[np.bool_]:
    return np.asarray(np.abs(latent) > ERROR_PRIOR.farthest)
