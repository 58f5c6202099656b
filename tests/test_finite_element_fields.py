"""Fields: values known at rest and in a uniform stretch, files that meshio reads back, suction and reflux."""

from __future__ import annotations

import contextlib
import logging

import meshio
import numpy as np
import pytest
from toys.synthetic_recordings import supplement

from bayeskin.finite_element.fields import FieldWriter, StatesAt, fields_of
from bayeskin.finite_element.gmsh import read_gmsh
from bayeskin.finite_element.mesh import layered_mesh
from bayeskin.finite_element.problem import build_problem, material
from bayeskin.finite_element.simulate import ModelSpec, problem_of, simulate
from bayeskin.finite_element.surface import PARTS, divided_triangle, seen_surface, surface_state
from bayeskin.geometry import Geometry
from bayeskin.types import PadMotion

THETA = {"E_c": 6e4, "E_s": 2e4, "k_c": 1e-14, "k_s": 5e-13, "p_init": 0.0}


@pytest.fixture(scope="module")
def problem():
    return problem_of("bricks", 1)


def stretched(problem, gradient, pressure=0.0):
    x = np.zeros(problem.space.dofs)
    n = 3 * problem.space.n_nodes
    x[:n] = (gradient @ problem.space.points_u).T.ravel()
    x[n:] = pressure
    return x


def test_at_rest_the_porosities_are_the_articles_and_nothing_moves(problem):
    x = np.zeros(problem.space.dofs)
    fields = fields_of(problem, THETA, x, x)
    np.testing.assert_allclose(fields.porosity, np.where(problem.mesh.cutis, 0.2, 0.4))
    assert np.abs(fields.effective_stress).max() == 0
    assert np.abs(fields.fluid_velocity).max() == 0


def test_in_a_uniform_stretch_stress_and_porosity_are_the_closed_forms(problem):
    gradient = np.diag([0.2, -0.05, 0.0])
    fields = fields_of(problem, THETA, stretched(problem, gradient, 100.0), np.zeros(problem.space.dofs))
    f = np.eye(3) + gradient
    j = np.linalg.det(f)
    cells = material(THETA, problem.mesh.cutis)
    for cell in (0, int(np.flatnonzero(problem.mesh.cutis)[0])):
        mu, lam = cells.mu[cell], cells.lam[cell]
        expected = (mu * (f @ f.T - np.eye(3)) + lam * np.log(j) * np.eye(3)) / j
        np.testing.assert_allclose(fields.effective_stress[cell], expected, rtol=1e-9, atol=1e-6)
        np.testing.assert_allclose(
            fields.total_stress[cell], expected - 100 * np.eye(3), rtol=1e-9, atol=1e-6
        )
        initial = 0.2 if problem.mesh.cutis[cell] else 0.4
        assert fields.porosity[cell] == pytest.approx(1 - (1 - initial) / j)


def test_fluid_runs_down_the_pressure_gradient_relative_to_the_solid(problem):
    space = problem.space
    x, rate = np.zeros(space.dofs), np.zeros(space.dofs)
    x[3 * space.n_nodes :] = 1e5 * corners_of(problem)[:, 0]
    rate[0 : 3 * space.n_nodes : 3] = 2e-3
    fields = fields_of(problem, THETA, x, rate)
    for layer, k, porosity in ((problem.mesh.cutis, 1e-14, 0.2), (~problem.mesh.cutis, 5e-13, 0.4)):
        expected = 2e-3 - k / (5e-3 * porosity) * 1e5
        np.testing.assert_allclose(fields.fluid_velocity[layer][:, 0], expected, rtol=1e-9)


