"""A gmsh file of the skin, flat, as gmsh itself would write one; with what can be wrong about it."""

from __future__ import annotations

import numpy as np
import skfem

from bayeskin.finite_element.gmsh import GMSH_LAYERS, GMSH_NAMES
from bayeskin.finite_element.mesh import SkinMesh, layered_mesh
from bayeskin.geometry import Geometry

NUMBER = {name: n for n, name in enumerate((*GMSH_NAMES, *GMSH_LAYERS, "everything"), start=1)}


def coarse_tetrahedra(geometry: Geometry = Geometry()) -> SkinMesh:
    """Returns a mesh with the fewest tetrahedra that show the edges of pads, guard and layers."""
    length, width, thickness = geometry.box_m
    lines = (0.0, *geometry.along_m, length), (0.0, *geometry.across_m, width)
    depths = (0.0, geometry.subcutis_m, thickness)
    return layered_mesh([np.array(axis) for axis in (*lines, depths)], "coarse", True, geometry)


def gmsh_text(
    flat: SkinMesh, unit: float = 1.0, first: str | None = None, layers: tuple[str, str] = tuple(GMSH_LAYERS)
) -> str:
    """A file in gmsh's format 4.1 of a mesh that is not rolled.

    unit : of the coordinates, 1e3 for millimetres; first : a name that every surface carries before its own;
    layers : names of what lies below and above
    """
    mesh: skfem.MeshTet = flat.geometry
    facets = [(mesh.facets[:, flat.facets[own]], name) for name, own in GMSH_NAMES.items()]
    surfaces = [
        (2, 2, corners, [first, name] if first else [name]) for corners, name in facets if corners.size
    ]
    cells = [mesh.t[:, ~flat.cutis], mesh.t[:, flat.cutis]]
    volumes = [(3, 4, corners, [name]) for corners, name in zip(cells, layers, strict=True)]
    names = [f'{3 if name in GMSH_LAYERS else 2} {n} "{name}"' for name, n in NUMBER.items()]
    entities, elements, count = [], [], 0
    for tag, (dimension, kind, corners, carried) in enumerate([*surfaces, *volumes], start=1):
        numbers = " ".join(str(NUMBER[name]) for name in carried)
        entities.append(f"{tag} 0 0 0 1 1 1 {len(carried)} {numbers} 0")
        elements.append(f"{dimension} {tag} {kind} {corners.shape[1]}")
        for column in corners.T:
            count += 1
            elements.append(f"{count} {' '.join(str(1 + node) for node in column)}")
    n = mesh.p.shape[1]
    points = [" ".join(repr(float(unit * x)) for x in point) for point in mesh.p.T]
    sections = {
        "MeshFormat": ["4.1 0 8"],
        "PhysicalNames": [str(len(names)), *names],
        "Entities": [f"0 0 {len(surfaces)} {len(volumes)}", *entities],
        "Nodes": [f"1 {n} 1 {n}", f"3 {len(entities)} 0 {n}", *map(str, range(1, n + 1)), *points],
        "Elements": [f"{len(entities)} {count} 1 {count}", *elements],
    }
    return "".join(f"${name}\n{chr(10).join(lines)}\n$End{name}\n" for name, lines in sections.items())
