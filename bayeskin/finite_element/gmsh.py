"""Reads a user's mesh from a gmsh file.

The mesh must be flat, in metres, and have the article's names for boundaries and layers. Before the mesh is
rolled onto the arm, it is compared with the lengths of the device and the tissue that it should represent.
"""

from __future__ import annotations

import io
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import meshio
import numpy as np
import skfem

from bayeskin.errors import InputError
from bayeskin.finite_element.mesh import SkinMesh, roll
from bayeskin.geometry import Geometry
from bayeskin.types import Array

GMSH_NAMES = {
    "right_patch": "pad",
    "u_right": "guard",
    "left": "symmetry_x",
    "back": "symmetry_y",
    "bottom": "bottom",
}
GMSH_LAYERS = {"bottom_layer": "subcutis", "top_layer": "cutis"}
LONGEST_M = 2.0  # a mesh of skin that is longer than this must be in another unit
PLAN_TOLERANCE_M, DEPTH_TOLERANCE_M = 0.5e-3, 0.1e-3  # along x and y, and along z


def read_gmsh(path: Path | str, geometry: Geometry = Geometry()) -> SkinMesh:
    """Returns the mesh of a flat gmsh file, rolled onto the arm.

    The file must use the article's names for boundaries and layers.

    Raises InputError if the file is absent or unreadable, has no tetrahedra or some that belong to no layer,
    lacks a name, is in millimetres, or if its lengths differ from those of `geometry`.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(path, "there is no such file", "bayeskin needs a gmsh mesh")
    try:
        with redirect_stderr(io.StringIO()), redirect_stdout(io.StringIO()):  # meshio prints long warnings
            return _skin_mesh(path, meshio.read(path, file_format="gmsh"), geometry)
    except InputError:
        raise
    except (Exception, SystemExit) as error:  # a damaged file can raise almost any error
        raise InputError(
            path,
            f"this file cannot be read as gmsh ({type(error).__name__})",
            "bayeskin needs a gmsh 4.1 mesh",
        ) from None


@dataclass(frozen=True)
class _Cells:
    """The cells of one kind, and the names that they carry. A cell may carry several names.

    corners (n, corners) : node numbers of each cell's corners
    named : for each name, which cells carry it (n,)
    """

    corners: np.ndarray
    named: dict[str, np.ndarray]


def _skin_mesh(path: Path, raw: meshio.Mesh, geometry: Geometry) -> SkinMesh:
    """Returns the rolled mesh. Raises InputError for a mesh that `read_gmsh` does not accept."""
    names = {gmsh: name for gmsh, name in GMSH_NAMES.items() if name != "guard" or geometry.guard is not None}
    missing = [n for n in (*names, *GMSH_LAYERS) if n not in raw.field_data]
    if missing:
        raise InputError(
            path, f"no boundary or layer is named {', '.join(missing)}", "use the article's names"
        )
    solid, surface = _cells(raw, "tetra", 4), _cells(raw, "triangle", 3)
    if not len(solid.corners):
        raise InputError(path, "the mesh has no tetrahedra", "bayeskin needs the mesh of a volume")
    used, compact = np.unique(solid.corners, return_inverse=True)
    points = np.ascontiguousarray(raw.points[used].T)
    flat = skfem.MeshTet(points, np.ascontiguousarray(compact.reshape(solid.corners.shape).T))
    _check_units(path, points)
    _check_layers(path, points, flat.t, solid, geometry)
    _check_guard(path, surface, geometry)
    number = np.full(len(raw.points), -1)
    number[used] = np.arange(len(used))
    facets = {"guard": np.empty(0, int)}
    for gmsh_name, name in names.items():
        nodes = number[surface.corners[surface.named[gmsh_name]]]
        if not len(nodes):
            raise InputError(path, f"the boundary {gmsh_name} has no triangles", "it needs at least one")
        _check_boundary(f"{path}: {gmsh_name}", points[:, nodes.ravel()], name, geometry)
        facets[name] = _facet_indices(flat, nodes)
    rolled = skfem.MeshTet(roll(flat.p, geometry.arm_radius_m), flat.t)
    return SkinMesh(rolled, facets, solid.named["top_layer"], path.name, geometry)


def _cells(raw: meshio.Mesh, kind: str, corners: int) -> _Cells:
    """Returns all cells of one of meshio's kinds, with the names that they carry."""
    blocks = [k for k, block in enumerate(raw.cells) if block.type == kind]
    if not blocks:
        return _Cells(np.empty((0, corners), int), {name: np.empty(0, bool) for name in raw.field_data})
    named = {name: np.concatenate([_carries(raw, k, name) for k in blocks]) for name in raw.field_data}
    return _Cells(np.concatenate([raw.cells[k].data for k in blocks]), named)


