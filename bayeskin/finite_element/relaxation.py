"""Follows a body that snaps from one equilibrium to another, until it comes to rest.

Beyond a fold of the equilibria (a limit point) there is no solution near the last one, and Newton's method
does not converge. The body then moves by itself to another equilibrium. `relax` follows this motion in a
viscous medium by pseudo-transient continuation (Kelley & Keyes, SIAM J. Numer. Anal. 35, 1998, 508).
"""

from __future__ import annotations

import numpy as np

from bayeskin.finite_element.newton import Equations, NewtonSolver
from bayeskin.types import Array

MOST_STEPS = 400
NEGLIGIBLE_DRAG = 1e5  # length of a step in which the drag has become negligible
ALLOWED_CONTRACTION, WANTED_CONTRACTION, MOST_GROWTH = 0.8, 0.25, 10.0


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
    length, growth = 1.0, MOST_GROWTH
    for _ in range(MOST_STEPS):
        trial, after, moved, contraction = _step(solver, equations, x, right, drag / length)
        if after is None or not contraction < ALLOWED_CONTRACTION:
            length, growth = 0.5 * length, 1.0
            continue
        x, right = trial, after
        if length > NEGLIGIBLE_DRAG and moved < 1.0:
            return solver.solve(equations, x)
        change = np.sqrt(WANTED_CONTRACTION / contraction) if contraction > 0.0 else growth
        length, growth = length * float(np.clip(change, 0.5, growth)), MOST_GROWTH
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
