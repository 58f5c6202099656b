"""Nonlinear solves that keep factorised tangents: Newton when needed, Broyden in between.

A factorisation costs as much as some tens of residuals and back-substitutions, and the tangent
changes slowly along the protocol, whose cycles come back to where it was before. So a few are kept, each
under the place where it was made (`Equations.place`), and the nearest serves as approximate inverse,
corrected by Broyden's rank-one updates (C. T. Kelley, Iterative Methods for Linear and Nonlinear
Equations, SIAM 1995, section 7.3). When none contracts well, a new one is made.

Past a fold of the equilibria there is no solution near the last one, and Newton's method finds none. A body
then moves on by itself, and `NewtonSolver.relax` follows it to where it comes to rest.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import scipy.sparse as sp

from bayeskin.finite_element.linear import Factorisations, factorisations
from bayeskin.types import Array

MAX_RENEWALS = 8
MAX_BROYDEN = 25
DEAR = 8.0  # iterations left from which a factorisation, worth some twenty-five but kept, is cheaper
SMALLEST_DAMPING = 1 / 64
SAME_PLACE = 0.2  # a factorisation this near to a new one is replaced by it
EXTRAPOLATION_POINTS = 3
COUNTED = ("iterations", "residuals", "factorisations", "solves", "falls", "crawls")
MOST_RELAXING, RELAXED = 400, 1e5  # steps of `relax`, and the length at which its drag is all but nothing
ALLOWED_CONTRACTION, WANTED_CONTRACTION, MOST_GROWTH = 0.8, 0.25, 10.0


@dataclass(frozen=True)
class Equations:
    """Functions that one solve needs: of the whole vector x (dofs,), with free rows and columns only.

    residual : x -> (free,) or None where a cell has turned inside out
    tangent : x -> free-free matrix and free-fixed matrix
    weight : (free,) one over the tolerance of each unknown; a step is small where |weight step| < 1
    scale : (free,) size of each unknown in the linear solves, so that the matrix is balanced
    place : coordinates, each of order one, in which near equations have near tangents
    """

    free: np.ndarray
    residual: Callable[[Array], Array | None]
    tangent: Callable[[Array], tuple[sp.csr_matrix, sp.csr_matrix]]
    weight: Array
    scale: Array
    place: Array


@dataclass
class NewtonSolver:
    """Carries the factorised tangent from solve to solve, and counts what was spent."""

    symmetric: bool = True  # the tangent nearly is, so its symmetric part is what is factorised
    counts: dict[str, int] = field(default_factory=lambda: dict.fromkeys(COUNTED, 0))
    last_residual: float = np.nan
    _factors: Factorisations = field(init=False)
    _places: dict[int, Array] = field(default_factory=dict)  # number of a kept factorisation: its place
    _used: dict[int, int] = field(default_factory=dict)  # and when it last served
    _current: int = 0

    def __post_init__(self) -> None:
        self._factors = factorisations(self.symmetric)

    def release(self) -> None:
        """Frees the factors."""
        self._factors.release()
        self._places.clear()

    def renew(self, equations: Equations, x: Array, drag: Array | None = None) -> sp.csr_matrix:
        """Factorises the tangent at x, with `drag` (free,) added to its diagonal.

        Returns its free-fixed part, for prescribed increments.
        """
        free_free, free_fixed = equations.tangent(x)
        if drag is not None:
            free_free.setdiag(free_free.diagonal() + drag)
        self._current = self._number_for(equations.place)
        self._places[self._current] = equations.place
        self._factors.factorise(self._current, free_free, equations.scale)
        self.counts["factorisations"] += 1
        return free_fixed

    def _number_for(self, place: Array) -> int:
        """Returns the number of the factor at this place, else a free one, else the least recently used."""
        nearest = self._nearest(place)
        if nearest is not None and np.abs(self._places[nearest] - place).sum() < SAME_PLACE:
            return nearest
        if len(self._places) < self._factors.room:
            return len(self._places)
        return min(self._places, key=lambda number: self._used[number])

    def _nearest(self, place: Array) -> int | None:
        return min(self._places, key=lambda n: float(np.abs(self._places[n] - place).sum()), default=None)

    def respond(self, equations: Equations, x: Array, target: Array, fixed: np.ndarray) -> Array | None:
        """First guess when the fixed dofs jump from x to `target`: the linear response of the free ones.

        Renews the tangent at x. None if x itself is inside out.
        """
        free_fixed = self.renew(equations, x)
        right = self._residual(equations, x)
        if right is None:
            return None
        guess = target.copy()
        guess[equations.free] = x[equations.free] - self.back_substitute(
            right + free_fixed @ (target[fixed] - x[fixed])
        )
        return guess

    def toward(self, place: Array) -> Array:
        """Takes the factorisation nearest to a place for the coming back-substitutions.

        Returns where that was made: the same array as long as it is kept.
        """
        self._current = min(self._places, key=lambda n: float(np.abs(self._places[n] - place).sum()))
        return self._places[self._current]

    def back_substitute(self, right: Array) -> Array:
        """Solves with the tangent factorised or taken last, (free,) or (free, r)."""
        self.counts["solves"] += 1
        self._used[self._current] = self.counts["solves"]
        return self._factors.solve(self._current, right)

    def solve(self, equations: Equations, guess: Array) -> Array | None:
        """The solution from a guess whose fixed dofs are already right; None if none was found."""
        with np.errstate(over="ignore", invalid="ignore"):  # of steps that are then refused
            return self._solved(equations, guess.copy())

    def _solved(self, equations: Equations, x: Array) -> Array | None:
        nearest = self._nearest(equations.place)
        fresh = nearest is None
        if nearest is None:
            self.renew(equations, x)
        else:
            self._current = nearest
        for _ in range(MAX_RENEWALS):
            x_new, converged = self._broyden(equations, x, fresh)
            if converged:
                return x_new
            if x_new is None and (fresh or self._residual(equations, x) is None):
                return None
            x = x if x_new is None else x_new
            self.renew(equations, x)
            fresh = True
        return None

    def relax(self, equations: Equations, x: Array, drag: Array) -> Array | None:
        """Returns where x, with its fixed dofs right, comes to rest in a viscous medium; None if nowhere.

        drag : (free,) resistance of each unknown to motion, in units of its stiffness; none of the pressures,
        so that the energy of the step falls. Pseudo-transient continuation (Kelley & Keyes, SIAM J. Numer.
        Anal. 35, 1998, 508): implicit Euler steps of one Newton iteration each, as long as that contracts.
        They grow towards rest, and what is returned solves the equations without drag.
        """
        right = self._residual(equations, x)
        if right is None:
            return None
        self.counts["falls"] += 1
        length, growth = 1.0, MOST_GROWTH
        for _ in range(MOST_RELAXING):
            trial, after, moved, contraction = self._crawl(equations, x, right, drag / length)
            if after is None or not contraction < ALLOWED_CONTRACTION:
                length, growth = 0.5 * length, 1.0
                continue
            x, right = trial, after
            if length > RELAXED and moved < 1.0:
                return self.solve(equations, x)
            change = np.sqrt(WANTED_CONTRACTION / contraction) if contraction > 0.0 else growth
            length, growth = length * float(np.clip(change, 0.5, growth)), MOST_GROWTH
        return None

    def _crawl(
        self, equations: Equations, x: Array, right: Array, drag: Array
    ) -> tuple[Array, Array | None, float, float]:
        """One step against drag: where to, the residual there, its size in units of the tolerance, and that
        of a second iteration relative to it, 0 of a step within the tolerance, which may be mere rounding.
        """
        self.counts["crawls"] += 1
        self.renew(equations, x, drag)
        step = -self.back_substitute(right)
        trial = x.copy()
        trial[equations.free] += step
        after, moved = self._residual(equations, trial), float(np.abs(step * equations.weight).max())
        if after is None or moved < 1.0:
            return trial, after, moved, 0.0
        rest = self.back_substitute(after + drag * step)
        sizes = [float(np.linalg.norm(move * equations.weight)) for move in (rest, step)]
        return trial, after, moved, sizes[0] / sizes[1]

    def _residual(self, equations: Equations, x: Array) -> Array | None:
        self.counts["residuals"] += 1
        return equations.residual(x)

    def _broyden(self, equations: Equations, x: Array, fresh: bool) -> tuple[Array | None, bool]:
        """Steps with the kept tangent: (x, True) converged, (x, False) slow, (None, False) lost."""
        right = self._residual(equations, x)
        if right is None:
            return None, False
        steps = [self._newton_step(equations, right)]
        sizes: list[float] = []
        free = equations.free
        for iteration in range(MAX_BROYDEN):
            self.counts["iterations"] += 1
            size = float(np.abs(steps[-1]).max())
            if not np.isfinite(size) or (iteration > 1 and size > 2.0 * sizes[-1]):
                return (x if fresh else None), False
            trial = x.copy()
            trial[free] += steps[-1] / equations.weight
            right, after = self._residual(equations, trial), None
            if right is not None and fresh and iteration == 0:
                after = self._newton_step(equations, right)
            if right is None or (after is not None and not _shorter(after, steps[0])):
                return (self._damped(equations, x, steps[-1]) if fresh else None), False
            x = trial
            if size < 1.0:
                self.last_residual = float(np.abs(right).max())
                return x, True
            if iteration > 1 and _iterations_left(size, sizes) > DEAR:
                return x, False
            sizes.append(size)
            steps.append(
                _updated_step(steps, self._newton_step(equations, right) if after is None else after)
            )
        return x, False

    def _newton_step(self, equations: Equations, right: Array) -> Array:
        """Returns Newton's step (free,) by the last tangent, in units of the tolerance."""
        return -self.back_substitute(right) * equations.weight

    def _damped(self, equations: Equations, x: Array, step: Array) -> Array | None:
        """The first of x + step/2, /4, ... after which cells are upright and steps shorter, or None.

        The natural monotonicity test: P. Deuflhard, Newton Methods for Nonlinear Problems, Springer 2004,
        section 3.3. step (free,) in units of the tolerance.
        """
        damping = 0.5
        while damping >= SMALLEST_DAMPING:
            trial = x.copy()
            trial[equations.free] += damping * step / equations.weight
            right = self._residual(equations, trial)
            if right is not None and _shorter(
                self._newton_step(equations, right), step, 1.0 - 0.25 * damping
            ):
                return trial
            damping *= 0.5
        return None


