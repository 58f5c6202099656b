"""Sentences on what a recording teaches of each parameter: intervals, ridges, bounds."""

import numpy as np
import pytest
from scipy import stats

from bayeskin.inference import identifiability, noise_remarks
from bayeskin.inference.identify import Informed, information_gain_nats, parts
from bayeskin.types import Array, Parameter, ParameterSpace

SPACE = ParameterSpace(
    (
        Parameter("E", "Pa", 1.0, np.exp(10.0), "log-uniform"),
        Parameter("F", "Pa", 1.0, np.exp(10.0), "log-uniform"),
        Parameter("p_init", "Pa", -10.0, 10.0, "uniform"),
    )
)


def ridge_draws(n: int = 4000) -> Array:
    rng = np.random.default_rng(0)
    along = rng.standard_normal(n)
    across = 0.1 * rng.standard_normal((n, 2))
    return np.column_stack(
        [np.exp(5 + along + across[:, 0]), np.exp(5 - along + across[:, 1]), rng.uniform(-10, 10, n)]
    )


def test_a_parameter_with_its_prior_back_is_said_to_be_uninformed() -> None:
    identified = identifiability(SPACE, ridge_draws())
    assert identified.parameters[2].statement == "p_init: the data does not inform it (posterior = prior)"
    assert [parameter.informed for parameter in identified.parameters] == [
        Informed.WELL,
        Informed.WELL,
        Informed.NOT,
    ]
    assert identified.parameters[2].contraction == pytest.approx(0.0, abs=0.05)
    e = identified.parameters[0]
    assert e.contraction == pytest.approx(1 - 12 * 1.01 / 100, abs=0.02)
    assert e.quantiles == pytest.approx(np.exp(5 + np.array([-1.645, 0, 1.645])), rel=0.1)
    assert e.statement.startswith("E: the data informs it: median")


def test_a_sentence_without_statistics_says_what_the_test_taught() -> None:
    sentences = {
        parameter.name: parameter.sentence for parameter in identifiability(SPACE, ridge_draws()).parameters
    }
    assert sentences["p_init"].startswith("This test says nothing about the")
    assert "only known to lie in the assumed range" in sentences["p_init"]
    assert "times narrower than assumed" in sentences["E"]


def test_two_separate_ranges_are_said_and_one_of_any_shape_is_not() -> None:
    rng = np.random.default_rng(3)
    two = np.concatenate([0.2 + 0.03 * rng.standard_normal(1500), 0.7 + 0.05 * rng.standard_normal(500)])
    computed = parts(two)
    assert len(computed) == 2
    np.testing.assert_allclose(computed, [(0.15, 0.25), (0.62, 0.78)], atol=0.02)
    shapes = (rng.uniform(size=3000), rng.beta(2, 9, 3000), np.full(50, 0.3), 1 - rng.exponential(0.02, 3000))
    assert [len(parts(draws)) for draws in shapes] == [1, 1, 1, 1]
    few = np.concatenate([0.2 + 0.03 * rng.standard_normal(1970), 0.7 + 0.03 * rng.standard_normal(30)])
    assert len(parts(few)) == 1
    space = ParameterSpace((Parameter("E", "Pa", 1.0, np.exp(10.0), "log-uniform"),))
    (learned,) = identifiability(space, space.from_unit(two[:, None])).parameters
    np.testing.assert_allclose(np.log(learned.ranges) / 10.0, computed, atol=1e-6)
    assert "2 separate ranges fit: " in learned.statement
    assert identifiability(space, space.from_unit(shapes[1][:, None])).parameters[0].ranges == ()


def test_noise_parameters_at_their_bounds_are_remarked_on() -> None:
    noise = ParameterSpace(
        (
            Parameter("tau_noise", "s", 0.1, 100.0, "log-uniform"),
            Parameter("nu_noise", "1", 2.0, 100.0, "log-uniform"),
        )
    )
    unit = np.random.default_rng(0).beta(1.0, 60.0, (2000, 2))
    at_bounds = noise.from_unit(np.column_stack([1.0 - unit[:, 0], unit[:, 1]]))
    said = noise_remarks(identifiability(noise, at_bounds))
    assert len(said) == 1
    assert "as long as its prior allows and with the heaviest tails" in said[0]
    assert noise_remarks(identifiability(noise, noise.from_unit(0.3 + 0.2 * unit))) == ()
    other_ends = noise.from_unit(np.column_stack([unit[:, 0], 1.0 - unit[:, 1]]))  # white and Gaussian
    assert noise_remarks(identifiability(noise, other_ends)) == ()


def test_a_ridge_is_named() -> None:
    identified = identifiability(SPACE, ridge_draws()).ridges
    assert [(r.first, r.second) for r in identified] == [("E", "F")]
    assert identified[0].correlation == pytest.approx(-0.99, abs=0.01)
    assert "E and F form a ridge" in identified[0].statement


def test_a_curved_ridge_is_named() -> None:
    """Two moduli whose weighted sum is what the force hangs on: in logarithms that is a bend, no line."""
    rng = np.random.default_rng(4)
    share = rng.uniform(0.004, 0.996, 4000) ** rng.choice([0.2, 1.0, 5.0], 4000)
    draws = np.column_stack([np.exp(9.0) * share, np.exp(9.0) * (1.0 - share), rng.uniform(-10, 10, 4000)])
    assert abs(np.corrcoef(np.log(draws[:, :2]), rowvar=False)[0, 1]) < 0.8
    assert [(r.first, r.second) for r in identifiability(SPACE, draws).ridges] == [("E", "F")]


def test_a_posterior_on_a_bound_is_said_to_lean_on_it() -> None:
    draws = ridge_draws()
    draws[:, 0] = np.exp(np.random.default_rng(1).exponential(0.3, len(draws)))
    first, second, _ = identifiability(SPACE, draws).parameters
    assert (first.leans_on, second.leans_on) == (("lower",), ())
    assert "leans on the prior's lower bound, 1 Pa" in first.statement
    assert first.outcome == (
        "the data informs it; leans on the prior's lower bound, 1 Pa, so that the prior shapes it"
    )


@pytest.mark.parametrize("sd", [0.1, 0.01, 0.001])
def test_the_information_gain_of_a_normal_is_its_closed_form(sd: float) -> None:
    draws = 0.5 + sd * np.random.default_rng(0).standard_normal(5000)
    exact = -stats.norm.entropy(scale=sd)
    assert information_gain_nats(draws) == pytest.approx(exact, abs=0.05)
    assert information_gain_nats(np.random.default_rng(1).uniform(size=5000)) < 0.02
