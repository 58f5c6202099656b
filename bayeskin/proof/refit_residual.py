"""Computes what remains of an effect after the base model is fitted again. Only this remainder can be seen.

E_c, E_s, k_c and k_s are fitted to the force without noise, by least squares with the base model's surrogate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from bayeskin.types import Array, Surrogate

FITTED = 4  # the first four of theta; p_init leaves no trace in the force
STEP = 0.02  # step of a finite difference, in the logarithm of a parameter
BATCH = 256
LEVELS = np.array([(k_c, k_s) for k_c in (1e-15, 1e-12) for k_s in (1e-15, 1e-12)])
ALONE = np.empty((0, 2))  # no starting points beside theta itself


@dataclass(frozen=True)
class Refit:
    """Fits the base model. Its `surrogate` has the parameters E_c, E_s, k_c, k_s and p_init."""

    surrogate: Surrogate

    def force(self, theta: Array) -> Array:
        """Returns the force (n, m) of the base model at theta (n, 5)."""
        parts = [self.surrogate.predict(theta[i : i + BATCH]).mean for i in range(0, len(theta), BATCH)]
        return np.concatenate(parts)

    def slopes(self, theta: Array) -> Array:
        """Returns the derivatives (n, m, 4) of the force by the logarithms of the fitted parameters."""
        n, (low, high) = len(theta), np.log(self._bounds())
        lines, moved = np.log(theta[:, :FITTED]), np.repeat(theta[None], 2 * FITTED, axis=0)
        for j in range(FITTED):
            moved[2 * j, :, j] = np.exp(np.maximum(lines[:, j] - STEP, low[j]))
            moved[2 * j + 1, :, j] = np.exp(np.minimum(lines[:, j] + STEP, high[j]))
        force = self.force(moved.reshape(2 * FITTED * n, -1)).reshape(FITTED, 2, n, -1)
        width = np.stack([np.log(moved[2 * j + 1, :, j] / moved[2 * j, :, j]) for j in range(FITTED)])
        return np.asarray(np.moveaxis((force[:, 1] - force[:, 0]) / width[..., None], 0, 2))

    def linear(self, effect_n: Array, theta: Array) -> Array:
        """Returns what remains (n, m) of effects (n, m) after a fit that is linear about theta.

        The effects have to be small enough for this.
        """
        basis, _ = np.linalg.qr(self.slopes(theta))
        fitted = basis @ (np.swapaxes(basis, 1, 2) @ effect_n[:, :, None])
        return np.asarray(effect_n - fitted[:, :, 0])

    def residual(self, force_n: Array, theta: Array, permeabilities: Array = LEVELS) -> Array:
        """Returns what remains (m,) of a force (m,) after the best fit.

        The fit starts from theta (5,). It also starts from each pair of permeabilities (s, 2) [m^2], because
        the sum of squares has several minima in the permeabilities.
        """
        starts = [theta, *(np.concatenate([theta[:2], pair, theta[FITTED:]]) for pair in permeabilities)]
        residuals = [self._fitted_from(force_n, start) for start in starts]
        return min(residuals, key=lambda residual: float(rms(residual)))

    def _fitted_from(self, force_n: Array, theta: Array) -> Array:
        """Returns the residual (m,) of the fit that starts from theta (5,)."""
        bounds = np.log(self._bounds())

        def full(line: Array) -> Array:
            return np.concatenate([np.clip(np.exp(line), *self._bounds()), theta[FITTED:]])[None]

        def excess(line: Array) -> Array:
            return np.asarray(self.force(full(line))[0] - force_n)

        def jacobian(line: Array) -> Array:
            return np.asarray(self.slopes(full(line))[0])

        start = np.clip(np.log(theta[:FITTED]), bounds[0] + 1e-6, bounds[1] - 1e-6)
        fit = least_squares(excess, start, jacobian, bounds=(bounds[0], bounds[1]), max_nfev=100)
        return np.asarray(-fit.fun)

    def _bounds(self) -> Array:
        space = self.surrogate.space
        return np.stack([space.lower[:FITTED], space.upper[:FITTED]])


def rms(values: Array) -> Array:
    """Returns the root mean square over the last axis."""
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=-1)))


def windows(left_n: Array, floor_n: float, edges_s: Array) -> list[tuple[float, float]]:
    """Returns the intervals [s] of bins in which the remaining effect left_n (m,) exceeds the floor."""
    beyond = np.concatenate([[False], np.abs(left_n) > floor_n, [False]])
    ends = np.flatnonzero(np.diff(beyond.astype(int)))
    return [(float(edges_s[a]), float(edges_s[b])) for a, b in ends.reshape(-1, 2)]
