"""A local maximum of the posterior in few predictions: Gauss-Newton on the force, the noise in between.

Each round makes the noise parameters the most probable ones for the present force, then takes the force
as linear in the material parameters, by one-sided differences, and solves the robust regression on them
and on the surrogate's own error, within the prior box. Steps of several damped lengths are tried, straight
and along the ridge of the moduli (`straighten`); the best of them is taken if the posterior itself rises. The
information is the posterior's curvature by Fisher scoring, with the t's (nu + 1) / (nu + 3) for each
innovation (Lange, Little & Taylor 1989, JASA 84:881).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from scipy.linalg import cho_solve, solve_triangular
from scipy.optimize import minimize

from bayeskin.inference.likelihood import FARTHEST, STIFF, log_likelihood
from bayeskin.inference.noise_model import NoiseChain, innovations
from bayeskin.inference.problem import LogPosterior
from bayeskin.inference.reparametrisation import Shear
from bayeskin.types import Array, NDArray, Prediction

STEP = 1e-4  # of the box, for differences
DAMPED = ((0.0, 1e-2, 1.0), (1e2, 1e4))  # shares of the information added to its diagonal, in turn
ENOUGH = 0.02  # nats a round
REWEIGHTED, QUICK_REWEIGHTED = 4, 2  # steps of the regression with t weights
NOISE_STEPS = (0.03, 0.1, 0.3, 1.0)  # of Newton's, for the noise
FARTHEST_NOISE = 0.5  # of the box, a step of the noise
SPRUNG = 6  # steps at most, after which it is settled which errors are beyond three sd
ROUNDING = 1e-12  # of the sum of a precision's diagonal
LESS_NOISE = (1.0, 0.3, 0.1)  # shares of a point's noise, by which what is missing from a force is tested
ERRORS = 8  # draws of the surrogate's error, over which a quick step of the noise averages


@dataclass(frozen=True)
class Top:
    """The end of a climb: sampling coordinates (D,) and log density, after so many rounds.

    information (D, D) and gradient (D,) are those of the log density over the unit cube; the material and the
    noise do not mix in the information. latent (r,): the surrogate's error there, in sd of each column of its
    factor.
    """

    vector: Array
    value: float
    rounds: int
    _linear: _Linear

    @property
    def information(self) -> Array:
        return self._linear.curvature[0]

    @property
    def gradient(self) -> Array:
        return self._linear.curvature[1]

    @property
    def latent(self) -> Array:
        return self._linear.curvature[2]


def gauss_newton(
    log_posterior: LogPosterior, start: Array, shear: Shear | None, rounds: int = 40, quick: bool = False
) -> Top:
    """Returns the end of a climb from `start` (D,) in sampling coordinates.

    shear : straightens this posterior, where it is known
    quick : for the first rounds of many climbs, of which the best goes on without: a round's step of the
        noise is one of expectation maximisation, weights are found in fewer steps, the first round that gains
        next to nothing is the last, and a climb across a ridge may end on its side
    """
    low, high = log_posterior.bounds
    x = np.clip(np.asarray(start, dtype=float), low, high)
    here = log_posterior.predict(log_posterior.from_sampling(x))
    value = float(log_posterior.log_prob_given(x[None], here)[0])
    small = made = 0
    while np.isfinite(value) and made < rounds and small < (1 if quick else 2):
        made += 1
        before = value
        linear = _Linear(log_posterior, x, here)
        for trials in _trials(linear, linear.with_noise(quick), shear, quick):
            found = _best(log_posterior, trials)
            if found[1] > value:
                x, value, here = found
            if value > before + ENOUGH:
                break
        small = small + 1 if value - before < ENOUGH else 0
    return Top(x, value, made, _Linear(log_posterior, x, here))


def _best(log_posterior: LogPosterior, trials: Array) -> tuple[Array, float, Prediction]:
    """The most probable of trials (n, D), its log density and the prediction at it."""
    there = log_posterior.predict(log_posterior.from_sampling(trials))
    values = log_posterior.log_prob_given(trials, there)
    best = int(np.argmax(values))
    one = slice(best, best + 1)
    return (
        trials[best],
        float(values[best]),
        Prediction(there.mean[one], there.factor[one], there.diagonal[one]),
    )


def promise(
    log_posterior: LogPosterior, vector: Array, trials: Array, free: NDArray[np.bool_], count: int,
    mean_n: Array | None = None,
) -> list[tuple[int, float, float, Array]]:  # fmt: skip
    """The `count` of `trials` (n, D) along whose change of force most is to be gained from `vector` (D,).

    Of each its row, the nats, the best multiple of that change, and `vector` with what is `free` (D,) moved
    to make room, within the box; all by the force's linear approximation (a score test). What the noise has
    taken up is given back: it is as large as at `vector`, or a part of that, whichever promises most.
    `mean_n` (n, m) is the force at the trials, where the surrogate is not to say it.
    """
    if mean_n is None:
        mean_n = log_posterior.predict_mean(log_posterior.from_sampling(trials))
    value, found = float(log_posterior.log_prob(vector[None])[0]), []
    for share in LESS_NOISE:
        quieter = with_less_noise(log_posterior, vector, share)
        lost = value - float(log_posterior.log_prob(quieter[None])[0])
        found.append(_Promised(log_posterior, quieter, mean_n, free, lost))
    best = np.argmax([one.gain for one in found], axis=0)
    gain = np.max([one.gain for one in found], axis=0)
    return [
        (int(i), float(gain[i]), float(found[best[i]].multiple[i]), found[best[i]].moved(int(i)))
        for i in np.argsort(-gain)[:count]
    ]


def with_less_noise(log_posterior: LogPosterior, vector: Array, share: float = LESS_NOISE[-1]) -> Array:
    """Returns the point (D,) with a share of each kind of phase's noise with a memory, within the box."""
    sds = np.array([name.startswith("sd_") for name in log_posterior.names])
    low, high = log_posterior.bounds
    return np.asarray(np.clip(np.where(sds, vector + np.log(share), vector), low, high))


