"""Compiled derivatives of a solved stage of the reduced model, by all parameters at once."""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bayeskin.model.assembly import compiled
from bayeskin.reduced.kernels import History, Laws, Room, System, answer, renew
from bayeskin.types import Array


class Varied(NamedTuple):
    """A run's constants where one of r parameters is a step further, and derivatives of its exact parts.

    mu, lam, mobility (r, n); par (r, .), data (r, .) : as in `System` and `Laws`, at the changed values
    solid_units (s, k, k), flow_units (t, m, m) : what `System.solid` and `flow` are combinations of
    solid_by (r, s), flow_by (r, t) : derivatives of the coefficients; step : the change, in units of one
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
    """Derivatives by r parameters of a state: x (r, k + m), J and p (r, n), memory (r, .)."""

    x: Array
    volume: Array
    pressure: Array
    memory: Array


@compiled
def differentiate(system, laws, past, x, room, varied, before, pads_by, inverse, force_row, by_pads, out):
    """Fills `out`, the derivatives of a solved stage's end, and returns those of the force [N], (r,).

    room : as `solve` left it at x; before : derivatives of the history (x those of x*)
    pads_by (r,) : of the pads' displacement

    The tangent at x is made anew and left in inverse, force_row and by_pads.
    """
    n, k, m = system.weight.shape[0], system.gradient.shape[2], system.pressure.shape[1]
    r = len(pads_by)
    step = varied.step
    renew(system, laws, past, x, room, inverse, force_row, by_pads)
    other = Room(
        room.deformation.copy(), room.at_pressure.copy(), room.at_slope.copy(), np.empty((n, 3, 3)),
        np.empty(n), np.empty((n, 3)), np.empty(n), np.empty(len(room.memory)),
    )  # fmt: skip
    stress, content, flux = np.empty((r, 9 * n)), np.empty((r, n)), np.empty((r, 3 * n))
    for i in range(r):
        _answer_varied(system, laws, past, varied, before, i, other)
        for q in range(n):
            w = system.weight[q] / step
            content[i, q] = w * (other.content[q] - room.content[q])
            for a in range(3):
                flux[i, 3 * q + a] = w * (other.flux[q, a] - room.flux[q, a])
                for b in range(3):
                    stress[i, 9 * q + 3 * a + b] = w * (other.stress[q, a, b] - room.stress[q, a, b])
    gradient, slope = system.gradient.reshape(9 * n, k), system.slope.reshape(3 * n, m)
    right = np.empty((r, k + m))
    right[:, :k] = np.dot(stress, gradient)
    right[:, k:] = -(np.dot(content, system.pressure) + np.dot(flux, slope))
    _add_exact(system, past, x, varied, before, right)
    free = right[:, 2:] + np.outer(pads_by, by_pads[:-1])
    out.x[:, 0] = pads_by
    out.x[:, 1] = 0.0
    out.x[:, 2:] = -np.dot(free, inverse.T)
    force = 2.0 * right[:, 1] + np.dot(out.x[:, 2:].copy(), force_row) + pads_by * by_pads[-1]
    deformed = np.dot(out.x[:, :k].copy(), gradient.T)
    pressed, sloped = np.dot(out.x[:, k:].copy(), system.pressure.T), np.dot(out.x[:, k:].copy(), slope.T)
    for i in range(r):
        for q in range(n):
            other.at_pressure[q] = room.at_pressure[q] + step * pressed[i, q]
            for a in range(3):
                other.at_slope[q, a] = room.at_slope[q, a] + step * sloped[i, 3 * q + a]
                for b in range(3):
                    change = step * deformed[i, 9 * q + 3 * a + b]
                    other.deformation[q, a, b] = room.deformation[q, a, b] + change
        _answer_varied(system, laws, past, varied, before, i, other)
        out.volume[i] = (other.volume - room.volume) / step
        out.memory[i] = (other.memory - room.memory) / step
        out.pressure[i] = pressed[i]
    return force


@compiled
def _answer_varied(system, laws, past, varied, before, i, other):
    """Fills `other` with the answers where parameter i and the history are a step further."""
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
def _add_exact(system, past, x, varied, before, right):
    """Adds the derivatives of the exactly integrated parts to right (r, k + m)."""
    k = system.gradient.shape[2]
    force, fluid = x[:k].copy(), x[k:].copy()
    for s in range(varied.solid_units.shape[0]):
        answer = np.dot(varied.solid_units[s], force)
        for i in range(right.shape[0]):
            right[i, :k] += varied.solid_by[i, s] * answer
    for t in range(varied.flow_units.shape[0]):
        answer = np.dot(varied.flow_units[t], fluid)
        for i in range(right.shape[0]):
            right[i, k:] += past.length_s * varied.flow_by[i, t] * answer
    right[:, k:] -= np.dot(before.x[:, :k].copy(), system.coupling)
