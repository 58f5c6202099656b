"""Places in the base model's equations at which further physics enters.

A tissue law is bound to values of its parameters and to the points of a model before a run. It changes what
the base law answers at the points, and its derivatives, in place; or it adds linear terms on surfaces; or it
lies in series with the skin, between the drive and the pads.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
import scipy.sparse as sp
import skfem

from bayeskin.finite_element.problem import Problem, Sites
from bayeskin.finite_element.space import TaylorHood
from bayeskin.types import Array, PadMotion

SURFACE_QUADRATURE_DEGREE = 4


class Rank(IntEnum):
    """Order in which laws answer: each acts on the elastic stress that laws of lower rank left."""

    ELASTIC = 0
    AGEING = 1
    VISCOUS = 2


Kernel = Callable[..., None]  # compiled, of the signatures of `kernels`


@dataclass(frozen=True, eq=False)
class TissueLaw:
    """A law with the values of a run; by default it changes nothing.

    rank : when it answers, among others
    remembers : numbers that it keeps at each point, 0 at the start
    par (k,), data (n, d) : what its kernels are given, of the run and of each point (`Sites.table`)
    respond, linearise : compiled kernels (`kernels`), or None where it leaves the points' response alone
    surfaces : terms that are added to the residual
    opening_m : how far the pads were moved apart, and all was let come to rest, before the test [m, LVDT]
    series : what lies between drive and skin, if anything
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


Bind = Callable[[Mapping[str, float], Sites], TissueLaw]  # of all parameters' values, SI


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
    """``value * unit(problem) @ x`` in the residual, times the stage's length where it is a rate.

    unit : a function of a module, so that its matrix (dofs, dofs) is made once a problem (`Problem.linear`)
    """

    value: float
    unit: Callable[[Problem], sp.csr_matrix]
    per_second: bool = False


def surface_mass(
    problem: Problem, facets: np.ndarray, displacement: bool, weight: Callable[[Array], Array] | None = None
) -> sp.coo_matrix:
    """Returns integrals over `facets` of products of shape functions, (nodes, nodes) or (corners, corners).

    displacement : of the quadratic ones, else of the linear ones
    weight : of points (3, ...), 1 if None; the result's unit is the weight's times m^2
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
