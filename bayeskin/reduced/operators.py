"""Evaluates a basis at quadrature points, and integrates the linear parts of the base law."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
import scipy.sparse as sp

from bayeskin.finite_element.problem import Problem, Sites
from bayeskin.geometry import Geometry
from bayeskin.types import Array

CELLS_AT_ONCE = 64


@dataclass(frozen=True)
class Basis:
    """Fields of a reduced model on the nodes of a mesh; the most important modes come first.

    moving (3 nodes,) : field that is one along x on all nodes of the pads (`basis.Inner`)
    dual (3 nodes,) : field that is one along x only on the nodes that the load cell measures
    displacement (u, 3 nodes) : modes [m]; pressure (p, corners) : modes [Pa], of which the first is constant
    """

    moving: Array
    dual: Array
    displacement: Array
    pressure: Array

    @property
    def fields(self) -> Array:
        """Returns all fields of the displacement (2 + u, 3 nodes): `moving`, `dual` and the modes."""
        return np.concatenate([[self.moving, self.dual], self.displacement])

    def nodal(self, x: Array) -> Array:
        """Returns the full model's unknowns (dofs,) for the coefficients (2 + u + p,) of a reduced state."""
        k = 2 + len(self.displacement)
        return np.concatenate([x[:k] @ self.fields, x[k:] @ self.pressure])


@dataclass(frozen=True)
class PointFields:
    """Gradients and values of the fields of a basis at n quadrature points, with their weights.

    gradient (n, 9, k) : gradients of the k displacement fields
    slope (n, 3, m), pressure (n, m) : gradients and values of the m pressure modes
    weight (n,) : weights of the points [m^3]; cutis (n,) : True in the cutis; points_m (3, n) : coordinates

    gradient, slope and pressure are in single precision, which is the precision of the modes.
    """

    gradient: Array
    slope: Array
    pressure: Array
    weight: Array
    cutis: np.ndarray
    points_m: Array

    def at(self, rule: Rule) -> PointFields:
        """Returns the fields at the points of a rule, with the weights of the rule."""
        i = rule.points
        return PointFields(
            self.gradient[i], self.slope[i], self.pressure[i], rule.weight(self.weight), self.cutis[i],
            np.ascontiguousarray(self.points_m[:, i]),
        )  # fmt: skip


@dataclass(frozen=True)
class Rule:
    """A cubature: indices (n,) of the chosen points, and factors (n,) that multiply their weights."""

    points: np.ndarray
    factor: Array

    def weight(self, weight: Array) -> Array:
        """Returns the weights (n,) of the chosen points, from the weights of all points."""
        return np.asarray(self.factor * weight[self.points])


@dataclass(frozen=True)
class LinearParts:
    """Matrices of the base law's linear part, for each layer (first axis: cutis, subcutis).

    shear, bulk (2, k, k) : matrices for mu = 1 and for lambda = 1; flow (2, m, m) : matrix for mobility = 1
    coupling (k, m) : integral of - div u p over both layers
    """

    shear: Array
    bulk: Array
    flow: Array
    coupling: Array

    def __sub__(self, other: LinearParts) -> LinearParts:
        return LinearParts(
            self.shear - other.shear, self.bulk - other.bulk, self.flow - other.flow,
            self.coupling - other.coupling,
        )  # fmt: skip


SurfaceUnit = Callable[[Problem], sp.csr_matrix]  # returns the matrix (dofs, dofs) of a unit surface term


@dataclass(frozen=True)
class ReducedSpace:
    """A basis at the points of a cubature, and the parts of the equations that are integrated exactly.

    lengths : geometry of device and tissue; at : fields of the basis at the points
    exact : exact integrals of the base law's linear parts minus their sums over the points
    surfaces : function that returns a unit surface term, projected on all fields, (k + m, k + m)
    """

    lengths: Geometry
    at: PointFields
    exact: LinearParts
    surfaces: Callable[[SurfaceUnit], Array]

    @property
    def modes(self) -> tuple[int, int]:
        """Returns the number k of displacement fields (pads and dual included) and m of pressure modes."""
        return self.at.gradient.shape[2], self.at.pressure.shape[1]

    @property
    def sites(self) -> Sites:
        """Returns the points in the form that laws are given."""
        return Sites(self.at.cutis, self.at.points_m, self.lengths)


