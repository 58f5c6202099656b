"""One sparse factorisation, kept and reused: MKL PARDISO where it is installed, else SuperLU.

A symmetric factorisation of the tangent's symmetric part costs half of an unsymmetric one and
serves as well as an approximate inverse where the rest is small (`newton` corrects it). Unknowns
are scaled first, because displacements [m] and pressures [Pa] lie many decades apart.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from bayeskin.types import Array

try:
    import pypardiso
except (ImportError, OSError):  # no wheel for this processor, or no MKL beside it
    pypardiso = None

SOLVER_NAME = "MKL PARDISO" if pypardiso is not None else "SuperLU"
_UNSYMMETRIC, _SYMMETRIC_INDEFINITE = 11, -2


class Factorisation(Protocol):
    """Solves with the matrix last given to `factorise`; all its matrices share one sparsity pattern."""

    def factorise(self, matrix: sp.csr_matrix, scale: Array) -> None: ...

    def solve(self, right: Array) -> Array: ...

    def release(self) -> None: ...


class _Pardiso:
    def __init__(self, symmetric: bool) -> None:
        self._symmetric = symmetric
        self._solver = pypardiso.PyPardisoSolver(mtype=_SYMMETRIC_INDEFINITE if symmetric else _UNSYMMETRIC)
        # own parameters: METIS ordering, scaling and matching, no refinement unless pivots were perturbed
        for number, value in {1: 1, 2: 2, 8: 0, 10: 8 if symmetric else 13, 11: 1, 13: 1}.items():
            self._solver.set_iparm(number, value)
        self._matrix: sp.csr_matrix | None = None

    def factorise(self, matrix: sp.csr_matrix, scale: Array) -> None:
        first = self._matrix is None
        if first:
            self._prepare(matrix)
        self._scale = scale
        data = matrix.data * scale[self._row] * scale[matrix.indices]
        if self._symmetric:
            data = 0.5 * (data[self._upper] + data[self._mirrored])
        self._matrix = sp.csr_matrix((data, self._indices, self._indptr), shape=matrix.shape)
        self._solver.set_phase(12 if first else 22)  # the pattern is analysed once
        self._solver._call_pardiso(self._matrix, np.zeros((matrix.shape[0], 1)))

    def _prepare(self, matrix: sp.csr_matrix) -> None:
        self._row = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
        self._indices, self._indptr = matrix.indices, matrix.indptr
        if not self._symmetric:
            return
        place = sp.csr_matrix((np.arange(matrix.nnz), matrix.indices, matrix.indptr), shape=matrix.shape)
        self._upper = np.flatnonzero(matrix.indices >= self._row)
        self._mirrored = place.T.tocsr().data[self._upper]
        self._indices = matrix.indices[self._upper]
        count = np.bincount(self._row[self._upper], minlength=matrix.shape[0])
        self._indptr = np.concatenate([[0], np.cumsum(count)]).astype(matrix.indptr.dtype)

    def solve(self, right: Array) -> Array:
        if self._matrix is None:
            raise RuntimeError("solve before factorise")
        self._solver.set_phase(33)
        scaled = np.ascontiguousarray(right * self._scale)[:, None]
        return self._solver._call_pardiso(self._matrix, scaled)[:, 0] * self._scale

    def release(self) -> None:
        """Gives MKL's memory back; Python's collector knows nothing of it."""
        if self._matrix is not None:
            self._solver.free_memory(everything=True)
            self._matrix = None


class _SuperLU:
    def __init__(self) -> None:
        self._factors: spla.SuperLU | None = None

    def factorise(self, matrix: sp.csr_matrix, scale: Array) -> None:
        diagonal = sp.diags(scale)
        self._scale = scale
        scaled = (diagonal @ matrix @ diagonal).tocsc()
        self._factors = spla.splu(scaled, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})

    def solve(self, right: Array) -> Array:
        if self._factors is None:
            raise RuntimeError("solve before factorise")
        return self._factors.solve(right * self._scale) * self._scale

    def release(self) -> None:
        self._factors = None


def factorisation(symmetric: bool) -> Factorisation:
    """A fresh, empty factorisation of the best solver at hand, of the symmetric part only or of all."""
    return _Pardiso(symmetric) if pypardiso is not None else _SuperLU()
