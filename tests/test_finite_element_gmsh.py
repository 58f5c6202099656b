"""A gmsh file is a mesh of the device that it is said to be of, in metres, or is refused in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from toys.gmsh_file import coarse_tetrahedra, gmsh_text
from toys.synthetic_recordings import supplement

from bayeskin.errors import InputError
from bayeskin.finite_element.gmsh import read_gmsh
from bayeskin.finite_element.mesh import BOUNDARIES
from bayeskin.geometry import Geometry, Guard

FLAT = Geometry(arm_radius_m=None)
BARE = Geometry(guard=None, arm_radius_m=None)


def written(folder: Path, geometry: Geometry = FLAT, **wrong: object) -> Path:
    path = folder / "skin.msh"
    path.write_text(gmsh_text(coarse_tetrahedra(geometry), **wrong))
    return path


@pytest.mark.parametrize("geometry", [FLAT, BARE, Geometry(cutis_m=3e-3, arm_radius_m=None)])
@pytest.mark.parametrize("first", [None, "everything"])
def test_a_file_gives_the_mesh_that_it_was_written_from(geometry, first, tmp_path):
    """Also where each surface carries another name before its own."""
    mesh, read = coarse_tetrahedra(geometry), read_gmsh(written(tmp_path, geometry, first=first), geometry)
    assert read.lengths == geometry

    def middles(either, cells):
        return {
            tuple(np.round(1e9 * middle).astype(int)) for middle in either.geometry.p[:, cells].mean(axis=1).T
        }

    for name in BOUNDARIES:
        sides = [either.geometry.facets[:, either.facets[name]] for either in (mesh, read)]
        assert middles(mesh, sides[0]) == middles(read, sides[1]), name
    assert middles(mesh, mesh.geometry.t[:, mesh.cutis]) == middles(read, read.geometry.t[:, read.cutis])


@pytest.mark.parametrize(
    ("asked", "wrong", "says"),
    [
        (FLAT, {"unit": 1e3}, "a length of 105, so its unit is probably millimetres"),
        (FLAT, {"layers": ("everything", "top_layer")}, "tetrahedra belong to no layer or to both layers"),
        (
            FLAT,
            {"layers": ("top_layer", "bottom_layer")},
            "bottom_layer: the mesh extends over z 8 to 10 mm; the device and the tissue require z 0 to 8",
        ),
        (
            Geometry(gauge_m=38e-3, arm_radius_m=None),
            {},
            "right_patch: the mesh extends over x 18 to 26 mm; the device and the tissue require x 19 to 27",
        ),
        (
            Geometry(pad_length_m=9e-3, arm_radius_m=None),
            {},
            "right_patch: the mesh extends over x 18 to 26 mm",
        ),
        (
            Geometry(pad_width_m=10e-3, arm_radius_m=None),
            {},
            "right_patch: the mesh extends over y 0 to 4 mm; the device and the tissue require y 0 to 5",
        ),
        (
            Geometry(guard=Guard(2e-3), arm_radius_m=None),
            {},
            "u_right: the mesh extends over x 18 to 35 mm; the device and the tissue require x 18 to 36",
        ),
        (BARE, {}, "u_right: the mesh has a guard"),
        (
            Geometry(cutis_m=2.3e-3, arm_radius_m=None),
            {},
            "top_layer: the mesh extends over z 8 to 10 mm; the device and the tissue require z 8 to 10.3",
        ),
        (
            Geometry(subcutis_m=9e-3, arm_radius_m=None),
            {},
            "bottom_layer: the mesh extends over z 0 to 8 mm; the device and the tissue require z 0 to 9",
        ),
        (FLAT, {"first": "right_patch"}, "u_right: some of its triangles also belong to right_patch"),
    ],
)
def test_a_mesh_of_something_else_is_refused_in_one_line(asked, wrong, says, tmp_path):
    with pytest.raises(InputError) as caught:
        read_gmsh(written(tmp_path, **wrong), asked)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_article_s_mesh_is_one_of_its_device_only():
    path = supplement("data/Mesh_SKIN.msh")
    assert read_gmsh(path).lengths == Geometry()
    with pytest.raises(InputError, match=r"top_layer: .* z 8 to 10 mm; .* z 8 to 11 mm"):
        read_gmsh(path, Geometry(cutis_m=3e-3))
