"""Computes, in compiled code, the derivatives of a solved stage of the reduced model by all parameters."""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bayeskin.finite_element.assembly import compiled
from bayeskin.reduced.arrays import History, Laws, Room, System
from bayeskin.reduced.kernels import FIRST, add_linear, answer, product
from bayeskin.reduced.newton import SLOW_CONTRACTION, fill_step, largest, renew, update
from bayeskin.types import Array

ENOUGH = 1e-3  # relative to the largest derivatives so far; the solve ends with a step below it
MOST_PASSES = 12


class Varied(NamedTuple):
    """Constants of a run after a step of one of r parameters, and derivatives of its exact parts.

    mu, lam, mobility (r, n); par (r, .), data (r, .) : as in `System` and `Laws`, for the changed parameters
    solid_units (s, k, k), flow_units (t, m, m) : matrices whose combinations are `System.solid` and `flow`
    solid_by (r, s), flow_by (r, t) : derivatives of the coefficients of these matrices
    step : size of the step, in units of each parameter's change
    """

    mu: Array
    lam: Array
    mobility: Array
    par: Array
    data: Array
    solid_units: Array
    flow_units: Array
    solid_by: Array
    flow_by: Array
    step: float


class Slopes(NamedTuple):
    """Derivatives of a state by r parameters: of x (r, k + m), J and p (r, n), and memory (r, .)."""

    x: Array
    volume: Array
    pressure: Array
    memory: Array


@compiled
def differentiate(system, laws, past, x, room, varied, before, scale, inverse, force_row, by_pads, out):
    """Solves for the derivatives `out` of the state at the end of a solved stage.

    room : arrays as the solve left them at x; before : derivatives of the history, whose x belongs to x*
    scale (2, r) : largest derivatives of the run so far, of displacements and of the force; it is updated
    inverse, force_row, by_pads : inverse, row and column of a tangent near x; each step corrects the inverse,
        and all are computed again where the solve converges badly
    out : its x is a guess at the start, in which the derivatives of the pads' displacement are exact

    Returns the derivatives (r,) of the force [N], which the last step corrects to first order, and the number
    of tangents that were computed.
    """
    k, r, size = system.gradient.shape[2], len(out.x), len(x)
    exact, force = _exact(system, past, x, varied, before), np.empty(r)
    step, change = np.empty((r, size - 2)), np.empty(size - 2)
    rows, count, worst, tangents = np.arange(r), r, np.inf, 0
    left = _left(system, laws, past, room, varied, before, exact, rows, out)
    for _ in range(MOST_PASSES):
        going, worst_before, worst = 0, worst, 0.0
        for a in range(count):
            i = rows[a]
            fill_step(inverse, left[a], step[going])
            more, far = product(force_row, step[going]), largest(step[going], k - 2)
            force[i] = 2.0 * left[a, 1] + more
            scale[0, i] = max(scale[0, i], largest(out.x[i], k), far)
            scale[1, i] = max(scale[1, i], abs(force[i]))
            if far > 0.0:
                now = max(far / scale[0, i], abs(more) / scale[1, i])
                worst = max(worst, now)
                if not now < ENOUGH:
                    rows[going] = i
                    for c in range(size):
                        left[going, c] = left[a, c]
                    going += 1
        count = going
        if count == 0:
            break
        if worst > SLOW_CONTRACTION * worst_before:
            tangents += 1
            renew(system, laws, past, x, room, inverse, force_row, by_pads)
            worst = np.inf
            for a in range(count):
                fill_step(inverse, left[a], step[a])
        for a in range(count):
            for c in range(size - 2):
                out.x[rows[a], 2 + c] += step[a, c]
        nearer = _left(system, laws, past, room, varied, before, exact, rows[:count], out)
        for a in range(count):
            for c in range(size - 2):
                change[c] = nearer[a, 2 + c] - left[a, 2 + c]
            update(inverse, step[a], change)
        left = nearer
    return force, tangents


