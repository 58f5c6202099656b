"""Binds the base law and the laws of mechanisms to the points of a reduced space, for a run's parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bayeskin.finite_element.problem import Material, material
from bayeskin.finite_element.tissue import Bind, SurfaceTerm, TissueLaw
from bayeskin.reduced.arrays import Laws
from bayeskin.reduced.calls import address
from bayeskin.reduced.operators import ReducedSpace
from bayeskin.types import Array


@dataclass(frozen=True)
class Bound:
    """Constants and laws of a run at the points, for given values of all parameters.

    solid_by (s,), flow_by (t,) : coefficients of the matrices of the exact parts (`exact_units`)
    """

    solid: Material
    laws: tuple[TissueLaw, ...]
    solid_by: Array
    flow_by: Array

    @property
    def par(self) -> Array:
        """Returns the constants of all laws in one flat array."""
        return _flat([law.par for law in self.laws])

    @property
    def data(self) -> Array:
        """Returns the constants of all laws at the points in one flat array."""
        return _flat([law.data for law in self.laws])


def bound(space: ReducedSpace, theta: Mapping[str, float], binds: Sequence[Bind]) -> Bound:
    """Binds the base law and the laws of mechanisms to values of their parameters."""
    sites, cutis = space.sites, space.at.cutis
    solid = material(theta, cutis)
    laws = tuple(sorted((bind(theta, sites) for bind in binds), key=lambda law: law.rank))
    in_cutis, in_subcutis = int(np.argmax(cutis)), int(np.argmin(cutis))  # the first point of each layer

    def of_layers(name: str) -> Array:
        return np.array([getattr(solid, name)[in_cutis], getattr(solid, name)[in_subcutis]])

    still, rates = surface_terms(laws)
    return Bound(
        solid, laws,
        np.concatenate([of_layers("mu"), of_layers("lam"), [term.value for term in still]]),
        np.concatenate([-of_layers("mobility"), [term.value for term in rates]]),
    )  # fmt: skip


def surface_terms(laws: Sequence[TissueLaw]) -> tuple[list[SurfaceTerm], list[SurfaceTerm]]:
    """Returns two lists of the laws' surface terms: terms of the displacement, and rates of the fluid."""
    terms = [term for law in laws for term in law.surfaces]
    return [t for t in terms if not t.per_second], [t for t in terms if t.per_second]


def exact_units(space: ReducedSpace, laws: Sequence[TissueLaw]) -> tuple[Array, Array]:
    """Returns the matrices (s, k, k) and (t, m, m) whose linear combinations are the exact parts."""
    k, exact = space.modes[0], space.exact
    still, rates = surface_terms(laws)
    solid = [*exact.shear, *exact.bulk, *(space.surfaces(term.unit)[:k, :k] for term in still)]
    flow = [*exact.flow, *(space.surfaces(term.unit)[k:, k:] for term in rates)]
    return np.array(solid), np.array(flow)


def _flat(arrays: Sequence[Array]) -> Array:
    return np.concatenate([np.zeros(0), *(np.ravel(array) for array in arrays)])


def packed(laws: Sequence[TissueLaw], points: int) -> Laws:
    """Returns laws in the form that the compiled driver takes; points : number of points."""
    par, widths = [len(law.par) for law in laws], [law.data.shape[1] for law in laws]
    memory = [law.remembers for law in laws]

    def starts(counts: Sequence[int]) -> np.ndarray:
        return np.concatenate([[0], np.cumsum(np.asarray(counts, dtype=np.int64))]).astype(np.int64)

    return Laws(
        np.array([address(law.respond) for law in laws], dtype=np.int64),
        np.array([address(law.linearise) for law in laws], dtype=np.int64),
        _flat([law.par for law in laws]), starts(par), _flat([law.data for law in laws]),
        np.array(widths, dtype=np.int64), points * starts(widths),
        np.array(memory, dtype=np.int64), points * starts(memory),
    )  # fmt: skip
