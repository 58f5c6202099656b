"""The displacement of points on the surface, in the full and in the reduced model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import skfem

from bayeskin.errors import InputError
from bayeskin.finite_element.gradients import logarithms
from bayeskin.finite_element.mesh import brick_lines, layered_mesh
from bayeskin.finite_element.problem import build_problem
from bayeskin.finite_element.simulate import ModelSpec, problem_of, simulate
from bayeskin.finite_element.surface_points import SurfaceTracks, half_extent, surface_displacement
from bayeskin.geometry import Geometry
from bayeskin.mechanisms import catalogue
from bayeskin.reduced.files import load_reduced
from bayeskin.reduced.surface import SurfaceRun, simulate_surface
from bayeskin.shipped import shipped
from bayeskin.types import Array, PadMotion

FLAT = replace(Geometry(), arm_radius_m=None)
MOTION = PadMotion(np.array([0.0, 2.0, 5.0, 15.0]), 1e-3 * np.array([0.0, 0.0, 6.0, 6.0]))
SKIN = {"E_c": 200e3, "E_s": 30e3, "k_c": 1e-14, "k_s": 1e-13, "p_init": 300.0}
PLACES_M = 1e-3 * np.array([[-12.0, 3.0], [12.0, 3.0], [-12.0, -3.0], [0.0, -6.5], [9.5, 0.25], [14.0, 7.0]])
AT_S = np.array([0.0, 3.0, 4.5, 5.0, 8.0, 15.0])


def anywhere(lengths: Geometry, count: int = 300) -> Array:
    return np.random.default_rng(0).uniform(-1.0, 1.0, (count, 2)) * half_extent(lengths)


@pytest.mark.parametrize("lengths", [Geometry(), FLAT])
def test_a_field_that_is_linear_in_the_places_is_exact(lengths: Geometry) -> None:
    problem, places_m = problem_of("bricks", 0, lengths), anywhere(lengths)
    x = np.zeros(problem.space.dofs)
    x[0 : 3 * problem.space.n_nodes : 3] = 0.1 * problem.space.points_u[0]
    x[1 : 3 * problem.space.n_nodes : 3] = 0.2 * problem.space.points_u[1]
    moved_m = (surface_displacement(problem, places_m) @ x).reshape(-1, 2)
    np.testing.assert_allclose(moved_m, places_m * [0.1, 0.2], atol=1e-15)


def test_any_field_is_as_another_interpolation_gives_it() -> None:
    mesh = layered_mesh(brick_lines(0, FLAT), "tetrahedra", tetrahedra=True, geometry=FLAT)
    problem = build_problem(mesh)
    places_m = np.abs(anywhere(FLAT, 40))
    x = np.random.default_rng(1).standard_normal(problem.space.dofs)
    basis = skfem.Basis(mesh.geometry, skfem.ElementTetP2())
    points = np.vstack([places_m.T, np.full(len(places_m), FLAT.thickness_m * (1.0 - 1e-12))])
    probes = basis.probes(points)
    expected = np.stack([probes @ x[i : 3 * problem.space.n_nodes : 3] for i in range(2)], axis=1)
    moved = (surface_displacement(problem, places_m) @ x).reshape(-1, 2)
    np.testing.assert_allclose(moved, expected, atol=1e-7)


def test_a_point_outside_the_skin_is_refused_in_one_line() -> None:
    problem = problem_of("bricks", 0, Geometry())
    across_m = half_extent(Geometry())[1]
    assert across_m < Geometry().box_m[1]  # the camera sees the projection of the arc
    with pytest.raises(InputError, match=r"x 0 mm, y 57.* mm is outside the skin"):
        surface_displacement(problem, np.array([[0.0, 0.0], [0.0, 1.001 * across_m]]))


@pytest.fixture(scope="module")
def by_parameters() -> SurfaceRun:
    return run_of(SKIN, logarithms(SKIN))


def run_of(
    theta: dict[str, float], by: dict[str, float] | None = None, names: tuple[str, ...] = ()
) -> SurfaceRun:
    model = load_reduced(shipped("surrogates/article-device-reduced.h5"))
    known = catalogue()
    return simulate_surface(model, MOTION, theta, [known[n] for n in names], by, PLACES_M, AT_S, 0.15)


def test_the_skin_moves_as_symmetry_and_the_pads_demand(by_parameters: SurfaceRun) -> None:
    moved_m = by_parameters.displacement_m
    assert moved_m is not None
    np.testing.assert_allclose(moved_m[:, 0], moved_m[:, 1] * [-1.0, 1.0], atol=1e-15)
    np.testing.assert_allclose(moved_m[:, 0], moved_m[:, 2] * [1.0, -1.0], atol=1e-15)
    np.testing.assert_allclose(moved_m[:, 3, 0], 0.0, atol=1e-12)  # the point is on the plane of symmetry
    assert 1.5e-3 < moved_m[3, 1, 0] < 3e-3  # near a pad, which moves by 3 mm
    assert moved_m[3, 1, 1] < -1e-4  # skin that is pulled becomes narrower


@pytest.mark.parametrize("name", ["E_c", "E_s", "k_s"])
def test_derivatives_are_those_of_two_runs(by_parameters: SurfaceRun, name: str) -> None:
    step = 0.01
    ends = [run_of({**SKIN, name: SKIN[name] * (1.0 + way * step)}).displacement_m for way in (1, -1)]
    by_two_runs = (ends[0] - ends[1]) / (2.0 * step)
    slopes_m = by_parameters.slopes_m
    assert slopes_m is not None
    by_tangent = slopes_m[..., list(logarithms(SKIN)).index(name)]
    np.testing.assert_allclose(by_tangent, by_two_runs, atol=0.01 * np.abs(by_two_runs).max())


@pytest.mark.slow
def test_derivatives_by_a_length_include_the_moved_nodes() -> None:
    theta, step = {**SKIN, "cutis_m": 2e-3}, 0.02
    ends = [run_of({**theta, "cutis_m": 2e-3 * (1.0 + way * step)}).displacement_m for way in (1, -1)]
    by_two_runs = (ends[0] - ends[1]) / (2.0 * step)
    slopes_m = run_of(theta, {"cutis_m": 2e-3}).slopes_m
    assert slopes_m is not None
    np.testing.assert_allclose(slopes_m[..., 0], by_two_runs, atol=0.03 * np.abs(by_two_runs).max())


@pytest.mark.slow
def test_the_reduced_model_moves_the_points_as_the_full_model(by_parameters: SurfaceRun) -> None:
    tracks = SurfaceTracks(surface_displacement(problem_of("bricks", 1), PLACES_M))
    simulation = simulate(ModelSpec(), MOTION, SKIN, on_state=tracks.on_state)
    error_m = tracks.since_first(simulation, AT_S) - by_parameters.displacement_m
    assert np.sqrt(np.mean(error_m**2)) < 3e-6
