"""Coordinates in which the ridge of the moduli is straight.

A force fixes the sum of what several layers contribute, say a E_c + b E_s, to a few parts in a thousand
and leaves their ratio open. In logarithms that ridge is a thin curve, which neither an ensemble of walkers
nor an optimiser follows well. With x the sampling coordinates, G the parameters that the amplitude alpha
of the force grows with, c the mean of x over G and P x what is left when c is taken from each of G,

    c' = c + h(P x),     h(P x) = log sum_G a_j exp((P x)_j) + polynomial(P x),     P x' = P x,

turns the ridge alpha = 1 into c' = 0. The map is a shear, since h does not depend on c: its inverse is
explicit and its determinant constant whatever h is, so a poor fit of h costs speed, never correctness
(a triangular transport map; Parno & Marzouk 2018, SIAM/ASA J. Uncertainty Quantification 6:645).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement
from typing import Any

import numba as nb
import numpy as np
from scipy.optimize import nnls

from bayeskin.inference.problem import LogPosterior
from bayeskin.types import Array, NDArray, _FreezesArrays

_POINTS = 2048  # of the prior, that the amplitude is learnt from
_CHUNK = 256
_MIN_SHARE = 0.02  # mean share of the amplitude that puts a parameter into the group
_DEGREE = 5
_NEWTON = 4  # steps onto the ridge
_STEP = 1e-4  # of a logarithm, for differences


@dataclass(frozen=True)
class Shear(_FreezesArrays):
    """The map for x (n, D): `group` (D,) bool, log_weight (D,) of its members, -inf outside.

    The polynomial has `powers` (t, D) and `coefficients` (t,) in (P x - centre) / scale. With another `power`
    q than 1 the amplitude is a sum of moduli to the power q, to the power 1 / q.
    """

    group: NDArray[np.bool_]
    log_weight: Array
    powers: NDArray[np.int64]
    coefficients: Array
    centre: Array
    scale: Array
    power: float = 1.0

    def straight(self, x: Array) -> Array:
        """P x (n, D) with c' in the place of the group's first parameter."""
        level, rest = self.split(x)
        out = rest.copy()
        out[:, self._first] = level + self.height(rest)
        return out

    def back(self, straight: Array) -> Array:
        """x of what `straight` gives, (n, D)."""
        rest = straight.copy()
        rest[:, self._first] = 0.0
        rest[:, self._first] = -rest[:, self.group].sum(axis=1)
        return self.join(straight[:, self._first] - self.height(rest), rest)

    def split(self, x: Array) -> tuple[Array, Array]:
        """c (n,) and P x (n, D)."""
        level = x[:, self.group].mean(axis=1)
        return level, self.join(-level, x)

    def join(self, level: Array, rest: Array) -> Array:
        """x of c (n,) and P x (n, D)."""
        return rest + np.outer(level, self.group)

    def height(self, rest: Array) -> Array:
        """h (n,) at P x (n, D)."""
        height = log_sum(self.power * rest[:, self.group] + self.log_weight[self.group]) / self.power
        return height + self.coefficients @ self.polynomial(rest)

    def among(self, own: Sequence[str], names: Sequence[str]) -> Shear:
        """The same map for a space of more coordinates, by the names of both; it leaves the others alone."""
        column = [own.index(name) if name in own else -1 for name in names]

        def spread(values: NDArray[Any], other: float) -> NDArray[Any]:
            wide = np.full((*values.shape[:-1], len(names)), other, dtype=values.dtype)
            wide[..., np.array(column) >= 0] = values[..., [c for c in column if c >= 0]]
            return wide

        return Shear(
            spread(self.group, 0), spread(self.log_weight, -np.inf), spread(self.powers, 0),
            self.coefficients, spread(self.centre, 0.0), spread(self.scale, 1.0), self.power,
        )  # fmt: skip

    @property
    def _first(self) -> int:
        return int(np.argmax(self.group))

    def polynomial(self, rest: Array) -> Array:
        """The polynomial's terms (t, n) at P x (n, D)."""
        # Flat beyond the points it was fitted to, where a polynomial runs away.
        unit = np.clip((rest - self.centre) / self.scale, -1.0, 1.0)
        return _monomials(np.ascontiguousarray(unit.T), self.powers)


@nb.njit(cache=True, nogil=True)
def _monomials(unit: Array, powers: NDArray[np.int64]) -> Array:
    """Products over columns of unit (D, n) raised to powers (t, D): (t, n)."""
    terms = np.ones((len(powers), unit.shape[1]))
    for t in range(len(powers)):
        for j in range(len(unit)):
            for _ in range(powers[t, j]):
                for i in range(unit.shape[1]):
                    terms[t, i] *= unit[j, i]
    return terms


def log_sum(values: Array) -> Array:
    """log sum exp over the last axis."""
    top = values.max(axis=-1)
    return top + np.log(np.exp(values - top[..., None]).sum(axis=-1))


