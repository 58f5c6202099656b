"""Manufactured solutions: exact fields, and the loads that make them solutions of the full model.

Nothing here calls the model's law or its assembly: derivatives are taken by complex steps (exact to
rounding) of the law as `driven` writes it, integrals by scikit-fem's bases.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import skfem
from toys.driven_model import Load, Point, corner_points, elements

from bayeskin.finite_element.space import QUADRATURE_DEGREE, TaylorHood
from bayeskin.finite_element.stages import State
from bayeskin.types import Array

COMPLEX_STEP = 1e-30
FINE_QUADRATURE = 6


@dataclass(frozen=True)
class Manufactured:
    """Exact fields, analytic functions of points X (3, n) and time t.

    displacement (3, n), its gradient (n, 3, 3); pressure (n,), its gradient (n, 3)
    """

    displacement: Callable[[Array, complex], Array]
    gradient: Callable[[Array, complex], Array]
    pressure: Callable[[Array, complex], Array]
    pressure_gradient: Callable[[Array, complex], Array]

    def deformation(self, points: Array, t: complex) -> Array:
        return np.eye(3) + self.gradient(points, t)

    def unknowns(self, space: TaylorHood, t: float) -> Array:
        """Nodal values (dofs,)."""
        u = self.displacement(space.points_u, t).T.ravel()
        return np.concatenate([u, self.pressure(corner_points(space), t)])

    def fluid_rate(self, points: Array, t: float, layer: Point) -> Array:
        """dJ/dt + J S dp/dt, (n,)."""
        later = t + 1j * COMPLEX_STEP
        j = np.linalg.det(self.deformation(points, later))
        return (j.imag + j.real * layer.storage * self.pressure(points, later).imag) / COMPLEX_STEP

    def body_source(self, points: Array, t: float, layer: Point) -> tuple[Array, Array]:
        """-Div P (n, 3) and dJ/dt + J S dp/dt - Div Q (n,) of the strong form."""
        force, fluid = np.zeros((points.shape[1], 3)), self.fluid_rate(points, t, layer)
        for direction in range(3):
            there = points.astype(complex)
            there[direction] += 1j * COMPLEX_STEP
            f = self.deformation(there, t)
            stress = layer.stress(f, self.pressure(there, t))
            flux = layer.flux(f, self.pressure_gradient(there, t))
            force -= stress[:, :, direction].imag / COMPLEX_STEP
            fluid -= flux[:, direction].imag / COMPLEX_STEP
        return force, fluid

    def surface_source(self, points: Array, normal: Array, t: float, layer: Point) -> tuple[Array, Array]:
        """P N (n, 3) and Q . N (n,)."""
        f = self.deformation(points, t)
        stress = layer.stress(f, self.pressure(points, t))
        flux = layer.flux(f, self.pressure_gradient(points, t))
        return np.einsum("nij,jn->ni", stress, normal), np.einsum("nj,jn->n", flux, normal)


def _tested(basis: skfem.CellBasis | skfem.FacetBasis, values: Array, size: int) -> Array:
    """int values w for every scalar shape function w; values (n,) or (n, 3) at the points -> (size, ...)."""
    values = values.reshape(*basis.dx.shape, -1)
    out = np.zeros((size, values.shape[-1]))
    for a, shape in enumerate(basis.basis):
        weighted = np.broadcast_to(np.asarray(shape[0]), basis.dx.shape) * basis.dx
        np.add.at(out, basis.element_dofs[a], np.einsum("eq,eqi->ei", weighted, values))
    return out


def strong_load(exact: Manufactured, space: TaylorHood, upper: Point, lower: Point) -> Load:
    """The load that makes `exact` the solution: body force and fluid source in each layer, and traction and
    flux on the whole surface of each layer, the interface (where they jump) among them.
    """
    mesh, parts = space.mesh, []
    for layer, inside in ((upper, space.mesh.cutis), (lower, ~space.mesh.cutis)):
        cells = np.flatnonzero(inside)
        around = mesh.geometry.facets_around(cells)
        quadratic, linear = elements(mesh)
        body = skfem.CellBasis(mesh.geometry, quadratic, elements=cells, intorder=FINE_QUADRATURE)
        skin = skfem.FacetBasis(mesh.geometry, quadratic, facets=around, intorder=FINE_QUADRATURE)
        parts.append((layer, body, body.with_element(linear), skin, skin.with_element(linear)))

    def load(t: float, h: float) -> Array:
        solid, fluid = np.zeros((space.n_nodes, 3)), np.zeros(space.n_corners)
        for layer, body, body_p, skin, skin_p in parts:
            inner = np.asarray(body.global_coordinates()).reshape(3, -1)
            force, source = exact.body_source(inner, t, layer)
            outer, normal = (np.asarray(v).reshape(3, -1) for v in (skin.global_coordinates(), skin.normals))
            traction, flow = exact.surface_source(outer, normal, t, layer)
            solid += _tested(body, force, space.n_nodes) + _tested(skin, traction, space.n_nodes)
            fluid += _tested(body_p, source, space.n_corners)[:, 0]
            fluid += _tested(skin_p, flow, space.n_corners)[:, 0]
        return np.concatenate([solid.ravel(), -h * fluid])

    return remembered(load)


def weak_load(exact: Manufactured, space: TaylorHood, upper: Point, lower: Point) -> Load:
    """The load under which `exact`, if it lies in the finite-element space, is the discrete solution.

    int P : Grad w and h int (q (dJ/dt + J S dp/dt) + Grad q . Q), with the model's own quadrature degree.
    """
    quadratic, linear = elements(space.mesh)
    parts = []
    for layer, inside in ((upper, space.mesh.cutis), (lower, ~space.mesh.cutis)):
        cells = np.flatnonzero(inside)
        basis = skfem.CellBasis(space.mesh.geometry, quadratic, elements=cells, intorder=QUADRATURE_DEGREE)
        parts.append((layer, basis, basis.with_element(linear)))

    def load(t: float, h: float) -> Array:
        solid, fluid = np.zeros((space.n_nodes, 3)), np.zeros(space.n_corners)
        for layer, basis, basis_p in parts:
            points = np.asarray(basis.global_coordinates()).reshape(3, -1)
            f = exact.deformation(points, t)
            stress = layer.stress(f, exact.pressure(points, t)).reshape(*basis.dx.shape, 3, 3)
            flux = layer.flux(f, exact.pressure_gradient(points, t)).reshape(*basis.dx.shape, 3)
            for a, shape in enumerate(basis.basis):
                part = np.einsum("eqij,jeq,eq->ei", stress, shape[0].grad, basis.dx)
                np.add.at(solid, basis.element_dofs[a], part)
            fluid += _tested(basis_p, exact.fluid_rate(points, t, layer), space.n_corners)[:, 0]
            for b, shape in enumerate(basis_p.basis):
                part = np.einsum("eqj,jeq,eq->e", flux, shape[0].grad, basis_p.dx)
                np.add.at(fluid, basis_p.element_dofs[b], part)
        return np.concatenate([solid.ravel(), -h * fluid])

    return remembered(load)


def remembered(load: Load) -> Load:
    """`load`, evaluated once a stage."""
    last: dict[tuple[float, float], Array] = {}

    def once(t: float, h: float) -> Array:
        if (t, h) not in last:
            last.clear()
            last[t, h] = load(t, h)
        return last[t, h]

    return once


def exact_state(exact: Manufactured, space: TaylorHood, t: float) -> State:
    """The state whose history J, p is the exact one at the model's quadrature points."""
    basis = skfem.CellBasis(space.mesh.geometry, elements(space.mesh)[0], intorder=QUADRATURE_DEGREE)
    points = np.asarray(basis.global_coordinates()).reshape(3, -1)
    volume = np.linalg.det(exact.deformation(points, t)).reshape(basis.dx.shape)
    return State(t, exact.unknowns(space, t), volume, exact.pressure(points, t).reshape(basis.dx.shape))


