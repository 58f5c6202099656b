"""Defines the equations of the article's formulation and solves one of its time steps.

`article` describes the formulation, and `article_law` its constitutive law.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sp
import skfem

from bayeskin.finite_element import article_law, assembly
from bayeskin.finite_element.newton import SOLVER_TOLERANCE, Equations, NewtonSolver
from bayeskin.finite_element.problem import Material, Problem
from bayeskin.types import Array

FACE_QUADRATURE_DEGREE = 6


@dataclass(frozen=True)
class PadFace:
    """Quadrature points on the f triangles of the pad, with q points on each triangle.

    cells (f,) : number of the tetrahedron that has the triangle as a face
    gradients (f, q, a, 3) : gradients of the cell's quadratic shape functions on the reference tetrahedron
    value_p (f, q, 4) : values of the cell's linear shape functions
    corners (f, 3) : node numbers of the triangle's corners
    weight (q,) : quadrature weights, which sum to 1/2
    """

    cells: np.ndarray
    gradients: Array
    value_p: Array
    corners: np.ndarray
    weight: Array


@dataclass
class ArticleModel:
    """The article's equations for one mesh and material.

    The state of a run is the vector of unknowns x (dofs,) and the coordinates of the moved corners (n, 3).
    """

    problem: Problem
    material: Material
    solver: NewtonSolver = field(default_factory=lambda: NewtonSolver(symmetric=False))

    def __post_init__(self) -> None:
        space, mesh = self.problem.space, self.problem.mesh.geometry
        quadratic = skfem.ElementTetP2()
        points, self._weight = skfem.quadrature.get_quadrature(quadratic.refdom, 4)
        self._ref_u = _reference_gradients(quadratic, points)
        self._ref_p = _reference_gradients(skfem.ElementTetP1(), points)
        self._face = _pad_face(mesh, self.problem.mesh.facets["pad"])
        self._cells = np.ascontiguousarray(mesh.t.T)
        shape = space.weight.shape
        self._chunks = assembly.chunks(shape)
        self._data = np.empty(self.problem.pattern.size)  # each tangent overwrites it
        # `move` relies on scikit-fem's numbering: the first displacement nodes are the mesh's vertices
        assert np.array_equal(space.nodes_u[:, :4], self._cells)

    def step(
        self, x: Array, corners: Array, dt: float, pad_displacement_m: float, guess: Array | None
    ) -> tuple[Array, float] | None:
        """Solves a backward Euler step of length dt [s].

        x (dofs,), corners (n, 3) [m] : unknowns and mesh at the start of the step
        pad_displacement_m : displacement of the pad at the end of the step
        guess : starting point (dofs,) for the solver; None when the speed of the pads has just changed, so
            that the solver starts from the linear response
        Returns the new unknowns (dofs,) and the force [N], or None if the step does not converge.
        """
        jacobian = corners[self._cells[:, 1:]] - corners[self._cells[:, :1]]  # (e, 3 edges, 3)
        inverse = np.linalg.inv(jacobian)  # rows: coordinates; columns: edges
        volume = np.linalg.det(jacobian)
        grad_u, grad_p = (
            np.ascontiguousarray(np.einsum("qaj,eij->eqia", on_cell, inverse, optimize=True))
            for on_cell in (self._ref_u, self._ref_p)
        )
        weight = np.abs(volume)[:, None] * self._weight
        equations = self.equations(x, grad_u, grad_p, weight, dt)
        target = self.problem.prescribe(x if guess is None else guess, pad_displacement_m)
        start: Array | None = target
        if guess is None:
            start = self.solver.respond(equations, x, target, self.problem.pattern.fixed)
        new = None if start is None else self.solver.solve(equations, start)
        if new is None:
            return None
        return new, self._force(new, corners, inverse)

    def move(self, corners: Array, old: Array, new: Array) -> Array:
        """Returns the corners (n, 3) [m] after the increment from the old to the new unknowns (dofs,)."""
        n = len(corners)
        return corners + (new - old)[: 3 * n].reshape(n, 3)

    def equations(self, old: Array, grad_u: Array, grad_p: Array, weight: Array, dt: float) -> Equations:
        """Returns the equations of a step that starts at `old` (dofs,), with gradients on the mesh there."""
        s, m, pattern = self.problem.space, self.material, self.problem.pattern

        def evaluate(x: Array, chunk: assembly.Chunk) -> None:
            c, at = chunk.cells, chunk.at
            assembly.evaluate(
                x, s.n_nodes, s.nodes_u[c], s.nodes_p[c], grad_u[c], grad_p[c], s.value_p,
                at.deformation, at.pressure, at.gradient,
            )  # fmt: skip

        divergence_old, pressure_old = np.empty(weight.shape), np.empty(weight.shape)
        for chunk in self._chunks:
            evaluate(old, chunk)
            divergence_old[chunk.cells] = np.trace(chunk.at.deformation, axis1=2, axis2=3)
            pressure_old[chunk.cells] = chunk.at.pressure

        def residual(x: Array) -> Array | None:
            out = np.zeros(s.dofs)
            for chunk in self._chunks:
                c, at, response = chunk.cells, chunk.at, chunk.response
                evaluate(x, chunk)
                smallest = article_law.respond(
                    at.deformation, at.pressure, at.gradient, m.mu[c], m.lam[c], m.mobility[c], m.storage[c],
                    dt, divergence_old[c], pressure_old[c], response.stress, response.content, response.flux,
                )  # fmt: skip
                if not smallest > 0.0:
                    return None
                assembly.residual(
                    s.n_nodes, s.nodes_u[c], s.nodes_p[c], grad_u[c], grad_p[c], s.value_p, weight[c],
                    response.stress, response.content, response.flux, out,
                )  # fmt: skip
            return out[pattern.free] if np.isfinite(out).all() else None

        def tangent(x: Array) -> tuple[sp.csr_matrix, sp.csr_matrix]:
            data = self._data
            data[:] = 0.0
            for chunk in self._chunks:
                c, at, by = chunk.cells, chunk.at, chunk.by
                evaluate(x, chunk)
                article_law.linearise(
                    at.deformation, m.mu[c], m.lam[c], m.mobility[c], m.storage[c], dt,
                    by.stress_f, by.stress_p, by.content_f, by.content_p, by.flux_g,
                )  # fmt: skip
                assembly.tangent(
                    grad_u[c], grad_p[c], s.value_p, weight[c], by.stress_f, by.stress_p, by.content_f,
                    by.content_p, by.flux_f, by.flux_g, pattern.position[c], data,
                )  # fmt: skip
            return pattern.matrices(data)

        n = 3 * s.n_nodes
        size_u = max(float(np.abs(old[:n]).max()), 1e-4)
        size_p = max(float(np.abs(old[n:]).max()), 1e-3 * float(m.mu.min()))
        size = np.where(np.arange(s.dofs) < n, size_u, size_p)
        scale = np.where(np.arange(s.dofs) < n, 1.0, float(m.mu.max()) / self.problem.lengths.cutis_m)
        return Equations(
            pattern.free,
            residual,
            tangent,
            1.0 / (SOLVER_TOLERANCE * size[pattern.free]),
            scale[pattern.free],
            np.array([np.log2(dt), float(np.abs(old[self.problem.pattern.fixed]).max()) / size_u]),
        )

    def _force(self, x: Array, corners: Array, inverse: Array) -> float:
        """Returns the integral [N] of t_xx - p over the pad's face.

        Gradients are taken on the mesh at the start of the step.
        """
        s, m, face = self.problem.space, self.material, self._face
        u = x[: 3 * s.n_nodes].reshape(-1, 3)
        local_u = u[s.nodes_u[face.cells]]
        local_p = x[3 * s.n_nodes + s.nodes_p[face.cells]]
        gradients = np.einsum("fqaj,fij->fqai", face.gradients, inverse[face.cells])
        f = np.eye(3) + np.einsum("fai,fqaj->fqij", local_u, gradients)
        j = np.linalg.det(f)
        mu, lam = m.mu[face.cells][:, None], m.lam[face.cells][:, None]
        t_xx = (mu * (np.einsum("fqj,fqj->fq", f[:, :, 0], f[:, :, 0]) - 1.0) + lam * np.log(j)) / j
        pressure = np.einsum("fqb,fb->fq", face.value_p, local_p)
        a, b, c = (corners[face.corners[:, k]] for k in range(3))
        twice_area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        return float(np.einsum("f,q,fq->", twice_area, face.weight, t_xx - pressure))


def _reference_gradients(element: skfem.Element, points: Array) -> Array:
    """Returns gradients (q, a, 3) of an element's shape functions at points (3, q) of the reference cell."""
    count = 10 if isinstance(element, skfem.ElementTetP2) else 4
    return np.ascontiguousarray(
        np.stack([element.lbasis(points, a)[1] for a in range(count)]).transpose(2, 0, 1)
    )


def _pad_face(mesh: skfem.MeshTet, facets: np.ndarray) -> PadFace:
    """Returns the quadrature points on the given facets of the mesh."""
    triangle, weight = skfem.quadrature.get_quadrature(skfem.ElementTriP1().refdom, FACE_QUADRATURE_DEGREE)
    barycentric = np.stack([1.0 - triangle.sum(axis=0), *triangle])  # (3, q)
    corners, cells = mesh.facets[:, facets].T, mesh.f2t[0, facets]
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    gradients, values = [], []
    for nodes, cell in zip(corners, cells, strict=True):
        local = [int(np.flatnonzero(mesh.t[:, cell] == node)[0]) for node in nodes]
        points = vertices[local].T @ barycentric
        gradients.append(_reference_gradients(skfem.ElementTetP2(), points))
        values.append(np.stack([skfem.ElementTetP1().lbasis(points, b)[0] for b in range(4)]).T)
    return PadFace(cells, np.stack(gradients), np.stack(values), corners, weight)
