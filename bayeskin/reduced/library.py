"""Modes of a reduced model: those of the base model, and of each mechanism what the base's do not hold.

A set of mechanisms has the union of its members' modes beside the base's. Training runs of a mechanism have
others beside it now and then, so that its modes know of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from bayeskin.reduced.basis import Inner, pod
from bayeskin.reduced.operators import Basis
from bayeskin.types import Array

MODE_M, MODE_PA = 5e-3, 1e4  # coefficients of order one: displacement of the pads, pressure
DEPENDENT = 1e-3  # of unit modes of a union: what is left of one beyond the others, below which it goes


@dataclass(frozen=True)
class Modes:
    """Orthonormal modes: displacement (a, 3 nodes), pressure (b, corners), beside the constant one."""

    displacement: Array
    pressure: Array


@dataclass(frozen=True)
class Library:
    """Modes of the base model, and of each mechanism those beyond the base's, by its name."""

    base: Modes
    beyond: Mapping[str, Modes]

    def basis(self, mechanisms: Sequence[str], inner: Inner) -> Basis:
        """Returns the basis of a set of mechanisms.

        Raises KeyError for a mechanism that the library does not know.
        """
        more = [self.beyond[name] for name in mechanisms]
        u = _union(self.base.displacement, [m.displacement for m in more], inner.displacement)
        p = _union(self.base.pressure, [m.pressure for m in more], inner.pressure)
        return scaled_basis(Modes(u, p), inner)


def scaled_basis(modes: Modes, inner: Inner) -> Basis:
    """Returns orthonormal modes as a basis with coefficients of order one, the constant pressure first."""
    size = MODE_M * np.sqrt(inner.moving @ (inner.displacement @ inner.moving))
    pressure = np.concatenate([[inner.constant], modes.pressure]) * MODE_PA / inner.constant[0]
    return Basis(inner.moving, inner.dual, modes.displacement * size, pressure)


def _union(first: Array, others: Sequence[Array], inner: sp.csr_matrix) -> Array:
    """Orthonormal modes of a union: `first` as they are, and what the others have beyond them."""
    if not others:
        return first
    values, modes = pod(np.concatenate(others), inner)
    return np.concatenate([first, modes[values > DEPENDENT]])


def modes_of(weighted: Modes, inner: Inner, most: tuple[int, int]) -> Modes:
    """Returns the largest displacement and pressure modes of weighted ones, `most` of each at most."""
    u, p = pod(weighted.displacement, inner.displacement)[1], pod(weighted.pressure, inner.pressure)[1]
    return Modes(u[: most[0]], p[: most[1]])


def modes_beyond(own: Modes, weighted: Modes, inner: Inner, most: tuple[int, int]) -> Modes:
    """Returns the largest modes of what weighted ones have beyond orthonormal modes `own`."""
    left = Modes(
        _less(weighted.displacement, own.displacement, inner.displacement),
        _less(weighted.pressure, own.pressure, inner.pressure),
    )
    return modes_of(left, inner, most)


def _less(rows: Array, modes: Array, inner: sp.csr_matrix) -> Array:
    """Returns what rows have beyond orthonormal modes."""
    return np.asarray(rows - (rows @ (inner @ modes.T)) @ modes)
