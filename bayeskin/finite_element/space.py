"""Builds the Taylor-Hood space on a skin mesh (quadratic displacement, linear pressure) and its sparsity."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from functools import cached_property

import numba
import numpy as np
import scipy.sparse as sp
import skfem

from bayeskin.finite_element.mesh import SkinMesh
from bayeskin.types import Array

QUADRATURE_DEGREE = 4


@dataclass(frozen=True)
class TaylorHood:
    """Dof numbers, shape functions and their gradients on one mesh, as the compiled kernels need them.

    A vector of unknowns x has shape (dofs,). It holds three displacements [m] for each node, node by node,
    and then one pressure [Pa] for each corner. There are e cells with q quadrature points each, a shape
    functions of the displacement and b of the pressure.

    nodes_u (e, a), nodes_p (e, b) : numbers of the nodes and of the corners of each cell
    grad_u (e, q, 3, a), grad_p (e, q, 3, b) : gradients of the shape functions [1/m]
    value_p (q, b) : values of the pressure's shape functions
    weight (e, q) : quadrature weight times volume element [m^3]
    points_u (3, nodes), quadrature_points (3, e, q) : coordinates of displacement nodes and of points [m]
    n_nodes, n_corners : number of displacement nodes, and of corners
    """

    mesh: SkinMesh
    nodes_u: np.ndarray
    nodes_p: np.ndarray
    grad_u: Array
    grad_p: Array
    value_p: Array
    weight: Array
    points_u: Array
    quadrature_points: Array
    n_nodes: int
    n_corners: int

    @property
    def dofs(self) -> int:
        """Returns the number of unknowns."""
        return 3 * self.n_nodes + self.n_corners

    @cached_property
    def cell_dofs(self) -> np.ndarray:
        """Returns all dofs of each cell, (e, 3 a + b): displacements node by node, then pressures."""
        u = (3 * self.nodes_u[:, :, None] + np.arange(3)).reshape(len(self.nodes_u), -1)
        return np.concatenate([u, 3 * self.n_nodes + self.nodes_p], axis=1)

    def facet_nodes(self, name: str) -> np.ndarray:
        """Returns the displacement nodes on a named boundary, sorted."""
        return np.unique(self._basis().get_dofs(self.mesh.facets[name]).all())

    def _basis(self) -> skfem.CellBasis:
        return skfem.Basis(self.mesh.geometry, _element(self.mesh)[0], intorder=QUADRATURE_DEGREE)


def _element(mesh: SkinMesh) -> tuple[skfem.Element, skfem.Element]:
    """Returns the elements of displacement and of pressure for a mesh of bricks or tetrahedra."""
    if isinstance(mesh.geometry, skfem.MeshHex2):
        return skfem.ElementHex2(), skfem.ElementHex1()
    return skfem.ElementTetP2(), skfem.ElementTetP1()


def taylor_hood(mesh: SkinMesh) -> TaylorHood:
    """Builds the space of a mesh, with quadrature of degree 4, as in the article's script."""
    quadratic, linear = _element(mesh)
    basis = skfem.Basis(mesh.geometry, quadratic, intorder=QUADRATURE_DEGREE)
    corner = basis.with_element(linear)

    def gradients(b: skfem.CellBasis) -> Array:
        stacked = np.stack([shape[0].grad for shape in b.basis])  # (a, 3, e, q)
        return np.ascontiguousarray(stacked.transpose(2, 3, 1, 0))

    return TaylorHood(
        mesh=mesh,
        nodes_u=np.ascontiguousarray(basis.element_dofs.T),
        nodes_p=np.ascontiguousarray(corner.element_dofs.T),
        grad_u=gradients(basis),
        grad_p=gradients(corner),
        value_p=np.ascontiguousarray(np.stack([np.array(shape[0])[0] for shape in corner.basis]).T),
        weight=np.ascontiguousarray(basis.dx),
        points_u=basis.doflocs,
        quadrature_points=np.asarray(basis.global_coordinates()),
        n_nodes=basis.N,
        n_corners=corner.N,
    )


