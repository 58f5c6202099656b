"""The quarter of the skin as a mesh: what a mesh is, and graded bricks of our own (`gmsh` reads files).

Both are made flat, as `bayeskin.geometry` has it, and rolled onto an arm of radius R:
``theta = y / (R + z)``, ``y' = (R + z) sin(theta)``, ``z' = (R + z) cos(theta)``.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import skfem
from skfem.mapping import MappingIsoparametric

from bayeskin.finite_element.bricks import brick_lines
from bayeskin.geometry import Geometry
from bayeskin.types import Array

TOP_TOLERANCE_M = 1e-6  # of what lies on the skin's outer face
BOUNDARIES = ("pad", "guard", "symmetry_x", "symmetry_y", "bottom")


@dataclass(frozen=True)
class SkinMesh:
    """A rolled mesh with the facets of each boundary and the cells of the cutis.

    geometry : scikit-fem mesh, coordinates in metres, already rolled
    facets : indices of `geometry.facets` for each name in BOUNDARIES; none of a guard that is not there
    cutis : (cells,) True in the cutis, False in the subcutis
    name : for messages and records
    lengths : device and tissue that it is a mesh of
    """

    geometry: skfem.Mesh
    facets: dict[str, np.ndarray]
    cutis: np.ndarray
    name: str
    lengths: Geometry = Geometry()

    @property
    def hash(self) -> str:
        """sha256 over cells, boundaries, layers, and coordinates to a nanometre (sines differ by machine)."""
        nanometres = np.round(1e9 * self.geometry.doflocs).astype(np.int64)
        whole = (self.geometry.t, self.cutis, *(self.facets[name] for name in BOUNDARIES))
        digest = hashlib.sha256()
        for array in (nanometres, *(np.asarray(part, dtype=np.int64) for part in whole)):
            digest.update(f"{array.shape}".encode() + np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    def top(self) -> np.ndarray:
        """Facets of the skin's outer face, under pads and guard, too."""
        mesh = self.geometry
        outside = mesh.boundary_facets()
        corners = unroll(mesh.p[:, mesh.facets[:, outside]], self.lengths.arm_radius_m)
        on_top = np.isclose(corners[2], self.lengths.thickness_m, rtol=0.0, atol=TOP_TOLERANCE_M)
        return outside[on_top.all(axis=0)]

    def facet_mapping(self) -> skfem.Mapping | None:
        """With which scikit-fem's FacetBasis can place points on facets; None for its own."""
        mesh = self.geometry
        return _BrickMapping(mesh, mesh.elem(), mesh.bndelem) if isinstance(mesh, skfem.MeshHex) else None


class _BrickMapping(MappingIsoparametric):
    """Inverts to 1e-10 of a brick: scikit-fem's own 1e-12 is below rounding in thin curved ones."""

    def invF(
        self,
        x: Array,
        tind: np.ndarray | None = None,
        newton_max_iters: int = 50,
        newton_tol: float = 1e-10,
    ) -> Array:
        return np.asarray(super().invF(x, tind, newton_max_iters, newton_tol))


def roll(points: Array, radius_m: float | None) -> Array:
    """Flat coordinates (3, n) [m] onto an arm, (3, n) [m] (the article's script, after loading).

    Without a radius they stay as they are.
    """
    if radius_m is None:
        return points
    x, y, z = points
    theta = y / (radius_m + z)
    return np.stack([x, (radius_m + z) * np.sin(theta), (radius_m + z) * np.cos(theta)])


def unroll(points: Array, radius_m: float | None) -> Array:
    """The flat coordinates (3, ...) [m] of points (3, ...) on an arm: what `roll` made them from."""
    if radius_m is None:
        return points
    x, y, z = points
    radius = np.hypot(y, z)
    return np.stack([x, radius * np.arctan2(y, z), radius - radius_m])


def brick_mesh(
    refinement: int = 1, geometry: Geometry = Geometry(), like: Geometry | None = None
) -> SkinMesh:
    """Bricks graded toward the edges of pads and guard; 27-node cells, so the arm is curved.

    There a clamped surface meets a free one and the stress is singular, so that is where they are small and
    where `refinement` divides them: 1 gives the article's device 448 bricks, 2 gives 1,540, each finer one
    a further line on either side of every edge, a quarter of the cell's width from it.

    like : the same device on other skin, whose mesh this one is, cell by cell, with its nodes moved to this
        skin's layers and arm

    Raises InputError for another device than that of `like`.
    """
    lines = brick_lines(refinement, geometry, like)
    return layered_mesh(lines, f"bricks, refinement {refinement}", geometry=geometry)


def layered_mesh(
    lines: Sequence[Array], name: str, tetrahedra: bool = False, geometry: Geometry = Geometry()
) -> SkinMesh:
    """Curved bricks between `lines` along x, y, z before rolling [m], or straight tetrahedra cut from them.

    The edges of pads and guard, and where the layers meet, are among the lines.
    """
    flat = skfem.MeshHex.init_tensor(*lines)
    flat = flat.to_meshtet() if tetrahedra else flat
    facets = _flat_boundaries(flat.p[:, flat.facets].mean(axis=1), geometry)
    cutis = flat.p[2, flat.t].mean(axis=0) > geometry.subcutis_m
    if not tetrahedra:
        flat = skfem.MeshHex2.from_mesh(flat)
    rolled = type(flat)(roll(flat.doflocs, geometry.arm_radius_m), flat.t)
    return SkinMesh(rolled, facets, cutis, name, geometry)


def _flat_boundaries(centre: Array, geometry: Geometry) -> dict[str, np.ndarray]:
    """Facets of each boundary from the facet centres (3, facets) of the flat mesh [m]."""
    x, y, z = centre
    top = np.isclose(z, geometry.thickness_m)
    pad = _within(x, y, geometry.along_m[1], geometry.across_m[0])
    guard = np.zeros_like(top)
    if geometry.guard is not None:
        inside = _within(x, y, geometry.along_m[2], geometry.across_m[1])
        guard = _within(x, y, geometry.along_m[3], geometry.across_m[2]) & ~inside
    device = top & (x > geometry.half_gauge_m)
    sets = {
        "pad": device & pad,
        "guard": device & guard,
        "symmetry_x": np.isclose(x, 0.0),
        "symmetry_y": np.isclose(y, 0.0),
        "bottom": np.isclose(z, 0.0),
    }
    return {name: np.flatnonzero(inside) for name, inside in sets.items()}


def _within(x: Array, y: Array, end_m: float, half_width_m: float) -> np.ndarray:
    return (x < end_m) & (y < half_width_m)
