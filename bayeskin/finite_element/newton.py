"""Solves the nonlinear equations of a time step by Newton's and Broyden's methods, with kept factorisations.

A factorisation of the tangent costs as much as some tens of residuals and back-substitutions. The tangent
changes slowly along the protocol, and each cycle of the protocol returns to earlier states. The solver
therefore keeps a few factorisations, each with the place where it was made (`Equations.place`). The nearest
serves as approximate inverse, corrected by Broyden's rank-one updates (C. T. Kelley, Iterative Methods for
Linear and Nonlinear Equations, SIAM 1995, section 7.3). If it does not contract well, the solver factorises a
new tangent.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import scipy.sparse as sp

from bayeskin.finite_element.linear import Factorisations, factorisations
from bayeskin.types import Array

SOLVER_TOLERANCE = 1e-4  # relative to the largest displacement and pressure, before the last correction
COUNTED = ("iterations", "residuals", "factorisations", "solves", "falls", "crawls")


@dataclass(frozen=True)
class NewtonSettings:
    """Settings of a solve.

    most_renewals : largest number of new factorisations in a solve
    most_iterations : largest number of iterations with one factorisation
    dear : a new factorisation is made if more than so many iterations are left. It costs about as much as
        twenty-five iterations, but later solves use it again
    smallest_damping : smallest share of a step that is tried
    same_place : a new factorisation replaces an old one that is nearer than this
    """

    most_renewals: int = 8
    most_iterations: int = 25
    dear: float = 8.0
    smallest_damping: float = 1 / 64
    same_place: float = 0.2


NEWTON = NewtonSettings()


@dataclass(frozen=True)
class Equations:
    """The equations of one solve, as functions of the whole vector of unknowns x (dofs,).

    free : numbers of the free dofs; the results have only free rows
    residual : function of x that returns (free,), or None if a cell has turned inside out
    tangent : function of x that returns the free-free matrix and the free-fixed matrix
    weight : (free,) one over the tolerance of each unknown; a step is small if |weight step| < 1
    scale : (free,) size of each unknown in the linear solves, which balances the matrix
    place : coordinates of order one; equations with similar coordinates have similar tangents
    """

    free: np.ndarray
    residual: Callable[[Array], Array | None]
    tangent: Callable[[Array], tuple[sp.csr_matrix, sp.csr_matrix]]
    weight: Array
    scale: Array
    place: Array


@dataclass
class NewtonSolver:
    """Solves equations, keeps the factorised tangents from solve to solve, and counts the work."""

    symmetric: bool = True  # the tangent is nearly symmetric, so that its symmetric part is factorised
    counts: dict[str, int] = field(default_factory=lambda: dict.fromkeys(COUNTED, 0))
    last_residual: float = np.nan
    _factors: Factorisations = field(init=False)
    _places: dict[int, Array] = field(default_factory=dict)  # the place of each kept factorisation, by number
    _used: dict[int, int] = field(default_factory=dict)  # the number of the solve that used it last
    _current: int = 0

    def __post_init__(self) -> None:
        self._factors = factorisations(self.symmetric)

    def release(self) -> None:
        """Frees the memory of all factorisations."""
        self._factors.release()
        self._places.clear()

    def renew(self, equations: Equations, x: Array, drag: Array | None = None) -> sp.csr_matrix:
        """Factorises the tangent at x, with `drag` (free,) added to its diagonal.

        Returns the free-fixed part of the tangent, which gives the effect of prescribed increments.
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
        """Returns the number under which a new factorisation at this place is stored.

        It is the number of a factorisation at nearly the same place, else an unused number, else the number
        of the least recently used factorisation.
        """
        nearest = self._nearest(place)
        if nearest is not None and np.abs(self._places[nearest] - place).sum() < NEWTON.same_place:
            return nearest
        if len(self._places) < self._factors.room:
            return len(self._places)
        return min(self._places, key=lambda number: self._used[number])

    def _nearest(self, place: Array) -> int | None:
        """Returns the number of the factorisation nearest to a place, or None if there is none."""
        return min(self._places, key=lambda n: float(np.abs(self._places[n] - place).sum()), default=None)

    def respond(self, equations: Equations, x: Array, target: Array, fixed: np.ndarray) -> Array | None:
        """Returns the linear response of the free dofs when the fixed dofs jump from x to `target`.

        The result is a starting point for a solve. The method factorises the tangent at x. It returns None if
        a cell is inside out at x.
        """
        free_fixed = self.renew(equations, x)
        right = self.residual(equations, x)
        if right is None:
            return None
        guess = target.copy()
        guess[equations.free] = x[equations.free] - self.back_substitute(
            right + free_fixed @ (target[fixed] - x[fixed])
        )
        return guess

    def toward(self, place: Array) -> Array:
        """Selects the factorisation nearest to a place for the next back-substitutions.

        Returns the place where that factorisation was made. As long as the factorisation is kept, this is
        always the same array object.
        """
        self._current = min(self._places, key=lambda n: float(np.abs(self._places[n] - place).sum()))
        return self._places[self._current]

    def back_substitute(self, right: Array) -> Array:
        """Returns the solution for right-hand sides (free,) or (free, r).

        The matrix is the tangent that was factorised or selected last.
        """
        self.counts["solves"] += 1
        self._used[self._current] = self.counts["solves"]
        return self._factors.solve(self._current, right)

    def solve(self, equations: Equations, guess: Array) -> Array | None:
        """Returns the solution (dofs,), or None if the solver does not converge.

        guess : starting point (dofs,), with the fixed dofs at their prescribed values
        """
        with np.errstate(over="ignore", invalid="ignore"):  # steps that overflow are rejected
            return self._solve_renewing(equations, guess.copy())

    def _solve_renewing(self, equations: Equations, x: Array) -> Array | None:
        """Iterates from x, and factorises a new tangent each time the iteration is slow."""
        nearest = self._nearest(equations.place)
        fresh = nearest is None
        if nearest is None:
            self.renew(equations, x)
        else:
            self._current = nearest
        for _ in range(NEWTON.most_renewals):
            x_new, converged = self._broyden(equations, x, fresh)
            if converged:
                return x_new
            if x_new is None and (fresh or self.residual(equations, x) is None):
                return None
            x = x if x_new is None else x_new
            self.renew(equations, x)
            fresh = True
        return None

    def residual(self, equations: Equations, x: Array) -> Array | None:
        """Returns the residual (free,) at x, or None if a cell has turned inside out, and counts it."""
        self.counts["residuals"] += 1
        return equations.residual(x)

    def _broyden(self, equations: Equations, x: Array, fresh: bool) -> tuple[Array | None, bool]:
        """Iterates with the kept tangent and Broyden's updates.

        fresh : the tangent was factorised at x
        Returns (x, True) if the iteration converges, (x, False) if it is slow, and (None, False) if it fails.
        """
        right = self.residual(equations, x)
        if right is None:
            return None, False
        steps = [self._newton_step(equations, right)]
        sizes: list[float] = []
        free = equations.free
        for iteration in range(NEWTON.most_iterations):
            self.counts["iterations"] += 1
            size = float(np.abs(steps[-1]).max())
            if not np.isfinite(size) or (iteration > 1 and size > 2.0 * sizes[-1]):
                return (x if fresh else None), False
            trial = x.copy()
            trial[free] += steps[-1] / equations.weight
            right, after = self.residual(equations, trial), None
            if right is not None and fresh and iteration == 0:
                after = self._newton_step(equations, right)
            if right is None or (after is not None and not _shorter(after, steps[0])):
                return (self._damped(equations, x, steps[-1]) if fresh else None), False
            x = trial
            if size < 1.0:
                self.last_residual = float(np.abs(right).max())
                return x, True
            if iteration > 1 and _iterations_left(size, sizes) > NEWTON.dear:
                return x, False
            sizes.append(size)
            steps.append(
                _updated_step(steps, self._newton_step(equations, right) if after is None else after)
            )
        return x, False

    def _newton_step(self, equations: Equations, right: Array) -> Array:
        """Returns the Newton step (free,) with the last tangent, in units of the tolerance."""
        return -self.back_substitute(right) * equations.weight

    def _damped(self, equations: Equations, x: Array, step: Array) -> Array | None:
        """Returns the first acceptable point among x + step/2, x + step/4, ..., or None.

        A point is acceptable if no cell is inside out and the next step is shorter. This is the natural
        monotonicity test (P. Deuflhard, Newton Methods for Nonlinear Problems, Springer 2004, section 3.3).

        step : (free,) in units of the tolerance
        """
        damping = 0.5
        while damping >= NEWTON.smallest_damping:
            trial = x.copy()
            trial[equations.free] += damping * step / equations.weight
            right = self.residual(equations, trial)
            if right is not None and _shorter(
                self._newton_step(equations, right), step, 1.0 - 0.25 * damping
            ):
                return trial
            damping *= 0.5
        return None


def _shorter(after: Array, before: Array, allowed: float = 1.0) -> bool:
    """Returns True if the next step with the same tangent is at most `allowed` times as long as the last."""
    return float(np.linalg.norm(after)) <= allowed * float(np.linalg.norm(before))


def _updated_step(steps: list[Array], z: Array) -> Array:
    """Returns the next step of Broyden's method, in Kelley's matrix-free form.

    steps : all earlier steps with the kept tangent; z : the next step by the kept tangent alone
    """
    for old, new in pairwise(steps):
        z = z + new * (old @ z) / (old @ old)
    last = steps[-1]
    return z / (1.0 - (last @ z) / (last @ last))


def _iterations_left(size: float, before: list[float]) -> float:
    """Returns how many iterations are left until a step is smaller than 1.

    It assumes the mean contraction of the last two iterations, because Broyden's method contracts unevenly.
    """
    contraction = np.sqrt(size / before[-2])
    return float(np.log(size) / -np.log(contraction)) if contraction < 1.0 else np.inf