@dataclass(frozen=True)
class Sparsity:
    """The sparsity pattern of the tangent, and the place of each entry of each cell's matrix in it.

    The tangent has rows only for free dofs. Its columns are split into those of free and of fixed dofs.

    free (f,), fixed (c,) : dof numbers
    free_free (f, f), free_fixed (f, c) : sparsity patterns; their data (bytes) have no meaning
    position (e, nd, nd) : index into the concatenated data of both matrices, or -1 for a fixed row
    """

    free: np.ndarray
    fixed: np.ndarray
    free_free: sp.csr_matrix
    free_fixed: sp.csr_matrix
    position: np.ndarray

    @property
    def size(self) -> int:
        """Returns the length of the concatenated data."""
        return self.free_free.nnz + self.free_fixed.nnz

    def matrices(self, data: Array) -> tuple[sp.csr_matrix, sp.csr_matrix]:
        """Returns the free-free and the free-fixed matrix with the concatenated data (size,).

        The matrices share their indices with the pattern, and scipy does not check them again.
        """
        n = self.free_free.nnz
        blocks = copy(self.free_free), copy(self.free_fixed)
        blocks[0].data, blocks[1].data = data[:n], data[n:]
        return blocks

    def places(self, matrix: sp.csr_matrix) -> tuple[np.ndarray, Array]:
        """Returns the places of a matrix's entries in the concatenated data, and their values.

        Rows of fixed unknowns are left out. Every other entry must couple two unknowns of one cell.
        """
        number = np.full(matrix.shape[0], -1)
        number[self.free] = np.arange(len(self.free))
        entries = matrix.tocoo()
        wanted = number[entries.row] >= 0
        row, column, value = entries.row[wanted], entries.col[wanted], entries.data[wanted]
        is_free = number[column] >= 0
        number[self.fixed] = np.arange(len(self.fixed))
        place = np.empty(len(row), dtype=np.int64)
        for block, mine, offset in (
            (self.free_free, is_free, 0),
            (self.free_fixed, ~is_free, self.free_free.nnz),
        ):
            if not mine.any():
                continue
            numbered = sp.csr_matrix((np.arange(1, block.nnz + 1), block.indices, block.indptr), block.shape)
            place_in_block = np.asarray(numbered[number[row[mine]], number[column[mine]]]).ravel()
            assert (place_in_block > 0).all()
            place[mine] = offset + place_in_block - 1
        return place, np.asarray(value)


def sparsity(space: TaylorHood, fixed: np.ndarray) -> Sparsity:
    """Returns the sparsity pattern of the tangent if the dofs `fixed` are prescribed."""
    is_fixed = np.zeros(space.dofs, dtype=bool)
    is_fixed[fixed] = True
    free, fixed = np.flatnonzero(~is_fixed), np.flatnonzero(is_fixed)
    number = np.empty(space.dofs, dtype=np.int64)
    number[free], number[fixed] = np.arange(len(free)), np.arange(len(fixed))
    cells = space.cell_dofs
    incidence = sp.csr_matrix(
        (np.ones(cells.size, np.int8), (np.repeat(np.arange(len(cells)), cells.shape[1]), cells.ravel())),
        shape=(len(cells), space.dofs),
        dtype=np.int32,
    )
    pattern = (incidence[:, free].T @ incidence).tocsr()
    free_free, free_fixed = pattern[:, free].tocsr(), pattern[:, fixed].tocsr()
    for block in (free_free, free_fixed):
        block.sort_indices()
        block.data = block.data.astype(np.int8)
    position = _positions(
        cells,
        number,
        is_fixed,
        free_free.indptr,
        free_free.indices,
        free_fixed.indptr,
        free_fixed.indices,
        free_free.nnz,
    )
    return Sparsity(free, fixed, free_free, free_fixed, position)


@numba.njit(cache=True)
def _positions(cells, number, is_fixed, ptr, idx, ptr_fixed, idx_fixed, offset):  # type: ignore[no-untyped-def]
    """Returns `Sparsity.position` (e, nd, nd); offset : number of entries of the free-free matrix."""
    out = np.full((cells.shape[0], cells.shape[1], cells.shape[1]), -1, np.int32)
    for e in range(cells.shape[0]):
        for i in range(cells.shape[1]):
            if is_fixed[cells[e, i]]:
                continue
            row = number[cells[e, i]]
            for j in range(cells.shape[1]):
                column = number[cells[e, j]]
                if is_fixed[cells[e, j]]:
                    a, b = ptr_fixed[row], ptr_fixed[row + 1]
                    out[e, i, j] = offset + a + np.searchsorted(idx_fixed[a:b], column)
                else:
                    a, b = ptr[row], ptr[row + 1]
                    out[e, i, j] = a + np.searchsorted(idx[a:b], column)
    return out
