"""The full model under loads and boundary values of any kind; its law written out again in plain NumPy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import skfem

from bayeskin.finite_element.lagrangian import LagrangianModel
from bayeskin.finite_element.mesh import SkinMesh, roll
from bayeskin.finite_element.problem import Material, Problem
from bayeskin.finite_element.series import Drive, SeriesSolver
from bayeskin.finite_element.space import TaylorHood, sparsity, taylor_hood
from bayeskin.finite_element.stages import State
from bayeskin.finite_element.stepping import advance
from bayeskin.types import Array, PadMotion

STILL = PadMotion(np.array([0.0, 1.0]), np.zeros(2))
Load = Callable[[float, float], Array]  # time [s], length of the stage [s] -> (dofs,)


@dataclass(frozen=True)
class DrivenProblem(Problem):
    """Prescribed dofs follow `values(time_s)`, (fixed,)."""

    values: Callable[[float], Array] | None = None

    def prescribe(self, x, time_s):
        out = x.copy()
        out[self.pattern.fixed] = self.values(time_s)
        return out


class Clock(Drive):
    """A drive that tells the time in place of the pads' displacement."""

    def pads_m(self, time_s, lost_m):
        return time_s


class TightModel(LagrangianModel):
    """The model, solved `precision` times more tightly than in production."""

    precision = 1e3

    def equations(self, h, old, elapsed_s=None):
        usual = super().equations(h, old, elapsed_s)
        return replace(usual, weight=usual.weight * self.precision)


class DrivenModel(TightModel):
    """The model with an external load and boundary values of any kind."""

    def __init__(self, problem, material, load: Load | None = None):
        super().__init__(problem, material, STILL)
        self.load, self.time_s = load, 0.0
        self.drive = Clock(STILL, 0.0, ())
        self.series_solver = SeriesSolver(self.drive)

    def pad_displacement_m(self, state):
        return state.time_s

    def solve_stage(self, time_s, h, old, guess, jump):
        self.time_s = time_s
        return super().solve_stage(time_s, h, old, guess, jump)

    def residual(self, x, h, old, elapsed_s=None, changed=None):
        residual = super().residual(x, h, old, elapsed_s, changed)
        if residual is None or self.load is None:
            return residual
        return residual._replace(residual=residual.residual - self.load(self.time_s, h))

    def state_at(self, x: Array) -> State:
        """The state at x (dofs,) with a history that is x itself."""
        residual = super().residual(x, 1.0, self.initial_state(0.0))
        return State(0.0, x, residual.volume, residual.pressure)


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
