"""Compiled Newton's method of the reduced model: solves a stage with a tangent that each step corrects.

The inverse of an earlier tangent serves as long as the steps become shorter quickly. Broyden's rank-one
update corrects it after each step. The unknowns and the arrays are those of `kernels`.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np

from bayeskin.finite_element.assembly import compiled
from bayeskin.reduced.kernels import FIRST, fill_kinematics, product, residual, tangent

CONVERGED, INSIDE_OUT, SLOW, NOT_FINITE = range(4)
MOST_ITERATIONS, MOST_RENEWALS = 60, 12
SLOW_CONTRACTION = 0.6  # ratio of two steps above which a new tangent, as costly as twenty residuals, is made
SMALLEST_DAMPING = 1e-3


@compiled
def renew(system, laws, past, x, room, inverse, force_row, by_pads):
    """Fills the inverse of the free part of the tangent at x, the force's row and the pads' column.

    The rows of the pads' field and of the dual field are not solved for. The free rows come after them.
    """
    fill_kinematics(system, x, FIRST, system.weight.shape[0], room)
    whole = tangent(system, laws, past, room)
    count, finite = whole.shape[0] - 2, True
    scale, free = np.empty(count), np.empty((count, count))
    for i in range(count):
        scale[i] = 1.0 / np.sqrt(abs(whole[2 + i, 2 + i]) + 1e-300)
    for i in range(count):
        for j in range(count):
            free[i, j] = whole[2 + i, 2 + j] * (scale[i] * scale[j])
            finite = finite and np.isfinite(free[i, j])
    if not finite:  # a law's values are not finite; the solve fails at its next step
        inverse[:] = np.nan
        return
    scaled = np.linalg.inv(free)
    for i in range(count):
        for j in range(count):
            inverse[i, j] = scaled[i, j] * (scale[i] * scale[j])
        force_row[i] = 2.0 * whole[1, 2 + i]
        by_pads[i] = whole[2 + i, 0]
    by_pads[count] = 2.0 * whole[1, 0]


@compiled
def solve(system, laws, past, x, tolerance, nominal_n, room, inverse, force_row, by_pads, counts):
    """Solves a stage in place, from the guess x, whose first entry is the displacement of the pads.

    inverse, force_row, by_pads : parts of the last tangent (`renew`), renewed where convergence is slow
    counts (3,) : counters of iterations, residuals and tangents, to which this solve is added
    Returns the status and the force [N], which the last step corrects to first order.
    """
    size, modes = len(x), system.gradient.shape[2] - 2
    right, after, moved = np.empty(size), np.empty(size), x.copy()
    step, change = np.empty(size - 2), np.empty(size - 2)
    counts[1] += 1
    if not residual(system, laws, past, x, room, right) > 0.0:
        return INSIDE_OUT, 0.0
    before, renewals = np.inf, 0
    for iteration in range(MOST_ITERATIONS):
        counts[0] += 1
        fill_step(inverse, right, step)
        force_step = product(force_row, step)
        length = max(0.1 * largest(step, modes), abs(force_step) / nominal_n) / tolerance
        if not np.isfinite(length):
            return NOT_FINITE, 0.0
        if (length < 1.0 and iteration > 0) or length < 0.01:
            return CONVERGED, 2.0 * right[1] + force_step
        if iteration > 0 and length > SLOW_CONTRACTION * before:
            if renewals == MOST_RENEWALS:
                return SLOW, 0.0
            renewals += 1
            counts[2] += 1
            renew(system, laws, past, x, room, inverse, force_row, by_pads)
            fill_step(inverse, right, step)
            before = np.inf
        else:
            before = length
        damping = 1.0
        while True:
            for i in range(size - 2):
                moved[2 + i] = x[2 + i] + damping * step[i]
            counts[1] += 1
            if residual(system, laws, past, moved, room, after) > 0.0:
                break
            damping *= 0.5
            if damping < SMALLEST_DAMPING:
                return INSIDE_OUT, 0.0
        if damping == 1.0:
            for i in range(size - 2):
                change[i] = after[2 + i] - right[2 + i]
            update(inverse, step, change)
        for i in range(size):
            x[i], right[i] = moved[i], after[i]
    return SLOW, 0.0


@compiled
def fill_step(inverse, right, step):
    """Fills Newton's step of the free unknowns from a residual, whose first two rows are not solved for."""
    for i in range(len(step)):
        step[i] = -product(inverse[i], right[2:])


@compiled
def largest(values, count):
    """Returns the largest absolute value of the first values; NaN where any of them is NaN."""
    most = 0.0
    for i in range(count):
        if not abs(values[i]) <= most:
            most = abs(values[i])
            if np.isnan(most):
                return most
    return most


@compiled
def update(inverse, step, change):
    """Corrects an inverse in place by Broyden's rank-one update (Broyden's good method)."""
    count = len(step)
    answer, row = np.empty(count), np.zeros(count)
    for i in range(count):
        answer[i] = product(inverse[i], change)
        for j in range(count):
            row[j] += step[i] * inverse[i, j]
    along = product(row, change)
    if abs(along) > 1e-3 * product(step, step):
        for i in range(count):
            share = (step[i] - answer[i]) / along
            for j in range(count):
                inverse[i, j] += share * row[j]