def _carries(raw: meshio.Mesh, block: int, name: str) -> np.ndarray:
    """Returns which cells of a block carry a name (n,).

    Older formats of gmsh have exactly one name for each cell.
    """
    if name not in raw.cell_sets:
        return np.asarray(raw.cell_data["gmsh:physical"][block] == raw.field_data[name][0])
    carries = np.zeros(len(raw.cells[block].data), dtype=bool)
    carries[raw.cell_sets[name][block]] = True
    return carries


def _check_units(path: Path, points: Array) -> None:
    """Raises InputError if the coordinates (3, n) look like millimetres."""
    longest_m = float(np.ptp(points, axis=1).max())
    if longest_m > LONGEST_M:
        remedy = "give coordinates in metres (in gmsh: Mesh.ScalingFactor = 0.001 before it is saved)"
        raise InputError(
            path, f"the mesh has a length of {longest_m:g}, so its unit is probably millimetres", remedy
        )


def _check_layers(path: Path, points: Array, cells: np.ndarray, solid: _Cells, geometry: Geometry) -> None:
    """Raises InputError unless each cell belongs to one layer, and each layer has the expected thickness."""
    layers = [solid.named[name] for name in GMSH_LAYERS]
    stray = int(np.sum(layers[0] == layers[1]))
    if stray:
        raise InputError(
            path,
            f"{stray} tetrahedra belong to no layer or to both layers",
            f"each must belong to one of {', '.join(GMSH_LAYERS)}",
        )
    depths = (0.0, geometry.subcutis_m), (geometry.subcutis_m, geometry.thickness_m)
    for name, inside, depth in zip(GMSH_LAYERS, layers, depths, strict=True):
        if not inside.any():
            raise InputError(path, f"the layer {name} has no tetrahedra", "it needs at least one")
        _check_extent(f"{path}: {name}", points[2, cells[:, inside]], "z", depth, DEPTH_TOLERANCE_M)


def _check_guard(path: Path, surface: _Cells, geometry: Geometry) -> None:
    """Raises InputError if the device has no guard but the mesh does, or if guard and pad share triangles."""
    guard = surface.named.get("u_right", np.empty(0, bool))
    if geometry.guard is None and guard.any():
        raise InputError(
            f"{path}: u_right", "the mesh has a guard", "remove it, because this device has none"
        )
    if geometry.guard is not None and (guard & surface.named["right_patch"]).any():
        raise InputError(
            f"{path}: u_right",
            "some of its triangles also belong to right_patch",
            "pad and guard must be separate",
        )


def _check_boundary(where: str, points: Array, name: str, geometry: Geometry) -> None:
    """Raises InputError unless the corners (3, n) of a boundary extend as far as in the geometry."""
    top = (geometry.thickness_m,) * 2
    expected: dict[str, list[tuple[str, tuple[float, ...]]]] = {
        "pad": [("x", geometry.along_m[:2]), ("y", (0.0, geometry.across_m[0])), ("z", top)],
        "guard": [("x", geometry.along_m[::3]), ("y", (0.0, geometry.across_m[-1])), ("z", top)],
        "symmetry_x": [("x", (0.0, 0.0))],
        "symmetry_y": [("y", (0.0, 0.0))],
        "bottom": [("z", (0.0, 0.0))],
    }
    for axis, extent in expected[name]:
        tolerance_m = DEPTH_TOLERANCE_M if axis == "z" else PLAN_TOLERANCE_M
        _check_extent(where, points["xyz".index(axis)], axis, extent, tolerance_m)


def _check_extent(
    where: str, coordinates_m: Array, axis: str, required_m: tuple[float, ...], tolerance_m: float
) -> None:
    """Raises InputError unless the coordinates along an axis extend over the expected interval."""
    ends = float(coordinates_m.min()), float(coordinates_m.max())
    if not np.allclose(ends, required_m, rtol=0.0, atol=tolerance_m):
        measured, required = (f"{axis} {1e3 * a:.4g} to {1e3 * b:.4g} mm" for a, b in (ends, required_m))
        raise InputError(
            where, f"the mesh extends over {measured}", f"the device and the tissue require {required}"
        )


def _facet_indices(mesh: skfem.Mesh, nodes: np.ndarray) -> np.ndarray:
    """Returns the indices of the facets that have the given corner nodes (n, 3)."""
    keys = {tuple(sorted(f)): i for i, f in enumerate(mesh.facets.T.tolist())}
    return np.unique([keys[tuple(sorted(n))] for n in nodes.tolist()])