class _Promised:
    """Score tests of changes of force at a point: nats (n,) less those `lost` by its noise, and multiples."""

    def __init__(
        self, log_posterior: LogPosterior, vector: Array, mean_n: Array, free: NDArray[np.bool_], lost: float
    ) -> None:
        here = log_posterior.predict(log_posterior.from_sampling(vector))
        self._linear, self._vector = _Linear(log_posterior, vector, here), vector
        linear = self._linear
        self._others = free[: linear.inner]
        self._change = linear.white((mean_n - here.mean)[:, linear.chain.bins].T)
        residual, slopes, factor = linear.columns()
        room = np.concatenate([slopes[:, self._others], factor], axis=1)
        moved = int(self._others.sum())
        pull, bend = linear.prior(vector)
        normal = room.T @ room + np.diag(np.r_[np.full(moved, 12.0), np.ones(factor.shape[1])])
        normal[:moved, :moved] += bend[np.ix_(self._others, self._others)]
        target = np.column_stack([residual, self._change])
        right = room.T @ target
        right[:moved, 0] += pull[self._others]
        left = target - room @ np.linalg.solve(normal, right)
        length = np.maximum(np.sum(self._change * left[:, 1:], axis=0), 1e-12)
        self.multiple = (self._change.T @ left[:, 0]) / length
        self.gain = 0.5 * self.multiple**2 * length - lost

    def moved(self, i: int) -> Array:
        """The point (D,) with room made for the best multiple of a change."""
        explained = self.multiple[i] * self._change[:, i]
        step = self._linear.steps(self._vector, (0.0,), REWEIGHTED, explained, self._others)[0]
        return np.asarray(self._vector + step)


def _trials(linear: _Linear, x: Array, shear: Shear | None, quick: bool) -> list[Array]:
    """The point and those that the linear force proposes, (n, D), in the box, for each part of `DAMPED`."""
    low, high = linear.log_posterior.bounds
    steps = iter(linear.steps(x, sum(DAMPED, ()), QUICK_REWEIGHTED if quick else REWEIGHTED))
    found = []
    for dampings in DAMPED:
        trials = [x]
        for _ in dampings:
            step = next(steps)
            trials.append(x + step)
            if shear is not None:
                here = shear.straight(x[None])
                ahead = (shear.straight((x + 1e-6 * step)[None]) - here) / 1e-6
                trials.append(shear.back(here + ahead)[0])
        found.append(np.clip(np.array(trials), low, high))
    return found


