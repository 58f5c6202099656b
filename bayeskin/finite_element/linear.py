"""Keeps and reuses a few sparse factorisations, made by MKL PARDISO where it is installed, else by SuperLU.

The factors serve only as an approximate inverse. `newton` corrects the result with true residuals in double
precision. PARDISO can therefore factorise in single precision, which takes half the time and memory. Where
the tangent is nearly symmetric, it factorises only the symmetric part, which halves time and memory again.
The unknowns are scaled first, because displacements [m] and pressures [Pa] differ by many orders of
magnitude.
"""

from __future__ import annotations

import ctypes
import os
import sys
from pathlib import Path
from typing import Protocol

import numba
import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from bayeskin.types import Array

_library = next(iter(sorted(p for p in Path(sys.prefix, "lib").glob("libmkl_rt*") if p.is_file())), None)
_unset = "PYPARDISO_MKL_RT" not in os.environ and _library is not None
if _unset:  # MKL's wheel installs the library here; otherwise pypardiso searches the whole environment
    os.environ["PYPARDISO_MKL_RT"] = str(_library)
try:
    import pypardiso
except (ImportError, OSError):  # there is no wheel for this processor, or MKL is missing
    pypardiso = None
if _unset:  # a child process may run in another environment, and must not inherit this path
    del os.environ["PYPARDISO_MKL_RT"]

SOLVER_NAME = "MKL PARDISO" if pypardiso is not None else "SuperLU"
_STRUCTURALLY_SYMMETRIC, _SYMMETRIC_INDEFINITE = 1, -2
_ANALYSE_AND_FACTORISE, _FACTORISE, _SOLVE, _RELEASE = 12, 22, 33, -1
# The keys are the numbers of PARDISO's parameters (iparm) in Intel's manual. In this order they choose
# settings other than the defaults, METIS ordering, perturbation of pivots below 1e-8, scaling, matching,
# counting of the factor's entries, single precision, and indices that start at 0.
_SETTINGS = {1: 1, 2: 2, 10: 8, 11: 1, 13: 1, 18: -1, 28: 1, 35: 1}
_PERTURBED_PIVOTS, _ENTRIES_OF_FACTOR = 14, 18  # the -1 above makes PARDISO report the latter
MOST, MEMORY_BYTES = 10, 480_000_000  # largest number of kept factorisations, and of bytes that they take


