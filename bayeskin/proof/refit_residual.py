"""What is left of an effect when the base model is fitted again: that, not the effect, is what can be seen.

E_c, E_s, k_c and k_s are fitted by least squares, with the base's surrogate, to the noise-free force.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from bayeskin.types import Array, Surrogate

FITTED = 4  # the first of theta; p_init leaves no trace
STEP = 0.02  # of a logarithm, for differences
BATCH = 256
LEVELS = np.array([(k_c, k_s) for k_c in (1e-15, 1e-12) for k_s in (1e-15, 1e-12)])
ALONE = np.empty((0, 2))  # no permeabilities beside theta's own


@dataclass(frozen=True)
class Refit:
    """The base model as it is fitted; `surrogate` of E_c, E_s, k_c, k_s, p_init."""

    surrogate: Surrogate

    def force(self, theta: Array) -> Array:
        """The base's force (n, m) at theta (n, 5)."""
        parts = [self.surrogate.predict(theta[i : i + BATCH]).mean for i in range(0, len(theta), BATCH)]
        return np.concatenate(parts)

    def slopes(self, theta: Array) -> Array:
        """Derivatives (n, m, 4) by the logarithms of what is fitted."""
        n, (low, high) = len(theta), np.log(self._bounds())
        lines, moved = np.log(theta[:, :FITTED]), np.repeat(theta[None], 2 * FITTED, axis=0)
        for j in range(FITTED):
            moved[2 * j, :, j] = np.exp(np.maximum(lines[:, j] - STEP, low[j]))
            moved[2 * j + 1, :, j] = np.exp(np.minimum(lines[:, j] + STEP, high[j]))
        force = self.force(moved.reshape(2 * FITTED * n, -1)).reshape(FITTED, 2, n, -1)
        width = np.stack([np.log(moved[2 * j + 1, :, j] / moved[2 * j, :, j]) for j in range(FITTED)])
        return np.asarray(np.moveaxis((force[:, 1] - force[:, 0]) / width[..., None], 0, 2))

    def linear(self, effect_n: Array, theta: Array) -> Array:
        """What is left (n, m) of effects (n, m) that are small enough for straight lines about theta."""
        basis, _ = np.linalg.qr(self.slopes(theta))
        taken = basis @ (np.swapaxes(basis, 1, 2) @ effect_n[:, :, None])
        return np.asarray(effect_n - taken[:, :, 0])

    def residual(self, force_n: Array, theta: Array, permeabilities: Array = LEVELS) -> Array:
        """What is left (m,) of a force (m,) at the best fit, searched from theta (5,).

        And, for the force has several valleys in them, from each of the permeabilities (s, 2) [m^2] too.
        """
        starts = [theta, *(np.concatenate([theta[:2], pair, theta[FITTED:]]) for pair in permeabilities)]
        found = [self._searched(force_n, start) for start in starts]
        return min(found, key=lambda left: float(rms(left)))

    def _searched(self, force_n: Array, theta: Array) -> Array:
        bounds = np.log(self._bounds())

        def full(line: Array) -> Array:
            return np.concatenate([np.clip(np.exp(line), *self._bounds()), theta[FITTED:]])[None]

        def missing(line: Array) -> Array:
            return np.asarray(self.force(full(line))[0] - force_n)

        def jacobian(line: Array) -> Array:
            return np.asarray(self.slopes(full(line))[0])

        start = np.clip(np.log(theta[:FITTED]), bounds[0] + 1e-6, bounds[1] - 1e-6)
        found = least_squares(missing, start, jacobian, bounds=(bounds[0], bounds[1]), max_nfev=100)
        return np.asarray(-found.fun)

    def _bounds(self) -> Array:
        space = self.surrogate.space
        return np.stack([space.lower[:FITTED], space.upper[:FITTED]])


def rms(values: Array) -> Array:
    """Root mean square over the last axis."""
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=-1)))


def windows(left_n: Array, floor_n: float, edges_s: Array) -> list[tuple[float, float]]:
    """Stretches [s] of bins in which what is left (m,) exceeds the floor."""
    beyond = np.concatenate([[False], np.abs(left_n) > floor_n, [False]])
    ends = np.flatnonzero(np.diff(beyond.astype(int)))
    return [(float(edges_s[a]), float(edges_s[b])) for a, b in ends.reshape(-1, 2)]
