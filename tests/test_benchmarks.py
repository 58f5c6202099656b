"""The benchmarks' own parts: rows that survive a crash, meshes, and the stress on the pad's face."""

from __future__ import annotations

import importlib
import json
import shutil
import sys
from functools import partial
from pathlib import Path

import arviz as az
import numpy as np
import pytest
import toy_inference
from scipy.integrate import cumulative_trapezoid
from scipy.stats import binom, multivariate_normal

from bayeskin import storage
from bayeskin.finite_element import ModelSpec
from bayeskin.finite_element.problem import build_problem
from bayeskin.inference import NoisePriors
from bayeskin.proof import score, seals
from bayeskin.proof.curves import curve
from bayeskin.recordings import read_recording
from bayeskin.shipped import shipped
from bayeskin.surrogates import load_surrogate
from bayeskin.surrogates.shapes import split
from bayeskin.types import Design, Recording, Simulation


@pytest.fixture
def benchmark(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
    return importlib.import_module


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

    found = study.error(history(1.02 * time_s), history(time_s))
    assert found.largest == pytest.approx(0.02)
    assert found.rms == pytest.approx(0.02 * np.sqrt(1 / 3), rel=1e-2)
    assert found.scale == pytest.approx(1 / 1.02)
    assert found.rms_scaled < 1e-12


def test_the_tolerance_chosen_is_the_loosest_below_which_all_are_good(benchmark):
    study = benchmark("discretisation_tables")
    rms = {1e-1: 1e-4, 1e-2: 9e-4, 1e-3: 2e-4, 1e-4: 1e-5}  # the loosest is good by chance
    errors = {(t, "A"): study.Error(e, e, 1.0, 1.0, e) for t, e in rms.items()}
    assert study.choose(errors, 5e-4) == 1e-3
    assert study.choose(errors | {(1e-4, "B"): errors[1e-4, "A"]}, 5e-4) == 1e-4  # of B only the tightest ran


def test_the_peers_likelihood_is_the_normal_with_their_covariance(benchmark):
    peers, rng = benchmark("surrogate_peers"), np.random.default_rng(1)
    residual, factor = 0.02 * rng.normal(size=(3, 8)), 0.02 * rng.normal(size=(3, 2, 8))
    found = peers.log_likelihood(residual, factor)
    for i in range(3):
        covariance = factor[i].T @ factor[i] + peers.NOISE_N**2 * np.eye(8)
        exact = multivariate_normal(np.zeros(8), covariance).logpdf(residual[i])
        assert found[i] == pytest.approx(exact, rel=1e-10)
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


def test_uniform_ranks_look_uniform_and_those_of_narrow_posteriors_do_not(benchmark):
    calibration, rng = benchmark("calibration"), np.random.default_rng(1)
    n, levels = 300, calibration.DRAWS + 1
    p_values = [calibration.uniformity(rng.integers(0, levels, n)) for _ in range(200)]
    assert 0.02 < np.mean(np.array(p_values) < 0.1) < 0.2
    z = rng.standard_normal(n)  # truth and draws of one law, the draws a third too narrow
    ranks = (0.67 * rng.standard_normal((n, calibration.DRAWS)) < z[:, None]).sum(axis=1)
    assert calibration.uniformity(ranks) < 1e-3


def test_ranks_and_intervals_are_those_of_the_draws(benchmark):
    calibration = benchmark("calibration")
    draws = np.tile(np.linspace(0.0, 1.0, 1001)[:, None], (1, len(calibration.NAMES)))
    theta = np.full(len(calibration.NAMES), 0.9)
    theta[0] = 0.3
    row = calibration.ranked(draws, theta, np.random.default_rng(0))
    assert (row["in50_E_c"], row["in90_E_c"]) == (True, True)
    assert (row["in50_E_s"], row["in90_E_s"]) == (False, True)
    assert row["rank_E_c"] == pytest.approx(30, abs=15)
    assert row["rank_E_s"] == pytest.approx(90, abs=10)


def test_a_recording_is_made_inferred_and_ranked_in_one_row(benchmark):
    calibration = benchmark("calibration")
    settings = calibration.SampleSettings(2, 24, 500, calibration.Limits())
    item = {"surrogate": calibration.surrogate_hash(), "data": "surrogate", "seed": 1, "index": 3}
    rows = [calibration.replicate(item, calibration.problem(), settings) for _ in range(2)]
    assert set(rows[0]) == set(calibration.ROWS.columns)
    assert {**rows[0], "cpu_s": 0} == {**rows[1], "cpu_s": 0}
    assert not rows[0]["trusted"]  # 40 steps, and it says so
    assert "needed" in rows[0]["reason"]
    assert 0.0 <= rows[0]["band50"] <= rows[0]["band90"] <= 1.0


def test_a_recording_of_the_full_model_is_near_the_surrogate_s(benchmark, monkeypatch):
    calibration = benchmark("calibration")
    monkeypatch.setattr(calibration, "ModelSpec", partial(ModelSpec, refinement=0))
    about = calibration.problem()
    middle = about.space.from_unit(np.full(about.dim, 0.5))
    force, expected = calibration.made_by_model(about, middle), about.predict(middle).mean[0]
    assert np.sqrt(np.mean((force - expected) ** 2)) < 0.05 * np.ptp(expected)


def test_the_page_of_mechanisms_has_the_catalogue_as_it_is(benchmark):
    page = Path(__file__).parents[1] / "docs" / "mechanisms.md"
    assert benchmark("catalogue_table").table() in page.read_text()


def some_draws(problem, count=200):
    """Around the truth of the toy, in SI."""
    rng = np.random.default_rng(3)
    centre = problem.vector({**toy_inference.TRUTH, **toy_inference.NOISE})
    low, high = problem.bounds
    return problem.from_sampling(np.clip(centre + 0.02 * rng.standard_normal((count, len(low))), low, high))


def test_phases_are_scored_as_arviz_scores_them(benchmark):
    noise, problem = benchmark("noise_models"), toy_inference.toy_problem()
    theta = some_draws(problem)
    phases, pareto_k = noise.predicted(problem, theta, problem.binned.force_n)
    idata = az.from_dict(
        posterior={"x": theta[None, :, 0]}, log_likelihood={"y": problem.block_log_likelihood(theta)[None]}
    )
    exact = az.loo(idata, pointwise=True, reff=1.0)
    assert phases == pytest.approx(exact.loo_i.values, abs=1e-6)
    assert pareto_k == pytest.approx(exact.pareto_k.values, abs=1e-6)


def test_only_the_phase_left_out_is_scored_on_the_other_force(benchmark):
    noise, problem = benchmark("noise_models"), toy_inference.toy_problem()
    theta, force = some_draws(problem), np.array(problem.binned.force_n)
    own, _ = noise.predicted(problem, theta, force)
    force[problem.binned.phase == problem.blocks[2]] += 0.05
    other, _ = noise.predicted(problem, theta, force)
    assert other[2] < own[2] - 10.0
    assert np.delete(other, 2) == pytest.approx(np.delete(own, 2), abs=1e-6)


def test_each_model_of_the_noise_lacks_one_part(benchmark):
    noise = benchmark("noise_models")
    found = noise.models(shipped("data/demo.h5"), shipped("surrogates/demo.h5"))
    reference = found[noise.SHIPPED]
    assert reference.noise_priors == NoisePriors()
    assert found["Gaussian"].space.lower[-1] >= 1e5
    assert found["white"].noise_priors.tau_s[1] < 0.01 * np.diff(reference.binned.edges_s).min()
    one_sd = found["one sd for all phases"]
    assert [name for name in one_sd.names if name.startswith("sd_")] == ["sd_hold"]
    assert len(one_sd.blocks) == len(reference.blocks)
    spiked = found["spikes left in the bins"].binned
    recording = read_recording(shipped("data/demo.h5"))
    integral = cumulative_trapezoid(recording.force_n, recording.time_s, initial=0)
    plain = np.interp(spiked.edges_s, recording.time_s, integral)
    assert np.diff(plain) / np.diff(spiked.edges_s) == pytest.approx(spiked.force_n, abs=1e-4)
    assert np.abs(spiked.force_n - reference.binned.force_n).max() > 1e-3


def test_differences_of_scores_have_the_error_of_their_sum(benchmark):
    noise, rng = benchmark("noise_models"), np.random.default_rng(0)
    phases = rng.normal(-3.0, 2.0, 400)
    assert noise.difference(phases, np.zeros(400)) == f"{phases.sum():+.1f} ± {20 * phases.std(ddof=1):.1f}"


def test_the_default_move_is_judged_on_the_same_density_and_repeats(benchmark):
    speed, problem = benchmark("sampling_speed"), toy_inference.toy_problem()
    start = {**toy_inference.TRUTH, **toy_inference.NOISE}
    timed = [speed.default_move(problem, start, seed, 200) for seed in (1, 1, 2)]
    assert timed[0].found.steps == 200
    assert 0.0 < timed[0].fewest == timed[1].fewest != timed[2].fewest
    assert timed[0].highest > 1.01  # 200 steps are too few, and the measure sees it
    assert not timed[0].found.verdict.trusted


def ramp(until_s=180.0):
    """The article's sampling, every 10 ms, of a force [N] that grows by 1 mN a second."""
    time_s = np.round(np.arange(0.0, until_s, 0.01), 10)
    return Recording(time_s, np.zeros_like(time_s), 1e-3 * time_s, "ramp", "0" * 64)


def test_the_articles_smoothing_delays_looks_around_and_looks_ahead_by_segment(benchmark):
    article = benchmark("article_calibration")
    time_s, force_n = article.smoothed(ramp())
    assert (time_s[1] - time_s[0], time_s[-1]) == pytest.approx((0.5, 144.5))
    late = dict(zip(np.round(time_s, 3).tolist(), (1e3 * force_n - time_s).tolist(), strict=True))
    # means over the 50 samples before and the sample itself lag by 0.25 s, those after lead by as much
    assert [late[t] for t in (10.0, 50.0, 80.0, 95.0, 120.0)] == pytest.approx(
        [-0.25, 0.0, 0.25, -0.25, 0.0], abs=1e-9
    )
    assert late[0.0] == 0.0  # among the first 19, which are zero
    assert late[30.0] == pytest.approx(2.505)  # the mean of the 500 samples after it: none before 30 s
    assert late[74.5] == pytest.approx((0.49 - 5.0) / 2, abs=0.01)  # none after 75 s


def test_the_articles_cost_is_the_rmse_in_its_windows_alone(benchmark):
    article = benchmark("article_calibration")
    time_s = np.arange(0.0, 145.0, 0.5)
    outside = (time_s < 18.8) | ((time_s > 75.0) & (time_s < 97.8))
    target = np.where(outside, 1.0, 0.0)
    cost = article.cost_of(article.PRESETS["script"], time_s, target, lambda theta: np.full(290, 3e-3))
    assert cost(article.FOUND) == pytest.approx(3e-3)
    failed = article.cost_of(article.PRESETS["script"], time_s, target, lambda theta: np.full(290, np.nan))
    assert failed(article.FOUND) == article.UNSTABLE_N


def test_the_articles_search_keeps_to_its_bounds_and_its_evaluations(benchmark):
    article = benchmark("article_calibration")
    low, high = (
        np.array(ends) for ends in (article.PRESETS["script"].lower, article.PRESETS["script"].upper)
    )
    asked = []

    def cost(theta):
        asked.append(theta)
        return float(np.sum(np.log(theta / article.FOUND) ** 2))

    ended = article.search(cost, low, high, seed=1)
    assert len(asked) == article.EVALUATIONS
    assert np.all((np.array(asked) >= low * (1 - 1e-9)) & (np.array(asked) <= high * (1 + 1e-9)))
    assert cost(ended) == min(map(cost, asked[: article.EVALUATIONS])) < cost(article.START)
    assert article.least(cost, low, high) == pytest.approx(article.FOUND, rel=1e-2)
    cut = article.PRESETS["text"].within(dict.fromkeys(article.NAMES, (20e3, 30e3)))
    assert cut[0].tolist() == [20e3] * 4
    assert cut[1][2] == article.PRESETS["text"].upper[2]


@pytest.mark.parametrize("data", ["surrogate", "full"])
def test_stored_ranks_are_uniform_and_stand_in_the_documentation(benchmark, data):
    """What `benchmarks/calibration.py` has found so far: no parameter's intervals are wrong for certain."""
    calibration = benchmark("calibration")
    stored = [row for row in calibration.ROWS.read() if (row["data"], row["seed"]) == (data, "1")]
    on_page = []
    for surrogate in sorted({row["surrogate"] for row in stored}):
        found = sorted((r for r in stored if r["surrogate"] == surrogate), key=lambda r: int(r["index"]))
        on_page += [found[:n] for n in range(len(found), 49, -1) if shown(calibration.table(found[:n]))]
    assert len(on_page) == 1  # the page has the table of so many
    (found,) = on_page
    n = len(found)
    for name in calibration.NAMES:
        ranks = np.array([int(row[f"rank_{name}"]) for row in found])
        assert calibration.uniformity(ranks) > 0.01 / len(calibration.NAMES), name
        for level in (50, 90):
            held = sum(row[f"in{level}_{name}"] == "True" for row in found)
            low, high = binom.ppf([0.0005, 0.9995], n, level / 100)
            assert low <= held <= high, (name, level)


def shown(table: str) -> bool:
    """Whether a page of the documentation has the rows of a table."""
    page = (Path(__file__).parents[1] / "docs" / "inference.md").read_text()
    return all(line in page for line in table.splitlines()[2:])


def test_the_page_of_the_recording_says_what_the_diagnosis_says(benchmark):
    page = benchmark("healthy_skin_page")
    fits = {
        when: {"rmse": rmse, "rmse_held_out": 2.0 * rmse, "coverage90": 0.8,
               "rmse_by_phase": {kind: rmse for kind in page.KINDS},
               "sampled": {"settled": False, "rhat": 1.25}}
        for when, rmse in (("before", 0.07), ("after", 0.0095))
    }  # fmt: skip
    named = {"name": "pad-slip", "probability": 0.97, "contribution_n": 0.04, "statement": "The pads slip."}
    answer = {
        "verdict": "named", "best_set": ["pad-slip"], "explained": 0.98, "smooth_probability": 0.4,
        "seconds": 600.0, "mechanisms": [named], "located": [{}] * 3, "remaining": [{}], "fit": fits,
        "full_model": {"rmse": 0.011, "fit_off_by": 1e-3},
    }  # fmt: skip
    whole = page.fits(answer)
    assert "| 70.0 mN | 9.5 mN | 12 mN |" in whole
    assert "| 140.0 mN | 19.0 mN | 18 mN |" in whole
    assert "RMSE |  | 11.0 mN |" in whole
    assert "| 3 | 1 |" in whole
    assert "it folds" in page.fits({**answer, "full_model": {"message": "it folds"}})
    words = page.named(answer)
    assert "| pad-slip | 0.97 | 40.0 mN | The pads slip. |" in words
    assert "`named`" in words
    assert "R-hat of its draws 1.25 (not settled)" in words
    assert "10 minutes" in words


def test_the_page_of_the_proof_counts_all_sets_and_leaves_out_what_is_not_judged(benchmark, tmp_path):
    page, folder = benchmark("proof_page"), Path(__file__).parents[1] / "data" / "development"
    assert page.judged(folder)
    for path in ("index.json", "verdicts/001.json"):
        (tmp_path / path).parent.mkdir(exist_ok=True)
        shutil.copy(folder / path, tmp_path / path)
    assert not page.judged(tmp_path)
    answers = {
        path.stem: json.loads(path.read_text())["answer"] for path in (folder / "verdicts").glob("*.json")
    }
    board = score(seals.read_keys(folder), answers)
    table = page.nothing({"one": board, "two": board}).splitlines()
    assert [line.split("|")[2].strip() for line in table[2:]] == ["0 of 20", "0 of 20", "0 of 40"]


def test_the_skins_parameters_are_counted_by_what_was_concealed(benchmark):
    page = benchmark("proof_page")

    def one(number, kind, label, named, right, size, hits):
        inside = dict(zip(("E_c", "E_s"), hits, strict=True))
        answer = " + ".join(named) or "nothing-missing"
        return {"number": number, "kind": kind, "label": label, "named": named, "answer": answer,
                "right": right, "size": size, "inside_base": inside}  # fmt: skip

    each = [
        one("1", "nothing", "nothing", [], False, 0.0, (True, True)),
        one("2", "alone", "pad-slip", ["pad-slip"], True, 5.0, (True, False)),
        one("3", "alone", "pre-stretch", [], False, 1.0, (False, False)),
        one("4", "outside", "peeling", ["pad-slip"], False, 2.0, (False, True)),
    ]
    cells = {
        line.split(" | ")[0].strip("| "): [cell.strip(" |") for cell in line.split(" | ")[1:]]
        for line in page.inside({"one": {"each": each}}).splitlines()[2:]
    }
    assert cells == {
        "nothing": ["1", "1", "1", "2 of 2"],
        "clear, named right": ["1", "1", "0", "1 of 2"],
        "pad-slip": ["1", "1", "0", "1 of 2"],
        "pre-stretch, called nothing": ["1", "0", "0", "0 of 2"],
        "a wrong name": ["1", "0", "1", "1 of 2"],
    }


def test_the_table_of_sizes_tells_clear_effects_from_smaller_ones(benchmark):
    sizes, right = [1.0, 2.0, 4.0, 8.0], [False, True, True, True]
    one = {"sizes": sizes, "right": right, "up_to": [True] * 4, "curve": curve(sizes, right)}
    line = benchmark("proof_page").sizes({"by_mechanism": {"pad-slip": one}}).splitlines()[-1]
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    assert cells[:5] == ["pad-slip", "1.0 to 8.0", "2 of 2", "1 of 2", "1"]