def find_shear(log_posterior: LogPosterior) -> Shear | None:
    """The shear that fits the surrogate's amplitude, or None when no two parameters share it.

    The amplitude is that of the recorded force in the predicted one, <y, f> / <y, y> over the fitted
    bins. Same posterior, same shear: its points have a fixed seed of their own.
    """
    material = log_posterior.surrogate.space.dim
    low, high = log_posterior.bounds
    rng = np.random.default_rng(0)
    x = np.tile(0.5 * (low + high), (_POINTS, 1))
    x[:, :material] = rng.uniform(low[:material], high[:material], (_POINTS, material))
    alpha = _amplitude(log_posterior, x)
    is_log = log_posterior.space.is_log & (np.arange(log_posterior.dim) < material)
    weight = _weights(np.where(is_log, np.exp(np.where(is_log, x, 0.0)), 0.0), alpha)
    group = weight > 0
    if group.sum() < 2:
        return None
    with np.errstate(divide="ignore"):
        log_weight = np.log(weight)
    plain = Shear(
        group, log_weight, np.zeros((0, log_posterior.dim), dtype=np.int64), np.zeros(0),
        0.5 * (low + high), 0.5 * (high - low),
    )  # fmt: skip
    return _corrected(log_posterior, plain, x, material)


def shear_at(log_posterior: LogPosterior, x: Array, power: float) -> Shear | None:
    """Returns the shear by the amplitude's slopes along each modulus at a point (D,), without a polynomial.

    power : of the moduli, in which the amplitude is a sum
    None where fewer than two moduli raise it.
    """
    moduli = log_posterior.surrogate.space.scaled(1)
    if len(moduli) < 2:
        return None
    step = _STEP * np.eye(len(x))[moduli]
    ahead, back = (_amplitude(log_posterior, x + way * step) for way in (1.0, -1.0))
    share = np.zeros(len(x))
    share[moduli] = (ahead - back) / (2.0 * _STEP)  # the amplitude there is about one
    group = share > _MIN_SHARE
    if group.sum() < 2:
        return None
    with np.errstate(divide="ignore"):
        log_weight = np.where(group, np.log(np.maximum(share, 0.0)) - power * x, -np.inf)
    nothing = np.zeros((0, len(x)), dtype=np.int64), np.zeros(0), np.zeros(len(x)), np.ones(len(x))
    return Shear(group, log_weight, *nothing, power)


def _amplitude(log_posterior: LogPosterior, x: Array) -> Array:
    chain = log_posterior.chain
    share = chain.force_n / max(float(chain.force_n @ chain.force_n), np.finfo(float).tiny)
    theta = log_posterior.from_sampling(x)
    return np.concatenate(
        [
            log_posterior.predict_mean(theta[a : a + _CHUNK])[:, chain.bins] @ share
            for a in range(0, len(theta), _CHUNK)
        ]
    )


def _weights(columns: Array, alpha: Array) -> Array:
    """Non-negative a_j (D,) with alpha = sum a_j columns_j, in relative terms; 0 for small shares."""
    usable = np.isfinite(alpha) & (alpha > 0)
    weight = np.zeros(columns.shape[1])
    if usable.sum() < 10 * len(weight):
        return weight
    relative = columns[usable] / alpha[usable, None]
    size = np.sqrt((relative**2).mean(axis=0))
    candidate = size > 0
    while candidate.any():
        weight[:] = 0.0
        weight[candidate] = nnls(relative[:, candidate] / size[candidate], np.ones(len(relative)))[0]
        weight[candidate] /= size[candidate]
        # A permeability's column is nearly always tiny, so a fit may give it some; drop and fit again.
        small = candidate & ((relative * weight).mean(axis=0) < _MIN_SHARE)
        if not small.any():
            break
        candidate = candidate & ~small
    return weight


def _corrected(log_posterior: LogPosterior, plain: Shear, x: Array, material: int) -> Shear:
    """The polynomial that brings the points of the ridge to c' = 0."""
    low, high = log_posterior.bounds
    rest = plain.split(x)[1]
    on_ridge = plain.join(-plain.height(rest), rest)
    good = np.ones(len(x), dtype=bool)
    for _ in range(_NEWTON):  # the amplitude is nearly of degree one in the moduli together
        good &= np.all((on_ridge >= low) & (on_ridge <= high), axis=1)
        alpha = np.full(len(x), np.nan)
        if good.any():
            alpha[good] = _amplitude(log_posterior, on_ridge[good])
        good &= np.nan_to_num(alpha) > 0
        on_ridge[good] = plain.join(-np.log(alpha[good]), on_ridge[good])
    # The sum of P x over the group is zero: one of its members says nothing that the others do not.
    axes = [j for j in range(material) if j != np.argmax(plain.group)]
    powers = _powers(axes, len(low))
    if good.sum() < 5 * len(powers):
        return plain
    level, rest = plain.split(on_ridge[good])
    bottom, top = rest.min(axis=0), rest.max(axis=0)
    shear = replace(
        plain,
        powers=powers,
        coefficients=np.zeros(len(powers)),
        centre=0.5 * (bottom + top),
        scale=np.maximum(0.5 * (top - bottom), 1e-9),
    )
    missing = -(level + plain.height(rest))
    coefficients = np.asarray(np.linalg.lstsq(shear.polynomial(rest).T, missing, rcond=None)[0], dtype=float)
    return replace(shear, coefficients=coefficients)


def _powers(axes: list[int], dim: int) -> NDArray[np.int64]:
    rows = [np.zeros(dim, dtype=np.int64)]
    for degree in range(1, _DEGREE + 1):
        for chosen in combinations_with_replacement(axes, degree):
            row = np.zeros(dim, dtype=np.int64)
            np.add.at(row, list(chosen), 1)
            rows.append(row)
    return np.array(rows)
