"""The force near one point, linear in the material parameters, and the noise at this point.

The posterior near the point is then a robust regression on the material parameters and on the surrogate's own
error, within the prior box. A Gauss-Newton step solves it, and its curvature is the posterior's information.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from bayeskin.inference.gauss_newton_settings import GaussNewtonSettings
from bayeskin.inference.likelihood import log_likelihood
from bayeskin.inference.noise_model import NoiseChain, innovations
from bayeskin.inference.problem import LogPosterior
from bayeskin.inference.surrogate_error import (
    drawn_errors,
    orthonormal,
    prior_stiffness,
    surrogate_error,
    t_weight,
)
from bayeskin.types import Array, Prediction


class LocalRegression:
    """The force, linear in the material parameters about one point, and the noise at this point."""

    def __init__(
        self, log_posterior: LogPosterior, x: Array, here: Prediction, settings: GaussNewtonSettings
    ) -> None:
        self.log_posterior, self.x, self.here, self.settings = log_posterior, x, here, settings
        self.chain: NoiseChain = log_posterior.chain
        self.low, self.high = log_posterior.bounds
        self.inner = log_posterior.surrogate.space.dim
        width, share = self.high - self.low, settings.step
        side = np.where(x + share * width <= self.high, 1.0, -1.0)[: self.inner]
        points = np.repeat(x[None], self.inner + 1, axis=0)
        points[1:, : self.inner] += np.diag(side * share * width[: self.inner])
        theta = log_posterior.from_sampling(points)
        mean, bins = log_posterior.predict_mean(theta), self.chain.bins
        slope = (mean[1:] - mean[0])[:, bins] / (side * share)[:, None]
        self.slope = slope.T  # (k, inner), change of the force [N] over the width of the box
        self.noise = x[self.inner :]
        self._markers: tuple[Array, Array] | None = None
        if log_posterior.markers is not None:
            moved_m = log_posterior.predict_markers(theta)
            by_m = (moved_m[1:] - moved_m[0]) / (side * share)[:, None, None, None]
            self._markers = moved_m[0], by_m
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
        (residual, _, factor), count = self.columns(), self.settings.error_draws
        normals = _normals(factor.shape[1], count)
        drawn = drawn_errors(residual, factor, self.nu, normals, self.settings)
        mean = self.here.mean[0] + (self.here.factor[0] @ drawn).T  # (count, m)

        def values(tried: Array) -> Array:
            predictions = Prediction(
                np.tile(mean, (len(tried), 1)),
                np.zeros((count * len(tried), mean.shape[1], 1)),
                np.repeat(self.here.diagonal, count * len(tried), axis=0),
            )
            rows = self._at_noise(tried)
            noise = np.repeat(self.log_posterior.split(rows)[1], count, axis=0)
            each = log_likelihood(self.chain, predictions, noise)
            return np.asarray(each.reshape(-1, count).mean(axis=1)) + self._of_markers(rows)

        value, gradient, second = _finite_differences(values, unit, self.settings.step)
        far = np.maximum(np.abs(second), np.abs(gradient) / self.settings.farthest_noise)
        step = np.divide(gradient, far, out=np.zeros_like(gradient), where=far > 0.0)
        trials = np.clip(unit + np.outer(self.settings.noise_steps, step), 0.0, 1.0)
        trial_values = values(trials)
        best = int(np.argmax(trial_values))
        return trials[best] if trial_values[best] > value else None

    def _negative_value(self, unit: Array) -> tuple[float, Array]:
        """Returns minus the log-likelihood, and its gradient (q,) by one-sided differences."""
        step = self.settings.step
        side = np.where(unit + step <= 1.0, 1.0, -1.0)
        values = self._values(np.concatenate([unit[None], unit + step * np.diag(side)]))
        return -float(values[0]), (values[0] - values[1:]) * side / step

    def _values(self, unit: Array) -> Array:
        """Returns log-likelihoods (n,) at noise parameters (n, q) in the unit cube."""
        rows = self._at_noise(unit)
        of_force = log_likelihood(self.chain, self.here, self.log_posterior.split(rows)[1])
        return of_force + self._of_markers(rows)

    def _of_markers(self, rows: Array) -> Array | float:
        """Returns the log-likelihood of the markers (n,) at SI values (n, D) that differ in their noise."""
        markers = self.log_posterior.markers
        if markers is None or self._markers is None:
            return 0.0
        return markers.log_density(self._markers[0][None], rows[:, -1])

    def _at_noise(self, unit: Array) -> Array:
        """Returns the point in SI with other noise (n, D), from noise parameters (n, q) in the unit cube."""
        low, high = self.low[self.inner :], self.high[self.inner :]
        rows = np.repeat(self.x[None], len(unit), axis=0)
        rows[:, self.inner :] = low + np.clip(unit, 0.0, 1.0) * (high - low)
        return self.log_posterior.from_sampling(rows)

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

    def beside_force(self, x: Array) -> tuple[Array, Array]:
        """Returns the gradient (d,) of what is beside the force, and its negative curvature (d, d).

        This is the log prior of the material at x (D,), and the markers' log-likelihood near the point. Both
        results are derivatives over the unit cube.
        """
        width = (self.high - self.low)[: self.inner]
        gradient, curvature = self.log_posterior.space.log_density_slopes(x)
        inner = curvature[: self.inner, : self.inner]
        pull, bend = width * gradient[: self.inner], np.outer(width, width) * inner
        markers = self.log_posterior.markers
        if markers is None or self._markers is None:
            return pull, bend
        sd_m = self.log_posterior.from_sampling(np.concatenate([x[: self.inner], self.noise]))[-1]
        (here_m, by_m), images = self._markers, len(self._markers[0])
        columns_m = np.concatenate([markers.residual_m(here_m[None]), by_m.reshape(self.inner, images, -1)])
        white = markers.whitened(columns_m.transpose(1, 2, 0), float(sd_m)).reshape(-1, 1 + self.inner)
        slopes = white[:, 1:]
        step = (x[: self.inner] - self.x[: self.inner]) / width
        return pull + slopes.T @ (white[:, 0] - slopes @ step), bend + slopes.T @ slopes

    def steps(
        self, x: Array, dampings: Sequence[float], quick: bool = False, explained: Array | float = 0.0,
        free: NDArray[np.bool_] | None = None,
    ) -> list[Array]:  # fmt: skip
        """Returns for each damping the regression's change (D,) of the sampling coordinates, within the box.

        `explained` (k,), in innovations, is first subtracted from the residual. Only `free` coordinates move.
        The t weights are those of the first damping.
        """
        residual, slopes, factor = self.columns()
        residual = residual - explained
        if free is not None:
            slopes = slopes * free
        design = np.concatenate([slopes, factor], axis=1)
        width = (self.high - self.low)[: self.inner]
        room_up = (self.high[: self.inner] - x[: self.inner]) / width
        room_down = (self.low[: self.inner] - x[: self.inner]) / width
        pull, bend = self.beside_force(x)
        if free is not None:
            pull, bend = pull * free, bend * np.outer(free, free)

        def solved(normal: Array, target: Array, change: Array, damping: float) -> Array:
            penalty = np.full(design.shape[1], 1e-6)
            penalty[: self.inner] += damping * np.maximum(np.diag(normal)[: self.inner], 1e-6)
            penalty[self.inner :], offset = prior_stiffness(change[self.inner :])
            normal, target = normal.copy(), target.copy()
            target[self.inner :] += offset
            target[: self.inner] += pull
            normal[: self.inner, : self.inner] += bend
            normal[np.diag_indices(len(normal))] += penalty
            return _bounded(normal, target, room_down, room_up, self.inner)

        change: Array = np.zeros(design.shape[1])
        for _ in range(self.settings.quick_reweighted if quick else self.settings.reweighted):
            root = np.sqrt(t_weight(residual - design @ change, self.nu))
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
        latent = surrogate_error(residual, factor, self.nu, self.settings)
        weight = (self.nu + 1.0) / (self.nu + 3.0)
        absorbed = orthonormal(np.sqrt(weight) * factor, prior_stiffness(latent)[0])[0].T @ slopes
        material = weight * (slopes.T @ slopes - absorbed.T @ absorbed)
        unexplained = residual - factor @ latent
        material_gradient = slopes.T @ (t_weight(unexplained, self.nu) * unexplained)
        low, high = self.low[self.inner :], self.high[self.inner :]
        unit = (self.noise - low) / (high - low)
        _, noise_gradient, second = _finite_differences(self._values, unit, self.settings.step)
        information = np.diag(np.concatenate([np.zeros(self.inner), np.maximum(-second, 0.0)]))
        pull, bend = self.beside_force(self.x)
        information[: self.inner, : self.inner] = material + bend
        return information, np.concatenate([material_gradient + pull, noise_gradient]), latent


def _finite_differences(
    values: Callable[[Array], Array], unit: Array, step: float
) -> tuple[float, Array, Array]:
    """Returns value, gradient (q,) and second derivatives (q,) at a point of the unit cube.

    The derivatives are taken at the nearest point whose differences stay inside the cube.
    """
    eye = step * np.eye(len(unit))
    centre = np.clip(unit, step, 1.0 - step)
    results = values(np.concatenate([unit[None], centre[None], centre + eye, centre - eye]))
    up, down = results[2:].reshape(2, -1)
    return float(results[0]), (up - down) / (2 * step), (up + down - 2 * results[1]) / step**2


@cache
def _normals(rank: int, count: int) -> Array:
    """Returns the same standard normals (rank, count) each time, each with its opposite."""
    half = np.random.default_rng(rank).standard_normal((rank, count // 2))
    return np.concatenate([half, -half], axis=1)


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
