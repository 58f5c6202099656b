"""The full model under loads and boundary values of any kind, and manufactured solutions for it.

Nothing here calls the model's law or its assembly: stresses, fluxes and loads are written out again in
plain NumPy, derivatives are taken by complex steps (exact to rounding), integrals by scikit-fem's bases.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import skfem

from bayeskin.model.lagrangian import LagrangianModel, State, advance
from bayeskin.model.mesh import SkinMesh, roll
from bayeskin.model.problem import Material, Problem
from bayeskin.model.space import QUADRATURE_DEGREE, TaylorHood, sparsity, taylor_hood
from bayeskin.types import Array, PadMotion

STILL = PadMotion(np.array([0.0, 1.0]), np.zeros(2))
COMPLEX_STEP = 1e-30
FINE_QUADRATURE = 6
Load = Callable[[float, float], Array]  # time [s], length of the stage [s] -> (dofs,)


@dataclass(frozen=True)
class DrivenProblem(Problem):
    """Prescribed dofs follow `values(time_s)`, (fixed,)."""

    values: Callable[[float], Array] | None = None

    def prescribe(self, x, pad_displacement_m):
        out = x.copy()
        out[self.pattern.fixed] = self.values(pad_displacement_m)  # a DrivenModel passes the time here
        return out


class TightModel(LagrangianModel):
    """The model, solved `precision` times more tightly than in production."""

    precision = 1e3

    def equations(self, h, old):
        usual = super().equations(h, old)
        return replace(usual, weight=usual.weight * self.precision)


class DrivenModel(TightModel):
    """The model with an external load and boundary values of any kind."""

    def __init__(self, problem, material, load: Load | None = None):
        super().__init__(problem, material, STILL)
        self.load, self.time_s = load, 0.0

    def pad_displacement(self, time_s):
        return time_s

    def solve_stage(self, time_s, h, old, guess, jump):
        self.time_s = time_s
        return super().solve_stage(time_s, h, old, guess, jump)

    def residual(self, x, h, old):
        found = super().residual(x, h, old)
        if found is None or self.load is None:
            return found
        return found[0] - self.load(self.time_s, h), *found[1:]

    def state_at(self, x: Array) -> State:
        """The state at x (dofs,) with a history that is x itself."""
        _, volume, pressure = super().residual(x, 1.0, self.initial_state(0.0))
        return State(0.0, x, volume, pressure)


def driven(
    mesh: SkinMesh,
    material: Material,
    fixed: Array,
    values: Callable[[float], Array],
    load: Load | None = None,
    pad: Array | None = None,
    space: TaylorHood | None = None,
) -> DrivenModel:
    """A model on `mesh` whose dofs `fixed`, sorted, follow values(time_s)."""
    pad = np.array([], int) if pad is None else pad
    space = space or taylor_hood(mesh)
    return DrivenModel(DrivenProblem(mesh, space, sparsity(space, fixed), pad, pad, values), material, load)


def march(model: LagrangianModel, start: State, times: Array, corner_s: float = np.nan):
    """Yields the Step that ends at each of `times`; nothing is extrapolated over the corner."""
    past = [start]
    for end in times:
        step = advance(model, past, end - past[-1].time_s)
        assert step is not None, f"no convergence at {end}"
        past = [step.state] if np.isclose(end, corner_s) else [*past, step.state][-3:]
        yield step


def block(kind: str, lines: tuple[Array, Array, Array], cutis_from: float, radius: float | None) -> SkinMesh:
    """Bricks or tetrahedra between `lines` [m], cutis above z = cutis_from, rolled if a radius is given."""
    flat = skfem.MeshHex.init_tensor(*lines)
    geometry = skfem.MeshHex2.from_mesh(flat) if kind == "bricks" else flat.to_meshtet()
    cutis = geometry.p[2, geometry.t[:4]].mean(axis=0) > cutis_from
    if kind == "bricks":
        cutis = geometry.p[2, geometry.t[:8]].mean(axis=0) > cutis_from
    if radius is not None:
        geometry = type(geometry)(roll(geometry.doflocs, radius), geometry.t)
    return SkinMesh(geometry, {}, cutis, kind)


def elements(mesh: SkinMesh) -> tuple[skfem.Element, skfem.Element]:
    if isinstance(mesh.geometry, skfem.MeshHex2):
        return skfem.ElementHex2(), skfem.ElementHex1()
    return skfem.ElementTetP2(), skfem.ElementTetP1()


def corner_points(space: TaylorHood) -> Array:
    """Coordinates (3, corners) of the pressure's nodes [m]."""
    points = np.zeros((3, space.n_corners))
    points[:, space.nodes_p] = space.points_u[:, space.nodes_u[:, : space.nodes_p.shape[1]]]
    return points


@dataclass(frozen=True)
class Point:
    """A material at one point: mu, lam [Pa], mobility [m^2/(Pa s)], storage [1/Pa]."""

    mu: float
    lam: float
    mobility: float
    storage: float

    def stress(self, f: Array, p: Array) -> Array:
        """First Piola-Kirchhoff stress (n, 3, 3): the energy's derivative by F (n, 3, 3), and p (n,)."""
        turned = np.swapaxes(np.linalg.inv(f), 1, 2)
        j = np.linalg.det(f)
        return self.mu * (f - turned) + ((self.lam * np.log(j) - p * j)[:, None, None]) * turned

    def flux(self, f: Array, gradient: Array) -> Array:
        """(k/mu_f) J C^-1 Grad p, (n, 3): the inward flux through the reference area."""
        metric = np.linalg.inv(np.swapaxes(f, 1, 2) @ f)
        return self.mobility * np.linalg.det(f)[:, None] * np.einsum("nij,nj->ni", metric, gradient)


def by_layer(cutis: Array, upper: Point, lower: Point) -> Material:
    def pick(name: str) -> Array:
        return np.where(cutis, getattr(upper, name), getattr(lower, name))

    return Material(pick("mu"), pick("lam"), pick("mobility"), pick("storage"))


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
    found = [basis.interpolate(np.ascontiguousarray(x[i:n:3])) for i in range(3)]
    found_p = np.asarray(basis_p.interpolate(np.ascontiguousarray(x[n:])))

    def norm(field: Array) -> float:
        return float(np.sqrt((field**2 * basis.dx).sum()))

    values = np.stack([np.asarray(part) for part in found])
    gradients = np.stack([part.grad for part in found])  # (i, j, e, q)
    return {
        "u": norm(values - u) / norm(u),
        "grad u": norm(gradients - du.transpose(2, 3, 0, 1)) / norm(du.transpose(2, 3, 0, 1)),
        "p": norm(found_p - p) / norm(p),
    }
