"""Draws the parts of a population whose density, given all others, has a closed form or nearly so.

B and the values of the units are normal. Covariances would be inverse Wishart under a prior that is close to
the model's.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bayeskin.study.model import Model, State, sums
from bayeskin.types import Array

_FREEDOM = 2.0  # degrees of freedom of the prior under which covariances are proposed


def draw_coefficients(model: Model, state: State, rng: np.random.Generator) -> State:
    """Returns the state with new coefficients.

    They are drawn with the values of the units held, and then once more for each level, with the sums of its
    values and the part of B that is the same for all members of its units held. The second way is efficient
    where units differ more than their members.
    """
    matrix = model.layout.matrix
    above = state.x - model.above(state)
    drawn = _regression(above, matrix, state.covariances[-1], model.centre, model.sd, rng)
    state = replace(state, coefficients=drawn)
    for at, level in enumerate(model.layout.levels):
        rows = matrix[np.unique(level.unit, return_index=True)[1]]
        same = np.all(rows[level.unit] == matrix, axis=0)
        old = state.coefficients[:, same]
        kept = model.effects(state)[at] + rows[:, same] @ old
        new = _regression(kept, rows[:, same], state.covariances[at], model.centre[same], model.sd[same], rng)
        coefficients = state.coefficients.copy()
        coefficients[:, same] = new
        moved = model.shifted(state, at, rows[:, same] @ (old - new))
        state = replace(moved, coefficients=coefficients, x=state.x)
    return state


def draw_values(model: Model, state: State, rng: np.random.Generator) -> State:
    """Returns the state with new values of all units above the recordings, from the highest level down."""
    levels = model.layout.levels
    for at in range(len(levels)):
        lowest = at + 1 == len(levels)
        members = state.x - model.layout.matrix @ state.coefficients if lowest else state.values[at + 1]
        unit = levels[at].unit if lowest else levels[at + 1].parent
        count = state.values[at].shape[1]
        own, below = (np.linalg.inv(state.covariances[level])[:, None] for level in (at, at + 1))
        members_of = np.bincount(unit, minlength=count).astype(float)
        precision = own + members_of[:, None, None] * below
        total = sums(members, unit, count)[..., None]
        right = own @ model.parents(state)[at][..., None] + below @ total
        values = list(state.values)
        values[at] = _normal(precision, right[..., 0], rng)
        state = replace(state, values=tuple(values))
    return state


def draw_covariances(model: Model, state: State, rng: np.random.Generator) -> State:
    """Returns the state after a proposal of new covariances for each level.

    The proposal is exact under the prior of Huang & Wand (2013, Bayesian Analysis 8:439), which is inverse
    Wishart given auxiliary scales. The ratio of the model's prior to that prior accepts or rejects it.
    """
    dim = state.x.shape[2]
    covariances = []
    for effects, old in zip(model.effects(state), state.covariances, strict=True):
        squares = np.swapaxes(effects, 1, 2) @ effects
        rate = _huang_wand_rates(old, model.priors.spread_scale)
        inverse_scales = rng.gamma(0.5 * (_FREEDOM + dim), size=rate.shape) / rate
        squares[:, range(dim), range(dim)] += 2.0 * _FREEDOM * inverse_scales
        new = _inverse_wishart(_FREEDOM + dim - 1 + effects.shape[1], squares, rng)
        gain = _log_prior_ratio(model, new) - _log_prior_ratio(model, old)
        accepted = np.log(rng.random(len(gain))) < gain
        covariances.append(np.where(accepted[:, None, None], new, old))
    return replace(state, covariances=tuple(covariances))


def _huang_wand_rates(covariance: Array, scale: float) -> Array:
    """Returns the rates (m, d) of the inverse gamma distributions of the auxiliary scales."""
    precision = np.diagonal(np.linalg.inv(covariance), axis1=1, axis2=2)
    return np.asarray(_FREEDOM * precision + scale**-2)


def _log_prior_ratio(model: Model, covariance: Array) -> Array:
    """Returns the log (m,) of the model's prior density over that of Huang & Wand, up to a constant."""
    dim = covariance.shape[1]
    rates = _huang_wand_rates(covariance, model.priors.spread_scale)
    size = np.linalg.slogdet(covariance)[1]
    other = -0.5 * (_FREEDOM + 2 * dim) * size - 0.5 * (_FREEDOM + dim) * np.log(rates).sum(axis=1)
    return model.log_prior_of_covariance(covariance) - other


def _regression(
    values: Array, matrix: Array, covariance: Array, centre: Array, sd: Array, rng: np.random.Generator
) -> Array:
    """Returns coefficients (m, q, d), drawn given values (m, n, d) = matrix (n, q) times them + noise.

    covariance (m, d, d) : of the noise of one row; centre, sd (q, d) : of the normal prior
    """
    count, dim = centre.shape
    inverse = np.linalg.inv(covariance)
    gram = (matrix.T @ matrix)[:, None, :, None]
    precision = (gram * inverse[:, None, :, None, :]).reshape(-1, count * dim, count * dim)
    precision[:, range(count * dim), range(count * dim)] += sd.ravel() ** -2
    right = (matrix.T @ values) @ inverse + centre / sd**2
    return _normal(precision, right.reshape(len(values), -1), rng).reshape(-1, count, dim)


def _normal(precision: Array, right: Array, rng: np.random.Generator) -> Array:
    """Returns normal draws (..., d) with precision (..., d, d) and mean precision^-1 right."""
    root = np.linalg.cholesky(precision)
    half = np.linalg.solve(root, right[..., None]) + rng.standard_normal((*right.shape, 1))
    return np.asarray(np.linalg.solve(np.swapaxes(root, -1, -2), half)[..., 0])


def _inverse_wishart(freedom: float, squares: Array, rng: np.random.Generator) -> Array:
    """Returns inverse Wishart draws (m, d, d) with scale matrices `squares`, by Bartlett's decomposition."""
    count, dim = squares.shape[:2]
    factor = np.tril(rng.standard_normal((count, dim, dim)), -1)
    factor[:, range(dim), range(dim)] = np.sqrt(rng.chisquare(freedom - np.arange(dim), (count, dim)))
    half = np.linalg.solve(factor, np.swapaxes(np.linalg.cholesky(squares), 1, 2))
    return np.swapaxes(half, 1, 2) @ half