class _Linear:
    """The force linear about one point of the material parameters, and the noise there."""

    def __init__(self, log_posterior: LogPosterior, x: Array, here: Prediction) -> None:
        self.log_posterior, self.x, self.here = log_posterior, x, here
        self.chain: NoiseChain = log_posterior.chain
        self.low, self.high = log_posterior.bounds
        self.inner = log_posterior.surrogate.space.dim
        width = self.high - self.low
        side = np.where(x + STEP * width <= self.high, 1.0, -1.0)[: self.inner]
        points = np.repeat(x[None], self.inner + 1, axis=0)
        points[1:, : self.inner] += np.diag(side * STEP * width[: self.inner])
        theta = log_posterior.from_sampling(points)
        mean, bins = log_posterior.predict_mean(theta), self.chain.bins
        slope = (mean[1:] - mean[0])[:, bins] / (side * STEP)[:, None]
        self.slope = slope.T  # (k, inner), a box width
        self.noise = x[self.inner :]
        self._columns: tuple[Array, Array, Array] | None = None

    def with_noise(self, quick: bool) -> Array:
        """The point with the most probable noise for its force, or where a Newton step of the noise ends."""
        low, high = self.low[self.inner :], self.high[self.inner :]
        unit = (self.noise - low) / (high - low)
        better = self._stepped(unit) if quick else self._most_probable(unit)
        if better is not None:
            self.noise, self._columns = low + better * (high - low), None
        return np.concatenate([self.x[: self.inner], self.noise])

    def _most_probable(self, unit: Array) -> Array | None:
        found = minimize(
            self._minus, unit, jac=True, method="L-BFGS-B", bounds=[(0.0, 1.0)] * len(unit),
            options={"maxiter": 6, "ftol": 1e-9},
        )  # fmt: skip
        better = np.clip(found.x, 0.0, 1.0)
        values = self._values(np.array([unit, better]))
        return better if values[1] > values[0] else None

    def _stepped(self, unit: Array) -> Array | None:
        """The best of several lengths of Newton's step, each coordinate by its own second derivative.

        Of what expectation maximisation climbs: the log-likelihood without the surrogate's error, averaged
        over draws of what that is by the recording (Dempster, Laird & Rubin 1977, JRSS B 39:1).
        """
        residual, _, factor = self.columns()
        drawn = drawn_errors(residual, factor, self.nu, _normals(factor.shape[1]))
        mean = self.here.mean[0] + (self.here.factor[0] @ drawn).T  # (ERRORS, m)

        def values(tried: Array) -> Array:
            there = Prediction(
                np.tile(mean, (len(tried), 1)),
                np.zeros((ERRORS * len(tried), mean.shape[1], 1)),
                np.repeat(self.here.diagonal, ERRORS * len(tried), axis=0),
            )
            found = log_likelihood(self.chain, there, np.repeat(self._noise(tried), ERRORS, axis=0))
            return np.asarray(found.reshape(-1, ERRORS).mean(axis=1))

        value, gradient, second = _differences(values, unit)
        far = np.maximum(np.abs(second), np.abs(gradient) / FARTHEST_NOISE)
        step = np.divide(gradient, far, out=np.zeros_like(gradient), where=far > 0.0)
        tried = np.clip(unit + np.outer(NOISE_STEPS, step), 0.0, 1.0)
        found = values(tried)
        best = int(np.argmax(found))
        return tried[best] if found[best] > value else None

    def _minus(self, unit: Array) -> tuple[float, Array]:
        """Minus the value, and its gradient (q,) by one-sided differences."""
        side = np.where(unit + STEP <= 1.0, 1.0, -1.0)
        values = self._values(np.concatenate([unit[None], unit + STEP * np.diag(side)]))
        return -float(values[0]), (values[0] - values[1:]) * side / STEP

    def _values(self, unit: Array) -> Array:
        """Log-likelihoods (n,) at noise parameters (n, q) of the unit cube."""
        return log_likelihood(self.chain, self.here, self._noise(unit))

    def _noise(self, unit: Array) -> Array:
        """Noise (n, q) in SI from the unit cube."""
        low, high = self.low[self.inner :], self.high[self.inner :]
        rows = np.repeat(self.x[None], len(unit), axis=0)
        rows[:, self.inner :] = low + np.clip(unit, 0.0, 1.0) * (high - low)
        return self.log_posterior.split(self.log_posterior.from_sampling(rows))[1]

    def white(self, columns: Array) -> Array:
        """Columns (k, n) in innovations of the noise at hand."""
        _, noise = self.log_posterior.split(
            self.log_posterior.from_sampling(np.concatenate([self.x[: self.inner], self.noise]))
        )
        self.nu = float(noise[0, -1])
        return innovations(self.chain, noise[0], self.here.diagonal[0, self.chain.bins], columns)

    def columns(self) -> tuple[Array, Array, Array]:
        """Residual (k,), slopes (k, d) and the surrogate's factor (k, r), whitened by the noise at hand."""
        if self._columns is None:
            bins = self.chain.bins
            residual = self.chain.force_n - self.here.mean[0, bins]
            plain = np.concatenate([residual[:, None], self.slope, self.here.factor[0, bins]], axis=1)
            white = self.white(plain)
            self._columns = white[:, 0], white[:, 1 : self.inner + 1], white[:, self.inner + 1 :]
        return self._columns

    def prior(self, x: Array) -> tuple[Array, Array]:
        """Gradient (d,) of the log prior of the material at x (D,) and its curvature (d, d), downward, by the
        box's width."""
        width = (self.high - self.low)[: self.inner]
        gradient, curvature = self.log_posterior.space.log_density_slopes(x)
        inner = curvature[: self.inner, : self.inner]
        return width * gradient[: self.inner], np.outer(width, width) * inner

    def steps(
        self, x: Array, dampings: Sequence[float], reweighted: int, explained: Array | float = 0.0,
        free: NDArray[np.bool_] | None = None,
    ) -> list[Array]:  # fmt: skip
        """Changes (D,) of the sampling coordinates that the regression asks for, within the box, damped each.

        `explained` (k,), in innovations, is taken from the residual first; only `free` ones move. The weights
        are those of the first damping, after so many steps.
        """
        residual, slopes, factor = self.columns()
        residual = residual - explained
        if free is not None:
            slopes = slopes * free
        design = np.concatenate([slopes, factor], axis=1)
        width = (self.high - self.low)[: self.inner]
        room_up = (self.high[: self.inner] - x[: self.inner]) / width
        room_down = (self.low[: self.inner] - x[: self.inner]) / width
        pull, bend = self.prior(x)
        if free is not None:
            pull, bend = pull * free, bend * np.outer(free, free)

        def solved(normal: Array, target: Array, change: Array, damping: float) -> Array:
            penalty = np.full(design.shape[1], 1e-6)
            penalty[: self.inner] += damping * np.maximum(np.diag(normal)[: self.inner], 1e-6)
            penalty[self.inner :], rest = _spring(change[self.inner :])
            normal, target = normal.copy(), target.copy()
            target[self.inner :] += rest
            target[: self.inner] += pull
            normal[: self.inner, : self.inner] += bend
            normal[np.diag_indices(len(normal))] += penalty
            return _bounded(normal, target, room_down, room_up, self.inner)

        change: Array = np.zeros(design.shape[1])
        for _ in range(reweighted):
            root = np.sqrt(_weight(residual - design @ change, self.nu))
            weighted = design * root[:, None]
            normal, target = weighted.T @ weighted, weighted.T @ (root * residual)
            change = solved(normal, target, change, dampings[0])
        found = []
        for one in (change, *(solved(normal, target, change, damping) for damping in dampings[1:])):
            step = np.zeros(len(x))
            step[: self.inner] = one[: self.inner] * width
            found.append(step)
        return found

    @cached_property
    def curvature(self) -> tuple[Array, Array, Array]:
        """Information (D, D) and gradient (D,) over the unit cube; the surrogate's error (r,)."""
        residual, slopes, factor = self.columns()
        latent = surrogate_error(residual, factor, self.nu)
        weight = (self.nu + 1.0) / (self.nu + 3.0)
        taken = _orthonormal(np.sqrt(weight) * factor, _spring(latent)[0])[0].T @ slopes
        material = weight * (slopes.T @ slopes - taken.T @ taken)
        left = residual - factor @ latent
        steep = slopes.T @ (_weight(left, self.nu) * left)
        low, high = self.low[self.inner :], self.high[self.inner :]
        _, noise_gradient, second = _differences(self._values, (self.noise - low) / (high - low))
        information = np.diag(np.concatenate([np.zeros(self.inner), np.maximum(-second, 0.0)]))
        pull, bend = self.prior(self.x)
        information[: self.inner, : self.inner] = material + bend
        return information, np.concatenate([steep + pull, noise_gradient]), latent