def linear_parts(at: PointFields) -> LinearParts:
    """Integrates the base law's linear part at rest, with weighted points."""
    shear, bulk, flow = [], [], []
    divergence, weight = at.gradient[:, 0] + at.gradient[:, 4] + at.gradient[:, 8], _single(at.weight)
    for layer in (at.cutis, ~at.cutis):
        b, w, g, trace = at.gradient[layer], weight[layer], at.slope[layer], divergence[layer]
        (n, _, k), m = b.shape, g.shape[2]
        symmetric = b + b.reshape(n, 3, 3, k).transpose(0, 2, 1, 3).reshape(n, 9, k)
        shear.append(b.reshape(n * 9, k).T @ (symmetric * w[:, None, None]).reshape(n * 9, k))
        bulk.append(trace.T @ (trace * w[:, None]))
        flow.append(g.reshape(n * 3, m).T @ (g * w[:, None, None]).reshape(n * 3, m))
    coupling = -(divergence * weight[:, None]).T @ at.pressure
    return LinearParts(*(np.array(part, dtype=float) for part in (shear, bulk, flow, coupling)))


def point_fields(problem: Problem, basis: Basis, cells: np.ndarray | slice = slice(None)) -> PointFields:
    """Returns the fields of a basis at the quadrature points of some cells of a problem, cell after cell."""
    s = problem.space
    fields, nodes_u, nodes_p = basis.fields, s.nodes_u[cells], s.nodes_p[cells]
    (e, q), sites = s.weight[cells].shape, problem.sites
    numbers = (np.arange(len(s.weight))[cells, None] * q + np.arange(q)).ravel()
    nodal = _single(fields.T).reshape(-1, 3, len(fields))[nodes_u]  # (e, a, 3, k)
    gradient = np.einsum("eqja,eaik->eqijk", _single(s.grad_u[cells]), nodal, optimize=True)
    corners = _single(basis.pressure.T)[nodes_p]  # (e, b, m)
    slope = np.einsum("eqjb,ebm->eqjm", _single(s.grad_p[cells]), corners, optimize=True)
    return PointFields(
        gradient=gradient.reshape(e * q, 9, -1),
        slope=slope.reshape(e * q, 3, -1),
        pressure=np.einsum("qb,ebm->eqm", _single(s.value_p), corners, optimize=True).reshape(e * q, -1),
        weight=s.weight[cells].ravel(),
        cutis=sites.cutis[numbers],
        points_m=np.ascontiguousarray(sites.points_m[:, numbers]),
    )


def _single(values: Array) -> np.ndarray:
    return np.asarray(values, dtype=np.float32)


def fields_at(problem: Problem, basis: Basis, rule: Rule) -> PointFields:
    """Returns the fields of a basis at the points of a rule, with the weights of the rule."""
    q = problem.space.weight.shape[1]
    cells, place = np.unique(rule.points // q, return_inverse=True)
    local = Rule(place * q + rule.points % q, rule.factor)
    return point_fields(problem, basis, cells).at(local)


def whole_linear_parts(problem: Problem, basis: Basis) -> LinearParts:
    """Integrates the base law's linear part at rest, with all points of a problem, some cells at a time."""
    count = len(problem.space.weight)
    parts = [
        linear_parts(point_fields(problem, basis, slice(start, min(start + CELLS_AT_ONCE, count))))
        for start in range(0, count, CELLS_AT_ONCE)
    ]
    return LinearParts(*(np.sum([getattr(p, f.name) for p in parts], axis=0) for f in fields(LinearParts)))
