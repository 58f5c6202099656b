"""Meshes and the specification of a run: geometry that is known, files that are wrong."""

from __future__ import annotations

import numpy as np
import pytest
from toys.synthetic_recordings import supplement

from bayeskin.errors import InputError
from bayeskin.finite_element import ModelSpec, simulate
from bayeskin.finite_element.bricks import brick_lines
from bayeskin.finite_element.gmsh import read_gmsh
from bayeskin.finite_element.mesh import brick_mesh, roll, unroll
from bayeskin.finite_element.problem import build_problem
from bayeskin.types import PadMotion

STILL = PadMotion(np.array([0.0, 1.0]), np.zeros(2))
THETA = {"E_c": 6e4, "E_s": 2e4, "k_c": 1e-14, "k_s": 5e-13, "p_init": 700.0}


def test_rolling_keeps_arc_lengths_and_radii():
    flat = np.random.default_rng(0).uniform(0, 1, (3, 50)) * np.array([[0.105], [0.084], [0.01]])
    x, y, z = roll(flat, 48e-3)
    np.testing.assert_allclose(np.hypot(y, z), 48e-3 + flat[2], rtol=1e-14)
    np.testing.assert_allclose(np.arctan2(y, z) * np.hypot(y, z), flat[1], atol=1e-16)
    np.testing.assert_array_equal(x, flat[0])
    np.testing.assert_allclose(unroll(roll(flat, 48e-3), 48e-3), flat, atol=1e-16)
    np.testing.assert_array_equal(roll(flat, None), flat)


def test_bricks_are_refined_beside_the_pads_edges_only():
    assert brick_mesh(1).geometry.nelements == 448
    assert brick_mesh(2).geometry.nelements == 1540
    edges_m = (1e-3 * np.array([18, 26, 27, 35]), 1e-3 * np.array([4, 5, 12]), 1e-3 * np.array([10]))
    for coarse, fine, edges in zip(brick_lines(1), brick_lines(3), edges_m, strict=True):
        assert np.isin(edges, coarse).all()
        assert np.isin(coarse, fine).all()
        new = np.setdiff1d(fine, coarse)
        nearest = np.abs(new[:, None] - edges).min(axis=1)
        assert len(new)
        assert nearest.max() <= 0.25 * np.diff(coarse).max()


def test_bricks_have_the_rolled_volume_pads_and_layers():
    """Rolling keeps arc length at every depth, so the volume of each layer is that of the flat one."""
    mesh = brick_mesh(2)
    problem = build_problem(mesh)
    cells = problem.space.weight.sum(axis=1)
    assert cells[mesh.cutis].sum() == pytest.approx(0.105 * 0.084 * 0.002, rel=2e-3)
    assert cells[~mesh.cutis].sum() == pytest.approx(0.105 * 0.084 * 0.008, rel=2e-3)
    x, y, z = problem.space.points_u[:, problem.pad]
    radius = np.hypot(y, z)
    np.testing.assert_allclose(radius, 58e-3, rtol=1e-12)
    assert (x.min(), x.max()) == pytest.approx((18e-3, 26e-3))
    assert (np.arctan2(y, z) * radius).max() == pytest.approx(4e-3)
    assert not set(problem.pad) & (set(problem.pads) - set(problem.pad))


def test_articles_mesh_has_its_counts_and_nearly_our_volume():
    mesh = read_gmsh(supplement("data/Mesh_SKIN.msh"))
    assert mesh.geometry.nelements == 9456
    assert build_problem(mesh).space.dofs == 46133
    weight = build_problem(mesh).space.weight.sum()
    assert weight == pytest.approx(0.105 * 0.084 * 0.01, rel=5e-3)


@pytest.mark.parametrize(
    ("content", "expected"),
    [(b"", "gmsh"), (b"not a mesh\n", "gmsh"), (b"$MeshFormat\n4.1 0 8\n$EndMeshFormat\n", "gmsh|names")],
)
def test_a_file_that_is_no_mesh_is_one_line(tmp_path, content, expected):
    path = tmp_path / "bad.msh"
    path.write_bytes(content)
    with pytest.raises(InputError, match=expected) as caught:
        read_gmsh(path)
    assert "\n" not in str(caught.value)


def test_a_mesh_without_the_named_boundaries_says_which(tmp_path):
    import meshio

    path = tmp_path / "unnamed.msh"
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    tags = {"gmsh:physical": [np.array([1])], "gmsh:geometrical": [np.array([1])]}
    meshio.write(path, meshio.Mesh(points, [("tetra", [[0, 1, 2, 3]])], cell_data=tags), file_format="gmsh")
    with pytest.raises(InputError, match="right_patch"):
        read_gmsh(path)


def test_a_missing_mesh_and_articles_force_on_bricks_are_refused():
    with pytest.raises(InputError, match="no such file"):
        read_gmsh("nowhere.msh")
    with pytest.raises(InputError, match="article"):
        ModelSpec("article")


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"E_c": -1.0}, "E_c"),
        ({"k_s": float("nan")}, "k_s"),
        ({"E_x": 1.0}, "E_x"),
        ({"p_init": np.inf}, "p_init"),
    ],
)
def test_parameters_that_cannot_be_are_named(change, named):
    with pytest.raises(InputError, match=named):
        simulate(ModelSpec(), STILL, THETA | change)


def test_at_rest_the_initial_pressure_is_gone_and_no_force_appears():
    simulation = simulate(ModelSpec(), STILL, THETA)
    assert simulation.status == "ok"
    assert np.abs(simulation.force_n).max() < 1e-6


def test_an_impossible_stretch_is_a_failed_run_with_a_remedy():
    torn = PadMotion(np.array([0.0, 1.0]), np.array([0.0, -200.0]))
    simulation = simulate(ModelSpec(), torn, THETA)
    assert simulation.status == "failed"
    assert "t = " in simulation.message
    assert "try" in simulation.message
    assert np.isfinite(simulation.force_n).all()


def test_hash_depends_on_what_the_force_depends_on():
    base = ModelSpec().hash
    assert ModelSpec().hash == base
    assert len({base, ModelSpec(refinement=2).hash, ModelSpec(tolerance=1e-4).hash}) == 3
