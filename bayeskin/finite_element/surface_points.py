"""The displacement of points on the skin's surface, as a distant camera above the skin sees it.

A point is stated by its place in the camera's plane before the test: x along the pull, y across it, with the
origin midway between the pads. On a curved arm y is the projection on this plane, and not the length of the
arc. The observed displacement is the projection too. It has the components u_x and u_y of the full model,
whose z axis is the direction of view. The model is a quarter of the skin, so a point is reflected into it,
and the displacement back.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import skfem

from bayeskin.errors import InputError
from bayeskin.finite_element.mesh import SkinMesh
from bayeskin.finite_element.problem import Problem
from bayeskin.geometry import Geometry
from bayeskin.types import Array, Simulation

STEPS = 20  # of Newton's method for the place of a point on a facet; three to five are usual
ON_FACET = 1e-6  # a point may lie so far beyond a facet's edge, as a share of the facet


def surface_displacement(problem: Problem, points_m: Array) -> sp.csr_matrix:
    """Returns the matrix (2 p, dofs) that gives the displacements of points from the unknowns.

    Its rows are the displacements along x and y of the first point, then those of the second, and so on.

    points_m (p, 2) : places of the points in the camera's plane before the test [m]
    Raises InputError for a point outside the modelled skin.
    """
    refuse_outside(problem.lengths, points_m)
    side = np.where(points_m < 0.0, -1.0, 1.0)
    cells, local = _places(problem.mesh, np.abs(points_m))
    values = _shape_functions(problem.mesh.geometry, local)  # (p, a)
    nodes = problem.space.nodes_u[cells]
    p, a = nodes.shape
    rows = np.repeat(np.arange(2 * p).reshape(p, 2), a, axis=0).reshape(p, a, 2)
    columns = 3 * nodes[:, :, None] + np.arange(2)
    entries = values[:, :, None] * side[:, None, :]
    shape = (2 * p, problem.space.dofs)
    return sp.csr_matrix((entries.ravel(), (rows.ravel(), columns.ravel())), shape=shape)


def refuse_outside(lengths: Geometry, points_m: Array, where: str = "markers") -> None:
    """Raises InputError for a point (p, 2) that lies outside the modelled skin, as the camera sees it."""
    along_m, across_m = half_extent(lengths)
    outside = np.flatnonzero((np.abs(points_m) > [along_m, across_m]).any(axis=1))
    if len(outside):
        x_mm, y_mm = 1e3 * points_m[outside[0]]
        remedy = (
            f"the modelled skin reaches {1e3 * along_m:.4g} mm along the pull and {1e3 * across_m:.4g} mm "
            "across it from the middle between the pads (is the device the right one?)"
        )
        raise InputError(where, f"a point at x {x_mm:.4g} mm, y {y_mm:.4g} mm is outside the skin", remedy)


def half_extent(lengths: Geometry) -> tuple[float, float]:
    """Returns how far [m] the modelled skin reaches from its middle, along x and y, as the camera sees it."""
    along_m, across_m, thickness_m = lengths.box_m
    if lengths.arm_radius_m is None:
        return along_m, across_m
    radius_m = lengths.arm_radius_m + thickness_m
    return along_m, float(radius_m * np.sin(min(across_m / radius_m, np.pi / 2)))


def _places(mesh: SkinMesh, points_m: Array) -> tuple[np.ndarray, Array]:
    """Returns the cell (p,) and the local coordinates (3, p) of points (p, 2) on the top of the quarter."""
    skin, top = mesh.geometry, mesh.top()
    cells = skin.f2t[0, top]
    origin, edges = _facet_frames(skin, top, cells)
    corners = skin.p[:2, skin.facets[:, top]]  # (2, corners, f)
    slack_m = 0.2 * np.ptp(corners, axis=1)  # a curved facet bulges beyond its corners
    low, high = corners.min(axis=1) - slack_m, corners.max(axis=1) + slack_m
    near = ((points_m.T[:, :, None] >= low[:, None]) & (points_m.T[:, :, None] <= high[:, None])).all(axis=0)
    point, facet = np.nonzero(near)
    on_facet = _on_facets(skin, cells[facet], origin[:, facet], edges[..., facet], points_m[point].T)
    beyond = _beyond(on_facet, isinstance(skin, skfem.MeshHex))
    best = np.full(len(points_m), -1)
    for pair in np.argsort(-beyond):  # the last entry, which remains, is the facet that contains the point
        best[point[pair]] = pair
    lost = np.flatnonzero((best < 0) | (beyond[best] > ON_FACET))
    if len(lost):
        raise AssertionError(f"no facet at {points_m[lost[0]]}")
    local = origin[:, facet[best]] + np.einsum("kap,ap->kp", edges[..., facet[best]], on_facet[:, best])
    return cells[facet[best]], local


def _facet_frames(skin: skfem.Mesh, facets: np.ndarray, cells: np.ndarray) -> tuple[Array, Array]:
    """Returns for each facet the local coordinates of a corner, (3, f), and of two edges there, (3, 2, f)."""
    reference = skin.elem.refdom.p  # (3, corners of a cell)
    local = np.array([
        reference[:, [int(np.flatnonzero(skin.t[:, cell] == vertex)[0]) for vertex in vertices]]
        for cell, vertices in zip(cells, skin.facets[:, facets].T, strict=True)
    ])  # (f, 3, corners)  # fmt: skip
    origin, others = local[:, :, :1], local[:, :, 1:] - local[:, :, :1]
    nearest = np.argsort(np.abs(others).sum(axis=1), axis=1, kind="stable")[:, :2]  # not the diagonal
    edges = np.take_along_axis(others, nearest[:, None, :], axis=2)
    return origin[:, :, 0].T, edges.transpose(1, 2, 0)


def _on_facets(skin: skfem.Mesh, cells: np.ndarray, origin: Array, edges: Array, points_m: Array) -> Array:
    """Returns coordinates (2, n) on facets at which the mesh has the places points_m (2, n) in the plane."""
    mapping, at = skin.mapping(), np.full((2, len(cells)), 1.0 / 3.0)
    for _ in range(STEPS):
        local = (origin + np.einsum("kan,an->kn", edges, at))[:, :, None]
        missing = points_m - np.asarray(mapping.F(local, cells))[:2, :, 0]
        slope = np.einsum("ikn,kan->nia", np.asarray(mapping.DF(local, cells))[:2, :, :, 0], edges)
        step = np.linalg.solve(slope, missing.T[:, :, None])[:, :, 0].T
        at = at + np.clip(step, -1.0, 1.0)
        if np.abs(step).max(initial=0.0) < 1e-12:
            break
    return at


def _beyond(on_facet: Array, bricks: bool) -> Array:
    """Returns how far coordinates (2, n) lie beyond a facet's edges, (n,); not above zero within it."""
    last = on_facet.max(axis=0) if bricks else on_facet.sum(axis=0)
    return np.asarray(np.maximum(-on_facet.min(axis=0), last - 1.0))


