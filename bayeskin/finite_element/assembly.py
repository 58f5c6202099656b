"""Evaluates fields at quadrature points, and assembles the residual and its tangent from them.

The functions are compiled and know no constitutive law. `evaluate` takes the unknowns to the quadrature
points: it gives F = I + grad u, p and grad p there. `residual` takes a law's stress P, fluid content m and
flux Q at the points back to the unknowns, with the test functions w and q:

    R_u = int P : grad w ,     R_p = - int ( q m + grad q . Q )

`tangent` does the same with the law's derivatives. Gradients are stored component by component, so that the
inner loops run over shape functions.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numba
import numpy as np

from bayeskin.types import Array

CHUNK = 256  # number of cells that are evaluated together
FASTMATH = {"contract", "reassoc", "nsz", "arcp"}
SETTINGS: dict[str, Any] = {"cache": True, "error_model": "numpy", "fastmath": FASTMATH}
compiled = numba.njit(**SETTINGS)


class AtPoints:
    """Base class of arrays (e, q, ...) at the q quadrature points of e cells."""

    @cached_property
    def flat(self) -> tuple[Array, ...]:
        """Returns the arrays, in the order of the fields, as views (e q, ...) with points cell by cell."""
        arrays = (getattr(self, f.name) for f in fields(self))  # type: ignore[arg-type]
        return tuple(a.reshape(-1, *a.shape[2:]) for a in arrays)


@dataclass(frozen=True)
class Points(AtPoints):
    """The state in which a law is evaluated: F (e, q, 3, 3), p (e, q) and grad p (e, q, 3)."""

    deformation: Array
    pressure: Array
    gradient: Array


@dataclass(frozen=True)
class Response(AtPoints):
    """The response of a law: stress (e, q, 3, 3), fluid content (e, q), and flux (e, q, 3) over the step."""

    stress: Array
    content: Array
    flux: Array


@dataclass(frozen=True)
class Linearised(AtPoints):
    """Derivatives of a `Response`. Deformations and stresses are written as rows of nine numbers.

    stress_f (e, q, 9, 9), content_f (e, q, 9), flux_f (e, q, 3, 9) : derivatives with respect to F
    stress_p (e, q, 9), content_p (e, q) : derivatives with respect to p
    flux_g (e, q, 3, 3) : derivative with respect to grad p
    """

    stress_f: Array
    stress_p: Array
    content_f: Array
    content_p: Array
    flux_f: Array
    flux_g: Array


@dataclass(frozen=True)
class Chunk:
    """A group of cells whose arrays are small enough for the processor's cache, and these arrays.

    cells : the cells of the group
    points : the quadrature points of these cells, among all points in order of cells
    at, response, by : storage for the state, the response and its derivatives
    """

    cells: slice
    points: slice
    at: Points
    response: Response
    by: Linearised


def chunks(shape: tuple[int, int]) -> list[Chunk]:
    """Returns the chunks that together contain all cells of a model with (e, q) points.

    All chunks share the same arrays, so each chunk must be used up before the next is evaluated.
    """
    size = min(CHUNK, shape[0]), shape[1]
    room = (
        Points(np.empty((*size, 3, 3)), np.empty(size), np.empty((*size, 3))),
        Response(np.empty((*size, 3, 3)), np.empty(size), np.empty((*size, 3))),
        Linearised(*(np.zeros((*size, *tail)) for tail in ((9, 9), (9,), (9,), (), (3, 9), (3, 3)))),
    )
    ends = ((start, min(start + CHUNK, shape[0])) for start in range(0, shape[0], CHUNK))
    return [
        Chunk(slice(a, b), slice(a * shape[1], b * shape[1]), *(_first(b - a, arrays) for arrays in room))
        for a, b in ends
    ]


def _first(count: int, arrays: Any) -> Any:
    """Returns the arrays of the first `count` cells, as views."""
    return type(arrays)(*(getattr(arrays, f.name)[:count] for f in fields(arrays)))


@compiled
def evaluate(x, n_nodes, nodes_u, nodes_p, grad_u, grad_p, value_p, deformation, pressure, gradient):
    """Fills F, p and grad p at the points from the unknowns x (dofs,).

    x holds 3 n_nodes displacements, then the pressures.
    """
    na, nb = nodes_u.shape[1], nodes_p.shape[1]
    u, p = np.empty((3, na)), np.empty(nb)
    for e in range(nodes_u.shape[0]):
        for a in range(na):
            for i in range(3):
                u[i, a] = x[3 * nodes_u[e, a] + i]
        for b in range(nb):
            p[b] = x[3 * n_nodes + nodes_p[e, b]]
        for q in range(value_p.shape[0]):
            for i in range(3):
                for j in range(3):
                    total = 1.0 if i == j else 0.0
                    for a in range(na):
                        total += u[i, a] * grad_u[e, q, j, a]
                    deformation[e, q, i, j] = total
            total = 0.0
            for b in range(nb):
                total += value_p[q, b] * p[b]
            pressure[e, q] = total
            for i in range(3):
                total = 0.0
                for b in range(nb):
                    total += grad_p[e, q, i, b] * p[b]
                gradient[e, q, i] = total


@compiled
def residual(n_nodes, nodes_u, nodes_p, grad_u, grad_p, value_p, weight, stress, content, flux, out):
    """Adds the residual to `out` (dofs,)."""
    na, nb = nodes_u.shape[1], nodes_p.shape[1]
    force, fluid = np.empty((3, na)), np.empty(nb)
    for e in range(nodes_u.shape[0]):
        force[:] = 0.0
        fluid[:] = 0.0
        for q in range(weight.shape[1]):
            w = weight[e, q]
            for i in range(3):
                s0, s1, s2 = w * stress[e, q, i, 0], w * stress[e, q, i, 1], w * stress[e, q, i, 2]
                for a in range(na):
                    force[i, a] += s0 * grad_u[e, q, 0, a] + s1 * grad_u[e, q, 1, a] + s2 * grad_u[e, q, 2, a]
            m, q0, q1, q2 = w * content[e, q], w * flux[e, q, 0], w * flux[e, q, 1], w * flux[e, q, 2]
            for b in range(nb):
                fluid[b] += (
                    m * value_p[q, b]
                    + q0 * grad_p[e, q, 0, b]
                    + q1 * grad_p[e, q, 1, b]
                    + q2 * grad_p[e, q, 2, b]
                )
        for a in range(na):
            for i in range(3):
                out[3 * nodes_u[e, a] + i] += force[i, a]
        for b in range(nb):
            out[3 * n_nodes + nodes_p[e, b]] -= fluid[b]


@compiled
def tangent(
    grad_u,
    grad_p,
    value_p,
    weight,
    stress_f,
    stress_p,
    content_f,
    content_p,
    flux_f,
    flux_g,
    position,
    data,
):
    """Adds the tangent to the entries `data` of a sparse matrix.

    position (e, nd, nd) : place in `data` of each entry of each cell's matrix; -1 for a row that is not
        needed
    """
    na, nb = grad_u.shape[3], grad_p.shape[3]
    solid = np.empty((3, na, 3, na))  # axes: component and node of the row, component and node of the column
    column = np.empty((3, na, nb))
    row = np.empty((nb, 3, na))
    fluid = np.empty((nb, nb))
    half = np.empty(9)
    for e in range(grad_u.shape[0]):
        solid[:] = 0.0
        column[:] = 0.0
        row[:] = 0.0
        fluid[:] = 0.0
        for q in range(weight.shape[1]):
            w = weight[e, q]
            for i in range(3):
                for a in range(na):
                    g0, g1, g2 = w * grad_u[e, q, 0, a], w * grad_u[e, q, 1, a], w * grad_u[e, q, 2, a]
                    for k in range(9):
                        half[k] = (
                            g0 * stress_f[e, q, 3 * i, k]
                            + g1 * stress_f[e, q, 3 * i + 1, k]
                            + g2 * stress_f[e, q, 3 * i + 2, k]
                        )
                    for k in range(3):
                        h0, h1, h2 = half[3 * k], half[3 * k + 1], half[3 * k + 2]
                        for b in range(na):
                            solid[i, a, k, b] += (
                                h0 * grad_u[e, q, 0, b] + h1 * grad_u[e, q, 1, b] + h2 * grad_u[e, q, 2, b]
                            )
                    by_p = (
                        g0 * stress_p[e, q, 3 * i]
                        + g1 * stress_p[e, q, 3 * i + 1]
                        + g2 * stress_p[e, q, 3 * i + 2]
                    )
                    for b in range(nb):
                        column[i, a, b] += by_p * value_p[q, b]
            for b in range(nb):
                v = w * value_p[q, b]
                s0, s1, s2 = w * grad_p[e, q, 0, b], w * grad_p[e, q, 1, b], w * grad_p[e, q, 2, b]
                for k in range(9):
                    half[k] = (
                        v * content_f[e, q, k]
                        + s0 * flux_f[e, q, 0, k]
                        + s1 * flux_f[e, q, 1, k]
                        + s2 * flux_f[e, q, 2, k]
                    )
                for k in range(3):
                    h0, h1, h2 = half[3 * k], half[3 * k + 1], half[3 * k + 2]
                    for a in range(na):
                        row[b, k, a] -= (
                            h0 * grad_u[e, q, 0, a] + h1 * grad_u[e, q, 1, a] + h2 * grad_u[e, q, 2, a]
                        )
                m = v * content_p[e, q]
                g0 = s0 * flux_g[e, q, 0, 0] + s1 * flux_g[e, q, 1, 0] + s2 * flux_g[e, q, 2, 0]
                g1 = s0 * flux_g[e, q, 0, 1] + s1 * flux_g[e, q, 1, 1] + s2 * flux_g[e, q, 2, 1]
                g2 = s0 * flux_g[e, q, 0, 2] + s1 * flux_g[e, q, 1, 2] + s2 * flux_g[e, q, 2, 2]
                for c in range(nb):
                    fluid[b, c] -= (
                        m * value_p[q, c]
                        + g0 * grad_p[e, q, 0, c]
                        + g1 * grad_p[e, q, 1, c]
                        + g2 * grad_p[e, q, 2, c]
                    )
        for a in range(na):
            for i in range(3):
                for b in range(na):
                    for k in range(3):
                        _add(data, position[e, 3 * a + i, 3 * b + k], solid[i, a, k, b])
                for b in range(nb):
                    _add(data, position[e, 3 * a + i, 3 * na + b], column[i, a, b])
                    _add(data, position[e, 3 * na + b, 3 * a + i], row[b, i, a])
        for b in range(nb):
            for c in range(nb):
                _add(data, position[e, 3 * na + b, 3 * na + c], fluid[b, c])


@compiled
def _add(data, place, value):
    """Adds a value at a place; a negative place means that the value is not needed."""
    if place >= 0:
        data[place] += value


@compiled
def inverse_and_determinant(f, inverse):
    """Fills the inverse (3, 3) of F (3, 3), and returns the determinant of F."""
    for i in range(3):
        i1, i2 = (i + 1) % 3, (i + 2) % 3
        for k in range(3):
            k1, k2 = (k + 1) % 3, (k + 2) % 3
            inverse[k, i] = f[i1, k1] * f[i2, k2] - f[i1, k2] * f[i2, k1]
    j = f[0, 0] * inverse[0, 0] + f[0, 1] * inverse[1, 0] + f[0, 2] * inverse[2, 0]
    for i in range(3):
        for k in range(3):
            inverse[i, k] /= j
    return j
