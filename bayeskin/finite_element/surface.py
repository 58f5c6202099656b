"""Computes the fields on the visible surface near the pads: the top and the two planes of symmetry.

The facets of the mesh are divided into small faces. At their corners the fields have the values of the
finite-element solution. The velocity of the fluid relative to the solid is Darcy's,
``v_l - v_s = -k / (mu_f porosity) grad p``, with the mean porosity of a facet. The porosity of a single point
cannot be used, because it falls below zero at the pads' corners, where the strain is singular. The velocity
lies in the faces, because no fluid crosses the top or a plane of symmetry.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import skfem

from bayeskin.finite_element.bricks import brick_lines
from bayeskin.finite_element.mesh import unroll
from bayeskin.finite_element.problem import Constants, Problem, material
from bayeskin.types import Array

DIVISIONS = {"brick": 6, "tetrahedron": 3}  # number of parts into which each edge of a facet is divided
PARTS = ("subcutis", "cutis", "top", "pad", "guard")


@dataclass(frozen=True)
class Surface:
    """The small faces of the visible facets near the pads.

    There are f small faces and v points, on g facets of k points each.

    faces (f, 3 or 4) : numbers of the points of each small face
    part (f,) : index into PARTS; on the planes of symmetry it is the index of a layer
    plane (f,) : 0 for the top, 1 for the plane y = 0, 2 for the plane x = 0
    point (g, k) : numbers of each facet's points
    small (s, 3 or 4) : small faces of one facet, by the numbers of its points within the facet
    near (g, s) : True for the small faces near the pads
    quadratic, linear : finite-element bases of displacement and pressure at the points of the facets
    """

    faces: np.ndarray
    part: np.ndarray
    plane: np.ndarray
    point: np.ndarray
    small: np.ndarray
    near: np.ndarray
    quadratic: skfem.FacetBasis
    linear: skfem.FacetBasis


@dataclass(frozen=True)
class SurfaceState:
    """The fields at one time. All but the first are means over the small faces.

    points_m (v, 3) : deformed points
    displacement_m (f,) : magnitude of the displacement
    pressure_pa (f,) : pressure
    velocity_m_s (f, 3) : velocity of the fluid relative to the solid
    """

    points_m: Array
    displacement_m: Array
    pressure_pa: Array
    velocity_m_s: Array


def seen_surface(problem: Problem) -> Surface:
    """Returns the visible surface near the pads, with each facet divided into small faces."""
    mesh = problem.mesh.geometry
    bricks = isinstance(mesh, skfem.MeshHex)
    quadratic, linear = (
        (skfem.ElementHex2(), skfem.ElementHex1()) if bricks else (skfem.ElementTetP2(), skfem.ElementTetP1())
    )
    local, small = (
        divided_square(DIVISIONS["brick"]) if bricks else divided_triangle(DIVISIONS["tetrahedron"])
    )
    facets, plane = _seen_facets(problem)
    basis = skfem.FacetBasis(
        mesh,
        quadratic,
        problem.mesh.facet_mapping(),
        facets=facets,
        quadrature=(local, np.ones(local.shape[1])),
    )
    corners = np.asarray(basis.global_coordinates()).transpose(1, 2, 0)  # (g, k, 3)
    _, point = np.unique(np.round(corners.reshape(-1, 3), 8), axis=0, return_inverse=True)
    point = point.reshape(corners.shape[:2])
    part = np.where(plane == 0, PARTS.index("top"), problem.mesh.cutis[mesh.f2t[0, facets]])
    for name in ("pad", "guard"):
        part[np.isin(facets, problem.mesh.facets[name])] = PARTS.index(name)
    near = _near(problem, corners[:, small].mean(axis=2))
    return Surface(
        faces=point[:, small][near],
        part=np.broadcast_to(part[:, None], near.shape)[near],
        plane=np.broadcast_to(plane[:, None], near.shape)[near],
        point=point,
        small=small,
        near=near,
        quadratic=basis,
        linear=basis.with_element(linear),
    )


def surface_state(problem: Problem, theta: Mapping[str, float], surface: Surface, x: Array) -> SurfaceState:
    """Returns the fields on the surface for the unknowns x (dofs,)."""
    n, c = 3 * problem.space.n_nodes, Constants()
    u = [surface.quadratic.interpolate(x[i:n:3]) for i in range(3)]
    p = surface.linear.interpolate(x[n:])
    moved = np.stack(u, axis=-1)  # (g, k, 3)
    f = np.eye(3) + np.stack([component.grad for component in u]).transpose(2, 3, 0, 1)
    cells = surface.quadratic.tind
    initial = np.where(problem.mesh.cutis, c.porosity_c, c.porosity_s)[cells, None]
    porosity = (1.0 - (1.0 - initial) / np.linalg.det(f)).mean(axis=1, keepdims=True)
    mobility = material(theta, problem.mesh.cutis).mobility[cells, None]
    gradient = np.einsum("gkji,jgk->gki", np.linalg.inv(f), p.grad)
    corners = np.asarray(surface.quadratic.global_coordinates()).transpose(1, 2, 0) + moved
    points = np.empty((surface.point.max() + 1, 3))
    points[surface.point] = corners
    return SurfaceState(
        points_m=points,
        displacement_m=_face_means(surface, np.linalg.norm(moved, axis=-1)),
        pressure_pa=_face_means(surface, np.asarray(p)),
        velocity_m_s=_face_means(surface, -(mobility / porosity)[..., None] * gradient),
    )


def _face_means(surface: Surface, values: Array) -> Array:
    """Returns means over the small faces (f, ...) of values at the facets' points (g, k, ...)."""
    return values[:, surface.small].mean(axis=2)[surface.near]


