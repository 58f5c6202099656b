"""Computes, in compiled code, the derivatives of a solved stage of the reduced model by all parameters."""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bayeskin.finite_element.assembly import compiled
from bayeskin.reduced.arrays import History, Laws, Room, System
from bayeskin.reduced.kernels import SLOW_CONTRACTION, answer, renew, update
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
    k, r = system.gradient.shape[2], len(out.x)
    exact, force = _exact(system, past, x, varied, before), np.empty(r)
    rows, worst, tangents = np.arange(r), np.inf, 0
    left = _left(system, laws, past, room, varied, before, exact, rows, out)
    for _ in range(MOST_PASSES):
        step, going = np.zeros((len(rows), len(x) - 2)), np.full(len(rows), False)
        worst_before, worst = worst, 0.0
        for a in range(len(rows)):
            i = rows[a]
            step[a] = -np.dot(inverse, left[a, 2:])
            more = np.dot(force_row, step[a])
            force[i] = 2.0 * left[a, 1] + more
            far = np.abs(step[a, : k - 2]).max()
            scale[0, i] = max(scale[0, i], np.abs(out.x[i, :k]).max(), far)
            scale[1, i] = max(scale[1, i], abs(force[i]))
            if far > 0.0:
                now = max(far / scale[0, i], abs(more) / scale[1, i])
                going[a] = not now < ENOUGH
                worst = max(worst, now)
        rows, left, step = rows[going], left[going], step[going]
        if len(rows) == 0:
            break
        if worst > SLOW_CONTRACTION * worst_before:
            tangents += 1
            renew(system, laws, past, x, room, inverse, force_row, by_pads)
            worst = np.inf
            for a in range(len(rows)):
                step[a] = -np.dot(inverse, left[a, 2:])
        for a in range(len(rows)):
            out.x[rows[a], 2:] += step[a]
        nearer = _left(system, laws, past, room, varied, before, exact, rows, out)
        for a in range(len(rows)):
            update(inverse, step[a], nearer[a, 2:] - left[a, 2:])
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
    solid, fluid = out.x[rows, :k].copy(), out.x[rows, k:].copy()
    single, single_fluid = solid.astype(np.float32), fluid.astype(np.float32)
    deformed = np.dot(single, gradient.T)
    pressed, sloped = np.dot(single_fluid, system.pressure.T), np.dot(single_fluid, slope.T)
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
        out.volume[i] = (other.volume - room.volume) / step
        out.memory[i] = (other.memory - room.memory) / step
    left = exact[rows]
    left[:, :k] += np.dot(stress, gradient) + np.dot(solid, system.solid.T) + np.dot(fluid, system.coupling.T)
    left[:, k:] += np.dot(solid, system.coupling) + past.length_s * np.dot(fluid, system.flow.T)
    left[:, k:] -= np.dot(content, system.pressure) + np.dot(flux, slope)
    return left


@compiled
def _answer_varied(system, laws, past, varied, before, i, other):
    """Fills `other` with the response of the laws after a step of parameter i and of the history."""
    step = varied.step
    changed = System(
        system.gradient, system.pressure, system.slope, system.weight, varied.mu[i], varied.lam[i],
        varied.mobility[i], system.storage, system.solid, system.coupling, system.flow,
    )  # fmt: skip
    acting = Laws(
        laws.respond, laws.linearise, varied.par[i], laws.par_at, varied.data[i], laws.data_width,
        laws.data_at, laws.memory_width, laws.memory_at,
    )  # fmt: skip
    older = History(
        past.volume + step * before.volume[i], past.pressure + step * before.pressure[i],
        past.memory + step * before.memory[i], past.displacement, past.length_s, past.elapsed_s, past.time_s,
    )  # fmt: skip
    answer(changed, acting, older, 0, system.weight.shape[0], other)


@compiled
def _exact(system, past, x, varied, before):
    """Returns the derivatives (r, k + m) of the exactly integrated parts at fixed x."""
    k = system.gradient.shape[2]
    force, fluid = x[:k].copy(), x[k:].copy()
    out = np.zeros((varied.solid_by.shape[0], len(x)))
    for s in range(varied.solid_units.shape[0]):
        answer = np.dot(varied.solid_units[s], force)
        for i in range(out.shape[0]):
            out[i, :k] += varied.solid_by[i, s] * answer
    for t in range(varied.flow_units.shape[0]):
        answer = np.dot(varied.flow_units[t], fluid)
        for i in range(out.shape[0]):
            out[i, k:] += past.length_s * varied.flow_by[i, t] * answer
    out[:, k:] -= np.dot(before.x[:, :k].copy(), system.coupling)
    return out
