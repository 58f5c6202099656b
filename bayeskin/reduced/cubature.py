"""Empirical cubature: few quadrature points with positive weights that integrate what reduced runs integrate.

The rows are integrands over all points, of states that reduced runs went through, tested with random mixtures
of the modes and with the force's own adjoint. The base law's linear part is left out of them, since it is
integrated exactly. A sparse non-negative least-squares fit then chooses points and weights.

Source: Hernandez, Caicedo & Ferrer, Comput. Methods Appl. Mech. Eng. 313 (2017), 687-722; non-negative least
squares: Lawson & Hanson, Solving Least Squares Problems (1974), chapter 23.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from bayeskin.finite_element.lagrangian import Step
from bayeskin.finite_element.stepping import integrate
from bayeskin.reduced.equations import ReducedEquations
from bayeskin.reduced.operators import PointFields, Rule
from bayeskin.reduced.shadow import Shadow
from bayeskin.types import Array


@dataclass(frozen=True)
class CubatureSettings:
    """Settings of the training of a cubature.

    every : steps between the states that are taken
    mixtures : random test vectors a state
    force : weight of the force's own rows beside a mixture's
    pressure : size of a pressure coefficient a newton of the peak force; mode_m : of a displacement's [m]
    volume : weight of the layers' volumes
    most : largest norm of a row; states with larger ones are scaled down, so that none outweighs all others
    batch : points added at once
    """

    every: int = 5
    mixtures: int = 6
    force: float = 30.0
    pressure: float = 3.0
    mode_m: float = 5e-3
    volume: float = 1.0
    most: float = 20.0
    batch: int = 8


@dataclass(frozen=True)
class Taken:
    """Integrands of one reduced run, to train or test a cubature.

    rows (r, n) : integrands times weights, over the peak force
    missing (s,) : force on all points less that of the run, over its peak, at the states taken
    message : empty, or why the run ended early
    """

    rows: Array
    missing: Array
    message: str


def take(run: ReducedEquations, shadow: Shadow, p_init: float, settings: CubatureSettings,
         rng: np.random.Generator, tolerance: float = 2e-3) -> Taken:  # fmt: skip
    """Runs the reduced model and follows it on all points, whose integrands are taken at some states."""
    states: list[tuple[Array, Array, float]] = []
    forces, count = [0.0], [0]

    def on_step(step: Step) -> None:
        if abs(step.state.time_s - run.starts_s) < 1e-6:
            run.zero_n = step.force_n
        followed = None
        for stage in step.stages:
            followed = shadow.follow(stage, max(stage.state.time_s - run.starts_s, 0.0))
            if followed is None:
                raise FloatingPointError("a point that was not chosen is inside out")
        if followed is None:
            return
        forces.append(step.force_n)
        count[0] += 1
        if step.corner or count[0] % settings.every == 0:
            dual = run.dual()
            missing_n = 2.0 * float(dual @ followed.residual) - step.force_n
            states.append((shadow.nonlinear_integrands(followed), dual, missing_n))

    try:
        message = integrate(run, p_init, tolerance, on_step, falls_too=False)
    except FloatingPointError as error:
        message = str(error)
    peak_n = max(map(abs, forces))
    at = shadow.equations.space.at
    rows = [_tested(integrand, dual, at, peak_n, settings, rng) for integrand, dual, _ in states]
    missing = np.array([missing_n for _, _, missing_n in states]) / peak_n if states else np.zeros(0)
    return Taken(np.concatenate([np.zeros((0, len(at.weight)), np.float32), *rows]), missing, message)


def _tested(
    integrand: Array, dual: Array, at: PointFields, peak_n: float, settings: CubatureSettings,
    rng: np.random.Generator,
) -> Array:  # fmt: skip
    """Rows (mixtures + 2, n) of one state's integrand (n, k + m): mixtures, and the force by layer."""
    k = at.gradient.shape[2]
    mixture = rng.standard_normal((integrand.shape[1], settings.mixtures)) / np.sqrt(settings.mixtures)
    mixture[:2] = 0.0
    mixture[k:] *= settings.pressure * peak_n
    mixed = (integrand @ mixture).T / (peak_n * settings.mode_m)
    force = settings.force * 2.0 * (integrand @ dual) / peak_n
    rows = np.concatenate([mixed, [force * at.cutis, force * ~at.cutis]]) * at.weight
    largest = float(np.linalg.norm(rows, axis=1).max())
    return np.asarray(rows * (settings.most / max(largest, settings.most)), dtype=np.float32)


