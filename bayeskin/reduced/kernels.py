"""Compiled core of the reduced model: residual, tangent and the whole solve of a stage at weighted points.

The unknowns are the coefficients x = (d, 0, displacement modes, pressure modes), where d is the displacement
of the pads. The second entry is always zero. It belongs to the dual field, whose row of the residual is half
the measured force. The laws of mechanisms are called by address (`calls`), so no loop over points or
iterations runs in Python.

The part of the base law that is linear at rest is integrated exactly. `System.solid`, `coupling` and `flow`
hold the difference between its integral over all points and its integral over the chosen points. This
difference corrects the sum over the chosen points.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np

from bayeskin.finite_element import poroelastic
from bayeskin.finite_element.assembly import compiled
from bayeskin.reduced.calls import call_linearise, call_respond

CONVERGED, INSIDE_OUT, SLOW, NOT_FINITE = range(4)
MOST_ITERATIONS, MOST_RENEWALS = 60, 12
SLOW_CONTRACTION = 0.6  # ratio of two steps above which a new tangent, as costly as twenty residuals, is made
SMALLEST_DAMPING = 1e-3
BLOCK = 16  # number of points whose modes fit into the first-level cache


@compiled
def residual(system, laws, past, x, room, out):
    """Fills the residual `out` (k + m,) and the room, and returns the smallest J.

    A point is inside out where J is not positive. The residual is then incomplete.
    """
    n, k = system.weight.shape[0], system.gradient.shape[2]
    m = system.pressure.shape[1]
    out[:] = 0.0
    smallest = np.inf
    for start in range(0, n, BLOCK):
        end = min(start + BLOCK, n)
        _kinematics(system, x, start, end, room)
        least = answer(system, laws, past, start, end, room)
        if not least > 0.0:
            return least
        smallest = min(smallest, least)
        _project(system, start, end, room, out)
    force, fluid = x[:k], x[k:]
    for i in range(k):
        total = 0.0
        for j in range(k):
            total += system.solid[i, j] * force[j]
        for j in range(m):
            total += system.coupling[i, j] * fluid[j]
        out[i] += total
    for i in range(m):
        total = 0.0
        for j in range(m):
            total += system.flow[i, j] * fluid[j]
        total *= past.length_s
        for j in range(k):
            total += system.coupling[j, i] * (force[j] - past.displacement[j])
        out[k + i] += total
    return smallest


@compiled
def _kinematics(system, x, start, end, room):
    """Fills F, p and grad p at the points from `start` to `end`."""
    k = system.gradient.shape[2]
    fields, pressures = x[:k], x[k:]
    for q in range(start, end):
        for i in range(3):
            for j in range(3):
                room.deformation[q, i, j] = _product(system.gradient[q, 3 * i + j], fields)
            room.deformation[q, i, i] += 1.0
        room.at_pressure[q] = _product(system.pressure[q], pressures)
        for i in range(3):
            room.at_slope[q, i] = _product(system.slope[q, i], pressures)


@compiled
def _product(left, right):
    total = 0.0
    for c in range(len(left)):
        total += left[c] * right[c]
    return total


@compiled
def answer(system, laws, past, start, end, room):
    """Fills stress, content, flux, J and memory at points `start` to `end`; returns the smallest J."""
    smallest = _base(system, past, start, end, room)
    if not smallest > 0.0:
        return smallest
    for law in range(len(laws.respond)):
        if laws.respond[law] != 0:
            before, after, data, par = _of_law(laws, law, start, end, past.memory, room.memory)
            call_respond(
                laws.respond[law], past.time_s, past.elapsed_s, par, data,
                room.deformation[start:end], room.at_pressure[start:end], room.at_slope[start:end],
                before, after, room.stress[start:end], room.content[start:end], room.flux[start:end],
            )  # fmt: skip
    return smallest


@compiled
def _base(system, past, start, end, room):
    """Fills the response of the base law at the points from `start` to `end`; returns the smallest J."""
    e = end - start
    return poroelastic.respond(
        room.deformation[start:end].reshape(e, 1, 3, 3), room.at_pressure[start:end].reshape(e, 1),
        room.at_slope[start:end].reshape(e, 1, 3), system.mu[start:end], system.lam[start:end],
        system.mobility[start:end], system.storage[start:end], past.length_s,
        past.volume[start:end].reshape(e, 1), past.pressure[start:end].reshape(e, 1),
        room.stress[start:end].reshape(e, 1, 3, 3), room.content[start:end].reshape(e, 1),
        room.flux[start:end].reshape(e, 1, 3), room.volume[start:end].reshape(e, 1),
    )  # fmt: skip


@compiled
def _of_law(laws, law, start, end, old, new):
    """Returns a law's memory before and after, its constants at some points, and its constants of the run."""
    width, at = laws.memory_width[law], laws.memory_at[law]
    before = old[at + start * width : at + end * width].reshape(end - start, width)
    after = new[at + start * width : at + end * width].reshape(end - start, width)
    wide, place = laws.data_width[law], laws.data_at[law]
    data = laws.data[place + start * wide : place + end * wide].reshape(end - start, wide)
    return before, after, data, laws.par[laws.par_at[law] : laws.par_at[law + 1]]


