"""Benchmarks of inference: calibration of posteriors, models of the noise, and the article's own search."""

from __future__ import annotations

from functools import partial

import arviz as az
import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid
from toys import inference_problems
from toys.coarse_proposals import propose_coarsely

from bayeskin.finite_element import ModelSpec
from bayeskin.inference import NoisePriors
from bayeskin.recordings import read_recording
from bayeskin.shipped import shipped
from bayeskin.types import Recording


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


def test_a_recording_is_made_inferred_and_ranked_in_one_row(benchmark, monkeypatch):
    propose_coarsely(monkeypatch)
    calibration = benchmark("calibration")
    settings = calibration.SampleSettings(2, 24, 500, calibration.Limits())
    item = {"surrogate": calibration.surrogate_hash(), "data": "surrogate", "seed": 1, "index": 3}
    row = calibration.replicate(item, calibration.problem(), settings)
    assert set(row) == set(calibration.ROWS.columns)
    assert not row["trusted"]  # 500 steps, and it says so
    assert "needed" in row["reason"]
    assert 0.0 <= row["band50"] <= row["band90"] <= 1.0


def test_a_recording_of_the_full_model_is_near_the_surrogate_s(benchmark, monkeypatch):
    calibration = benchmark("calibration")
    monkeypatch.setattr(calibration, "ModelSpec", partial(ModelSpec, refinement=0))
    about = calibration.problem()
    middle = about.space.from_unit(np.full(about.dim, 0.5))
    force, expected = calibration.made_by_model(about, middle), about.predict(middle).mean[0]
    assert np.sqrt(np.mean((force - expected) ** 2)) < 0.05 * np.ptp(expected)


def some_draws(problem, count=200):
    """Around the truth of the toy, in SI."""
    rng = np.random.default_rng(3)
    centre = problem.vector({**inference_problems.TRUTH, **inference_problems.NOISE})
    low, high = problem.bounds
    return problem.from_sampling(np.clip(centre + 0.02 * rng.standard_normal((count, len(low))), low, high))


def test_phases_are_scored_as_arviz_scores_them(benchmark):
    noise, problem = benchmark("noise_models"), inference_problems.toy_problem()
    theta = some_draws(problem)
    phases, pareto_k = noise.predicted(problem, theta, problem.binned.force_n)
    idata = az.from_dict(
        posterior={"x": theta[None, :, 0]}, log_likelihood={"y": problem.block_log_likelihood(theta)[None]}
    )
    exact = az.loo(idata, pointwise=True, reff=1.0)
    assert phases == pytest.approx(exact.loo_i.values, abs=1e-6)
    assert pareto_k == pytest.approx(exact.pareto_k.values, abs=1e-6)


def test_only_the_phase_left_out_is_scored_on_the_other_force(benchmark):
    noise, problem = benchmark("noise_models"), inference_problems.toy_problem()
    theta, force = some_draws(problem), np.array(problem.binned.force_n)
    own, _ = noise.predicted(problem, theta, force)
    force[problem.binned.phase == problem.blocks[2]] += 0.05
    other, _ = noise.predicted(problem, theta, force)
    assert other[2] < own[2] - 10.0
    assert np.delete(other, 2) == pytest.approx(np.delete(own, 2), abs=1e-6)


def test_each_model_of_the_noise_lacks_one_part(benchmark):
    noise = benchmark("noise_models")
    models = noise.models(shipped("data/demo.h5"), shipped("surrogates/demo.h5"))
    reference = models[noise.SHIPPED]
    assert reference.noise_priors == NoisePriors()
    assert models["Gaussian"].space.lower[-1] >= 1e5
    assert models["white"].noise_priors.tau_s[1] < 0.01 * np.diff(reference.binned.edges_s).min()
    one_sd = models["one sd for all phases"]
    assert [name for name in one_sd.names if name.startswith("sd_")] == ["sd_hold"]
    assert len(one_sd.blocks) == len(reference.blocks)
    spiked = models["spikes left in the bins"].binned
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
    speed, problem = benchmark("sampling_speed"), inference_problems.toy_problem()
    start = {**inference_problems.TRUTH, **inference_problems.NOISE}
    timed = [speed.default_move(problem, start, seed, 200) for seed in (1, 1, 2)]
    assert timed[0].convergence.steps == 200
    assert 0.0 < timed[0].fewest == timed[1].fewest != timed[2].fewest
    assert timed[0].highest > 1.01  # 200 steps are too few, and the measure sees it
    assert not timed[0].convergence.verdict.trusted


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
