"""Finds a local maximum of the posterior with few predictions, by Gauss-Newton steps on the force.

Each round first makes the noise parameters the most probable ones for the present force. It then takes the
force as linear in the material parameters, by one-sided differences. It solves the robust regression on these
parameters and on the surrogate's own error, within the prior box. Steps with several dampings are tried, both
straight and along the ridge of the moduli (`reparametrisation`). The best of them is taken if the posterior
itself rises. The information is the posterior's curvature by Fisher scoring, with the factor
(nu + 1) / (nu + 3) of the t-distribution for each innovation (Lange, Little & Taylor 1989, JASA 84:881).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, solve_triangular
from scipy.optimize import minimize

from bayeskin.inference.likelihood import FARTHEST, STIFF, log_likelihood
from bayeskin.inference.noise_model import NoiseChain, innovations
from bayeskin.inference.problem import LogPosterior
from bayeskin.inference.reparametrisation import Shear
from bayeskin.types import Array, Prediction

STEP = 1e-4  # step of finite differences, as a share of the box
# Multiples of the information's diagonal that are added to it. The second group is tried only where the first
# gains too little.
DAMPED = ((0.0, 1e-2, 1.0), (1e2, 1e4))
ENOUGH = 0.02  # nats that a round gains; a climb ends after rounds that gain less
REWEIGHTED, QUICK_REWEIGHTED = 4, 2  # steps of the regression with t weights
NOISE_STEPS = (0.03, 0.1, 0.3, 1.0)  # multiples of a Newton step of the noise that are tried
FARTHEST_NOISE = 0.5  # largest step of the noise, as a share of the box
SPRUNG = 6  # largest number of steps in which it is settled which errors are beyond three sd
ROUNDING = 1e-12  # share of a precision matrix's trace that is added to its diagonal against rounding
LESS_NOISE = (1.0, 0.3, 0.1)  # shares of a point's noise at which a missing change of force is tested
ERRORS = 8  # draws of the surrogate's error over which a quick step of the noise averages


@dataclass(frozen=True)
class Top:
    """End point of a climb: sampling coordinates `vector` (D,), log density `value` and number of rounds.

    information (D, D) and gradient (D,) belong to the log density over the unit cube. The information has no
    terms between material and noise. latent (r,) is the surrogate's error at the point, in sd of each column
    of its factor.
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

    shear : the map that straightens this posterior, where it is known
    quick : for the first rounds of many climbs, of which the best continues without this option. Each round
        makes one step of expectation maximisation for the noise, and fewer steps for the t weights. The first
        round that gains next to nothing is the last. A climb across a ridge may end on the ridge's side.
    """
    low, high = log_posterior.bounds
    x = np.clip(np.asarray(start, dtype=float), low, high)
    prediction = log_posterior.predict(log_posterior.from_sampling(x))
    value = float(log_posterior.log_prob_given(x[None], prediction)[0])
    small_rounds = rounds_done = 0
    while np.isfinite(value) and rounds_done < rounds and small_rounds < (1 if quick else 2):
        rounds_done += 1
        before = value
        linear = _Linear(log_posterior, x, prediction)
        for trials in _trials(linear, linear.with_noise(quick), shear, quick):
            best = _best_trial(log_posterior, trials)
            if best[1] > value:
                x, value, prediction = best
            if value > before + ENOUGH:
                break
        small_rounds = small_rounds + 1 if value - before < ENOUGH else 0
    return Top(x, value, rounds_done, _Linear(log_posterior, x, prediction))


def _best_trial(log_posterior: LogPosterior, trials: Array) -> tuple[Array, float, Prediction]:
    """Returns the most probable of trials (n, D), its log density and the prediction at it."""
    predictions = log_posterior.predict(log_posterior.from_sampling(trials))
    values = log_posterior.log_prob_given(trials, predictions)
    best = int(np.argmax(values))
    row = slice(best, best + 1)
    return (
        trials[best],
        float(values[best]),
        Prediction(predictions.mean[row], predictions.factor[row], predictions.diagonal[row]),
    )


def promise(
    log_posterior: LogPosterior, vector: Array, trials: Array, free: NDArray[np.bool_], count: int,
    mean_n: Array | None = None,
) -> list[tuple[int, float, float, Array]]:  # fmt: skip
    """Returns the `count` trials along whose change of force most can be gained from `vector` (D,).

    Each result has the trial's row, the gain [nats], the best multiple of the change of force, and `vector`
    with its `free` coordinates adjusted to that change, within the box. All follow from the linear
    approximation of the force (a score test). The noise at `vector` may contain the missing change. Each
    trial is therefore tested with this noise and with shares of it (`LESS_NOISE`); its largest gain counts.

    trials : points (n, D) in sampling coordinates
    free : (D,) True for coordinates that may move; only those of the material do
    mean_n : force (n, m) [N] at the trials, where it is not to be predicted by the surrogate
    """
    if mean_n is None:
        mean_n = log_posterior.predict_mean(log_posterior.from_sampling(trials))
    value, by_noise = float(log_posterior.log_prob(vector[None])[0]), []
    for share in LESS_NOISE:
        quieter = with_less_noise(log_posterior, vector, share)
        lost = value - float(log_posterior.log_prob(quieter[None])[0])
        by_noise.append(_ScoreTests(log_posterior, quieter, mean_n, free, lost))
    best = np.argmax([test.gain for test in by_noise], axis=0)
    gain = np.max([test.gain for test in by_noise], axis=0)
    return [
        (int(i), float(gain[i]), float(by_noise[best[i]].multiple[i]), by_noise[best[i]].moved(int(i)))
        for i in np.argsort(-gain)[:count]
    ]


def with_less_noise(log_posterior: LogPosterior, vector: Array, share: float = LESS_NOISE[-1]) -> Array:
    """Returns the point (D,) with a smaller noise, within the box.

    share : factor on the sd of the noise with a memory, for each kind of phase
    """
    sds = np.array([name.startswith("sd_") for name in log_posterior.names])
    low, high = log_posterior.bounds
    return np.asarray(np.clip(np.where(sds, vector + np.log(share), vector), low, high))


class _ScoreTests:
    """Score tests of n changes of force at a point.

    `gain` (n,) [nats] is the gain of each change, less the nats `lost` by the point's noise. `multiple` (n,)
    is the best multiple of each change.
    """

    def __init__(
        self, log_posterior: LogPosterior, vector: Array, mean_n: Array, free: NDArray[np.bool_], lost: float
    ) -> None:
        prediction = log_posterior.predict(log_posterior.from_sampling(vector))
        self._linear, self._vector = _Linear(log_posterior, vector, prediction), vector
        linear = self._linear
        self._others = free[: linear.inner]
        self._change = linear.white((mean_n - prediction.mean)[:, linear.chain.bins].T)
        residual, slopes, factor = linear.columns()
        design = np.concatenate([slopes[:, self._others], factor], axis=1)
        moved = int(self._others.sum())
        pull, bend = linear.prior(vector)
        normal = design.T @ design + np.diag(np.r_[np.full(moved, 12.0), np.ones(factor.shape[1])])
        normal[:moved, :moved] += bend[np.ix_(self._others, self._others)]
        target = np.column_stack([residual, self._change])
        right = design.T @ target
        right[:moved, 0] += pull[self._others]
        residuals = target - design @ np.linalg.solve(normal, right)
        length = np.maximum(np.sum(self._change * residuals[:, 1:], axis=0), 1e-12)
        self.multiple = (self._change.T @ residuals[:, 0]) / length
        self.gain = 0.5 * self.multiple**2 * length - lost

    def moved(self, i: int) -> Array:
        """Returns the point (D,) with its free coordinates adjusted to the best multiple of change `i`."""
        explained = self.multiple[i] * self._change[:, i]
        step = self._linear.steps(self._vector, (0.0,), REWEIGHTED, explained, self._others)[0]
        return np.asarray(self._vector + step)


def _trials(linear: _Linear, x: Array, shear: Shear | None, quick: bool) -> list[Array]:
    """Returns for each group of `DAMPED` the point and the trial points that the linear force proposes.

    Each group is (n, D), within the box.
    """
    low, high = linear.log_posterior.bounds
    steps = iter(linear.steps(x, sum(DAMPED, ()), QUICK_REWEIGHTED if quick else REWEIGHTED))
    groups = []
    for dampings in DAMPED:
        trials = [x]
        for _ in dampings:
            step = next(steps)
            trials.append(x + step)
            if shear is not None:
                straight = shear.straight(x[None])
                change = (shear.straight((x + 1e-6 * step)[None]) - straight) / 1e-6
                trials.append(shear.back(straight + change)[0])
        groups.append(np.clip(np.array(trials), low, high))
    return groups


class _Linear:
    """The force, linear in the material parameters about one point, and the noise at this point."""

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
        self.slope = slope.T  # (k, inner), change of the force [N] over the width of the box
        self.noise = x[self.inner :]
        self._columns: tuple[Array, Array, Array] | None = None

    def with_noise(self, quick: bool) -> Array:
        """Returns the point with the most probable noise for its force; if `quick`, with one noise step."""
        low, high = self.low[self.inner :], self.high[self.inner :]
        unit = (self.noise - low) / (high - low)
        better = self._expectation_step(unit) if quick else self._most_probable(unit)
        if better is not None:
            self.noise, self._columns = low + better * (high - low), None
        return np.concatenate([self.x[: self.inner], self.noise])

    def _most_probable(self, unit: Array) -> Array | None:
        """Returns the most probable noise (q,) in the unit cube, or None if it is no better than `unit`."""
        result = minimize(
            self._negative_value, unit, jac=True, method="L-BFGS-B", bounds=[(0.0, 1.0)] * len(unit),
            options={"maxiter": 6, "ftol": 1e-9},
        )  # fmt: skip
        better = np.clip(result.x, 0.0, 1.0)
        values = self._values(np.array([unit, better]))
        return better if values[1] > values[0] else None

    def _expectation_step(self, unit: Array) -> Array | None:
        """Returns the best of several multiples of a Newton step, or None where none is better than `unit`.

        Each coordinate uses its own second derivative. The objective is that of expectation maximisation: the
        log-likelihood with the surrogate's error fixed, averaged over draws of this error given the
        recording (Dempster, Laird & Rubin 1977, JRSS B 39:1).
        """
        residual, _, factor = self.columns()
        drawn = drawn_errors(residual, factor, self.nu, _normals(factor.shape[1]))
        mean = self.here.mean[0] + (self.here.factor[0] @ drawn).T  # (ERRORS, m)

        def values(tried: Array) -> Array:
            predictions = Prediction(
                np.tile(mean, (len(tried), 1)),
                np.zeros((ERRORS * len(tried), mean.shape[1], 1)),
                np.repeat(self.here.diagonal, ERRORS * len(tried), axis=0),
            )
            each = log_likelihood(self.chain, predictions, np.repeat(self._noise(tried), ERRORS, axis=0))
            return np.asarray(each.reshape(-1, ERRORS).mean(axis=1))

        value, gradient, second = _finite_differences(values, unit)
        far = np.maximum(np.abs(second), np.abs(gradient) / FARTHEST_NOISE)
        step = np.divide(gradient, far, out=np.zeros_like(gradient), where=far > 0.0)
        trials = np.clip(unit + np.outer(NOISE_STEPS, step), 0.0, 1.0)
        trial_values = values(trials)
        best = int(np.argmax(trial_values))
        return trials[best] if trial_values[best] > value else None

    def _negative_value(self, unit: Array) -> tuple[float, Array]:
        """Returns minus the log-likelihood, and its gradient (q,) by one-sided differences."""
        side = np.where(unit + STEP <= 1.0, 1.0, -1.0)
        values = self._values(np.concatenate([unit[None], unit + STEP * np.diag(side)]))
        return -float(values[0]), (values[0] - values[1:]) * side / STEP

    def _values(self, unit: Array) -> Array:
        """Returns log-likelihoods (n,) at noise parameters (n, q) in the unit cube."""
        return log_likelihood(self.chain, self.here, self._noise(unit))

    def _noise(self, unit: Array) -> Array:
        """Returns noise parameters (n, q) in SI from points of the unit cube."""
        low, high = self.low[self.inner :], self.high[self.inner :]
        rows = np.repeat(self.x[None], len(unit), axis=0)
        rows[:, self.inner :] = low + np.clip(unit, 0.0, 1.0) * (high - low)
        return self.log_posterior.split(self.log_posterior.from_sampling(rows))[1]

    def white(self, columns: Array) -> Array:
        """Returns the columns (k, n), whitened to innovations of the present noise."""
        _, noise = self.log_posterior.split(
            self.log_posterior.from_sampling(np.concatenate([self.x[: self.inner], self.noise]))
        )
        self.nu = float(noise[0, -1])
        return innovations(self.chain, noise[0], self.here.diagonal[0, self.chain.bins], columns)

    def columns(self) -> tuple[Array, Array, Array]:
        """Returns residual (k,), slopes (k, d) and surrogate's factor (k, r), all as innovations."""
        if self._columns is None:
            bins = self.chain.bins
            residual = self.chain.force_n - self.here.mean[0, bins]
            plain = np.concatenate([residual[:, None], self.slope, self.here.factor[0, bins]], axis=1)
            white = self.white(plain)
            self._columns = white[:, 0], white[:, 1 : self.inner + 1], white[:, self.inner + 1 :]
        return self._columns

    def prior(self, x: Array) -> tuple[Array, Array]:
        """Returns the gradient (d,) of the material's log prior at x (D,), and its negative curvature (d, d).

        Both are derivatives over the unit cube.
        """
        width = (self.high - self.low)[: self.inner]
        gradient, curvature = self.log_posterior.space.log_density_slopes(x)
        inner = curvature[: self.inner, : self.inner]
        return width * gradient[: self.inner], np.outer(width, width) * inner

    def steps(
        self, x: Array, dampings: Sequence[float], reweighted: int, explained: Array | float = 0.0,
        free: NDArray[np.bool_] | None = None,
    ) -> list[Array]:  # fmt: skip
        """Returns for each damping the regression's change (D,) of the sampling coordinates, within the box.

        `explained` (k,), in innovations, is first subtracted from the residual. Only `free` coordinates move.
        The t weights are those of the first damping, after `reweighted` steps.
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
            penalty[self.inner :], offset = _prior_stiffness(change[self.inner :])
            normal, target = normal.copy(), target.copy()
            target[self.inner :] += offset
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
        steps = []
        for solution in (change, *(solved(normal, target, change, damping) for damping in dampings[1:])):
            step = np.zeros(len(x))
            step[: self.inner] = solution[: self.inner] * width
            steps.append(step)
        return steps

    @cached_property
    def curvature(self) -> tuple[Array, Array, Array]:
        """Returns information (D, D) and gradient (D,) over the unit cube, and the surrogate's error (r,)."""
        residual, slopes, factor = self.columns()
        latent = surrogate_error(residual, factor, self.nu)
        weight = (self.nu + 1.0) / (self.nu + 3.0)
        absorbed = _orthonormal(np.sqrt(weight) * factor, _prior_stiffness(latent)[0])[0].T @ slopes
        material = weight * (slopes.T @ slopes - absorbed.T @ absorbed)
        unexplained = residual - factor @ latent
        material_gradient = slopes.T @ (_weight(unexplained, self.nu) * unexplained)
        low, high = self.low[self.inner :], self.high[self.inner :]
        _, noise_gradient, second = _finite_differences(self._values, (self.noise - low) / (high - low))
        information = np.diag(np.concatenate([np.zeros(self.inner), np.maximum(-second, 0.0)]))
        pull, bend = self.prior(self.x)
        information[: self.inner, : self.inner] = material + bend
        return information, np.concatenate([material_gradient + pull, noise_gradient]), latent


