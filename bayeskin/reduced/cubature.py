"""Trains an empirical cubature: a few quadrature points with positive weights that suffice for reduced runs.

Reduced runs pass through many states. At each state that is recorded, the integrand of the residual at all
points is tested with random mixtures of the modes and with the adjoint of the force, which gives the rows of
a least-squares problem. The linear part of the base law is left out, since it is integrated exactly. A sparse
non-negative least-squares fit then chooses points and weights.

Source: Hernandez, Caicedo & Ferrer, Comput. Methods Appl. Mech. Eng. 313 (2017), 687-722; non-negative least
squares: Lawson & Hanson, Solving Least Squares Problems (1974), chapter 23.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from bayeskin.finite_element.stages import Step
from bayeskin.finite_element.stepping import integrate
from bayeskin.reduced.equations import ReducedEquations
from bayeskin.reduced.operators import PointFields, Rule
from bayeskin.reduced.shadow import Shadow
from bayeskin.types import Array


@dataclass(frozen=True)
class CubatureSettings:
    """Settings of the training of a cubature.

    every : number of steps from one recorded state to the next
    mixtures : number of random test vectors for each state
    force : weight of the rows of the force, relative to a row of a mixture
    pressure : size of a pressure coefficient per newton of the peak force
    mode_m : size of a displacement coefficient [m]
    volume : weight of the rows for the volumes of the layers
    most : largest norm of a row; states with larger rows are scaled down, so that no state outweighs the rest
    batch : number of points that are added at once
    exact : relative residual that counts as zero; further points would change nothing
    """

    every: int = 5
    mixtures: int = 6
    force: float = 30.0
    pressure: float = 3.0
    mode_m: float = 5e-3
    volume: float = 1.0
    most: float = 20.0
    batch: int = 8
    exact: float = 1e-6


@dataclass(frozen=True)
class Taken:
    """Integrands of one reduced run, to train or to test a cubature.

    rows (r, n) : integrands times the weights of the points, relative to the peak force
    missing (s,) : force from all points minus the force of the run, relative to its peak, at recorded states
    message : empty, or the reason why the run ended early
    """

    rows: Array
    missing: Array
    message: str


def take(run: ReducedEquations, shadow: Shadow, p_init: float, settings: CubatureSettings,
         rng: np.random.Generator, tolerance: float = 2e-3) -> Taken:  # fmt: skip
    """Runs the reduced model, follows it on all points and returns the integrands there at some states."""
    states: list[tuple[Array, Array, float]] = []
    forces, count = [0.0], [0]

    def on_step(step: Step) -> None:
        if abs(step.state.time_s - run.starts_s) < 1e-6:
            run.zero_n = step.force_n
        at_all_points = None
        for stage in step.stages:
            at_all_points = shadow.follow(stage, max(stage.state.time_s - run.starts_s, 0.0))
            if at_all_points is None:
                raise FloatingPointError("the mesh is inverted at a point that was not chosen")
        if at_all_points is None:
            return
        forces.append(step.force_n)
        count[0] += 1
        if step.corner or count[0] % settings.every == 0:
            dual = run.dual()
            missing_n = 2.0 * float(dual @ at_all_points.residual) - step.force_n
            states.append((shadow.nonlinear_integrands(at_all_points), dual, missing_n))

    try:
        message = integrate(run, p_init, tolerance, on_step, falls_too=False)
    except FloatingPointError as error:
        message = str(error)
    peak_n = max(map(abs, forces))
    at = shadow.equations.space.at
    rows = [rows_of_state(integrand, dual, at, peak_n, settings, rng) for integrand, dual, _ in states]
    missing = np.array([missing_n for _, _, missing_n in states]) / peak_n if states else np.zeros(0)
    return Taken(np.concatenate([np.zeros((0, len(at.weight)), np.float32), *rows]), missing, message)


def rows_of_state(
    integrand: Array, dual: Array, at: PointFields, peak_n: float, settings: CubatureSettings,
    rng: np.random.Generator,
) -> Array:  # fmt: skip
    """Returns the rows (mixtures + 2, n) of one state's integrand (n, k + m).

    The first rows belong to the mixtures; the last two are the force of the cutis and of the subcutis.
    """
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
    """Returns the rows and one more for each layer, so that the weights in a layer add up to its volume."""
    share = at.weight / at.weight.sum() * settings.volume * np.sqrt(len(rows))
    return np.concatenate([rows, np.array([share * at.cutis, share * ~at.cutis], dtype=np.float32)])


def choose_points(
    rows: Array, counts: Sequence[int], settings: CubatureSettings
) -> dict[int, tuple[Rule, float]]:
    """Returns cubatures for rows (r, n), each with its relative residual, by the wanted number of points.

    counts : wanted numbers of points, in increasing order. A cubature has about that many points, or fewer
        where fewer are exact. It never needs more points than there are rows
    """
    right = rows.sum(axis=1, dtype=np.float64)
    norm = np.sqrt(np.einsum("ij,ij->j", rows, rows, dtype=np.float64))
    norm = np.maximum(norm, 1e-6 * norm.max())
    points, fit = np.zeros(0, np.int64), _NonNegative(right)
    rules: dict[int, tuple[Rule, float]] = {}
    wanted = list(counts)
    while wanted:
        gain = (fit.left().astype(np.float32) @ rows) / norm
        gain[points] = -np.inf
        count = min(settings.batch if len(points) > 20 else 2, max(1, wanted[0] - len(points)))
        new = np.argpartition(-gain, count)[:count]
        kept = fit.add(rows[:, new].astype(np.float64))
        points = np.concatenate([points, new])[kept]
        remaining = float(np.linalg.norm(fit.left()) / np.linalg.norm(right))
        while wanted and (len(points) >= wanted[0] or remaining < settings.exact):
            rules[wanted.pop(0)] = Rule(points.copy(), fit.factor.copy()), remaining
    return rules


class _NonNegative:
    """Solves a non-negative least-squares problem whose columns are added batch by batch.

    factor (c,) : factors of the columns that are kept so far, all positive
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
        """Adds columns and solves again; returns the indices of the kept columns, the new columns last."""
        cross, among_new = self._columns.T @ new, new.T @ new
        among_new[np.diag_indices_from(among_new)] *= 1.0 + 1e-12
        self._gram = np.block([[self._gram, cross], [cross.T, among_new]])
        self._projected = np.concatenate([self._projected, new.T @ self._right])
        self._columns = np.concatenate([self._columns, new], axis=1)
        kept = self._solved(np.concatenate([self.factor, np.zeros(new.shape[1])]))
        self._gram, self._projected = self._gram[np.ix_(kept, kept)], self._projected[kept]
        self._columns = self._columns[:, kept]
        return kept

    def _solved(self, factor: Array) -> np.ndarray:
        """Runs Lawson and Hanson's inner loop from feasible factors; returns indices of the kept columns."""
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