def errors(exact: Manufactured, space: TaylorHood, x: Array, t: float) -> dict[str, float]:
    """Norms of x - exact over those of exact: u in L2 and in the H1 seminorm, p in L2."""
    quadratic, linear = elements(space.mesh)
    basis = skfem.CellBasis(space.mesh.geometry, quadratic, intorder=FINE_QUADRATURE)
    basis_p = basis.with_element(linear)
    points = np.asarray(basis.global_coordinates()).reshape(3, -1)
    shape, n = basis.dx.shape, 3 * space.n_nodes
    u = exact.displacement(points, t).reshape(3, *shape)
    du = exact.gradient(points, t).reshape(*shape, 3, 3)
    p = exact.pressure(points, t).reshape(shape)
    components = [basis.interpolate(np.ascontiguousarray(x[i:n:3])) for i in range(3)]
    found_p = np.asarray(basis_p.interpolate(np.ascontiguousarray(x[n:])))

    def norm(field: Array) -> float:
        return float(np.sqrt((field**2 * basis.dx).sum()))

    values = np.stack([np.asarray(part) for part in components])
    gradients = np.stack([part.grad for part in components])  # (i, j, e, q)
    return {
        "u": norm(values - u) / norm(u),
        "grad u": norm(gradients - du.transpose(2, 3, 0, 1)) / norm(du.transpose(2, 3, 0, 1)),
        "p": norm(found_p - p) / norm(p),
    }
