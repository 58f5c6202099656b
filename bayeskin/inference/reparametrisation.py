"""Coordinates in which the ridge of the moduli is straight.

A force fixes the sum of the contributions of several layers, say a E_c + b E_s, to a few parts in a thousand
and leaves their ratio open. In logarithms this ridge is a thin curve, which neither an ensemble of walkers
nor an optimiser follows well. Let x be the sampling coordinates, G the parameters with which the amplitude
alpha of the force grows, and c the mean of x over G. P x is x after c is subtracted from each member of G.
The map

    c' = c + h(P x),     h(P x) = log sum_G a_j exp((P x)_j) + polynomial(P x),     P x' = P x,

turns the ridge alpha = 1 into c' = 0. The map is a shear, since h does not depend on c. Its inverse is
explicit and its determinant is constant, whatever h is. A poor fit of h costs speed, never correctness
(a triangular transport map; Parno & Marzouk 2018, SIAM/ASA J. Uncertainty Quantification 6:645).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from bayeskin.inference.problem import LogPosterior
from bayeskin.types import POINTS_AT_ONCE, Array, FreezesArrays


@dataclass(frozen=True)
class ShearSettings:
    """Settings of the fit of a shear.

    points : number of points of the prior from which the amplitude is learnt
    least_share : smallest mean share of the amplitude of a parameter that belongs to the group
    degree : degree of the polynomial
    newton : number of Newton steps onto the ridge
    step : step of central differences in a logarithm
    """

    points: int = 2048
    least_share: float = 0.02
    degree: int = 5
    newton: int = 4
    step: float = 1e-4


@dataclass(frozen=True)
class Shear(FreezesArrays):
    """The map for x (n, D): `group` (D,) bool marks G, and log_weight (D,) is log a_j in G, -inf outside.

    The polynomial has exponents `powers` (t, D) and `coefficients` (t,), in (P x - centre) / scale. If
    `power` q differs from 1, the amplitude is a sum of moduli to the power q, raised to the power 1 / q.
    """

    group: NDArray[np.bool_]
    log_weight: Array
    powers: NDArray[np.int64]
    coefficients: Array
    centre: Array
    scale: Array
    power: float = 1.0

    def straight(self, x: Array) -> Array:
        """Returns P x (n, D) with c' in the place of the group's first parameter."""
        level, rest = self.split(x)
        out = rest.copy()
        out[:, self._first] = level + self.height(rest)
        return out

    def back(self, straight: Array) -> Array:
        """Returns x (n, D) from the result of `straight`."""
        rest = straight.copy()
        rest[:, self._first] = 0.0
        rest[:, self._first] = -rest[:, self.group].sum(axis=1)
        return self.join(straight[:, self._first] - self.height(rest), rest)

    def split(self, x: Array) -> tuple[Array, Array]:
        """Returns c (n,) and P x (n, D)."""
        level = x[:, self.group].mean(axis=1)
        return level, self.join(-level, x)

    def join(self, level: Array, rest: Array) -> Array:
        """Returns x (n, D) from c (n,) and P x (n, D)."""
        return rest + np.outer(level, self.group)

    def height(self, rest: Array) -> Array:
        """Returns h (n,) at P x (n, D)."""
        height = log_sum(self.power * rest[:, self.group] + self.log_weight[self.group]) / self.power
        return height + self.coefficients @ self.polynomial(rest)

    def among(self, own: Sequence[str], names: Sequence[str]) -> Shear:
        """Returns the same map for a space with more coordinates; the added coordinates stay as they were.

        own, names : names of the coordinates of this map and of the larger space
        """
        column = [own.index(name) if name in own else -1 for name in names]

        def spread(values: NDArray[Any], added: float) -> NDArray[Any]:
            wide = np.full((*values.shape[:-1], len(names)), added, dtype=values.dtype)
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
        """Returns the polynomial's terms (t, n) at P x (n, D)."""
        # A polynomial grows quickly beyond the points to which it was fitted, so it is kept constant there.
        unit = np.clip((rest - self.centre) / self.scale, -1.0, 1.0)
        return _monomials(np.ascontiguousarray(unit.T), self.powers)


@nb.njit(cache=True, nogil=True)
def _monomials(unit: Array, powers: NDArray[np.int64]) -> Array:
    """Returns products (t, n) over the D rows of unit (D, n), raised to powers (t, D)."""
    terms = np.ones((len(powers), unit.shape[1]))
    for t in range(len(powers)):
        for j in range(len(unit)):
            for _ in range(powers[t, j]):
                for i in range(unit.shape[1]):
                    terms[t, i] *= unit[j, i]
    return terms


def log_sum(values: Array) -> Array:
    """Returns log sum exp over the last axis."""
    top = values.max(axis=-1)
    return top + np.log(np.exp(values - top[..., None]).sum(axis=-1))