class Factorisations(Protocol):
    """Factorisations of matrices that all share one sparsity pattern. They are numbered from 0.

    bytes_each : size of one factorisation, known after the first one
    room : number of factorisations that fit into the allowed memory, known after the first one
    """

    @property
    def bytes_each(self) -> int: ...

    @property
    def room(self) -> int:
        return int(np.clip(MEMORY_BYTES // max(self.bytes_each, 1), 1, MOST))

    def factorise(self, number: int, matrix: sp.csr_matrix, scale: Array) -> None:
        """Factorises a matrix under a number; scale (n,) is the size of each unknown."""
        ...

    def solve(self, number: int, right: Array) -> Array:
        """Returns the solution for right-hand sides (n,) or (n, r).

        The matrix is the one that was last factorised under this number.
        """
        ...

    def release(self) -> None:
        """Frees all factorisations."""
        ...


class Pardiso(Factorisations):
    """Factorisations by MKL PARDISO.

    The class calls MKL directly, because the methods of pypardiso allow only double precision and only one
    factorisation.
    """

    def __init__(self, symmetric: bool) -> None:
        self._symmetric = symmetric
        self._type = _SYMMETRIC_INDEFINITE if symmetric else _STRUCTURALLY_SYMMETRIC
        # a new function object, to which the argument types set by pypardiso do not apply
        self._pardiso = pypardiso.ps.libmkl["pardiso"]
        self._handle = np.zeros(64, np.int64)
        self._settings = np.zeros(64, np.int32)
        for number, value in _SETTINGS.items():
            self._settings[number - 1] = value
        self._scale: dict[int, Array] = {}  # scale of each factorisation
        self._entries: dict[int, np.ndarray] = {}  # entries of each matrix, where MKL needs them again

    @property
    def bytes_each(self) -> int:
        return 4 * int(self._settings[_ENTRIES_OF_FACTOR - 1])  # entries in single precision

    def factorise(self, number: int, matrix: sp.csr_matrix, scale: Array) -> None:
        first = not self._scale
        if first:
            self._prepare(matrix)
        entries = np.empty(len(self._indices), np.float32)
        _scaled_mean(self._indptr, self._indices, self._own, self._mirrored, matrix.data, scale, entries)
        self._scale[number], self._entries[number] = scale, entries
        self._call(number, _ANALYSE_AND_FACTORISE if first else _FACTORISE)  # the pattern is analysed once
        # MKL needs the entries again only where it has perturbed pivots and therefore refines each solve
        if self._settings[_PERTURBED_PIVOTS - 1] == 0:
            self._entries[number] = np.empty(0, np.float32)

    def _prepare(self, matrix: sp.csr_matrix) -> None:
        """Stores the sparsity pattern, and for each stored entry the places of the two entries to average."""
        numbers = np.arange(matrix.nnz, dtype=np.int32)
        pattern = sp.csr_matrix((numbers, matrix.indices, matrix.indptr), shape=matrix.shape)
        self._own = self._mirrored = numbers
        if self._symmetric:
            row = np.repeat(np.arange(matrix.shape[0], dtype=np.int32), np.diff(matrix.indptr))
            upper = matrix.indices >= row
            self._own, self._mirrored = numbers[upper], pattern.T.tocsr().data[upper]
            pattern = sp.triu(pattern, format="csr")
        self._indices, self._indptr = pattern.indices.astype(np.int32), pattern.indptr.astype(np.int32)

    def solve(self, number: int, right: Array) -> Array:
        scale = self._scale[number]
        scaled = np.ascontiguousarray(right.T) * scale  # MKL stores one column after the other
        # each column is scaled to size one, so that no number underflows in single precision
        size = np.maximum(np.abs(scaled).max(axis=-1, keepdims=True), np.finfo(float).tiny)
        solution = self._call(number, _SOLVE, (scaled / size).astype(np.float32))
        return np.asarray((solution.astype(float) * (size * scale)).T)

    def release(self) -> None:
        """Frees the memory of MKL, which Python's garbage collector does not manage."""
        if self._scale:
            self._call(0, _RELEASE)
            self._scale.clear()
            self._entries.clear()

    def _call(self, number: int, phase: int, right: np.ndarray | None = None) -> np.ndarray:
        """Runs a phase of PARDISO and returns the solution. Raises RuntimeError if MKL reports an error."""
        n = len(self._indptr) - 1
        right = np.zeros(n, np.float32) if right is None else right
        solution, error = np.zeros_like(right), ctypes.c_int32(0)
        entries = self._entries[number]

        def integer(value: int) -> object:
            return ctypes.byref(ctypes.c_int32(value))

        def pointer(array: np.ndarray) -> ctypes.c_void_p:
            return array.ctypes.data_as(ctypes.c_void_p)

        self._pardiso(
            pointer(self._handle), integer(MOST), integer(number + 1), integer(self._type),
            integer(phase), integer(n), pointer(entries), pointer(self._indptr), pointer(self._indices), None,
            integer(right.size // n), pointer(self._settings), integer(0), pointer(right), pointer(solution),
            ctypes.byref(error),
        )  # fmt: skip
        if error.value != 0:
            raise RuntimeError(f"MKL PARDISO gave error {error.value} in phase {phase}")
        return solution


@numba.njit(cache=True)
def _scaled_mean(indptr, indices, own, mirrored, data, scale, out):  # type: ignore[no-untyped-def]
    """Fills each entry of a CSR matrix, in `out`, with the scaled mean of two entries of `data`.

    own, mirrored : places of the two entries in `data`
    """
    for row in range(len(indptr) - 1):
        for k in range(indptr[row], indptr[row + 1]):
            out[k] = 0.5 * (data[own[k]] + data[mirrored[k]]) * scale[row] * scale[indices[k]]


class SuperLU(Factorisations):
    """Factorisations by SuperLU, which scipy includes."""

    def __init__(self) -> None:
        self._stored: dict[int, tuple[spla.SuperLU, Array]] = {}

    @property
    def bytes_each(self) -> int:
        return 12 * max(
            (factors.nnz for factors, _ in self._stored.values()), default=0
        )  # each entry with its index

    def factorise(self, number: int, matrix: sp.csr_matrix, scale: Array) -> None:
        diagonal = sp.diags(scale)
        scaled = (diagonal @ matrix @ diagonal).tocsc()
        factors = spla.splu(scaled, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        self._stored[number] = factors, scale

    def solve(self, number: int, right: Array) -> Array:
        factors, scale = self._stored[number]
        scale = scale.reshape((-1,) + (1,) * (right.ndim - 1))
        return np.asarray(factors.solve(right * scale) * scale)

    def release(self) -> None:
        self._stored.clear()


def factorisations(symmetric: bool) -> Factorisations:
    """Returns a store of factorisations by the fastest installed solver.

    symmetric : the matrices are nearly symmetric, so that PARDISO may factorise their symmetric part alone
    """
    return Pardiso(symmetric) if pypardiso is not None else SuperLU()
