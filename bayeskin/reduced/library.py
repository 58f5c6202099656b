"""Holds the modes of a reduced model: the base model's modes, and additional modes for each mechanism.

The basis of a set of mechanisms contains the base's modes and the union of the modes of its mechanisms. In
some training runs of a mechanism other mechanisms act as well, so that its modes represent their interaction.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from bayeskin.reduced.basis import Inner, pod
from bayeskin.reduced.operators import Basis
from bayeskin.types import Array

MODE_M, MODE_PA = 5e-3, 1e4  # displacement of the pads and pressure that make coefficients of order one
DEPENDENT = 1e-3  # modes of a union with a smaller singular value are dropped; all joined modes have norm one


@dataclass(frozen=True)
class Modes:
    """Orthonormal modes: displacement (a, 3 nodes) and pressure (b, corners), without the constant mode."""

    displacement: Array
    pressure: Array


@dataclass(frozen=True)
class Library:
    """Modes of the base model, and by name of each mechanism its modes beyond the base's."""

    base: Modes
    beyond: Mapping[str, Modes]

    def basis(self, mechanisms: Sequence[str], inner: Inner) -> Basis:
        """Returns the basis of a set of mechanisms.

        Raises KeyError for a mechanism that the library does not know.
        """
        added = [self.beyond[name] for name in mechanisms]
        u = _union(self.base.displacement, [m.displacement for m in added], inner.displacement)
        p = _union(self.base.pressure, [m.pressure for m in added], inner.pressure)
        return scaled_basis(Modes(u, p), inner)


def scaled_basis(modes: Modes, inner: Inner) -> Basis:
    """Returns the basis of orthonormal modes, scaled to coefficients of order one.

    The constant pressure comes first among the pressure modes.
    """
    size = MODE_M * np.sqrt(inner.moving @ (inner.displacement @ inner.moving))
    pressure = np.concatenate([[inner.constant], modes.pressure]) * MODE_PA / inner.constant[0]
    return Basis(inner.moving, inner.dual, modes.displacement * size, pressure)


def _union(first: Array, others: Sequence[Array], inner: sp.csr_matrix) -> Array:
    """Returns the union of modes: `first` unchanged, then orthonormal modes of the others.

    Each of the others is orthogonal to `first` already (`modes_beyond`).
    """
    if not others:
        return first
    values, modes = pod(np.concatenate(others), inner)
    return np.concatenate([first, modes[values > DEPENDENT]])


def modes_of(weighted: Modes, inner: Inner, most: tuple[int, int]) -> Modes:
    """Returns the largest displacement and pressure modes of weighted modes, at most `most` of each."""
    u, p = pod(weighted.displacement, inner.displacement)[1], pod(weighted.pressure, inner.pressure)[1]
    return Modes(u[: most[0]], p[: most[1]])


def modes_beyond(own: Modes, weighted: Modes, inner: Inner, most: tuple[int, int]) -> Modes:
    """Returns the largest modes of weighted modes after their projections on modes `own` are removed."""
    left = Modes(
        _without(weighted.displacement, own.displacement, inner.displacement),
        _without(weighted.pressure, own.pressure, inner.pressure),
    )
    return modes_of(left, inner, most)


def _without(rows: Array, modes: Array, inner: sp.csr_matrix) -> Array:
    """Returns rows minus their projections on orthonormal modes."""
    return np.asarray(rows - (rows @ (inner @ modes.T)) @ modes)
