"""The quarter of the upper arm as a mesh: graded bricks of our own, or a gmsh file.

Both are made flat (x 0..105 mm, y 0..84 mm, z 0..10 mm) and rolled onto the arm:
``theta = y / (R + z)``, ``y' = (R + z) sin(theta)``, ``z' = (R + z) cos(theta)``, R = 48 mm.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import meshio
import numpy as np
import skfem
from skfem.mapping import MappingIsoparametric

from bayeskin.errors import InputError
from bayeskin.types import Array

ARM_RADIUS_M = 48e-3
LENGTH_M = (105e-3, 84e-3, 10e-3)
CUTIS_BOTTOM_M = 8e-3
BOUNDARIES = ("pad", "guard", "symmetry_x", "symmetry_y", "bottom")
GMSH_NAMES = {
    "right_patch": "pad",
    "u_right": "guard",
    "left": "symmetry_x",
    "back": "symmetry_y",
    "bottom": "bottom",
}
GMSH_LAYERS = {"bottom_layer": "subcutis", "top_layer": "cutis"}


@dataclass(frozen=True)
class SkinMesh:
    """A rolled mesh with the facets of each boundary and the cells of the cutis.

    geometry : scikit-fem mesh, coordinates in metres, already rolled
    facets : indices of `geometry.facets` for each name in BOUNDARIES
    cutis : (cells,) True in the cutis, False in the subcutis
    name : for messages and records
    """

    geometry: skfem.Mesh
    facets: dict[str, np.ndarray]
    cutis: np.ndarray
    name: str

    @property
    def hash(self) -> str:
        """sha256 over cells, boundaries, layers, and coordinates to a nanometre (sines differ by machine)."""
        nanometres = np.round(1e9 * self.geometry.doflocs).astype(np.int64)
        whole = (self.geometry.t, self.cutis, *(self.facets[name] for name in BOUNDARIES))
        digest = hashlib.sha256()
        for array in (nanometres, *(np.asarray(part, dtype=np.int64) for part in whole)):
            digest.update(f"{array.shape}".encode() + np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

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


def roll(points: Array, radius_m: float = ARM_RADIUS_M) -> Array:
    """Flat coordinates (3, n) [m] onto the arm, (3, n) [m] (the article's script, after loading)."""
    x, y, z = points
    theta = y / (radius_m + z)
    return np.stack([x, (radius_m + z) * np.sin(theta), (radius_m + z) * np.cos(theta)])


def brick_mesh(refinement: int = 1) -> SkinMesh:
    """Bricks graded toward the pads' edges; 27-node geometry, so the arm is curved.

    There a clamped surface meets a free one and the stress is singular, so that is where they are small
    and where `refinement` divides them: 1 gives 448 bricks, 2 gives 1,540, each finer one a further line on
    either side of every edge, a quarter of the cell's width from it.
    """
    return layered_mesh(brick_lines(refinement), name=f"bricks, refinement {refinement}")


def layered_mesh(
    lines: Sequence[Array],
    name: str,
    tetrahedra: bool = False,
    cutis_bottom_m: float = CUTIS_BOTTOM_M,
    radius_m: float = ARM_RADIUS_M,
) -> SkinMesh:
    """Curved bricks between `lines` along x, y, z before rolling [m], or straight tetrahedra cut from them.

    The pads' edges and `cutis_bottom_m` are among the lines; rolled onto an arm of `radius_m`.
    """
    flat = skfem.MeshHex.init_tensor(*lines)
    flat = flat.to_meshtet() if tetrahedra else flat
    facets = _flat_boundaries(flat.p[:, flat.facets].mean(axis=1))
    cutis = flat.p[2, flat.t].mean(axis=0) > cutis_bottom_m
    if tetrahedra:
        return SkinMesh(skfem.MeshTet(roll(flat.p, radius_m), flat.t), facets, cutis, name)
    curved = skfem.MeshHex2.from_mesh(flat)
    return SkinMesh(skfem.MeshHex2(roll(curved.doflocs, radius_m), curved.t), facets, cutis, name)


# Lines of the bricks [mm], edges of the pads and z = 8, where the layers meet, among them.
_COARSEST_LINES_MM = (
    (0.0, 12.0, 18.0, 22.0, 26.0, 27.0, 35.0, 50.0, 105.0),
    (0.0, 4.0, 5.0, 12.0, 30.0, 84.0),
    (0.0, 8.0, 10.0),
)
_COARSE_LINES_MM = (
    # coarse beyond the guard: there a soft cutis on a stiff subcutis would fold, and fine bricks try to
    (0.0, 9.0, 16.5, 18.0, 19.5, 24.5, 26.0, 27.0, 28.5, 33.0, 35.0, 40.0, 48.0, 65.0, 105.0),
    (0.0, 3.0, 4.0, 5.0, 8.5, 12.0, 18.0, 38.0, 84.0),
    (0.0, 5.0, 8.0, 9.5, 10.0),
)
_EDGES_MM = ((18.0, 26.0, 27.0, 35.0), (4.0, 5.0, 12.0), (10.0,))
_TOWARD_EDGE = 0.25  # where a cell beside an edge is divided: a quarter of its width from it


def brick_lines(refinement: int) -> tuple[Array, ...]:
    """Coordinates of the bricks' faces along x, y and z before rolling [m]."""
    lines: tuple[tuple[float, ...], ...] = _COARSE_LINES_MM if refinement else _COARSEST_LINES_MM
    for _ in range(refinement - 1):
        lines = tuple(_divided(axis, edges) for axis, edges in zip(lines, _EDGES_MM, strict=True))
    return tuple(1e-3 * np.array(axis) for axis in lines)


def _divided(lines: tuple[float, ...], edges: tuple[float, ...]) -> tuple[float, ...]:
    new = [a + _TOWARD_EDGE * (b - a) for a, b in pairwise(lines) if a in edges]
    new += [b - _TOWARD_EDGE * (b - a) for a, b in pairwise(lines) if b in edges]
    return tuple(sorted({*lines, *new}))


def _flat_boundaries(centre: Array) -> dict[str, np.ndarray]:
    """Facets of each boundary from the facet centres (3, facets) of the flat mesh [m]."""
    x, y, z = 1e3 * centre
    top = np.isclose(z, 10.0)
    pad = top & (x > 18) & (x < 26) & (y < 4)
    guard = top & (x > 18) & (x < 35) & (y < 12) & ((y > 5) | (x > 27))
    sets = {
        "pad": pad,
        "guard": guard,
        "symmetry_x": np.isclose(x, 0.0),
        "symmetry_y": np.isclose(y, 0.0),
        "bottom": np.isclose(z, 0.0),
    }
    return {name: np.flatnonzero(inside) for name, inside in sets.items()}


def read_gmsh(path: Path | str) -> SkinMesh:
    """A flat gmsh file with the article's names for boundaries and layers, rolled after loading.

    Raises InputError if the file is absent or unreadable, holds no tetrahedra, or lacks a name.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(path, "no such file", "a gmsh mesh")
    try:
        with redirect_stderr(io.StringIO()), redirect_stdout(io.StringIO()):  # meshio complains at length
            return _assembled(path, meshio.read(path, file_format="gmsh"))
    except InputError:
        raise
    except (Exception, SystemExit) as error:  # a damaged file: meshio and the indices raise of every kind
        raise InputError(path, f"not readable as gmsh ({type(error).__name__})", "a gmsh 4.1 mesh") from None


def _assembled(path: Path, raw: meshio.Mesh) -> SkinMesh:
    missing = [n for n in (*GMSH_NAMES, *GMSH_LAYERS) if n not in raw.field_data]
    if missing:
        raise InputError(path, f"no boundary or layer named {', '.join(missing)}", "the article's names")
    tetrahedra, volume_tags = _cells(raw, "tetra")
    triangles, surface_tags = _cells(raw, "triangle")
    if not len(tetrahedra):
        raise InputError(path, "no tetrahedra", "a volume mesh")
    used, compact = np.unique(tetrahedra, return_inverse=True)
    corners = np.ascontiguousarray(compact.reshape(tetrahedra.shape).T)
    flat = skfem.MeshTet(np.ascontiguousarray(raw.points[used].T), corners)
    number = np.full(len(raw.points), -1)
    number[used] = np.arange(len(used))
    facets = {}
    for gmsh_name, name in GMSH_NAMES.items():
        nodes = number[triangles[surface_tags == raw.field_data[gmsh_name][0]]]
        facets[name] = _facet_indices(flat, nodes)
        if not len(facets[name]):
            raise InputError(path, f"boundary {gmsh_name} without triangles", "at least one")
    cutis = volume_tags == raw.field_data["top_layer"][0]
    rolled = skfem.MeshTet(roll(flat.p), flat.t)
    return SkinMesh(rolled, facets, cutis, path.name)


def _cells(raw: meshio.Mesh, kind: str) -> tuple[np.ndarray, np.ndarray]:
    pairs = [
        (block.data, tags)
        for block, tags in zip(raw.cells, raw.cell_data["gmsh:physical"], strict=True)
        if block.type == kind
    ]
    width = {"tetra": 4, "triangle": 3}[kind]
    if not pairs:
        return np.empty((0, width), int), np.empty(0, int)
    return np.concatenate([d for d, _ in pairs]), np.concatenate([t for _, t in pairs])


def _facet_indices(mesh: skfem.Mesh, nodes: np.ndarray) -> np.ndarray:
    """Indices of the facets with the corner nodes given, (n, 3)."""
    keys = {tuple(sorted(f)): i for i, f in enumerate(mesh.facets.T.tolist())}
    return np.array(sorted(keys[tuple(sorted(n))] for n in nodes.tolist()), dtype=int)