@pytest.mark.parametrize("tetrahedra", [False, True])
def test_the_solid_s_velocity_is_its_mean_over_a_cell(tetrahedra):
    """Quadratic over the depth, on straight cells, whose means are known from their corners."""
    lines = [np.array(axis) for axis in ([0.0, 0.01, 0.03], [0.0, 0.02], [0.0, 0.004, 0.01])]
    flat = Geometry(cutis_m=6e-3, subcutis_m=4e-3, arm_radius_m=None)
    mesh = layered_mesh(lines, "straight", tetrahedra, flat)
    problem = build_problem(mesh)
    space = problem.space
    z = space.points_u[2]
    x, rate = np.zeros(space.dofs), np.zeros(space.dofs)
    rate[2 : 3 * space.n_nodes : 3] = z**2
    corners = z[space.nodes_u[:, : 4 if tetrahedra else 8]]
    computed = fields_of(problem, THETA, x, rate).fluid_velocity[:, 2]
    if tetrahedra:  # the mean of a product of linear functions over a simplex
        expected = (corners.sum(axis=1) ** 2 + (corners**2).sum(axis=1)) / 20
    else:
        low, high = corners.min(axis=1), corners.max(axis=1)
        expected = (low**2 + low * high + high**2) / 3
    np.testing.assert_allclose(computed, expected, rtol=1e-6)


def corners_of(problem):
    """Vertices (c, 3) of the undeformed mesh, in the order of the pressures."""
    space = problem.space
    points = np.zeros((space.n_corners, 3))
    points[space.nodes_p] = space.points_u.T[space.nodes_u[:, :8]]
    return points


def test_the_series_is_read_back_with_its_times_displacements_and_pressures(problem, tmp_path):
    writer = FieldWriter(tmp_path / "fields", problem, THETA)
    gradient, corners = np.array([[0.1, 0, 0.02], [0, -0.03, 0], [0, 0, -0.04]]), corners_of(problem)
    pressure = 1e4 * corners[:, 0] - 2e4 * corners[:, 1]
    for time_s in (0.0, 1.0, 2.5):
        writer.on_state(time_s, stretched(problem, time_s * gradient, time_s * pressure), 0.0)
    assert not (tmp_path / "fields").exists(), "a run that fails leaves no folder"
    paths = writer.write()
    assert sorted((tmp_path / "fields").iterdir()) == sorted(paths)
    with contextlib.chdir(paths[0].parent), meshio.xdmf.TimeSeriesReader(paths[0].name) as reader:
        points, _ = reader.read_points_cells()
        steps = [reader.read_data(k) for k in range(reader.num_steps)]
    assert [time_s for time_s, _, _ in steps] == [0.0, 1.0, 2.5]
    to_ours = np.array([np.abs(corners - point).sum(axis=1).argmin() for point in points])
    np.testing.assert_allclose(corners[to_ours], points, atol=1e-12)
    for time_s, at_points, at_cells in steps:
        np.testing.assert_allclose(at_points["displacement"], time_s * points @ gradient.T, atol=1e-12)
        np.testing.assert_allclose(at_points["pressure"], time_s * pressure[to_ours], atol=1e-9)
        np.testing.assert_array_equal(at_cells["cutis"][0], problem.mesh.cutis)
    effective, total = (
        steps[-1][2][name][0].reshape(-1, 3, 3) for name in ("effective_stress", "total_stress")
    )
    assert np.ptp(effective[:, 0, 0]) > 0
    np.testing.assert_allclose((effective - total)[:, 0, 1], 0.0, atol=1e-9)


def test_paraview_s_reader_reads_the_series(problem, tmp_path):
    """VTK contains the XDMF reader of ParaView."""
    vtk = pytest.importorskip("vtk", reason="VTK is not installed: pip install vtk")
    numpy_support = pytest.importorskip("vtk.util.numpy_support")
    writer = FieldWriter(tmp_path, problem, THETA)
    gradient = np.array([[0.1, 0, 0.02], [0, -0.03, 0], [0, 0, -0.04]])
    for time_s in (0.0, 1.0, 2.5):
        writer.on_state(time_s, stretched(problem, time_s * gradient, 1e4 * time_s), 0.0)
    reader = vtk.vtkXdmfReader()
    reader.SetFileName(str(writer.write()[0]))
    reader.UpdateInformation()
    key = vtk.vtkStreamingDemandDrivenPipeline.TIME_STEPS()
    assert reader.GetOutputInformation(0).Get(key) == (0.0, 1.0, 2.5)
    reader.UpdateTimeStep(2.5)
    grid = reader.GetOutput().GetBlock(0)
    points = numpy_support.vtk_to_numpy(grid.GetPoints().GetData())
    of_points, of_cells = grid.GetPointData(), grid.GetCellData()
    displacement = numpy_support.vtk_to_numpy(of_points.GetArray("displacement"))
    np.testing.assert_allclose(displacement, 2.5 * points @ gradient.T, atol=1e-9)
    np.testing.assert_allclose(numpy_support.vtk_to_numpy(of_points.GetArray("pressure")), 2.5e4, rtol=1e-6)
    cutis = numpy_support.vtk_to_numpy(of_cells.GetArray("cutis"))
    np.testing.assert_array_equal(cutis.astype(bool), problem.mesh.cutis)