def _finite_differences(values: Callable[[Array], Array], unit: Array) -> tuple[float, Array, Array]:
    """Returns value, gradient (q,) and second derivatives (q,) at a point of the unit cube.

    The derivatives are taken at the nearest point whose differences stay inside the cube.
    """
    eye = STEP * np.eye(len(unit))
    centre = np.clip(unit, STEP, 1.0 - STEP)
    results = values(np.concatenate([unit[None], centre[None], centre + eye, centre - eye]))
    up, down = results[2:].reshape(2, -1)
    return float(results[0]), (up - down) / (2 * STEP), (up + down - 2 * results[1]) / STEP**2


@cache
def _normals(rank: int) -> Array:
    """Returns the same standard normals (rank, ERRORS) each time, each with its opposite."""
    half = np.random.default_rng(rank).standard_normal((rank, ERRORS // 2))
    return np.concatenate([half, -half], axis=1)


def _weight(left: Array, nu: float) -> Array:
    """Returns weights of innovations in a regression whose errors follow a t-distribution."""
    return np.asarray((nu + 1.0) / (nu + left**2))


def drawn_errors(residual: Array, factor: Array, nu: float, normals: Array) -> Array:
    """Returns draws (r, s) of the force's error given the residual, normal about the most probable error.

    The draws are in sd of each column of the factor, and are made from standard normals (r, s). Residual (k,)
    and factor (k, r) are whitened to innovations of t noise with `nu` degrees of freedom.
    """
    latent, weight = np.zeros(factor.shape[1]), np.ones(len(residual))
    for _ in range(QUICK_REWEIGHTED):
        weight = _weight(residual - factor @ latent, nu)
        weighted = factor * np.sqrt(weight)[:, None]
        gram, target = weighted.T @ weighted, factor.T @ (weight * residual)
        for _ in range(SPRUNG):
            stiffness, offset = _prior_stiffness(latent)
            lower = np.linalg.cholesky(gram + np.diag(stiffness + ROUNDING * np.trace(gram)))
            latent, before = cho_solve((lower, True), target + offset), latent
            if np.array_equal(np.abs(latent) > FARTHEST, np.abs(before) > FARTHEST):
                break
    return np.asarray(latent[:, None] + solve_triangular(lower.T, normals))


def surrogate_error(residual: Array, factor: Array, nu: float) -> Array:
    """Returns the most probable error of the surrogate (r,), in sd of each column of its factor.

    residual (k,) and factor (k, r) are whitened to innovations of t noise with `nu` degrees of freedom.
    """
    latent: Array = np.zeros(factor.shape[1])
    for _ in range(REWEIGHTED):
        root = np.sqrt(_weight(residual - factor @ latent, nu))
        stiffness, offset = _prior_stiffness(latent)
        columns, prior_rows, triangle = _orthonormal(root[:, None] * factor, stiffness)
        target = columns.T @ (root * residual) + prior_rows.T @ (offset / np.sqrt(stiffness))
        latent = np.asarray(solve_triangular(triangle, target), dtype=float)
    return latent


def _orthonormal(factor: Array, stiffness: Array) -> tuple[Array, Array, Array]:
    """Returns the QR decomposition of the columns (k, r) and the roots of their prior's stiffness (r,) below.

    The result is Q in two blocks, (k, r) and (r, r), and R (r, r). Normal equations would lose the prior to
    rounding where a surrogate knows next to nothing, since the squares of its columns are so large there.
    """
    q, triangle = np.linalg.qr(np.concatenate([factor, np.diag(np.sqrt(stiffness))]))
    return q[: len(factor)], q[len(factor) :], triangle


def _prior_stiffness(latent: Array) -> tuple[Array, Array]:
    """Returns stiffness (r,) of the prior of the surrogate's error, and its pull (r,) at an error of zero.

    The pull is extrapolated linearly from the error `latent` (r,). The prior is stiffer beyond three sd.
    """
    beyond = np.abs(latent) > FARTHEST
    return np.where(beyond, 1.0 + STIFF, 1.0), np.where(beyond, STIFF * FARTHEST * np.sign(latent), 0.0)


def _bounded(normal: Array, target: Array, low: Array, high: Array, count: int) -> Array:
    """Returns the solution whose first `count` entries lie in [low, high].

    Entries that leave this interval are held at their bound.
    """
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
