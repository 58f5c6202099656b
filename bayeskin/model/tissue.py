"""Where physics beyond the base model enters its equations.

A tissue law is bound to values of its parameters and to a problem before a run. It changes what the base
law answers at the quadrature points, and its derivatives, in place; or it adds linear terms on surfaces; or
it lies in series with the skin, between the drive and the pads.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import scipy.sparse as sp
import skfem

from bayeskin.model.assembly import Chunk
from bayeskin.model.problem import Problem
from bayeskin.model.space import TaylorHood
from bayeskin.types import Array, PadMotion

SURFACE_QUADRATURE_DEGREE = 4


class Rank(IntEnum):
    """Which laws answer first: viscous ones act on the elastic stress that those before left."""

    ELASTIC = 0
    VISCOUS = 1


@dataclass(frozen=True)
class Passage:
    """A law's memory (e, q, k) through one solve: `before`, earlier; `after`, which `respond` fills."""

    elapsed_s: float
    before: Array
    after: Array


class TissueLaw:
    """Changes nothing; what a law changes, it overrides.

    rank : when it answers, among others
    remembers : numbers that it keeps at each quadrature point, 0 at the start
    surfaces : terms that are added to the residual
    opening_m : how far the pads were moved apart, and all was let come to rest, before the test [m, LVDT]
    series : what lies between drive and skin, if anything
    """

    rank: Rank = Rank.ELASTIC
    remembers: int = 0
    surfaces: tuple[SurfaceTerm, ...] = ()
    opening_m: float = 0.0
    series: SeriesElement | None = None

    def respond(self, chunk: Chunk, passage: Passage) -> None:
        """Changes `chunk.found` (stress, content, flux) given `chunk.at`; fills `passage.after`."""

    def linearise(self, chunk: Chunk, passage: Passage) -> None:
        """Changes `chunk.by` to the derivatives of what `respond` leaves."""


Bind = Callable[[Mapping[str, float], Problem], TissueLaw]  # of all parameters' values, SI


class SeriesElement:
    """In series with the skin: the skin sees the drive's displacement less what is lost here.

    What is lost [m, LVDT] follows from the force [N] beyond that at the start of the test. Its memory (k,)
    starts as zeros; the first number is the lost displacement.
    """

    remembers: int = 2

    def moved(self, motion: PadMotion) -> PadMotion:
        """The motion that is left when what depends on the motion alone is lost."""
        return motion

    def follow(self, force_n: float, elapsed_s: float, before: Array) -> Array:
        """The memory (k,) under a force, a time after `before`."""
        return before


@dataclass(frozen=True)
class SurfaceTerm:
    """``matrix @ x`` in the residual, matrix (dofs, dofs); times the stage's length where it is a rate."""

    matrix: sp.csr_matrix
    per_second: bool = False


def surface_mass(
    problem: Problem, facets: np.ndarray, displacement: bool, weight: Callable[[Array], Array] | None = None
) -> sp.coo_matrix:
    """Integral over `facets` of the products of shape functions, (nodes, nodes) or (corners, corners) [m^2].

    displacement : of the quadratic ones, else of the linear ones; weight : of points (3, ...), 1 if None
    """
    mesh = problem.mesh.geometry
    bricks = isinstance(mesh, skfem.MeshHex)
    quadratic, linear = (
        (skfem.ElementHex2(), skfem.ElementHex1()) if bricks else (skfem.ElementTetP2(), skfem.ElementTetP1())
    )
    element = quadratic if displacement else linear
    basis = skfem.FacetBasis(
        mesh, element, problem.mesh.facet_mapping(), facets=facets, intorder=SURFACE_QUADRATURE_DEGREE
    )
    form = skfem.BilinearForm(lambda u, v, w: (1.0 if weight is None else weight(w.x)) * u * v)
    return form.assemble(basis).tocoo()


def pressure_rows(space: TaylorHood, mass: sp.coo_matrix) -> sp.csr_matrix:
    """A matrix over corners as one over all unknowns."""
    start = 3 * space.n_nodes
    return sp.csr_matrix((mass.data, (start + mass.row, start + mass.col)), shape=(space.dofs, space.dofs))


def displacement_rows(space: TaylorHood, mass: sp.coo_matrix, i: int, j: int) -> sp.csr_matrix:
    """A matrix over nodes as one from displacements along j to forces along i."""
    return sp.csr_matrix((mass.data, (3 * mass.row + i, 3 * mass.col + j)), shape=(space.dofs, space.dofs))