def with_volumes(rows: Array, at: PointFields, settings: CubatureSettings) -> Array:
    """The rows, and one for the volume of each layer, so that the weights add up to it."""
    share = at.weight / at.weight.sum() * settings.volume * np.sqrt(len(rows))
    return np.concatenate([rows, np.array([share * at.cutis, share * ~at.cutis], dtype=np.float32)])


def choose_points(
    rows: Array, counts: Sequence[int], settings: CubatureSettings
) -> dict[int, tuple[Rule, float]]:
    """Returns cubatures of about `counts` points, increasing, for rows (r, n), and what each leaves."""
    right = rows.sum(axis=1, dtype=np.float64)
    norm = np.sqrt(np.einsum("ij,ij->j", rows, rows, dtype=np.float64))
    norm = np.maximum(norm, 1e-6 * norm.max())
    points, fit = np.zeros(0, np.int64), _NonNegative(right)
    found: dict[int, tuple[Rule, float]] = {}
    wanted = list(counts)
    while wanted:
        gain = (fit.left().astype(np.float32) @ rows) / norm
        gain[points] = -np.inf
        more = min(settings.batch if len(points) > 20 else 2, max(1, wanted[0] - len(points)))
        new = np.argpartition(-gain, more)[:more]
        kept = fit.add(rows[:, new].astype(np.float64))
        points = np.concatenate([points, new])[kept]
        if len(points) >= wanted[0]:
            left = float(np.linalg.norm(fit.left()) / np.linalg.norm(right))
            found[wanted.pop(0)] = Rule(points.copy(), fit.factor.copy()), left
    return found


class _NonNegative:
    """Non-negative least squares of columns that come one batch after another.

    factor (c,) : of the columns kept so far, all positive
    """

    def __init__(self, right: Array) -> None:
        self.factor = np.zeros(0)
        self._right = right
        self._columns = np.zeros((len(right), 0))
        self._gram, self._projected = np.zeros((0, 0)), np.zeros(0)

    def left(self) -> Array:
        """Returns the residual of the right-hand side."""
        return self._right - self._columns @ self.factor

    def add(self, new: Array) -> np.ndarray:
        """Adds columns and solves again; returns the numbers of those that are kept, the new ones last."""
        cross, own = self._columns.T @ new, new.T @ new
        own[np.diag_indices_from(own)] *= 1.0 + 1e-12
        self._gram = np.block([[self._gram, cross], [cross.T, own]])
        self._projected = np.concatenate([self._projected, new.T @ self._right])
        self._columns = np.concatenate([self._columns, new], axis=1)
        kept = self._solved(np.concatenate([self.factor, np.zeros(new.shape[1])]))
        self._gram, self._projected = self._gram[np.ix_(kept, kept)], self._projected[kept]
        self._columns = self._columns[:, kept]
        return kept

    def _solved(self, factor: Array) -> np.ndarray:
        """Lawson and Hanson's inner loop from a feasible start."""
        kept = np.arange(len(factor))
        while True:
            factored = cho_factor(self._gram[np.ix_(kept, kept)], overwrite_a=True, check_finite=False)
            trial = cho_solve(factored, self._projected[kept], check_finite=False)
            if trial.min() > 0.0:
                self.factor = trial
                return kept
            negative = trial <= 0.0
            idle = negative & (factor == 0.0)
            if idle.any():
                stays = ~idle
            else:
                share = np.min(factor[negative] / (factor[negative] - trial[negative]))
                factor = factor + share * (trial - factor)
                stays = factor > 1e-12 * factor.max()
                if stays.all():
                    stays = np.arange(len(factor)) != np.argmin(np.where(negative, factor, np.inf))
            kept, factor = kept[stays], factor[stays]
