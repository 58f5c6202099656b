"""The most probable point: its search, the check by the full model, and the polish."""

import dataclasses

import nlopt
import numpy as np
import pytest
from numpy.typing import ArrayLike
from toys import closed_form_model
from toys.inference_problems import (
    EDGES_S,
    HOLDS,
    NOISE,
    SCALE,
    TRUTH,
    LineSurrogate,
    ToySurrogate,
    full_run,
    line_problem,
    toy_problem,
)

from bayeskin.errors import InputError
from bayeskin.inference import check_map, find_map, optimise, polish_map, refine_map
from bayeskin.types import Array, ParameterSpace, Prediction, Simulation


def test_the_toy_surrogate_is_the_toy() -> None:
    theta = closed_form_model.SPACE.from_unit(np.random.default_rng(0).uniform(size=(30, 5)))
    error = ToySurrogate().predict(theta).mean - SCALE * closed_form_model.toy_bin_means(theta, EDGES_S)
    assert np.abs(error).max() < 1e-4


def test_the_maximum_of_a_line_is_its_least_squares() -> None:
    problem = line_problem()
    maximum = find_map(problem, seed=0, starts=2, evaluations=4000)
    x = problem.surrogate.columns
    covariance = 2.5e-3 * np.eye(40) + 1e-6 * np.eye(40) + 1e-4 * np.outer(x[1], x[1])
    information = x @ np.linalg.solve(covariance, x.T)
    exact = np.linalg.solve(information, x @ np.linalg.solve(covariance, problem.binned.force_n))
    assert [maximum.theta["a"], maximum.theta["b"]] == pytest.approx(exact, abs=1e-3)
    assert maximum.agreement == 1.0
    assert maximum == find_map(problem, seed=0, starts=2, evaluations=4000)


def test_starts_on_the_ridge_agree_on_its_height() -> None:
    problem = toy_problem(windows=HOLDS)
    maximum = find_map(problem, seed=1, starts=2, evaluations=4000)
    truth = problem.vector({k: v for k, v in {**TRUTH, **NOISE}.items() if k in problem.names})
    assert maximum.value > problem.log_prob(truth)[0]
    assert maximum.value == max(s.value for s in maximum.starts)
    assert all(s.value > maximum.value - 2.0 for s in maximum.starts)
    assert problem.log_prob(problem.vector(maximum.theta))[0] == pytest.approx(maximum.value, abs=1e-6)
    assert "of 2 starts" in maximum.message


class Folded(LineSurrogate):
    """force = |a| + b t: one maximum for each sign of a, the lower one on the prior's bound."""

    def __init__(self) -> None:
        super().__init__()
        a, b = self.space.parameters
        self.space = ParameterSpace((dataclasses.replace(a, lower=-0.19), b))

    def predict(self, theta: ArrayLike) -> Prediction:
        return super().predict(np.atleast_2d(theta) * [0.0, 1.0] + np.abs(np.atleast_2d(theta)) * [1.0, 0.0])


def test_three_kinds_of_search_end_at_one_maximum() -> None:
    problem = dataclasses.replace(line_problem(1), surrogate=Folded())
    maximum = find_map(problem, seed=1, starts=6, evaluations=4000)
    assert min(start.value for start in maximum.starts) < maximum.value - 0.3  # there is a lower one besides
    assert list(maximum.by_search) == list(optimise.SEARCHES)
    assert all(maximum.value - value < 0.1 for value in maximum.by_search.values())
    assert "by controlled random search, differential evolution, Gauss-Newton" in maximum.message


def test_no_more_starts_are_made_where_every_kind_of_search_agrees() -> None:
    maximum = find_map(line_problem(), seed=0, starts=8, evaluations=4000)
    assert [start.search for start in maximum.starts] == list(optimise.SEARCHES)
    assert maximum.agreement == 1.0
    folded = dataclasses.replace(line_problem(1), surrogate=Folded())
    assert len(find_map(folded, seed=1, starts=5, evaluations=4000).starts) == 5


@pytest.mark.parametrize("kind", optimise.SEARCHES)
def test_each_kind_of_search_climbs_before_the_polish(kind: str) -> None:
    problem = toy_problem(windows=HOLDS)
    search = optimise.Search(optimise.SearchSpace(problem))
    optimise.SEARCHES[kind](search, 3, 2000)
    middle = problem.log_prob(np.mean(problem.bounds, axis=0)[None])[0]
    best = find_map(problem, seed=1, starts=3, evaluations=4000).value
    assert best - search.value < 0.2 * (best - middle)


def test_a_failing_optimiser_is_a_status(monkeypatch: pytest.MonkeyPatch) -> None:
    class Failing(nlopt.opt):
        def optimize(self, start: Array) -> Array:
            raise nlopt.RoundoffLimited("roundoff")

    monkeypatch.setattr(optimise.nlopt, "opt", Failing)
    maximum = find_map(line_problem(), seed=0, starts=2, evaluations=100)
    assert all(s.status.startswith("failed") for s in maximum.starts)
    with pytest.raises(InputError, match="at least 1 start"):
        find_map(line_problem(), seed=0, starts=0)


