"""Computes bases of displacement and pressure fields by proper orthogonal decomposition.

The inner product of displacements is the weighted vector Laplacian, which is an energy. The inner product of
pressures is the mass matrix. The motion of the pads is separated from the modes: a displacement is
``u = d * moving + modes``, where d is the displacement of the pads. The modes are therefore zero wherever
displacements are prescribed. The adjoint of the force is one on the nodes that the load cell measures, and
zero on all other nodes that the pads move. The field ``dual`` extends these values into the skin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from bayeskin.finite_element.problem import Problem
from bayeskin.types import Array

SUBCUTIS_WEIGHT = 0.3  # weight of the subcutis in the inner product of displacements; the cutis has 1
ROUNDING = 1e-14  # eigenvalues below this fraction of the largest are rounding errors


@dataclass(frozen=True)
class Inner:
    """Inner products of a problem, and the two fields that extend the pads' motion into the skin.

    displacement (3 nodes, 3 nodes), pressure (corners, corners) : symmetric matrices of the inner products
    moving (3 nodes,) : field that is one along x on all nodes of the pads
    dual (3 nodes,) : field that is one along x only on the nodes that the load cell measures
    pad_dof : index of a degree of freedom whose value is the displacement of the pads
    """

    displacement: sp.csr_matrix
    pressure: sp.csr_matrix
    moving: Array
    dual: Array
    pad_dof: int

    def without_mean(self, pressure: Array) -> Array:
        """Returns pressures (n, corners) minus their means over the volume."""
        weight = np.asarray(self.pressure.sum(axis=0)).ravel()
        return pressure - (pressure @ weight / weight.sum())[:, None]

    @property
    def constant(self) -> Array:
        """Returns the constant pressure field of norm one, (corners,)."""
        return np.full(self.pressure.shape[0], 1.0 / np.sqrt(self.pressure.sum()))


def inner_products(problem: Problem) -> Inner:
    """Returns the inner products of a problem and the two extensions of the pads' motion."""
    s = problem.space
    weight = s.weight * np.where(problem.mesh.cutis, 1.0, SUBCUTIS_WEIGHT)[:, None]
    stiffness = np.einsum("eq,eqja,eqjb->eab", weight, s.grad_u, s.grad_u, optimize=True)
    mass = np.einsum("eq,qa,qb->eab", s.weight, s.value_p, s.value_p, optimize=True)
    laplacian = sp.kron(_assembled(stiffness, s.nodes_u, s.n_nodes), sp.eye(3)).tocsr()
    moving, dual = _extensions(problem, laplacian)
    return Inner(laplacian, _assembled(mass, s.nodes_p, s.n_corners), moving, dual, 3 * int(problem.pad[0]))


def _assembled(cells: Array, nodes: np.ndarray, count: int) -> sp.csr_matrix:
    """Assembles cell matrices (e, a, a) at their nodes (e, a) into a sparse matrix (count, count)."""
    width = nodes.shape[1]
    rows, columns = np.repeat(nodes, width, axis=1).ravel(), np.tile(nodes, (1, width)).ravel()
    return sp.csr_matrix((cells.ravel(), (rows, columns)), shape=(count, count))


def _extensions(problem: Problem, laplacian: sp.csr_matrix) -> tuple[Array, Array]:
    """Returns the fields `moving` and `dual` of `Inner`, (3 nodes,) each.

    They are harmonic extensions, by the weighted Laplacian, of the values on the pads.
    """
    n = laplacian.shape[0]
    fixed = problem.pattern.fixed[problem.pattern.fixed < n]
    free = np.setdiff1d(np.arange(n), fixed)
    along = np.zeros((n, 2))
    along[3 * problem.pads, 0] = 1.0
    along[problem.measured_x, 1] = 1.0
    solve = spla.splu(laplacian[free][:, free].tocsc(), permc_spec="MMD_AT_PLUS_A").solve
    along[free] = -solve(laplacian[free][:, fixed] @ along[fixed])
    return along[:, 0], along[:, 1]


def weighted_modes(rows: Array, inner: sp.csr_matrix, kept: float, most: int) -> Array:
    """Returns orthogonal modes (m, k) of `rows` (n, k), each times its singular value, the largest first.

    kept : smallest singular value that is kept, as a fraction of the largest; most : maximum number of modes
    """
    values, modes = pod(rows, inner)
    wanted = (values > kept * values[0]) & (np.arange(len(values)) < most) if len(values) else slice(0)
    return values[wanted, None] * modes[wanted]


def pod(rows: Array, inner: sp.csr_matrix) -> tuple[Array, Array]:
    """Returns the singular values (m,) of `rows` (n, k) in an inner product, and orthonormal modes (m, k)."""
    gram = rows @ (inner @ rows.T)
    values, vectors = np.linalg.eigh(0.5 * (gram + gram.T))
    values, vectors = values[::-1], vectors[:, ::-1]
    wanted = values > ROUNDING * max(values[0], 0.0) if len(values) else slice(0)
    values = np.sqrt(values[wanted])
    return values, (vectors[:, wanted] / values).T @ rows