@compiled
def _project(system, start, end, room, out):
    """Adds the response at the points from `start` to `end` to the residual."""
    k, m = system.gradient.shape[2], system.pressure.shape[1]
    for q in range(start, end):
        w, g, slope = system.weight[q], system.gradient[q], system.slope[q]
        stress, flux = room.stress[q], room.flux[q]
        s0, s1, s2 = w * stress[0, 0], w * stress[0, 1], w * stress[0, 2]
        s3, s4, s5 = w * stress[1, 0], w * stress[1, 1], w * stress[1, 2]
        s6, s7, s8 = w * stress[2, 0], w * stress[2, 1], w * stress[2, 2]
        for c in range(k):  # all nine components in one pass, so that each sum is loaded and stored once
            out[c] += (
                s0 * g[0, c] + s1 * g[1, c] + s2 * g[2, c]
                + s3 * g[3, c] + s4 * g[4, c] + s5 * g[5, c]
                + s6 * g[6, c] + s7 * g[7, c] + s8 * g[8, c]
            )  # fmt: skip
        content, pressure = w * room.content[q], system.pressure[q]
        f0, f1, f2 = w * flux[0], w * flux[1], w * flux[2]
        for c in range(m):
            out[k + c] -= content * pressure[c] + f0 * slope[0, c] + f1 * slope[1, c] + f2 * slope[2, c]


@compiled
def tangent(system, laws, past, room):
    """Returns the derivative (k + m, k + m) of the residual by the unknowns.

    The room already holds F, p and grad p of these unknowns.
    """
    n = system.weight.shape[0]
    stress_f, stress_p, content_f = np.empty((n, 9, 9)), np.empty((n, 9)), np.empty((n, 9))
    content_p, flux_f, flux_g = np.empty(n), np.empty((n, 3, 9)), np.empty((n, 3, 3))
    poroelastic.linearise(
        room.deformation.reshape(n, 1, 3, 3), room.at_pressure.reshape(n, 1), room.at_slope.reshape(n, 1, 3),
        system.mu, system.lam, system.mobility, system.storage, past.length_s, past.pressure.reshape(n, 1),
        stress_f.reshape(n, 1, 9, 9), stress_p.reshape(n, 1, 9), content_f.reshape(n, 1, 9),
        content_p.reshape(n, 1), flux_f.reshape(n, 1, 3, 9), flux_g.reshape(n, 1, 3, 3),
    )  # fmt: skip
    for law in range(len(laws.linearise)):
        if laws.linearise[law] != 0:
            before, _, data, par = _of_law(laws, law, 0, n, past.memory, room.memory)
            call_linearise(
                laws.linearise[law], past.time_s, past.elapsed_s, par, data, room.deformation,
                room.at_pressure, room.at_slope, before, stress_f, stress_p, content_f, content_p, flux_f,
                flux_g,
            )  # fmt: skip
    return _assembled(system, past, stress_f, stress_p, content_f, content_p, flux_f, flux_g)


@compiled
def _assembled(system, past, stress_f, stress_p, content_f, content_p, flux_f, flux_g):
    """Returns the tangent from the laws' derivatives at the points, in the single precision of the modes."""
    n, k, m = system.weight.shape[0], system.gradient.shape[2], system.pressure.shape[1]
    solid, column = np.zeros((9 * n, k), np.float32), np.zeros((n, k), np.float32)
    row, turned = np.zeros((n, k), np.float32), np.zeros((3 * n, k), np.float32)
    stored, flow = np.empty((n, m), np.float32), np.zeros((3 * n, m), np.float32)
    for q in range(n):
        w = system.weight[q]
        for j in range(9):
            gradient_row = system.gradient[q, j]
            for i in range(9):
                _add_multiple(solid[9 * q + i], w * stress_f[q, i, j], gradient_row)
            for i in range(3):
                _add_multiple(turned[3 * q + i], w * flux_f[q, i, j], gradient_row)
            _add_multiple(column[q], w * stress_p[q, j], gradient_row)
            _add_multiple(row[q], w * content_f[q, j], gradient_row)
        for j in range(3):
            for i in range(3):
                _add_multiple(flow[3 * q + i], w * flux_g[q, i, j], system.slope[q, j])
        for c in range(m):
            stored[q, c] = w * content_p[q] * system.pressure[q, c]
    gradient, slope = system.gradient.reshape(9 * n, k), system.slope.reshape(3 * n, m)
    out = np.empty((k + m, k + m))
    out[:k, :k] = system.solid + np.dot(gradient.T, solid)
    out[:k, k:] = system.coupling + np.dot(column.T, system.pressure)
    out[k:, :k] = system.coupling.T - (np.dot(system.pressure.T, row) + np.dot(slope.T, turned))
    out[k:, k:] = past.length_s * system.flow
    out[k:, k:] -= np.dot(system.pressure.T, stored) + np.dot(slope.T, flow)
    return out