def _shape_functions(skin: skfem.Mesh, local: Array) -> Array:
    """Returns the shape functions of the displacement (p, a) at local coordinates (3, p)."""
    element = skfem.ElementHex2() if isinstance(skin, skfem.MeshHex) else skfem.ElementTetP2()
    count = element.doflocs.shape[0]
    return np.stack([element.lbasis(local, i)[0] for i in range(count)], axis=1)


class SurfaceTracks:
    """Keeps the displacements of points on the surface at all steps of a run of the full model.

    To use it, pass its method `on_state` to `simulate`.

    matrix (2 p, dofs) : the result of `surface_displacement`
    """

    def __init__(self, matrix: sp.csr_matrix) -> None:
        self._matrix = matrix
        self._steps: list[Array] = []

    def on_state(self, time_s: float, x: Array, force_n: float) -> None:
        """Receives the next state of the run."""
        self._steps.append(np.asarray(self._matrix @ x))

    def since_first(self, simulation: Simulation, time_s: Array) -> Array:
        """Returns the displacements [m] at times after the first, since the first of them, (t - 1, p, 2).

        simulation : the result of the run
        """
        return since_first(simulation, np.array(self._steps), time_s)


def since_first(simulation: Simulation, steps_m: Array, time_s: Array) -> Array:
    """Returns displacements since the first of times (t,), at the others, (t - 1, p, 2, ...).

    steps_m (n, 2 p, ...) : displacements [m] at the steps of a simulation
    """
    at_m = simulation.between_steps(steps_m, time_s)
    points = at_m.shape[1] // 2
    return np.asarray((at_m[1:] - at_m[0]).reshape(len(time_s) - 1, points, 2, *at_m.shape[2:]))
