"""Follows a body that snaps from one equilibrium to another, until it comes to rest.

Beyond a fold of the equilibria (a limit point) there is no solution near the last one, and Newton's method
does not converge. The body then moves by itself to another equilibrium. `relax` follows this motion in a
viscous medium by pseudo-transient continuation (Kelley & Keyes, SIAM J. Numer. Anal. 35, 1998, 508).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayeskin.finite_element.newton import Equations, NewtonSolver
from bayeskin.types import Array


@dataclass(frozen=True)
class RelaxationSettings:
    """Settings of the steps by which a body comes to rest.

    most_steps : largest number of steps
    negligible_drag : length of a step in which the drag has become negligible
    allowed_contraction : a step in which the iteration contracts less than this is halved
    wanted_contraction : contraction toward which the length of the steps is controlled
    most_growth : largest ratio of a step to the step before
    """

    most_steps: int = 400
    negligible_drag: float = 1e5
    allowed_contraction: float = 0.8
    wanted_contraction: float = 0.25
    most_growth: float = 10.0


RELAXATION = RelaxationSettings()


def relax(solver: NewtonSolver, equations: Equations, x: Array, drag: Array) -> Array | None:
    """Returns the unknowns (dofs,) at which a body comes to rest that starts at x in a viscous medium.

    x : starting point (dofs,), with the fixed dofs at their prescribed values
    drag : (free,) resistance of each unknown to motion, in units of its stiffness. It is zero for the
        pressures, so that the energy of the step decreases

    The function takes implicit Euler steps of one Newton iteration each, and halves a step in which the
    iteration does not contract. The steps grow as the body comes to rest. The result solves the equations
    without drag. It is None if the body does not come to rest, or if a cell is inside out at x.
    """
    right = solver.residual(equations, x)
    if right is None:
        return None
    solver.counts["falls"] += 1
    length, growth = 1.0, RELAXATION.most_growth
    for _ in range(RELAXATION.most_steps):
        trial, after, moved, contraction = _step(solver, equations, x, right, drag / length)
        if after is None or not contraction < RELAXATION.allowed_contraction:
            length, growth = 0.5 * length, 1.0
            continue
        x, right = trial, after
        if length > RELAXATION.negligible_drag and moved < 1.0:
            return solver.solve(equations, x)
        change = np.sqrt(RELAXATION.wanted_contraction / contraction) if contraction > 0.0 else growth
        length, growth = length * float(np.clip(change, 0.5, growth)), RELAXATION.most_growth
    return None


def _step(
    solver: NewtonSolver, equations: Equations, x: Array, right: Array, drag: Array
) -> tuple[Array, Array | None, float, float]:
    """Takes one step against the drag, and tests how a second iteration would contract.

    Returns the new unknowns (dofs,), the residual there (None if a cell has turned inside out), the size of
    the step in units of the tolerance, and the size of a second iteration relative to the step. The last is 0
    if the step is smaller than the tolerance, because it may then consist of rounding errors.
    """
    solver.counts["crawls"] += 1
    solver.renew(equations, x, drag)
    step = -solver.back_substitute(right)
    trial = x.copy()
    trial[equations.free] += step
    after, moved = solver.residual(equations, trial), float(np.abs(step * equations.weight).max())
    if after is None or moved < 1.0:
        return trial, after, moved, 0.0
    second = solver.back_substitute(after + drag * step)
    sizes = [float(np.linalg.norm(move * equations.weight)) for move in (second, step)]
    return trial, after, moved, sizes[0] / sizes[1]