def _differences(values: Callable[[Array], Array], unit: Array) -> tuple[float, Array, Array]:
    """Value, gradient (q,) and second derivatives (q,) at a point of the unit cube, one inside the bounds."""
    eye = STEP * np.eye(len(unit))
    centre = np.clip(unit, STEP, 1.0 - STEP)
    found = values(np.concatenate([unit[None], centre[None], centre + eye, centre - eye]))
    up, down = found[2:].reshape(2, -1)
    return float(found[0]), (up - down) / (2 * STEP), (up + down - 2 * found[1]) / STEP**2


@cache
def _normals(rank: int) -> Array:
    """The same ones each time, (rank, ERRORS), each with its opposite."""
    half = np.random.default_rng(rank).standard_normal((rank, ERRORS // 2))
    return np.concatenate([half, -half], axis=1)


def _weight(left: Array, nu: float) -> Array:
    """Returns weights of innovations in a regression whose errors are t."""
    return np.asarray((nu + 1.0) / (nu + left**2))


def drawn_errors(residual: Array, factor: Array, nu: float, normals: Array) -> Array:
    """Returns draws (r, s) of the force's error given the residual, normal about the most probable one.

    In sd of each column of the factor; from standard normals (r, s). Residual (k,) and factor (k, r) are
    whitened to innovations, of t noise with `nu` degrees of freedom.
    """
    latent, weight = np.zeros(factor.shape[1]), np.ones(len(residual))
    for _ in range(QUICK_REWEIGHTED):
        weight = _weight(residual - factor @ latent, nu)
        weighted = factor * np.sqrt(weight)[:, None]
        gram, target = weighted.T @ weighted, factor.T @ (weight * residual)
        for _ in range(SPRUNG):
            stiffness, rest = _spring(latent)
            lower = np.linalg.cholesky(gram + np.diag(stiffness + ROUNDING * np.trace(gram)))
            latent, before = cho_solve((lower, True), target + rest), latent
            if np.array_equal(np.abs(latent) > FARTHEST, np.abs(before) > FARTHEST):
                break
    return np.asarray(latent[:, None] + solve_triangular(lower.T, normals))


def surrogate_error(residual: Array, factor: Array, nu: float) -> Array:
    """The most probable error of the surrogate (r,), in sd of each column of its factor.

    residual (k,) and factor (k, r) whitened to innovations, of t noise with `nu` degrees of freedom.
    """
    latent: Array = np.zeros(factor.shape[1])
    for _ in range(REWEIGHTED):
        root = np.sqrt(_weight(residual - factor @ latent, nu))
        stiffness, rest = _spring(latent)
        columns, own, triangle = _orthonormal(root[:, None] * factor, stiffness)
        target = columns.T @ (root * residual) + own.T @ (rest / np.sqrt(stiffness))
        latent = np.asarray(solve_triangular(triangle, target), dtype=float)
    return latent


def _orthonormal(factor: Array, stiffness: Array) -> tuple[Array, Array, Array]:
    """Q (k, r) and (r, r), R (r, r) of the columns (k, r) over the roots of their prior's stiffness (r,).

    Where a surrogate knows next to nothing, its columns are so large that beside their squares the prior is
    lost to rounding.
    """
    q, triangle = np.linalg.qr(np.concatenate([factor, np.diag(np.sqrt(stiffness))]))
    return q[: len(factor)], q[len(factor) :], triangle


def _spring(latent: Array) -> tuple[Array, Array]:
    """Returns stiffness (r,) of the prior of the surrogate's error, and its pull where the error is zero."""
    beyond = np.abs(latent) > FARTHEST
    return np.where(beyond, 1.0 + STIFF, 1.0), np.where(beyond, STIFF * FARTHEST * np.sign(latent), 0.0)


def _bounded(normal: Array, target: Array, low: Array, high: Array, count: int) -> Array:
    """Solution whose first `count` entries lie in [low, high]: those that leave are held at their bound."""
    held = np.zeros(len(target), dtype=bool)
    values: Array = np.asarray(np.linalg.solve(normal, target), dtype=float)
    for _ in range(count):
        outside = ~held[:count] & ((values[:count] < low) | (values[:count] > high))
        if not outside.any():
            break
        held[:count] |= outside
        values[:count] = np.clip(values[:count], low, high)
        free = ~held
        right = target[free] - normal[np.ix_(free, held)] @ values[held]
        values[free] = np.asarray(np.linalg.solve(normal[np.ix_(free, free)], right), dtype=float)
    return values