def test_bricks_of_the_series_are_not_turned_inside_out_in_vtk_order(problem, tmp_path):
    writer = FieldWriter(tmp_path, problem, THETA)
    writer.on_state(0.0, np.zeros(problem.space.dofs), 0.0)
    path, _ = writer.write()
    with contextlib.chdir(path.parent), meshio.xdmf.TimeSeriesReader(path.name) as reader:
        points, cells = reader.read_points_cells()
    corner = points[cells[0].data]  # VTK: 0 1 2 3 around the bottom, 4 5 6 7 above them
    local = np.array([[-1, 1, 1, -1, -1, 1, 1, -1], [-1, -1, 1, 1, -1, -1, 1, 1], [-1] * 4 + [1] * 4]).T
    gauss, volume = local / np.sqrt(3), np.zeros(len(corner))
    for at in np.vstack([local, gauss]):  # trilinear shape functions at corners and Gauss points
        factor = 1 + local * at
        slope = local * np.stack(
            [factor[:, 1] * factor[:, 2], factor[:, 0] * factor[:, 2], factor[:, 0] * factor[:, 1]], axis=1
        )
        jacobian = np.linalg.det(np.einsum("eci,cj->eij", corner, slope / 8))
        assert jacobian.min() > 0
        volume += jacobian * bool(np.any(np.all(at == gauss, axis=1)))
    assert volume.sum() == pytest.approx(0.105 * 0.084 * 0.01, rel=0.05)  # straight edges across the arc


def test_states_at_chosen_times_are_linear_between_steps(problem):
    states = StatesAt((0.0, 0.5, 2.0, 2.5, 9.0), problem, 700.0)
    start, end = np.zeros(problem.space.dofs), np.ones(problem.space.dofs)
    start[3 * problem.space.n_nodes :] = 700.0
    states.on_state(1.0, end, 0.0)  # the article's formulation does not report its start
    states.on_state(3.0, 3 * end, 0.0)
    for state, expected in zip(states.states, (start, 0.5 * (start + end), 2 * end, 2.5 * end), strict=True):
        np.testing.assert_allclose(state, expected)


def test_the_last_moment_is_kept_though_the_last_time_misses_it_by_rounding(problem):
    states = StatesAt((130.1,), problem, 0.0)
    end = np.ones(problem.space.dofs)
    states.on_state((1e6 + 130.1) - 1e6, end, 0.0)
    np.testing.assert_allclose(states.states, [end])


# --- the surface near the pads ---------------------------------------------------------------------


@pytest.fixture(scope="module")
def surface(problem):
    return seen_surface(problem)


def area_mm2(corners):
    """Areas of flat faces (f, 3 or 4, 3) [m]."""
    halves = [(1, 2), (2, 3)] if corners.shape[1] == 4 else [(1, 2)]
    sides = corners - corners[:, :1]
    return 1e6 * sum(0.5 * np.linalg.norm(np.cross(sides[:, a], sides[:, b]), axis=1) for a, b in halves)


def test_the_surface_has_the_areas_of_pads_and_layers(problem, surface):
    rest = surface_state(problem, THETA, surface, np.zeros(problem.space.dofs))
    area = area_mm2(rest.points_m[surface.faces])
    known = {"pad": 8 * 4, "guard": 17 * 7 + 8 * 5, "top": 65 * 38 - 32 - 159}
    for name, expected in known.items():
        assert area[surface.part == PARTS.index(name)].sum() == pytest.approx(expected, rel=2e-3)
    for layer, thickness in (("subcutis", 8), ("cutis", 2)):
        for plane, length in ((1, 65), (2, 38)):
            cut = (surface.plane == plane) & (surface.part == PARTS.index(layer))
            assert area[cut].sum() == pytest.approx(length * thickness, rel=2e-3)