@compiled
def _add_multiple(to, factor, values):
    single = np.float32(factor)
    for c in range(len(values)):
        to[c] += single * values[c]


@compiled
def renew(system, laws, past, x, room, inverse, force_row, by_pads):
    """Fills the inverse of the free part of the tangent at x, the force's row and the pads' column.

    The rows of the pads' field and of the dual field are not solved for. The free rows come after them.
    """
    _kinematics(system, x, 0, system.weight.shape[0], room)
    whole = tangent(system, laws, past, room)
    free = whole[2:, 2:].copy()
    scale = np.empty(free.shape[0])
    for i in range(len(scale)):
        scale[i] = 1.0 / np.sqrt(abs(free[i, i]) + 1e-300)
    for i in range(len(scale)):
        for j in range(len(scale)):
            free[i, j] *= scale[i] * scale[j]
    if not np.all(np.isfinite(free)):  # a law's values are not finite; the solve fails at its next step
        inverse[:] = np.nan
        return
    inverse[:] = np.linalg.inv(free)
    for i in range(len(scale)):
        for j in range(len(scale)):
            inverse[i, j] *= scale[i] * scale[j]
    force_row[:] = 2.0 * whole[1, 2:]
    by_pads[: len(scale)] = whole[2:, 0]
    by_pads[len(scale)] = 2.0 * whole[1, 0]


@compiled
def solve(system, laws, past, x, tolerance, nominal_n, room, inverse, force_row, by_pads, counts):
    """Solves a stage in place, from the guess x, whose first entry is the displacement of the pads.

    inverse, force_row, by_pads : parts of the last tangent (`renew`), renewed where convergence is slow
    counts (3,) : counters of iterations, residuals and tangents, to which this solve is added
    Returns the status and the force [N], which the last step corrects to first order.
    """
    free = x[2:]
    k = system.gradient.shape[2]
    right, after = np.empty(len(x)), np.empty(len(x))
    counts[1] += 1
    if not residual(system, laws, past, x, room, right) > 0.0:
        return INSIDE_OUT, 0.0
    before, renewals = np.inf, 0
    for iteration in range(MOST_ITERATIONS):
        counts[0] += 1
        step = -np.dot(inverse, right[2:])
        force_step = np.dot(force_row, step)
        size = max(0.1 * np.abs(step[: k - 2]).max(), abs(force_step) / nominal_n) / tolerance
        if not np.isfinite(size):
            return NOT_FINITE, 0.0
        if (size < 1.0 and iteration > 0) or size < 0.01:
            return CONVERGED, 2.0 * right[1] + force_step
        if iteration > 0 and size > SLOW_CONTRACTION * before:
            if renewals == MOST_RENEWALS:
                return SLOW, 0.0
            renewals += 1
            counts[2] += 1
            renew(system, laws, past, x, room, inverse, force_row, by_pads)
            step = -np.dot(inverse, right[2:])
            before = np.inf
        else:
            before = size
        damping = 1.0
        while True:
            moved = x.copy()
            moved[2:] = free + damping * step
            counts[1] += 1
            if residual(system, laws, past, moved, room, after) > 0.0:
                break
            damping *= 0.5
            if damping < SMALLEST_DAMPING:
                return INSIDE_OUT, 0.0
        if damping == 1.0:
            update(inverse, step, after[2:] - right[2:])
        free[:] = moved[2:]
        right[:] = after
    return SLOW, 0.0


@compiled
def update(inverse, step, change):
    """Corrects an inverse in place by Broyden's rank-one update (Broyden's good method)."""
    answer = np.dot(inverse, change)
    row = np.dot(step, inverse)
    along = np.dot(row, change)
    if abs(along) > 1e-3 * np.dot(step, step):
        for i in range(len(step)):
            share = (step[i] - answer[i]) / along
            for j in range(len(step)):
                inverse[i, j] += share * row[j]