@compiled
def _left(system, laws, past, room, varied, before, exact, rows, out):
    """Returns derivatives (a, k + m) of the residual by the parameters `rows` (a,), given rows of `out.x`.

    Fills the other fields of these rows of `out`.
    """
    n, k, m = system.weight.shape[0], system.gradient.shape[2], system.pressure.shape[1]
    r, step = len(rows), varied.step
    gradient, slope = system.gradient.reshape(9 * n, k), system.slope.reshape(3 * n, m)
    fields, pressures = np.empty((r, k), np.float32), np.empty((r, m), np.float32)
    for parameter in range(r):
        x = out.x[rows[parameter]]
        for c in range(k):
            fields[parameter, c] = x[c]
        for c in range(m):
            pressures[parameter, c] = x[k + c]
    deformed = _product_of_rows(fields, gradient)
    pressed, sloped = _product_of_rows(pressures, system.pressure), _product_of_rows(pressures, slope)
    other = Room(
        np.empty((n, 3, 3)), np.empty(n), np.empty((n, 3)), np.empty((n, 3, 3)),
        np.empty(n), np.empty((n, 3)), np.empty(n), np.empty(len(room.memory)),
    )  # fmt: skip
    stress = np.empty((r, 9 * n), np.float32)
    content, flux = np.empty((r, n), np.float32), np.empty((r, 3 * n), np.float32)
    for parameter in range(r):
        i = rows[parameter]
        for q in range(n):
            other.at_pressure[q] = room.at_pressure[q] + step * pressed[parameter, q]
            for a in range(3):
                other.at_slope[q, a] = room.at_slope[q, a] + step * sloped[parameter, 3 * q + a]
                for b in range(3):
                    moved = step * deformed[parameter, 9 * q + 3 * a + b]
                    other.deformation[q, a, b] = room.deformation[q, a, b] + moved
        _answer_varied(system, laws, past, varied, before, i, other)
        for q in range(n):
            w = system.weight[q] / step
            content[parameter, q] = w * (other.content[q] - room.content[q])
            for a in range(3):
                flux[parameter, 3 * q + a] = w * (other.flux[q, a] - room.flux[q, a])
                for b in range(3):
                    stress[parameter, 9 * q + 3 * a + b] = w * (other.stress[q, a, b] - room.stress[q, a, b])
            out.pressure[i, q] = pressed[parameter, q]
            out.volume[i, q] = (other.volume[q] - room.volume[q]) / step
        for c in range(len(room.memory)):
            out.memory[i, c] = (other.memory[c] - room.memory[c]) / step
    return _projected(system, past, exact, rows, out.x, stress, content, flux)


@compiled
def _projected(system, past, exact, rows, x, stress, content, flux):
    """Returns the rows of `_left` from the derivatives of the response at the points."""
    n, k, m = system.weight.shape[0], system.gradient.shape[2], system.pressure.shape[1]
    stressed = _product(stress, system.gradient.reshape(9 * n, k))
    stored, flown = _product(content, system.pressure), _product(flux, system.slope.reshape(3 * n, m))
    left = np.empty((len(rows), k + m))
    for parameter in range(len(rows)):
        i = rows[parameter]
        for c in range(k):
            left[parameter, c] = exact[i, c] + stressed[parameter, c]
        for c in range(m):
            left[parameter, k + c] = exact[i, k + c] - (stored[parameter, c] + flown[parameter, c])
        add_linear(system, x[i], x[i], past.length_s, left[parameter])
    return left


@compiled
def _product(left, right):
    return np.dot(left, right)


@compiled
def _product_of_rows(left, right):
    """Returns left right'."""
    return np.dot(left, right.T)


@compiled
def _answer_varied(system, laws, past, varied, before, i, other):
    """Fills `other` with the response of the laws after a step of parameter i and of the history."""
    changed = System(
        system.gradient, system.pressure, system.slope, system.weight, varied.mu[i], varied.lam[i],
        varied.mobility[i], system.storage, system.solid, system.coupling, system.flow,
    )  # fmt: skip
    acting = Laws(
        laws.respond, laws.linearise, varied.par[i], laws.par_at, varied.data[i], laws.data_width,
        laws.data_at, laws.memory_width, laws.memory_at,
    )  # fmt: skip
    older = History(
        _moved(past.volume, varied.step, before.volume[i]),
        _moved(past.pressure, varied.step, before.pressure[i]),
        _moved(past.memory, varied.step, before.memory[i]),
        past.displacement, past.length_s, past.elapsed_s, past.time_s,
    )  # fmt: skip
    answer(changed, acting, older, FIRST, system.weight.shape[0], other)


@compiled
def _moved(values, step, slopes):
    """Returns values (n,) after a step along their slopes."""
    out = np.empty(len(values))
    for c in range(len(values)):
        out[c] = values[c] + step * slopes[c]
    return out


@compiled
def _exact(system, past, x, varied, before):
    """Returns the derivatives (r, k + m) of the exactly integrated parts at fixed x."""
    r, k, m = varied.solid_by.shape[0], system.gradient.shape[2], system.pressure.shape[1]
    out = np.zeros((r, k + m))
    for c in range(k):
        for s in range(varied.solid_units.shape[0]):
            by_unit = product(varied.solid_units[s, c], x[:k])
            for i in range(r):
                out[i, c] += varied.solid_by[i, s] * by_unit
    for c in range(m):
        for t in range(varied.flow_units.shape[0]):
            by_unit = past.length_s * product(varied.flow_units[t, c], x[k:])
            for i in range(r):
                out[i, k + c] += varied.flow_by[i, t] * by_unit
    for i in range(r):
        for a in range(k):
            for c in range(m):
                out[i, k + c] -= before.x[i, a] * system.coupling[a, c]
    return out