def test_an_honest_surrogate_passes_the_check_and_a_moved_one_does_not() -> None:
    honest = check_map(ToySurrogate(), full_run, {**TRUTH, **NOISE})
    assert honest.passes
    assert honest.rms_n < 1e-4
    moved = check_map(ToySurrogate(bias_n=3e-3), full_run, TRUTH)  # six of its own sd
    assert not moved.passes
    assert moved.rms_n == pytest.approx(3e-3, rel=0.05)
    sd = ToySurrogate().predict([list(TRUTH.values())]).sd()[0]
    assert moved.rms_z == pytest.approx(np.sqrt(np.mean((3e-3 / sd) ** 2)), rel=0.05)
    assert "add the point to the design" in moved.message
    assert check_map(ToySurrogate(bias_n=3e-3), full_run, TRUTH, noise_sd_n=0.05).passes
    assert set(moved.theta) == set(TRUTH)


def test_a_maximum_where_the_surrogate_is_off_by_more_than_the_noise_does_not_pass() -> None:
    sd_n = ToySurrogate().predict(np.array([list(TRUTH.values())])).sd()[0]
    bias_n = float(np.sqrt(np.mean(sd_n**2)))
    assert check_map(ToySurrogate(bias_n=bias_n), full_run, TRUTH, noise_sd_n=1.1 * bias_n).passes
    off = check_map(ToySurrogate(bias_n=bias_n), full_run, TRUTH, noise_sd_n=0.9 * bias_n)
    assert not off.passes
    assert off.rms_z < 2.0
    assert "more than the noise" in off.message


def test_the_mahalanobis_distance_takes_correlations_in() -> None:
    surrogate = ToySurrogate(bias_n=3e-3)
    check = check_map(surrogate, full_run, TRUTH)
    prediction = surrogate.predict([list(TRUTH.values())])
    total = prediction.factor[0] @ prediction.factor[0].T + np.diag(prediction.diagonal[0])
    exact = check.error_n @ np.linalg.solve(total, check.error_n)
    assert check.mahalanobis == pytest.approx(np.sqrt(exact / 130), rel=1e-6)


def test_the_loop_repairs_a_moved_surrogate() -> None:
    problem = toy_problem(windows=HOLDS, surrogate=ToySurrogate(bias_n=0.02))
    points: list[dict[str, float]] = []

    def retrain(theta, simulation: Simulation) -> ToySurrogate:  # type: ignore[no-untyped-def]
        points.append(dict(theta))
        wrong = problem.surrogate.predict([list(theta.values())]).mean[0]
        return ToySurrogate(bias_n=0.02 - float(np.mean(wrong - simulation.bin_means(EDGES_S))))

    result = refine_map(problem, full_run, retrain, seed=1, starts=1, evaluations=2000)
    assert [c.passes for c in result.checks] == [False, True]
    assert result.passes
    assert abs(result.log_posterior.surrogate.bias_n) < 1e-4
    assert points == [dict(result.checks[0].theta)]


def test_the_loop_ends_after_a_failed_run_and_after_its_rounds() -> None:
    problem = toy_problem(windows=HOLDS, surrogate=ToySurrogate(bias_n=0.02))

    def failing(theta: dict[str, float]) -> Simulation:
        return dataclasses.replace(full_run(theta), status="failed", message="halve the step")

    def stubborn(theta: dict[str, float], simulation: Simulation) -> ToySurrogate:
        return ToySurrogate(bias_n=0.02)

    failed = refine_map(problem, failing, stubborn, seed=1, starts=1, evaluations=200)
    assert (len(failed.checks), failed.passes) == (1, False)
    assert "halve the step" in failed.checks[0].message
    assert np.isnan(failed.checks[0].rms_n)
    tried = refine_map(problem, full_run, stubborn, seed=1, starts=1, evaluations=200, max_rounds=3)
    assert (len(tried.checks), tried.passes) == (3, False)


def full_run_with_derivatives(theta):
    """The toy with its derivatives by central differences of logarithms."""
    run, names, h = full_run(theta), ("E_c", "E_s", "k_c", "k_s"), 1e-4

    def shifted(name, sign):
        return full_run({**theta, name: theta[name] * np.exp(sign * h)}).force_n

    columns = [(shifted(name, 1) - shifted(name, -1)) / (2 * h) for name in names]
    return dataclasses.replace(run, gradient_names=names, gradient_n=np.stack(columns, axis=1))


def test_polish_climbs_the_full_model_from_where_a_wrong_surrogate_left_it():
    wrong = toy_problem(surrogate=ToySurrogate(bias_n=5e-3))
    start = dict(find_map(wrong, seed=1, starts=1, evaluations=4000).theta)
    polished = polish_map(wrong, full_run_with_derivatives, start, rounds=12)
    assert polished.gained > 5.0, polished.message
    assert "converged" in polished.message
    right = find_map(toy_problem(surrogate=ToySurrogate(sd_n=1e-7)), seed=1, starts=2, evaluations=8000)
    exact = toy_problem(surrogate=ToySurrogate(sd_n=1e-7))
    values = exact.log_prob(np.stack([exact.vector(polished.theta), exact.vector(right.theta)]))
    assert values[0] > values[1] - 0.5


def test_polish_ends_at_a_full_run_that_fails():
    problem = toy_problem()
    start = dict(find_map(problem, seed=1, starts=1, evaluations=4000).theta)
    failing = dataclasses.replace(full_run(TRUTH), status="failed", message="step 3")
    polished = polish_map(problem, lambda theta: failing, start)
    assert polished.theta == start
    assert "step 3" in polished.message
