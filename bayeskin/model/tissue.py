"""Where physics beyond the base model enters its equations.

A tissue law is bound to a problem and to values of its parameters before a run. It changes what the base law
answers at the quadrature points, and its derivatives, in place; or it adds linear terms on surfaces.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import skfem

from bayeskin.model.assembly import Chunk
from bayeskin.model.problem import Problem
from bayeskin.model.space import TaylorHood
from bayeskin.types import Array

SURFACE_QUADRATURE_DEGREE = 4


class TissueLaw:
    """Changes nothing; what a law changes, it overrides.

    surfaces : terms that are added to the residual
    opening_m : how far the pads were moved apart, and all was let come to rest, before the test [m, LVDT]
    """

    surfaces: tuple[SurfaceTerm, ...] = ()
    opening_m: float = 0.0

    def respond(self, chunk: Chunk) -> None:
        """Changes `chunk.found` (stress, content, flux) given `chunk.at`."""

    def linearise(self, chunk: Chunk) -> None:
        """Changes `chunk.by` to the derivatives of what `respond` leaves."""


Bind = Callable[[Problem], TissueLaw]


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
