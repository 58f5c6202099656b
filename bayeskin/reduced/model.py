"""Defines the reduced model of one device: its modes, its cubatures and the region that it was trained for.

The model runs with any set of the mechanisms that it was trained for, on any protocol, and with layers and
arms near its own. It keeps the spaces that it prepares from its modes, so only the first run of a set of
mechanisms prepares anything.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy.linalg

from bayeskin.finite_element.mesh import brick_mesh
from bayeskin.finite_element.problem import Problem, moved_problem
from bayeskin.finite_element.simulate import problem_of
from bayeskin.geometry import Geometry
from bayeskin.reduced.basis import Inner, inner_products
from bayeskin.reduced.cases import Trained
from bayeskin.reduced.library import Library
from bayeskin.reduced.operators import (
    Basis,
    ReducedSpace,
    Rule,
    SurfaceUnit,
    fields_at,
    linear_parts,
    whole_linear_parts,
)
from bayeskin.types import Array

MOST_SPACES = 32  # largest number of spaces that a model keeps


@dataclass(frozen=True)
class Cubatures:
    """Cubatures for the base model and for sets of mechanisms."""

    base: Rule
    sets: Rule

    def of(self, mechanisms: Sequence[str]) -> Rule:
        """Returns the cubature for a set of mechanisms; an empty set is the base model."""
        return self.sets if mechanisms else self.base


@dataclass(frozen=True, eq=False)
class ReducedModel:
    """A reduced model as it is stored.

    trained : region and geometry of the training; refinement : refinement of the full model's brick mesh
    full_hash : hash of the full model that it was made from (`ModelSpec.hash`); hash : hash of its arrays
    """

    trained: Trained
    refinement: int
    library: Library
    cubatures: Cubatures
    full_hash: str
    hash: str = ""
    _spaces: dict[object, ReducedSpace] = field(init=False, repr=False, default_factory=dict)

    def problem(self, geometry: Geometry | None = None) -> Problem:
        """Returns the full model's problem on the trained geometry, or with its mesh moved to another one."""
        trained = self.trained.geometry
        nominal = problem_of("bricks", self.refinement, trained)
        if geometry is None or geometry == trained:
            return nominal
        return moved_problem(nominal, brick_mesh(self.refinement, geometry, trained))

    def basis(self, mechanisms: Sequence[str]) -> Basis:
        """Returns the basis of a set of mechanisms, on the nodes of the mesh."""
        return self.library.basis(mechanisms, inner_of(self.problem()))

    def space(self, mechanisms: Sequence[str], geometry: Geometry | None = None) -> ReducedSpace:
        """Returns the space in which a run with a set of mechanisms is solved."""
        key = tuple(mechanisms), geometry or self.trained.geometry
        if key not in self._spaces:
            while len(self._spaces) >= MOST_SPACES:
                del self._spaces[next(iter(self._spaces))]
            problem, basis = self.problem(geometry), self.basis(mechanisms)
            self._spaces[key] = reduced_space(problem, basis, self.cubatures.of(mechanisms))
        return self._spaces[key]


def reduced_space(problem: Problem, basis: Basis, rule: Rule) -> ReducedSpace:
    """Returns a basis at the points of a rule, with the linear parts that these points leave out."""
    at_points = fields_at(problem, basis, rule)
    exact = whole_linear_parts(problem, basis) - linear_parts(at_points)
    return ReducedSpace(problem.lengths, at_points, exact, SurfacesOf(problem, basis))


class SurfacesOf:
    """Returns unit surface terms, projected on all fields of a basis. Each is computed at its first call."""

    def __init__(self, problem: Problem, basis: Basis) -> None:
        self._problem, self._basis = problem, basis
        self._known: dict[SurfaceUnit, Array] = {}

    def __call__(self, unit: SurfaceUnit) -> Array:
        if unit not in self._known:
            self._known[unit] = projected(self._problem, self._basis, unit)
        return self._known[unit]


def projected(problem: Problem, basis: Basis, unit: SurfaceUnit) -> Array:
    """Returns the matrix of a unit surface term, projected on all fields of a basis, (k + m, k + m)."""
    matrix, n = problem.linear(unit).matrix, 3 * problem.space.n_nodes
    u, p = basis.fields, basis.pressure
    return np.asarray(scipy.linalg.block_diag(u @ (matrix[:n, :n] @ u.T), p @ (matrix[n:, n:] @ p.T)))


_inner_products: dict[int, tuple[Problem, Inner]] = {}


def inner_of(problem: Problem) -> Inner:
    """Returns the inner products of a problem. They are computed once."""
    if id(problem) not in _inner_products:
        _inner_products[id(problem)] = problem, inner_products(problem)
    return _inner_products[id(problem)][1]