def _shorter(after: Array, before: Array, allowed: float = 1.0) -> bool:
    """Returns whether the next step with the same tangent is at most `allowed` times the last one."""
    return float(np.linalg.norm(after)) <= allowed * float(np.linalg.norm(before))


def _updated_step(steps: list[Array], z: Array) -> Array:
    """Next step from the history and the kept tangent's own, z (Kelley's matrix-free form of Broyden's)."""
    for old, new in pairwise(steps):
        z = z + new * (old @ z) / (old @ old)
    last = steps[-1]
    return z / (1.0 - (last @ z) / (last @ last))


def _iterations_left(size: float, before: list[float]) -> float:
    """Until a step is below 1 at the mean contraction of the last two (Broyden's method goes by fits)."""
    contraction = np.sqrt(size / before[-2])
    return float(np.log(size) / -np.log(contraction)) if contraction < 1.0 else np.inf


def extrapolate(past: Sequence[tuple[float, Array]], time_s: float) -> Array:
    """Unknowns (dofs,) at a later time by the polynomial through (at most) the last three (time, x)."""
    last = past[-EXTRAPOLATION_POINTS:]
    weights = extrapolation_weights([time for time, _ in last], time_s)
    return np.asarray(sum(weight * x for weight, (_, x) in zip(weights, last, strict=True)))


def extrapolation_weights(times_s: Sequence[float], time_s: float) -> list[float]:
    """Weights of values at `times_s` in their polynomial's value at another time (Lagrange)."""
    return [
        float(np.prod([(time_s - other) / (own - other) for other in times_s if other != own]))
        for own in times_s
    ]
