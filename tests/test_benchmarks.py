"""Parts of the benchmarks: rows that survive a crash, meshes, the pad's stress, scores of surrogates."""

from __future__ import annotations

import importlib
import sys

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from bayeskin import storage
from bayeskin.finite_element.problem import build_problem
from bayeskin.shipped import shipped
from bayeskin.surrogates import load_surrogate
from bayeskin.surrogates.shapes import split
from bayeskin.types import Design, Simulation


def test_a_row_is_found_by_its_inputs_and_a_line_cut_short_is_no_row(benchmark, tmp_path):
    rows = benchmark("rows").Rows(tmp_path / "rows.csv", ("point", "tolerance"), ("error", "message"))
    rows.append(point="A", tolerance=1e-3, error=0.5, message='said "no, never"')
    with open(rows.path, "a") as handle:
        handle.write("B,0.0")
    assert rows.find(point="B", tolerance=1e-3) is None
    rows.append(point="B", tolerance=1e-3, error=0.25, message="")
    assert rows.find(point="A", tolerance=1e-3)["message"] == 'said "no, never"'
    assert rows.find(point="B", tolerance=1e-3)["error"] == "0.25"
    assert len(rows.read()) == 2


def test_halved_bricks_have_every_line_and_the_middles(benchmark):
    skin = benchmark("healthy_skin")
    for axis, halved in zip(skin.brick_lines(2), skin.halved_lines(2), strict=True):
        np.testing.assert_allclose(halved[::2], axis)
        np.testing.assert_allclose(halved[1::2], 0.5 * (axis[1:] + axis[:-1]))


def test_face_stress_at_rest_is_minus_the_pressure_times_the_pads_area(benchmark):
    skin, study = benchmark("healthy_skin"), benchmark("discretisation_study")
    mesh = importlib.import_module("bayeskin.finite_element.mesh").brick_mesh()
    problem = build_problem(mesh)
    x = np.zeros(problem.space.dofs)
    x[3 * problem.space.n_nodes :] = 700.0
    face = study.FaceStress(problem, skin.POINTS["C"])
    assert face.force_n(x) == pytest.approx(-700.0 * 8e-3 * 4e-3, rel=1e-6)


def test_face_stress_of_a_uniform_strain_is_the_laws(benchmark):
    skin, study = benchmark("healthy_skin"), benchmark("discretisation_study")
    mesh = importlib.import_module("bayeskin.finite_element.mesh").brick_mesh()
    problem = build_problem(mesh)
    f = np.array([[1.2, 0.1, 0.05], [0.0, 0.95, 0.0], [0.02, 0.0, 1.05]])
    x = np.zeros(problem.space.dofs)
    x[: 3 * problem.space.n_nodes] = ((f - np.eye(3)) @ problem.space.points_u).T.ravel()
    e, nu, j = 684e3, 0.48, np.linalg.det(f)
    mu, lam = e / (2 * (1 + nu)), e * nu / ((1 + nu) * (1 - 2 * nu))
    stress = (mu * (f @ f.T - np.eye(3)) + lam * np.log(j) * np.eye(3)) / j
    face = study.FaceStress(problem, skin.POINTS["C"])
    assert face.force_n(x) == pytest.approx(stress[0, 0] * 8e-3 * 4e-3, rel=1e-6)


def test_error_of_a_scaled_history_is_gone_after_one_factor(benchmark):
    study = benchmark("discretisation_study")
    time_s = np.linspace(0.0, 10.0, 51)

    def history(force_n):
        return Simulation({}, time_s, time_s, force_n, np.zeros(51, bool), "ok", "", {}, "")

    error = study.error(history(1.02 * time_s), history(time_s))
    assert error.largest == pytest.approx(0.02)
    assert error.rms == pytest.approx(0.02 * np.sqrt(1 / 3), rel=1e-2)
    assert error.scale == pytest.approx(1 / 1.02)
    assert error.rms_scaled < 1e-12


def test_the_tolerance_chosen_is_the_loosest_below_which_all_are_good(benchmark):
    study = benchmark("discretisation_tables")
    rms = {1e-1: 1e-4, 1e-2: 9e-4, 1e-3: 2e-4, 1e-4: 1e-5}  # the loosest is good by chance
    errors = {(t, "A"): study.Error(e, e, 1.0, 1.0, e) for t, e in rms.items()}
    assert study.choose(errors, 5e-4) == 1e-3
    assert study.choose(errors | {(1e-4, "B"): errors[1e-4, "A"]}, 5e-4) == 1e-4  # of B only the tightest ran


def test_the_peers_likelihood_is_the_normal_with_their_covariance(benchmark):
    peers, rng = benchmark("surrogate_peers"), np.random.default_rng(1)
    residual, factor = 0.02 * rng.normal(size=(3, 8)), 0.02 * rng.normal(size=(3, 2, 8))
    computed = peers.log_likelihood(residual, factor)
    for i in range(3):
        covariance = factor[i].T @ factor[i] + peers.NOISE_N**2 * np.eye(8)
        exact = multivariate_normal(np.zeros(8), covariance).logpdf(residual[i])
        assert computed[i] == pytest.approx(exact, rel=1e-10)
    plain = multivariate_normal(np.zeros(8), peers.NOISE_N**2 * np.eye(8)).logpdf(residual)
    np.testing.assert_allclose(peers.log_likelihood(residual, None), plain, rtol=1e-10)


def test_nats_left_by_a_factor_are_those_of_its_covariance(benchmark):
    components, rng = benchmark("components"), np.random.default_rng(5)
    error = 2e-3 * rng.standard_normal(20)
    factor, diagonal = 1e-3 * rng.standard_normal((20, 3)), 1e-6 * rng.uniform(size=20)
    covariance = factor @ factor.T + np.diag(diagonal + components.NOISE_N**2)
    expected = 0.5 * error @ np.linalg.solve(covariance, error)
    assert components.unexplained(error, factor, diagonal) == pytest.approx(expected, rel=1e-10)


def test_a_surrogate_cut_to_fewer_components_calls_the_rest_noise_of_bins(benchmark):
    components, whole = benchmark("components"), load_surrogate(shipped("surrogates/demo.h5"))
    design = storage.load(shipped("surrogates/demo-design.h5"), Design)
    shapes, theta = split(design.force_n[design.training])[1], design.theta[:5]
    count = len(whole.transform.components)
    same, fewer = (components.cut(whole, k, shapes).predict(theta) for k in (count, count - 3))
    np.testing.assert_allclose(same.mean, whole.predict(theta).mean, rtol=1e-9)
    assert fewer.factor.shape[2] == same.factor.shape[2] - 3
    assert np.all(fewer.diagonal.mean(axis=1) > same.diagonal.mean(axis=1))


def test_a_package_that_is_absent_costs_one_line(benchmark, capsys):
    assert benchmark("surrogate_benchmark").peer_rows("no_such_package", sys.executable) == []
    assert capsys.readouterr().out.count("\n") == 1