def test_on_the_surface_fields_of_a_uniform_stretch_are_the_closed_forms(problem, surface):
    gradient, slope_pa_m = np.array([[0.2, 0.1, 0.0], [0.0, -0.05, 0.0], [-0.15, 0.0, 0.03]]), 2e5
    pressure = slope_pa_m * corners_of(problem)[:, 0]
    state = surface_state(problem, THETA, surface, stretched(problem, gradient, pressure))
    rest = surface_state(problem, THETA, surface, np.zeros(problem.space.dofs))
    corners = rest.points_m[surface.faces]
    np.testing.assert_allclose(state.points_m, rest.points_m @ (np.eye(3) + gradient).T, atol=1e-9)
    moved = np.linalg.norm(corners @ gradient.T, axis=-1).mean(axis=1)
    np.testing.assert_allclose(state.displacement_m, moved, atol=1e-9)
    np.testing.assert_allclose(state.pressure_pa, slope_pa_m * corners[..., 0].mean(axis=1), atol=1e-3)
    f = np.eye(3) + gradient
    j, slope = np.linalg.det(f), np.linalg.inv(f).T @ [slope_pa_m, 0.0, 0.0]
    for layer, k, initial in (("cutis", 1e-14, 0.2), ("subcutis", 5e-13, 0.4)):
        expected = -k / (5e-3 * (1 - (1 - initial) / j)) * slope
        inside = state.velocity_m_s[surface.part == PARTS.index(layer)]
        np.testing.assert_allclose(
            inside, np.tile(expected, (len(inside), 1)), atol=1e-6 * np.abs(expected).max()
        )


def test_small_triangles_of_a_tetrahedrons_facet_tile_it():
    points, triangles = divided_triangle(3)
    assert triangles.shape == (9, 3)
    corners = np.pad(points.T[triangles], ((0, 0), (0, 0), (0, 1)))
    np.testing.assert_allclose(area_mm2(corners), 1e6 * 0.5 / 9)
    assert np.unique(triangles).size == points.shape[1] == 10


def test_stretch_draws_fluid_in_front_of_the_pads_and_release_drives_it_back(problem, surface):
    """The article's reading of its fields: suction where the skin is stretched, reflux on release."""
    motion = PadMotion(np.array([0.0, 8.0, 20.0, 28.0]), 1e-3 * np.array([0.0, 8.0, 8.0, 0.0]))
    states = StatesAt((8.0, 20.0, 28.0), problem, 0.0)
    run = simulate(ModelSpec(tolerance=1e-2), motion, THETA, on_state=states.on_state)
    assert run.status == "ok"
    rest = surface_state(problem, THETA, surface, np.zeros(problem.space.dofs))
    x_mm = 1e3 * rest.points_m[surface.faces, 0].mean(axis=1)
    cut = surface.plane == 1
    ahead, below, behind = cut & (x_mm < 18), cut & (x_mm > 18) & (x_mm < 35), cut & (x_mm > 35)
    loaded, held, released = (surface_state(problem, THETA, surface, x) for x in states.states)
    for state in (loaded, held):
        assert state.pressure_pa[ahead].mean() < 0 < state.pressure_pa[behind].mean()
        assert state.velocity_m_s[below, 0].mean() < 0, "toward what is stretched"
    assert abs(held.pressure_pa).max() < abs(loaded.pressure_pa).max()
    assert released.pressure_pa[ahead].mean() > 0 > released.pressure_pa[behind].mean()
    assert released.velocity_m_s[below, 0].mean() > 0, "back, away from it"


def test_reading_a_mesh_warns_of_nothing(caplog):
    with caplog.at_level(logging.WARNING):
        read_gmsh(supplement("data/Mesh_SKIN.msh"))
    assert caplog.records == []