def find_shear(log_posterior: LogPosterior, settings: ShearSettings = ShearSettings()) -> Shear | None:
    """Returns the shear that fits the surrogate's amplitude, or None when no two parameters share it.

    The amplitude is that of the recorded force y in the predicted force f, <y, f> / <y, y> over the fitted
    bins. The same posterior always gives the same shear, because its points have a fixed seed.
    """
    material = log_posterior.surrogate.space.dim
    low, high = log_posterior.bounds
    rng = np.random.default_rng(0)
    x = np.tile(0.5 * (low + high), (settings.points, 1))
    x[:, :material] = rng.uniform(low[:material], high[:material], (settings.points, material))
    alpha = _amplitude(log_posterior, x)
    is_log = log_posterior.space.is_log & (np.arange(log_posterior.dim) < material)
    weight = _weights(np.where(is_log, np.exp(np.where(is_log, x, 0.0)), 0.0), alpha, settings.least_share)
    group = weight > 0
    if group.sum() < 2:
        return None
    with np.errstate(divide="ignore"):
        log_weight = np.log(weight)
    plain = Shear(
        group, log_weight, np.zeros((0, log_posterior.dim), dtype=np.int64), np.zeros(0),
        0.5 * (low + high), 0.5 * (high - low),
    )  # fmt: skip
    return _with_polynomial(log_posterior, plain, x, material, settings)


def shear_at(
    log_posterior: LogPosterior, x: Array, power: float, settings: ShearSettings = ShearSettings()
) -> Shear | None:
    """Returns the shear from the amplitude's slopes along each modulus at a point (D,), without a polynomial.

    It returns None where fewer than two moduli raise the amplitude.
    power : the amplitude is a sum of the moduli to this power
    """
    moduli = log_posterior.surrogate.space.scaled(1)
    if len(moduli) < 2:
        return None
    step = settings.step * np.eye(len(x))[moduli]
    ahead, back = (_amplitude(log_posterior, x + way * step) for way in (1.0, -1.0))
    share = np.zeros(len(x))
    share[moduli] = (ahead - back) / (2.0 * settings.step)  # the amplitude at x is about one
    group = share > settings.least_share
    if group.sum() < 2:
        return None
    with np.errstate(divide="ignore"):
        log_weight = np.where(group, np.log(np.maximum(share, 0.0)) - power * x, -np.inf)
    no_polynomial = np.zeros((0, len(x)), dtype=np.int64), np.zeros(0), np.zeros(len(x)), np.ones(len(x))
    return Shear(group, log_weight, *no_polynomial, power)


def _amplitude(log_posterior: LogPosterior, x: Array) -> Array:
    chain = log_posterior.chain
    share = chain.force_n / max(float(chain.force_n @ chain.force_n), np.finfo(float).tiny)
    theta = log_posterior.from_sampling(x)
    return np.concatenate(
        [
            log_posterior.predict_mean(theta[a : a + POINTS_AT_ONCE])[:, chain.bins] @ share
            for a in range(0, len(theta), POINTS_AT_ONCE)
        ]
    )


def _weights(columns: Array, alpha: Array, least_share: float) -> Array:
    """Returns non-negative a_j (D,) with alpha = sum a_j columns_j, fitted relatively; 0 for small shares."""
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
        # A permeability's column is nearly always tiny, so a fit may give it a weight. Such columns are
        # dropped, and the others are fitted again.
        small = candidate & ((relative * weight).mean(axis=0) < least_share)
        if not small.any():
            break
        candidate = candidate & ~small
    return weight


def _with_polynomial(
    log_posterior: LogPosterior, plain: Shear, x: Array, material: int, settings: ShearSettings
) -> Shear:
    """Returns the shear with a polynomial that brings the points of the ridge to c' = 0."""
    low, high = log_posterior.bounds
    rest = plain.split(x)[1]
    on_ridge = plain.join(-plain.height(rest), rest)
    good = np.ones(len(x), dtype=bool)
    for _ in range(settings.newton):  # the amplitude is nearly of degree one in all moduli together
        good &= np.all((on_ridge >= low) & (on_ridge <= high), axis=1)
        alpha = np.full(len(x), np.nan)
        if good.any():
            alpha[good] = _amplitude(log_posterior, on_ridge[good])
        good &= np.nan_to_num(alpha) > 0
        on_ridge[good] = plain.join(-np.log(alpha[good]), on_ridge[good])
    # The sum of P x over the group is zero, so one member of the group is redundant.
    axes = [j for j in range(material) if j != np.argmax(plain.group)]
    powers = _powers(axes, len(low), settings.degree)
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


def _powers(axes: list[int], dim: int, highest: int) -> NDArray[np.int64]:
    rows = [np.zeros(dim, dtype=np.int64)]
    for degree in range(1, highest + 1):
        for chosen in combinations_with_replacement(axes, degree):
            row = np.zeros(dim, dtype=np.int64)
            np.add.at(row, list(chosen), 1)
            rows.append(row)
    return np.array(rows)