def divided_square(n: int) -> tuple[Array, np.ndarray]:
    """Returns points (2, (n+1)^2) in the unit square, and the n^2 squares between them (n^2, 4)."""
    ticks = np.linspace(0.0, 1.0, n + 1)
    number = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    squares = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], axis=-1)
    return np.stack(np.meshgrid(ticks, ticks, indexing="ij")).reshape(2, -1), squares.reshape(-1, 4)


def divided_triangle(n: int) -> tuple[Array, np.ndarray]:
    """Returns points (2, (n+1)(n+2)/2) in the unit triangle, and the n^2 triangles between them (n^2, 3)."""
    number = {(i, j): k for k, (i, j) in enumerate((i, j) for i in range(n + 1) for j in range(n + 1 - i))}
    upright = [((i, j), (i + 1, j), (i, j + 1)) for i, j in number if i + j < n]
    hanging = [((i + 1, j), (i + 1, j + 1), (i, j + 1)) for i, j in number if i + j < n - 1]
    triangles = [[number[corner] for corner in corners] for corners in upright + hanging]
    return np.array(list(number)).T / n, np.array(triangles)


def _near(problem: Problem, points: Array) -> np.ndarray:
    """Returns which of the points (..., 3) lie near the pads, (...,).

    This is the region of all default bricks except the last along x and along y, which are long.
    """
    along, across, _ = brick_lines(1, problem.lengths)
    x, y, _ = unroll(np.moveaxis(points, -1, 0), problem.lengths.arm_radius_m)
    return np.asarray((x < along[-2]) & (y < across[-2]))


def _seen_facets(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Returns the facets that have a corner near the pads, and the plane of each."""
    mesh, named = problem.mesh.geometry, problem.mesh.facets
    corners = mesh.doflocs[:, mesh.facets]  # (3, corners, facets)
    sets = (problem.mesh.top(), named["symmetry_y"], named["symmetry_x"])
    facets, plane = np.concatenate(sets), np.repeat(np.arange(3), [len(part) for part in sets])
    near = _near(problem, corners[:, :, facets].transpose(2, 1, 0)).any(axis=1)
    return facets[near], plane[near]
