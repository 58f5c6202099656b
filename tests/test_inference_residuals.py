"""Tests of residuals: noise as assumed passes, noise of another law, correlation or size fails."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from scipy import stats
from toys.inference_problems import NOISE, TRUTH, ToySurrogate, toy_problem

from bayeskin.inference import LogPosterior, ResidualCheck, check_residuals, find_map
from bayeskin.inference.gauss_newton import gauss_newton
from bayeskin.inference.residuals import autocorrelation, normal_scores
from bayeskin.inference.surrogate_error import surrogate_error
from bayeskin.types import Array

SEEDS = range(30)


def at_truth(problem: LogPosterior) -> ResidualCheck:
    return check_residuals(problem, problem.vector({**TRUTH, **NOISE}))


def with_noise(draw: Callable[[np.random.Generator, Array, Array], Array], seed: int) -> LogPosterior:
    """The toy at the truth with noise by `draw` of the generator, the time [s] and the assumed sd [N]."""
    problem = toy_problem()
    prediction = problem.predict([list(TRUTH.values())])
    sd = np.array(list(NOISE.values()))[problem.chain.kind]
    noise = draw(np.random.default_rng(seed), problem.binned.time_s, sd)
    return dataclasses.replace(
        problem, binned=dataclasses.replace(problem.binned, force_n=prediction.mean[0] + noise)
    )


def correlated(rng: np.random.Generator, time_s: Array, sd: Array) -> Array:
    """Gaussian, of the assumed sd and correlation."""
    covariance = np.exp(-np.abs(time_s[:, None] - time_s) / NOISE["tau_noise"])
    return sd * rng.multivariate_normal(np.zeros(len(sd)), covariance)


def test_noise_as_assumed_gives_uniform_p_values_and_passes() -> None:
    checks = [at_truth(toy_problem(seed)) for seed in SEEDS]
    assert sum(not check.passes for check in checks) <= 1
    for p in (
        [check.p_law for check in checks],
        [check.p_correlation for check in checks],
        [kind.p_sd for check in checks for kind in check.kinds],
        [kind.p_correlation for check in checks for kind in check.kinds],
    ):
        assert stats.kstest(p, "uniform").pvalue > 1e-3
    assert checks[0].sentence.startswith("The residual looks like the assumed noise: in its distribution")
    assert [(kind.kind, kind.bins) for kind in checks[0].kinds] == [
        ("rest", 30), ("load", 20), ("hold", 60), ("unload", 20)
    ]  # fmt: skip


def test_noise_as_assumed_passes_at_the_fit_too() -> None:
    problem = toy_problem(8)
    best = find_map(problem, seed=1, starts=2, evaluations=3000)
    assert check_residuals(problem, problem.vector(best.theta)).passes


@pytest.mark.parametrize(
    ("draw", "word"),
    [
        (lambda rng, t, sd: sd * rng.standard_normal(len(t)), "has a different correlation"),  # white
        (lambda rng, t, sd: sd * rng.standard_cauchy(len(t)), "its sd is"),
        (lambda rng, t, sd: correlated(rng, t, sd) + 6e-3 * np.sin(t / 3.0), "has a different correlation"),
        (lambda rng, t, sd: 3.0 * correlated(rng, t, sd), "its sd is"),
        (lambda rng, t, sd: correlated(rng, t, 2e-3 + 0.0 * sd), "while pads load its sd is 0."),
    ],
    ids=["white", "heavy tails", "a sine", "thrice as wide", "one sd for all phases"],
)
def test_other_noise_fails_and_is_named(
    draw: Callable[[np.random.Generator, Array, Array], Array], word: str
) -> None:
    checks = [at_truth(with_noise(draw, seed)) for seed in range(10)]
    assert sum(not check.passes for check in checks) >= 8
    named = [check.sentence for check in checks if not check.passes]
    assert all(sentence.startswith("The residual is not the assumed noise: ") for sentence in named)
    assert sum(word in sentence for sentence in named) >= 6


def test_a_sine_fails_even_where_the_noise_is_fitted_to_it() -> None:
    """The sampled correlation time takes in what it can of a slow oscillation, and not all."""
    problem = with_noise(lambda rng, t, sd: correlated(rng, t, sd) + 0.02 * np.sin(t / 2.0), 1)
    best = find_map(problem, seed=1, starts=2, evaluations=3000)
    assert not check_residuals(problem, problem.vector(best.theta)).passes


@pytest.mark.parametrize("nu", [2.0, 6.0, 1e6, np.inf])
def test_scores_of_t_draws_are_standard_normal(nu: float) -> None:
    eps = np.linspace(-4.0, 4.0, 9)
    assert stats.norm.cdf(normal_scores(eps, nu)) == pytest.approx(stats.t.cdf(eps, nu), rel=1e-9)
    assert np.isfinite(normal_scores(np.array([-1e9, 1e9]), nu)).all()


def test_autocorrelation_is_about_zero() -> None:
    assert autocorrelation(np.array([1.0, -1.0] * 50), 2) == pytest.approx([-0.99, 0.98])
    assert autocorrelation(np.ones(100), 1) == pytest.approx([0.99])


def test_the_surrogate_s_error_is_the_mode_of_its_posterior() -> None:
    rng = np.random.default_rng(2)
    factor, residual, nu = rng.normal(size=(80, 2)), rng.standard_t(4, size=80), 1e9
    residual = residual + factor @ [0.8, -0.5]
    ridge = np.linalg.solve(factor.T @ factor + np.eye(2), factor.T @ residual)
    assert surrogate_error(residual, factor, nu) == pytest.approx(ridge, rel=1e-6)
    problem = toy_problem()
    top = gauss_newton(problem, problem.vector({**TRUTH, **NOISE}), None)
    assert np.abs(top.latent).max() > 0.05


def test_what_the_surrogate_s_error_explains_is_not_left() -> None:
    """A shift of 10 mN is two sd of one surrogate's error, and nothing that a surer one could be off by."""
    unsure, sure = (toy_problem(surrogate=ToySurrogate(sd_n=sd_n)) for sd_n in (5e-3, 5e-5))
    shifted = dataclasses.replace(unsure.binned, force_n=unsure.binned.force_n + 0.01)
    assert at_truth(dataclasses.replace(unsure, binned=shifted)).passes
    assert not at_truth(dataclasses.replace(sure, binned=shifted)).passes


def test_few_bins_are_not_tested_by_kind() -> None:
    check = at_truth(toy_problem(windows=((0.0, 4.0), (15.0, 45.0))))
    assert [kind.bins for kind in check.kinds] == [4, 30]
    assert np.isnan(check.kinds[0].p_sd)
    assert np.isfinite(check.kinds[1].p_sd)
    assert np.isnan(at_truth(toy_problem(windows=((0.0, 1.0),))).p_correlation)
