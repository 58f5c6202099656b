"""Draws of the surrogate's posterior weighed by the full model: closed forms of a line."""

import dataclasses

import arviz as az
import numpy as np
import pytest
from scipy.special import ndtri
from toys.inference_problems import LineSurrogate, line_problem

from bayeskin.inference import LogPosterior, Weighed, corrected, weigh
from bayeskin.inference.convergence import Verdict
from bayeskin.types import Array, Parameter, ParameterSpace

NOISE = [0.05, 0.001, 1e6]


def gaussian(problem: LogPosterior, extra: Array) -> tuple[Array, Array]:
    """Mean (2,) and covariance of a and b for white noise and a further covariance (m, m)."""
    x = problem.surrogate.columns
    inverse = np.linalg.inv(2.5e-3 * np.eye(len(extra)) + extra)
    covariance = np.linalg.inv(x @ inverse @ x.T)
    return covariance @ x @ inverse @ problem.binned.force_n, covariance


def draws(problem: LogPosterior, n: int, seed: int = 0) -> Array:
    """Exact draws (n, 5) of the surrogate's posterior, whose error is a slope and a little white noise."""
    t = problem.surrogate.columns[1]
    mean, covariance = gaussian(problem, 1e-4 * np.outer(t, t) + 1e-6 * np.eye(len(t)))
    ab = np.random.default_rng(seed).multivariate_normal(mean, covariance, n)
    return np.column_stack([ab, np.tile(NOISE, (n, 1))])


def full_force(theta: Array, slope: float = 0.0) -> Array:
    """The full model: the line, and a slope [N/s] that the surrogate leaves out."""
    columns = LineSurrogate().columns
    return theta[:, :2] @ columns + slope * columns[1]


def test_weighed_draws_give_the_full_models_posterior() -> None:
    problem = line_problem()
    theta, slope = draws(problem, 4000), 0.02
    weighed = weigh(problem, theta, full_force(theta, slope))
    mean, covariance = gaussian(problem, np.zeros((40, 40)))
    exact = mean - [0.0, slope]  # b takes the slope away
    for j, moments in enumerate(corrected(weighed, theta)[:2]):
        sd = np.sqrt(covariance[j, j])
        expected = exact[j] + sd * ndtri([0.05, 0.5, 0.95])
        np.testing.assert_allclose(moments.quantiles, expected, atol=0.12 * sd)
        assert moments.sd_ratio * theta[:, j].std() == pytest.approx(sd, rel=0.06)
    b = corrected(weighed, theta)[1]
    raw = theta[:, 1]
    assert b.shift_sd == pytest.approx((exact[1] - raw.mean()) / raw.std(), abs=4 * b.shift_error_sd)
    assert abs(b.shift_sd) > 5 * b.shift_error_sd


def test_few_draws_move_the_mean_of_many_by_what_the_weights_say() -> None:
    problem = line_problem()
    many = draws(problem, 20000)
    mean = gaussian(problem, np.zeros((40, 40)))[0]
    few = [draws(problem, 24, seed=seed) for seed in range(1, 101)]
    moved = [corrected(weigh(problem, sample, full_force(sample)), many)[1] for sample in few]
    off = np.array([summary.quantiles[1] for summary in moved]) - mean[1]
    alone = np.array([sample[:, 1].mean() for sample in few]) - mean[1]
    assert np.sqrt(np.mean(off**2)) < 0.7 * np.sqrt(np.mean(alone**2))
    said = np.array([summary.shift_error_sd for summary in moved]) * many[:, 1].std()
    assert 0.6 < np.sqrt(np.mean((off / said) ** 2)) < 1.6


def test_a_permeability_stays_one_when_the_weights_move_it_far() -> None:
    """Over decades, a shift of the mean in SI would make it negative: it is the logarithm's that moves."""
    rng = np.random.default_rng(1)
    space = ParameterSpace((Parameter("k", "m^2", 1e-16, 1e-11, "log-uniform"),))
    many = 1e-13 * np.exp(1.5 * rng.standard_normal((4000, 1)))
    weights = np.where(np.arange(24) < 4, 0.24, 0.002)
    few = np.sort(many[:24], axis=0)
    weighed = Weighed(space, few, np.log(weights), weights, 4.0, float("nan"), Verdict(False, ("",)))
    (summary,) = corrected(weighed, many)
    assert 1e-16 <= summary.quantiles[0] < summary.quantiles[1] < min(summary.quantiles[2], np.median(many))
    expected = np.median(np.log(many)) + weights @ np.log(few[:, 0]) - np.log(few[:, 0]).mean()
    assert np.log(summary.quantiles[1]) == pytest.approx(expected, abs=0.05)


def test_few_draws_are_judged_by_their_effective_number() -> None:
    problem = line_problem()
    theta = draws(problem, 24)
    weighed = weigh(problem, theta, full_force(theta))
    assert weighed.verdict.trusted
    assert np.isnan(weighed.khat)
    assert weighed.effective == pytest.approx(1 / np.sum(weighed.weights**2))
    assert f"{weighed.effective:.1f} effective" in weighed.verdict.reasons[0]
    assert "k-hat" not in weighed.verdict.reasons[0]


def test_from_200_draws_on_weights_are_pareto_smoothed() -> None:
    problem = line_problem()
    theta = draws(problem, 300)
    weighed = weigh(problem, theta, full_force(theta, 0.05))
    smooth, khat = az.psislw(weighed.log_ratio)
    np.testing.assert_allclose(weighed.weights, np.exp(smooth) / np.exp(smooth).sum(), rtol=1e-8)
    assert weighed.khat == pytest.approx(float(khat))
    assert "k-hat" in weighed.verdict.reasons[0]


def test_a_surrogate_that_is_elsewhere_is_not_trusted() -> None:
    problem = line_problem()
    theta = draws(problem, 300)
    off = weigh(problem, theta, full_force(theta, 0.3))
    assert not off.verdict.trusted
    assert off.effective < 30
    few = weigh(problem, theta[:24], full_force(theta[:24], 0.3))
    assert not few.verdict.trusted


def test_a_failed_run_weighs_nothing_and_none_at_all_is_no_error() -> None:
    problem = line_problem()
    theta = draws(problem, 12)
    force = full_force(theta)
    force[3] = np.nan
    weighed = weigh(problem, theta, force)
    assert weighed.weights[3] == 0.0
    assert weighed.weights.sum() == pytest.approx(1.0)
    assert "1 runs failed" in weighed.verdict.reasons[0]
    none = weigh(problem, theta, np.full_like(force, np.nan))
    assert (none.effective, none.verdict.trusted) == (0.0, False)


def test_only_fitted_bins_weigh() -> None:
    problem = dataclasses.replace(line_problem(), fit_windows=((0.0, 0.5),))
    theta = draws(line_problem(), 12)
    force = full_force(theta)
    force[:, 20:] += 1.0
    np.testing.assert_allclose(
        weigh(problem, theta, force).weights, weigh(problem, theta, full_force(theta)).weights
    )
