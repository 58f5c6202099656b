"""Fields for ParaView: values known at rest and in a uniform stretch, files that meshio reads back."""

from __future__ import annotations

import contextlib

import meshio
import numpy as np
import pytest

from bayeskin.model.fields import FieldWriter, fields_of
from bayeskin.model.problem import material
from bayeskin.model.simulate import problem_of

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
    points = np.zeros((space.n_corners, 3))
    points[space.nodes_p] = space.points_u.T[space.nodes_u[:, :8]]
    x[3 * space.n_nodes :] = 1e5 * points[:, 0]
    rate[0 : 3 * space.n_nodes : 3] = 2e-3
    fields = fields_of(problem, THETA, x, rate)
    for layer, k, porosity in ((problem.mesh.cutis, 1e-14, 0.2), (~problem.mesh.cutis, 5e-13, 0.4)):
        expected = 2e-3 - k / (5e-3 * porosity) * 1e5
        np.testing.assert_allclose(fields.fluid_velocity[layer][:, 0], expected, rtol=1e-9)


def test_the_series_is_read_back_with_its_times_and_volume(problem, tmp_path):
    writer = FieldWriter(tmp_path / "fields", problem, THETA)
    for time_s in (0.0, 1.0, 2.5):
        writer.on_state(time_s, stretched(problem, np.diag([0.1 * time_s, 0, 0])), 0.0)
    path = writer.write()
    with contextlib.chdir(path.parent), meshio.xdmf.TimeSeriesReader(path.name) as reader:
        points, cells = reader.read_points_cells()
        times, last = zip(
            *[(t, p) for t, p, _ in map(reader.read_data, range(reader.num_steps))], strict=True
        )
    assert list(times) == [0.0, 1.0, 2.5]
    np.testing.assert_allclose(last[-1]["displacement"][:, 0], 0.25 * points[:, 0], atol=1e-15)
    corner = points[cells[0].data]
    a, b, c = (corner[:, k] - corner[:, 0] for k in (1, 3, 4))
    assert np.all(np.einsum("ei,ei->e", np.cross(a, b), c) > 0), "VTK wants right-handed bricks"
