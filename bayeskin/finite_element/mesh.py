"""Defines the mesh of a quarter of the skin, and makes meshes of graded bricks.

The module `gmsh` reads other meshes from files. A mesh is first flat, with the coordinates of
`bayeskin.geometry`. It is then rolled onto an arm of radius R: ``theta = y / (R + z)``, ``y' = (R + z)
sin(theta)``, ``z' = (R + z) cos(theta)``.
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

TOP_TOLERANCE_M = 1e-6  # points so near to the skin's outer face count as lying on it
BOUNDARIES = ("pad", "guard", "symmetry_x", "symmetry_y", "bottom")


@dataclass(frozen=True, eq=False)
class SkinMesh:
    """A rolled mesh with the facets of each boundary and the cells of the cutis.

    geometry : scikit-fem mesh, already rolled, with coordinates in metres
    facets : for each name in BOUNDARIES the indices of its facets in `geometry.facets`; a device without a
        guard has no facets of that name
    cutis : (cells,) True in the cutis, False in the subcutis
    name : name for messages and records
    lengths : lengths of the device and the tissue that the mesh represents
    """

    geometry: skfem.Mesh
    facets: dict[str, np.ndarray]
    cutis: np.ndarray
    name: str
    lengths: Geometry = Geometry()

    @property
    def hash(self) -> str:
        """The sha256 of the cells, boundaries and layers, and of the coordinates.

        Coordinates are rounded to a nanometre, because sines differ slightly from machine to machine.
        """
        nanometres = np.round(1e9 * self.geometry.doflocs).astype(np.int64)
        whole = (self.geometry.t, self.cutis, *(self.facets[name] for name in BOUNDARIES))
        digest = hashlib.sha256()
        for array in (nanometres, *(np.asarray(part, dtype=np.int64) for part in whole)):
            digest.update(f"{array.shape}".encode() + np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    def top(self) -> np.ndarray:
        """Returns the facets of the skin's outer face, including those under pads and guard."""
        mesh = self.geometry
        outside = mesh.boundary_facets()
        corners = unroll(mesh.p[:, mesh.facets[:, outside]], self.lengths.arm_radius_m)
        on_top = np.isclose(corners[2], self.lengths.thickness_m, rtol=0.0, atol=TOP_TOLERANCE_M)
        return outside[on_top.all(axis=0)]

    def facet_mapping(self) -> skfem.Mapping | None:
        """Returns the mapping with which scikit-fem's FacetBasis can place points on facets.

        It is None where scikit-fem's default mapping works.
        """
        mesh = self.geometry
        return _BrickMapping(mesh, mesh.elem(), mesh.bndelem) if isinstance(mesh, skfem.MeshHex) else None


class _BrickMapping(MappingIsoparametric):
    """A mapping of bricks that is inverted to a tolerance of 1e-10 of a brick.

    scikit-fem's default of 1e-12 is smaller than the rounding errors in thin curved bricks.
    """

    def invF(
        self,
        x: Array,
        tind: np.ndarray | None = None,
        newton_max_iters: int = 50,
        newton_tol: float = 1e-10,
    ) -> Array:
        return np.asarray(super().invF(x, tind, newton_max_iters, newton_tol))


def roll(points: Array, radius_m: float | None) -> Array:
    """Returns flat coordinates (3, n) [m] rolled onto an arm, (3, n) [m].

    The article's script does the same after loading a mesh. Without a radius the coordinates do not change.
    """
    if radius_m is None:
        return points
    x, y, z = points
    theta = y / (radius_m + z)
    return np.stack([x, (radius_m + z) * np.sin(theta), (radius_m + z) * np.cos(theta)])


def unroll(points: Array, radius_m: float | None) -> Array:
    """Returns the flat coordinates (3, ...) [m] of points (3, ...) [m] on an arm: the inverse of `roll`."""
    if radius_m is None:
        return points
    x, y, z = points
    radius = np.hypot(y, z)
    return np.stack([x, radius * np.arctan2(y, z), radius - radius_m])


def brick_mesh(
    refinement: int = 1, geometry: Geometry = Geometry(), like: Geometry | None = None
) -> SkinMesh:
    """Returns a mesh of bricks that is graded toward the edges of pads and guard.

    The bricks have 27 nodes, so that they follow the curved arm. At the edges a clamped surface meets a free
    one, and the stress is singular. Bricks are therefore small there, and `refinement` divides them there.

    refinement : level of refinement. Level 1 gives the article's device 448 bricks, level 2 gives 1,540. Each
        further level adds a line on either side of every edge, at a quarter of the cell's width from the edge
    geometry : device and tissue
    like : the same device on other skin. The result is then the mesh of `like`, cell by cell, with its nodes
        moved to the layers and the arm of `geometry`

    Raises InputError if the device differs from that of `like`.
    """
    lines = brick_lines(refinement, geometry, like)
    return layered_mesh(lines, f"bricks, refinement {refinement}", geometry=geometry)


def layered_mesh(
    lines: Sequence[Array], name: str, tetrahedra: bool = False, geometry: Geometry = Geometry()
) -> SkinMesh:
    """Returns a mesh of curved bricks, or of straight tetrahedra that are cut from them.

    lines : coordinates [m] of the bricks' faces along x, y and z before rolling; they must include the edges
        of pads and guard, and the interface of the layers
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
    """Returns the facets of each boundary. centre (3, facets) : centres [m] of the flat mesh's facets."""
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
    """Returns which points lie before `end_m` along x and within `half_width_m` along y."""
    return (x < end_m) & (y < half_width_m)
