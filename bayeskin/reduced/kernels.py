"""Compiled core of the reduced model: the residual and the tangent of a stage, summed over weighted points.

The unknowns are the coefficients x = (d, 0, displacement modes, pressure modes), where d is the displacement
of the pads. The second entry is always zero. It belongs to the dual field, whose row of the residual is half
the measured force. The laws of mechanisms are called by address (`calls`), so no loop over points or
iterations runs in Python.

The part of the base law that is linear at rest is integrated exactly. `System.solid`, `coupling` and `flow`
hold the difference between its integral over all points and its integral over the chosen points. This
difference corrects the sum over the chosen points.

Loops over entries take the place of assignments and expressions of whole arrays, which numba compiles slowly.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np

from bayeskin.finite_element import poroelastic
from bayeskin.finite_element.assembly import compiled
from bayeskin.reduced.calls import call_linearise, call_respond

BLOCK = 16  # number of points whose modes fit into the first-level cache
FIRST = np.int64(0)  # the first point; for a plain 0, numba would compile the functions once more


@compiled
def residual(system, laws, past, x, room, out):
    """Fills the residual `out` (k + m,) and the room, and returns the smallest J.

    A point is inside out where J is not positive. The residual is then incomplete.
    """
    n, k = system.weight.shape[0], system.gradient.shape[2]
    out[:] = 0.0
    smallest = np.inf
    for start in range(0, n, BLOCK):
        end = min(start + BLOCK, n)
        fill_kinematics(system, x, start, end, room)
        least = answer(system, laws, past, start, end, room)
        if not least > 0.0:
            return least
        smallest = min(smallest, least)
        _project(system, start, end, room, out)
    moved = x[:k].copy()
    for i in range(k):
        moved[i] -= past.displacement[i]
    add_linear(system, x, moved, past.length_s, out)
    return smallest


@compiled
def add_linear(system, x, moved, length_s, out):
    """Adds the exactly integrated part to the residual; moved (k,) is the change of the displacement."""
    k, m = system.gradient.shape[2], system.pressure.shape[1]
    fields, pressures = x[:k], x[k:]
    for i in range(k):
        out[i] += product(system.solid[i], fields) + product(system.coupling[i], pressures)
    for i in range(m):
        total = length_s * product(system.flow[i], pressures)
        for j in range(k):
            total += system.coupling[j, i] * moved[j]
        out[k + i] += total


@compiled
def fill_kinematics(system, x, start, end, room):
    """Fills F, p and grad p at the points from `start` to `end`."""
    k = system.gradient.shape[2]
    fields, pressures = x[:k], x[k:]
    for q in range(start, end):
        for i in range(3):
            for j in range(3):
                room.deformation[q, i, j] = product(system.gradient[q, 3 * i + j], fields)
            room.deformation[q, i, i] += 1.0
        room.at_pressure[q] = product(system.pressure[q], pressures)
        for i in range(3):
            room.at_slope[q, i] = product(system.slope[q, i], pressures)


@compiled
def product(left, right):
    total = 0.0
    for c in range(len(left)):
        total += left[c] * right[c]
    return total


@compiled
def answer(system, laws, past, start, end, room):
    """Fills stress, content, flux, J and memory at points `start` to `end`; returns the smallest J."""
    smallest = poroelastic.respond(
        _cells_of_matrices(room.deformation, start, end), _cells(room.at_pressure, start, end),
        _cells_of_vectors(room.at_slope, start, end), system.mu[start:end], system.lam[start:end],
        system.mobility[start:end], system.storage[start:end], past.length_s,
        _cells(past.volume, start, end), _cells(past.pressure, start, end),
        _cells_of_matrices(room.stress, start, end), _cells(room.content, start, end),
        _cells_of_vectors(room.flux, start, end), _cells(room.volume, start, end),
    )  # fmt: skip
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
def _cells(values, start, end):
    """Returns values (n,) at some points as those of cells with a single point (e, 1)."""
    return values[start:end].reshape(end - start, 1)


@compiled
def _cells_of_vectors(values, start, end):
    return values[start:end].reshape(end - start, 1, 3)


@compiled
def _cells_of_matrices(values, start, end):
    return values[start:end].reshape(end - start, 1, 3, 3)


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
            before, _, data, par = _of_law(laws, law, FIRST, n, past.memory, room.memory)
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
    solid_part, turned_part = _product_of_columns(gradient, solid), _product_of_columns(slope, turned)
    column_part = _product_of_columns(column, system.pressure)
    row_part = _product_of_columns(system.pressure, row)
    stored_part, flow_part = _product_of_columns(system.pressure, stored), _product_of_columns(slope, flow)
    out = np.empty((k + m, k + m))
    for i in range(k):
        for j in range(k):
            out[i, j] = system.solid[i, j] + solid_part[i, j]
        for j in range(m):
            out[i, k + j] = system.coupling[i, j] + column_part[i, j]
    for i in range(m):
        for j in range(k):
            out[k + i, j] = system.coupling[j, i] - (row_part[i, j] + turned_part[i, j])
        for j in range(m):
            flow_rate = past.length_s * system.flow[i, j]
            out[k + i, k + j] = flow_rate - (stored_part[i, j] + flow_part[i, j])
    return out


@compiled
def _product_of_columns(left, right):
    """Returns left' right."""
    return np.dot(left.T, right)


@compiled
def _add_multiple(to, factor, values):
    single = np.float32(factor)
    for c in range(len(values)):
        to[c] += single * values[c]
