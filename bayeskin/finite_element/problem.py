"""The test as a boundary-value problem: which dofs are prescribed, which layer has which constants."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from bayeskin.errors import InputError
from bayeskin.finite_element.mesh import SkinMesh
from bayeskin.finite_element.space import Sparsity, TaylorHood, sparsity, taylor_hood
from bayeskin.geometry import Geometry
from bayeskin.types import Array

PARAMETERS = ("E_c", "E_s", "k_c", "k_s", "p_init")


@dataclass(frozen=True)
class Constants:
    """Parameters that the article fixes (its section "Initial parameters values"); SI."""

    nu_c: float = 0.48
    nu_s: float = 0.3
    porosity_c: float = 0.2
    porosity_s: float = 0.4
    viscosity_pa_s: float = 5e-3
    bulk_fluid_pa: float = 2.2e9
    bulk_solid_pa: float = 1e10


@dataclass(frozen=True)
class Material:
    """Constants of each cell (e,): Lame mu, lam [Pa], mobility k/mu_f [m^2/(Pa s)], storage [1/Pa]."""

    mu: Array
    lam: Array
    mobility: Array
    storage: Array


def material(theta: Mapping[str, float], cutis: np.ndarray, fixed: Constants | None = None) -> Material:
    """Returns constants of cells or points from a run's parameters and the fixed ones.

    theta : E_c, E_s [Pa], k_c, k_s [m^2], and drained Poisson's ratios nu_c, nu_s in place of the fixed ones
    cutis : (e,), which cells or points lie in the cutis
    Raises InputError for a ratio of no stable solid.
    """
    c = fixed or Constants()
    ratios = [theta.get(name, getattr(c, name)) for name in ("nu_c", "nu_s")]
    for name, ratio in zip(("nu_c", "nu_s"), ratios, strict=True):
        if not -1.0 < ratio < 0.5:
            raise InputError(f"parameters: {name}", f"{ratio:g}", "a number above -1 and below 0.5")

    def by_layer(in_cutis: float, in_subcutis: float) -> Array:
        return np.where(cutis, in_cutis, in_subcutis).astype(float)

    young, nu = by_layer(theta["E_c"], theta["E_s"]), by_layer(*ratios)
    porosity = by_layer(c.porosity_c, c.porosity_s)
    return Material(
        mu=young / (2 * (1 + nu)),
        lam=young * nu / ((1 + nu) * (1 - 2 * nu)),
        mobility=by_layer(theta["k_c"], theta["k_s"]) / c.viscosity_pa_s,
        storage=porosity / c.bulk_fluid_pa + (1 - porosity) / c.bulk_solid_pa,
    )


@dataclass(frozen=True, eq=False)
class Sites:
    """The n points at which laws act.

    cutis (n,) : True in the cutis; points_m (3, n) : coordinates on the rolled arm [m]
    lengths : device and tissue
    """

    cutis: np.ndarray
    points_m: Array
    lengths: Geometry = Geometry()

    def table(self, *columns: Array | float) -> Array:
        """Returns constants of the points side by side, (n, d), from columns (n,), (n, j) or one for all."""
        n = len(self.cutis)
        parts = [c.reshape(n, -1) if np.ndim(c) else np.full((n, 1), c) for c in map(np.asarray, columns)]
        return np.ascontiguousarray(np.concatenate([np.empty((n, 0)), *parts], axis=1))


class LinearTerm(NamedTuple):
    """A matrix (dofs, dofs), and where its entries stand in the tangent, with their values."""

    matrix: sp.csr_matrix
    place: np.ndarray
    value: Array


@dataclass(frozen=True)
class Problem:
    """A mesh with its space, prescribed dofs and sparsity; shared by every run on that mesh.

    pad, pads : displacement nodes of the central pad; of pad and guard together
    measured_x : x dofs of what the load cell holds, where the reaction is summed
    """

    mesh: SkinMesh
    space: TaylorHood
    pattern: Sparsity
    pad: np.ndarray
    pads: np.ndarray
    _linear: dict[object, LinearTerm] = field(init=False, repr=False, default_factory=dict)

    @cached_property
    def sites(self) -> Sites:
        """Returns the quadrature points, cell by cell."""
        points = self.space.quadrature_points
        cutis = np.repeat(self.mesh.cutis, points.shape[2])
        return Sites(cutis, np.ascontiguousarray(points.reshape(3, -1)), self.lengths)

    def linear(self, unit: Callable[[Problem], sp.csr_matrix]) -> LinearTerm:
        """Returns the matrix that `unit` makes of this problem, made at the first call."""
        if unit not in self._linear:
            matrix = unit(self)
            self._linear[unit] = LinearTerm(matrix, *self.pattern.places(matrix))
        return self._linear[unit]

    @property
    def lengths(self) -> Geometry:
        """Device and tissue."""
        return self.mesh.lengths

    @property
    def measured_x(self) -> np.ndarray:
        return 3 * (self.pad if self.lengths.force_on == "pad" else self.pads)

    def prescribe(self, x: Array, pad_displacement_m: float) -> Array:
        """A copy of x (dofs,) with every prescribed dof at its value: u_x of the pads, zero elsewhere."""
        out = x.copy()
        out[self.pattern.fixed] = 0.0
        out[3 * self.pads] = pad_displacement_m
        return out

    def reaction(self, residual: Array) -> float:
        """Force on what the load cell holds [N]: nodal reactions along x, doubled for the y-symmetry."""
        return float(2.0 * residual[self.measured_x].sum())


def nominal_force(solid: Material, cutis: np.ndarray, lengths: Geometry, moved_m: float) -> float:
    """Returns a scale of the force [N]: both layers pulled from x = 0, as wide as the load cell holds.

    cutis (e,) : which cells or points of the solid lie in the cutis; moved_m : how far a pad moves
    """
    young = solid.mu * (3 * solid.lam + 2 * solid.mu)
    young = young / (solid.lam + solid.mu)
    tension = young[cutis].max() * lengths.cutis_m + young[~cutis].max() * lengths.subcutis_m
    return float(tension * lengths.measured_width_m * moved_m / lengths.half_gauge_m)


def build_problem(mesh: SkinMesh) -> Problem:
    """Space, prescribed dofs and sparsity of a mesh (design: pads move along x, bottom u_z = 0)."""
    space = taylor_hood(mesh)
    pad, guard = space.facet_nodes("pad"), space.facet_nodes("guard")
    pads = np.union1d(pad, guard)
    fixed = np.unique(
        np.concatenate(
            [
                (3 * pads[:, None] + np.arange(3)).ravel(),
                3 * space.facet_nodes("symmetry_x"),
                3 * space.facet_nodes("symmetry_y") + 1,
                3 * space.facet_nodes("bottom") + 2,
            ]
        )
    )
    return Problem(mesh, space, sparsity(space, fixed), pad, pads)


def moved_problem(problem: Problem, mesh: SkinMesh) -> Problem:
    """The problem on a mesh with the same cells, whose nodes alone are elsewhere."""
    return Problem(mesh, taylor_hood(mesh), problem.pattern, problem.pad, problem.pads)
