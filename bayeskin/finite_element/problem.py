"""Describes the test as a boundary-value problem: its prescribed dofs, and the constants of each layer."""

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
    """Parameters that the article fixes in its section "Initial parameters values", in SI units."""

    nu_c: float = 0.48
    nu_s: float = 0.3
    porosity_c: float = 0.2
    porosity_s: float = 0.4
    viscosity_pa_s: float = 5e-3
    bulk_fluid_pa: float = 2.2e9
    bulk_solid_pa: float = 1e10


@dataclass(frozen=True)
class Material:
    """Constants of each cell (e,): Lame mu, lam [Pa], mobility k/mu_f [m^2/(Pa s)] and storage [1/Pa]."""

    mu: Array
    lam: Array
    mobility: Array
    storage: Array


def material(theta: Mapping[str, float], cutis: np.ndarray, fixed: Constants | None = None) -> Material:
    """Returns the material constants of cells or points.

    theta : parameters of the run: E_c, E_s [Pa], k_c, k_s [m^2]. Drained Poisson's ratios nu_c, nu_s are
        optional, and replace the fixed ones
    cutis (e,) : True for cells or points in the cutis
    fixed : the fixed parameters, by default the article's
    Raises InputError for a Poisson's ratio that no stable solid has.
    """
    c = fixed or Constants()
    ratios = [theta.get(name, getattr(c, name)) for name in ("nu_c", "nu_s")]
    for name, ratio in zip(("nu_c", "nu_s"), ratios, strict=True):
        if not -1.0 < ratio < 0.5:
            raise InputError(f"parameters: {name}", f"it is {ratio:g}", "it must lie above -1 and below 0.5")

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
    """The n points at which laws are evaluated.

    cutis (n,) : True in the cutis
    points_m (3, n) : coordinates on the rolled arm [m]
    lengths : device and tissue
    """

    cutis: np.ndarray
    points_m: Array
    lengths: Geometry = Geometry()

    def table(self, *columns: Array | float) -> Array:
        """Returns constants of the points side by side, (n, d).

        columns : arrays (n,) or (n, j), or a number that holds for all points
        """
        n = len(self.cutis)
        parts = [c.reshape(n, -1) if np.ndim(c) else np.full((n, 1), c) for c in map(np.asarray, columns)]
        return np.ascontiguousarray(np.concatenate([np.empty((n, 0)), *parts], axis=1))


class LinearTerm(NamedTuple):
    """A matrix (dofs, dofs), with the places of its entries in the data of the tangent, and their values."""

    matrix: sp.csr_matrix
    place: np.ndarray
    value: Array


@dataclass(frozen=True)
class Problem:
    """A mesh with its function space, prescribed dofs and sparsity pattern. All runs on the mesh share it.

    pad : displacement nodes of the central pad
    pads : displacement nodes of pad and guard together
    measured_x : x dofs of the parts that the load cell holds, over which the reaction is summed
    """

    mesh: SkinMesh
    space: TaylorHood
    pattern: Sparsity
    pad: np.ndarray
    pads: np.ndarray
    _linear: dict[object, LinearTerm] = field(init=False, repr=False, default_factory=dict)

    @cached_property
    def sites(self) -> Sites:
        """Returns the quadrature points, in order of cells."""
        points = self.space.quadrature_points
        cutis = np.repeat(self.mesh.cutis, points.shape[2])
        return Sites(cutis, np.ascontiguousarray(points.reshape(3, -1)), self.lengths)

    def linear(self, unit: Callable[[Problem], sp.csr_matrix]) -> LinearTerm:
        """Returns the matrix that `unit` computes from this problem, computed at the first call and kept."""
        if unit not in self._linear:
            matrix = unit(self)
            self._linear[unit] = LinearTerm(matrix, *self.pattern.places(matrix))
        return self._linear[unit]

    @property
    def lengths(self) -> Geometry:
        """Returns the lengths of device and tissue."""
        return self.mesh.lengths

    @property
    def measured_x(self) -> np.ndarray:
        """Returns the x dofs over which the reaction is summed."""
        return 3 * (self.pad if self.lengths.force_on == "pad" else self.pads)

    def prescribe(self, x: Array, pad_displacement_m: float) -> Array:
        """Returns a copy of x (dofs,) in which every prescribed dof has its value.

        The value is the pads' displacement [m] for u_x of the pads, and zero for all other prescribed dofs.
        """
        out = x.copy()
        out[self.pattern.fixed] = 0.0
        out[3 * self.pads] = pad_displacement_m
        return out

    def reaction(self, residual: Array) -> float:
        """Returns the force on the parts that the load cell holds [N].

        It is the sum of the nodal reactions along x, doubled because of the symmetry about y = 0.
        """
        return float(2.0 * residual[self.measured_x].sum())


ProblemAt = Callable[[Mapping[str, float]], Problem]  # its nodes moved to the lengths of the tissue in theta


def nominal_force(solid: Material, cutis: np.ndarray, lengths: Geometry, moved_m: float) -> float:
    """Returns a scale of the force [N].

    It is the force that stretches both layers between x = 0 and the pad, over the measured width.

    cutis (e,) : True for cells or points of the solid in the cutis
    moved_m : displacement of a pad [m]
    """
    young = solid.mu * (3 * solid.lam + 2 * solid.mu)
    young = young / (solid.lam + solid.mu)
    tension = young[cutis].max() * lengths.cutis_m + young[~cutis].max() * lengths.subcutis_m
    return float(tension * lengths.measured_width_m * moved_m / lengths.half_gauge_m)


def build_problem(mesh: SkinMesh) -> Problem:
    """Returns the boundary-value problem on a mesh.

    The pads and the guard move along x only. The bottom has u_z = 0. Points on the planes of symmetry have no
    normal displacement.
    """
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
    """Returns the problem on a mesh with the same cells, whose nodes have moved."""
    return Problem(mesh, taylor_hood(mesh), problem.pattern, problem.pad, problem.pads)
