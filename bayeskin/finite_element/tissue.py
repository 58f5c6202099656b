"""Defines how further physics enters the equations of the base model.

Before a run, a tissue law is bound to values of its parameters and to the points of a model. A law can act in
three ways. It changes the response of the base law at the points, and the derivatives of this response, in
place. Or it adds linear terms on surfaces. Or it lies in series with the skin, between the drive and the
pads.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from functools import lru_cache

import numpy as np
import scipy.sparse as sp
import skfem

from bayeskin.finite_element.mesh import SkinMesh
from bayeskin.finite_element.problem import Problem, Sites
from bayeskin.finite_element.space import TaylorHood
from bayeskin.types import Array, PadMotion

SURFACE_QUADRATURE_DEGREE = 4


class Rank(IntEnum):
    """Order in which laws are evaluated: each acts on the elastic stress after the laws of lower rank."""

    ELASTIC = 0
    AGEING = 1
    VISCOUS = 2


Kernel = Callable[..., None]  # compiled, with a signature of `kernels`


@dataclass(frozen=True, eq=False)
class TissueLaw:
    """A law with the parameter values of a run. By default it changes nothing.

    rank : rank in the order of the laws
    remembers : how many numbers the law keeps as its memory at each point; they are 0 at the start
    par (k,), data (n, d) : constants of the run, and of each point (`Sites.table`), which the kernels receive
    respond, linearise : compiled kernels (`kernels`), or None if the law does not change the response at the
        points
    surfaces : terms that are added to the residual
    opening_m : distance by which the pads were moved apart before the test, after which everything came to
        rest [m, LVDT]
    series : element between drive and skin, or None
    """

    rank: Rank = Rank.ELASTIC
    remembers: int = 0
    par: Array = field(default_factory=lambda: np.empty(0))
    data: Array = field(default_factory=lambda: np.empty((0, 0)))
    respond: Kernel | None = None
    linearise: Kernel | None = None
    surfaces: tuple[SurfaceTerm, ...] = ()
    opening_m: float = 0.0
    series: SeriesElement | None = None


Bind = Callable[[Mapping[str, float], Sites], TissueLaw]  # the mapping holds all parameters, in SI


class SeriesElement:
    """An element in series with the skin, which loses a part of the drive's displacement.

    The lost displacement [m, LVDT] depends on the force [N] relative to the start of the test. The element's
    memory (k,) is zero at the start. Its first number is the lost displacement.
    """

    remembers: int = 2

    def moved(self, motion: PadMotion) -> PadMotion:
        """Returns the motion without the displacement whose loss depends on the motion alone."""
        return motion

    def follow(self, force_n: float, elapsed_s: float, before: Array) -> Array:
        """Returns the memory (k,) under a force, `elapsed_s` after the memory `before`."""
        return before


@dataclass(frozen=True)
class SurfaceTerm:
    """The term ``value * unit(problem) @ x`` in the residual.

    unit : function that returns the matrix (dofs, dofs). It must be a function of a module, so that
        `Problem.linear` computes its matrix once for each problem
    per_second : True if the term is a rate, which is multiplied by the length of the stage
    """

    value: float
    unit: Callable[[Problem], sp.csr_matrix]
    per_second: bool = False


def surface_mass(
    problem: Problem, facets: np.ndarray, displacement: bool, weight: Callable[[Array], Array] | None = None
) -> sp.coo_matrix:
    """Returns integrals over `facets` of products of shape functions, (nodes, nodes) or (corners, corners).

    displacement : True for the quadratic shape functions of the displacement, False for the linear ones of
        the pressure
    weight : function of points (3, ...) by which the products are multiplied, 1 if None; the result has its
        unit times m^2
    """
    basis = _facet_basis(problem.mesh, facets.astype(np.int64).tobytes(), displacement)
    form = skfem.BilinearForm(lambda u, v, w: (1.0 if weight is None else weight(w.x)) * u * v)
    return form.assemble(basis).tocoo()


@lru_cache(maxsize=2)  # a term may need several integrals over the same facets
def _facet_basis(mesh: SkinMesh, facets: bytes, displacement: bool) -> skfem.FacetBasis:
    """Returns shape functions of displacement or pressure on facets, given as the bytes of an array."""
    bricks = isinstance(mesh.geometry, skfem.MeshHex)
    quadratic, linear = (
        (skfem.ElementHex2(), skfem.ElementHex1()) if bricks else (skfem.ElementTetP2(), skfem.ElementTetP1())
    )
    return skfem.FacetBasis(
        mesh.geometry, quadratic if displacement else linear, mesh.facet_mapping(),
        facets=np.frombuffer(facets, dtype=np.int64), intorder=SURFACE_QUADRATURE_DEGREE,
    )  # fmt: skip


def pressure_rows(space: TaylorHood, mass: sp.coo_matrix) -> sp.csr_matrix:
    """Returns a matrix over corners as a matrix over all unknowns (dofs, dofs)."""
    start = 3 * space.n_nodes
    return sp.csr_matrix((mass.data, (start + mass.row, start + mass.col)), shape=(space.dofs, space.dofs))


def displacement_rows(space: TaylorHood, mass: sp.coo_matrix, i: int, j: int) -> sp.csr_matrix:
    """Returns a matrix over nodes as a matrix (dofs, dofs) from displacements along j to forces along i."""
    return sp.csr_matrix((mass.data, (3 * mass.row + i, 3 * mass.col + j)), shape=(space.dofs, space.dofs))
