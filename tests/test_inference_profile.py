"""Profile likelihoods: a parabola where the force is linear, flat where it does not know a parameter."""

from collections.abc import Mapping
from types import SimpleNamespace

import numpy as np
import pytest
from toys.inference_problems import NOISE, TRUTH, line_problem, toy_problem

from bayeskin.inference import LogPosterior, find_map, profile, profiles
from bayeskin.inference.profile import DROP


@pytest.fixture(scope="module")
def best() -> Mapping[str, float]:
    """The most probable point of the toy's recording."""
    return find_map(toy_problem(), seed=1, starts=3, evaluations=2000).theta


def nothing(problem: LogPosterior) -> np.ndarray:
    """No draws."""
    return np.empty((0, problem.dim))


def test_a_linear_models_profile_is_a_parabola_of_its_standard_error() -> None:
    problem = line_problem()
    best = find_map(problem, seed=0, starts=3, evaluations=2000).theta
    x = problem.surrogate.columns
    covariance = (2.5e-3 + 1e-6) * np.eye(40) + 1e-4 * np.outer(x[1], x[1])
    spread = np.linalg.inv(x @ np.linalg.solve(covariance, x.T))
    for j, curve in enumerate(profiles(problem, best, nothing(problem), points=101)):
        exact = -0.5 * (curve.values - best[curve.name]) ** 2 / spread[j, j]
        near = exact > -4.0  # further out the surrogate's error leaves its three sd
        assert near.sum() > 4
        np.testing.assert_allclose(curve.drop_nats[near], exact[near], atol=0.02)
        half = np.sqrt(2 * DROP * spread[j, j])
        assert curve.interval == pytest.approx(
            (best[curve.name] - half, best[curve.name] + half), abs=0.1 * half
        )
        assert not curve.flat


def test_a_parameter_without_effect_has_a_flat_profile_and_one_with_effect_has_not(
    best: Mapping[str, float],
) -> None:
    problem = toy_problem()
    by_name = {curve.name: curve for curve in profiles(problem, best, nothing(problem), points=9)}
    assert by_name["p_init"].flat
    assert np.ptp(by_name["p_init"].drop_nats) < 0.1
    assert by_name["p_init"].interval == pytest.approx((-670.0, 2144.0))
    assert not by_name["E_c"].open_above
    for name in ("E_c", "k_s"):
        low, high = by_name[name].interval
        assert low <= TRUTH[name] <= high, name


def test_a_profile_is_nowhere_above_the_maximum_and_tops_what_holds_the_rest(
    best: Mapping[str, float],
) -> None:
    problem = toy_problem()
    top = problem.log_likelihood(np.array([list(best.values())]))[0]
    curve = profiles(problem, best, nothing(problem), points=7)[0]
    rows = np.tile([best[name] for name in problem.names], (len(curve.values), 1))
    rows[:, 0] = curve.values
    alone = problem.log_likelihood(rows) - top
    assert np.all(curve.drop_nats >= alone - 0.1)
    assert curve.drop_nats.max() == 0.0
    assert set(NOISE) <= set(problem.names)


def test_a_profile_begins_at_draws_too(best: Mapping[str, float], monkeypatch: pytest.MonkeyPatch) -> None:
    """A profile without any climb is as high as the likeliest and the nearest draw about each value."""
    problem = toy_problem()
    rng = np.random.default_rng(4)
    about = problem.vector(best) + 0.02 * rng.standard_normal((40, problem.dim))
    low, high = problem.bounds
    about[:, 1] = rng.uniform(low[1], high[1], 40)
    draws = problem.from_sampling(np.clip(about, low, high))

    def stays(held: LogPosterior, at: np.ndarray, *_: object) -> SimpleNamespace:
        return SimpleNamespace(vector=at)

    monkeypatch.setattr(profile, "gauss_newton", stays)
    without, with_draws = (profiles(problem, best, some, points=9)[1] for some in (nothing(problem), draws))
    assert np.all(with_draws.drop_nats >= without.drop_nats - 1e-9)
    values, top = problem.log_likelihood(draws), problem.log_likelihood(np.array([list(best.values())]))[0]
    assert np.any(with_draws.drop_nats > without.drop_nats + 1.0)
    assert with_draws.drop_nats.max() <= max(values.max() - top, 0.0) + 1e-9
