"""Normal priors, cut to their bounds: against SciPy, a conjugate posterior, and what a configuration says."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from toys.inference_problems import line_problem

from bayeskin.config import load_config, parameter_space, to_toml
from bayeskin.errors import InputError
from bayeskin.inference import identifiability
from bayeskin.inference.gauss_newton import gauss_newton
from bayeskin.sensitivity.result import describe
from bayeskin.types import Array, Correlation, Parameter, ParameterSpace

SPACE = ParameterSpace(
    (
        Parameter("E", "Pa", 1e3, 1e6, "log-normal", centre=2e4, spread=np.log(3.0)),
        Parameter("p", "Pa", -1.0, 4.0, "normal", centre=0.5, spread=2.0),
        Parameter("k", "m^2", 1e-16, 1e-12, "log-uniform"),
    )
)


def frozen(column: int):
    """SciPy's law of a column on its line."""
    centre, spread = (np.log(2e4), np.log(3.0)) if column == 0 else (0.5, 2.0)
    low, high = (np.log(1e3), np.log(1e6)) if column == 0 else (-1.0, 4.0)
    return stats.truncnorm((low - centre) / spread, (high - centre) / spread, centre, spread)


def test_probabilities_and_densities_are_those_of_scipy():
    unit = np.random.default_rng(0).uniform(size=(400, 3))
    theta = SPACE.from_unit(unit)
    assert SPACE.contains(np.clip(theta, SPACE.lower, SPACE.upper)).all()
    np.testing.assert_allclose(SPACE.to_unit(theta), unit, atol=1e-9)
    line = SPACE.to_line(theta)
    np.testing.assert_allclose(line[:, 0], frozen(0).ppf(unit[:, 0]), rtol=1e-9)
    np.testing.assert_allclose(line[:, 1], frozen(1).ppf(unit[:, 1]), atol=1e-9)
    expected = frozen(0).logpdf(line[:, 0]) + frozen(1).logpdf(line[:, 1]) - np.log(np.log(1e4))
    np.testing.assert_allclose(SPACE.log_density(line), expected, rtol=1e-9)
    assert SPACE.from_unit([[0.0, 0.0, 0.0]]) == pytest.approx(SPACE.lower[None])
    assert SPACE.from_unit([[1.0, 1.0, 1.0]]) == pytest.approx(SPACE.upper[None])


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_normal_prior_far_from_its_centre_keeps_its_law(side: float):
    """Twelve spreads out, where what is on the other side of the bounds cannot be told from one."""
    low, high = sorted((12.0 * side, 12.5 * side))
    space = ParameterSpace((Parameter("x", "1", low, high, "normal", centre=0.0, spread=1.0),))
    unit = np.array([[0.1], [0.5], [0.9]])
    computed, law = space.from_unit(unit), stats.truncnorm(low, high)
    np.testing.assert_allclose(computed[:, 0], law.ppf(unit[:, 0]), rtol=1e-9)
    np.testing.assert_allclose(space.to_unit(computed), unit, rtol=1e-9)
    np.testing.assert_allclose(space.log_density(computed), law.logpdf(computed[:, 0]), rtol=1e-9)


def test_the_box_of_a_normal_prior_is_flat_and_a_flat_one_is_its_own():
    assert [p.prior for p in SPACE.box.parameters] == ["log-uniform", "uniform", "log-uniform"]
    assert SPACE.box.box == SPACE.box
    np.testing.assert_array_equal(SPACE.box.lower, SPACE.lower)


def normal(parameter: Parameter, spread: float) -> Parameter:
    return dataclasses.replace(parameter, prior="normal", centre=0.0, spread=spread)


def assert_conjugate(parameters: tuple[Parameter, ...], precision: Array, *correlations: Correlation) -> None:
    """The posterior of a line whose prior adds `precision` is the closed form's."""
    problem = line_problem()
    x = problem.surrogate.columns
    informed = dataclasses.replace(problem, material=ParameterSpace(parameters, correlations))
    covariance = (2.5e-3 + 1e-6) * np.eye(40) + 1e-4 * np.outer(x[1], x[1])
    information = x @ np.linalg.solve(covariance, x.T) + precision
    mean = np.linalg.solve(information, x @ np.linalg.solve(covariance, problem.binned.force_n))
    offsets = 0.01 * np.random.default_rng(1).standard_normal((50, 2))
    rest = np.tile(informed.bounds[0][2:], (50, 1))
    computed = informed.log_prob(np.column_stack([mean + offsets, rest]))
    exact = -0.5 * np.einsum("ni,ij,nj->n", offsets, information, offsets)
    np.testing.assert_allclose(computed - computed[0], exact - exact[0], atol=0.02)


def test_a_normal_prior_gives_the_conjugate_posterior_of_a_line():
    a, b = line_problem().surrogate.space.parameters
    assert_conjugate((normal(a, 0.02), b), np.diag([1 / 0.02**2, 0.0]))


@pytest.mark.parametrize("correlation", [0.0, -0.7])
def test_slopes_of_a_normal_prior_are_its_density_s(correlation: float):
    space = dataclasses.replace(SPACE, correlations=(Correlation("E", "p", correlation),))
    line = space.to_line(np.array([4e4, 1.3, 1e-14]))
    gradient, curvature = space.log_density_slopes(line)
    steps = 1e-3 * np.eye(3)
    ahead = (space.log_density(line + steps) - space.log_density(line - steps)) / 2e-3
    np.testing.assert_allclose(gradient, ahead, atol=1e-8)
    moved = np.array([space.log_density_slopes(line + step)[0] for step in steps])
    np.testing.assert_allclose(-curvature, (moved - gradient) / 1e-3, atol=1e-8)


def test_a_climb_sees_a_normal_prior():
    """One that says more than the data do: the climb ends where both agree, and knows how sharp that is."""
    problem = line_problem()
    parameters = tuple(normal(p, 0.02) for p in problem.surrogate.space.parameters)
    space = ParameterSpace(parameters, (Correlation(*(p.name for p in parameters), 0.8),))
    informed = dataclasses.replace(problem, material=space)
    low, high = informed.bounds
    top = gauss_newton(informed, 0.1 * low + 0.9 * high, None, 4)
    width, steps = (high - low)[:2], 1e-3 * np.eye(informed.dim)[:2]
    ahead, behind = (informed.log_prob(top.vector + sign * steps) for sign in (1, -1))
    np.testing.assert_allclose(width * (ahead - behind) / 2e-3, 0.0, atol=0.5)
    curved = -(width**2) * (ahead + behind - 2 * top.value) / 1e-6
    np.testing.assert_allclose(np.diag(top.information)[:2], curved, rtol=0.02)
    alone = gauss_newton(problem, 0.1 * low + 0.9 * high, None, 4)
    assert np.abs(top.vector[:2]).max() < 0.5 * np.abs(alone.vector[:2]).max()


def test_draws_of_a_normal_prior_taught_nothing():
    draws = SPACE.from_unit(np.random.default_rng(2).uniform(size=(4000, 3)))
    for parameter in identifiability(SPACE, draws).parameters:
        assert "does not inform" in parameter.statement
        assert parameter.contraction == pytest.approx(0.0, abs=0.05)


JOINT = dataclasses.replace(SPACE, correlations=(Correlation("E", "p", -0.7),))


def test_a_joint_prior_is_a_normal_law_of_both_cut_to_the_bounds():
    sd = np.array([np.log(3.0), 2.0])
    law = stats.multivariate_normal([np.log(2e4), 0.5], np.outer(sd, sd) * [[1.0, -0.7], [-0.7, 1.0]])
    line = SPACE.to_line(SPACE.from_unit(np.random.default_rng(3).uniform(size=(50, 3))))
    difference = JOINT.log_density(line) - law.logpdf(line[:, :2])
    np.testing.assert_allclose(difference, difference[0], atol=1e-9)
    draws = JOINT.to_line(JOINT.draw(np.random.default_rng(4), 20_000))
    many = law.rvs(400_000, random_state=5)
    low, high = JOINT.to_line(JOINT.lower)[:2], JOINT.to_line(JOINT.upper)[:2]
    kept = many[np.all((many >= low) & (many <= high), axis=1)]
    np.testing.assert_allclose(draws[:, :2].mean(axis=0), kept.mean(axis=0), atol=0.03)
    np.testing.assert_allclose(np.cov(draws[:, :2].T), np.cov(kept.T), atol=0.04)
    assert np.corrcoef(draws.T)[0, 2] == pytest.approx(0.0, abs=0.03)
    assert JOINT.contains(JOINT.draw(np.random.default_rng(6), 1000)).all()


def test_a_joint_prior_pulls_the_posterior_of_a_line():
    a, b = (normal(p, 0.1) for p in line_problem().surrogate.space.parameters)
    covariance = 0.1**2 * np.array([[1.0, 0.8], [0.8, 1.0]])
    assert_conjugate((a, b), np.linalg.inv(covariance), Correlation(a.name, b.name, 0.8))


def test_the_distribution_stands_in_words():
    assert "E log-normal about 20 kPa (sd: factor 3), 1 kPa to 1 MPa" in describe(SPACE)


def written(where: Path, text: str) -> Path:
    (where / "case.toml").write_text(f'[recording]\nfile = "r.h5"\n[parameters.E_c]\n{text}\n')
    return where / "case.toml"


TWO = """prior = "log-normal"
median = 60e3
factor = 2.0
[parameters.E_s]
prior = "log-normal"
median = 15e3
factor = 2.0
[parameters.E_c.correlations]
"""


def test_a_configuration_states_a_joint_prior(tmp_path: Path):
    config = load_config(written(tmp_path, TWO + "E_s = -0.6"))
    assert parameter_space(config).correlations == (Correlation("E_c", "E_s", -0.6),)
    (tmp_path / "again.toml").write_text(to_toml(config))
    assert load_config(tmp_path / "again.toml") == config
    assert parameter_space(config).box.correlations == ()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("E_x = 0.5", "correlations: 'E_x' is not known; both parameters need normal or log-normal priors"),
        ("k_c = 0.5", "the prior of k_c is not normal; both parameters need normal"),
        ("E_s = 1.0", "correlations: E_c and E_s: the value is 1; two different parameters"),
        ("E_c = 0.5", "the value is 0.5; two different parameters"),
        ('E_s = "much"', 'E_c.correlations.E_s: "much" is not allowed; it must be a valid number'),
        (
            "E_s = 0.5\n[parameters.E_s.correlations]\nE_c = 0.5",
            "E_s and E_c: two values are given; give one",
        ),
    ],
)
def test_a_joint_prior_that_cannot_be_is_refused(tmp_path: Path, text: str, says: str):
    with pytest.raises(InputError) as caught:
        load_config(written(tmp_path, TWO + text))
    assert says in str(caught.value)


def test_correlations_that_cannot_hold_together_are_refused():
    three = [Parameter(name, "Pa", -9.0, 9.0, "normal") for name in "abc"]
    pairs = (Correlation("a", "b", 0.9), Correlation("b", "c", 0.9), Correlation("a", "c", -0.9))
    with pytest.raises(InputError, match="must be positive definite"):
        ParameterSpace(tuple(three), pairs)


def test_a_configuration_states_a_prior_and_its_source(tmp_path: Path):
    text = 'prior = "log-normal"\nmedian = 60e3\nfactor = 2.0\nsource = "indentation of the same site"'
    e_c = parameter_space(load_config(written(tmp_path, text))).parameters[0]
    assert (e_c.prior, e_c.centre, e_c.spread) == ("log-normal", 60e3, np.log(2.0))
    assert e_c.source == "indentation of the same site"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('prior = "normal"\nmean = 1e5', "prior: a normal prior is given with mean; it needs mean and sd"),
        (
            'prior = "log-normal"',
            "prior: a log-normal prior is given with no number; it needs factor and median",
        ),
        (
            "mean = 1e5\nsd = 1e4",
            "prior: a default prior is given with mean, sd; only a normal or log-normal prior",
        ),
        (
            'prior = "normal"\nmean = 5e6\nsd = 1e4',
            "centred at 5e+06 Pa; the centre must lie within the bounds, 10000 to 2e+06",
        ),
    ],
)
def test_a_prior_without_its_numbers_is_refused(tmp_path: Path, text: str, says: str):
    with pytest.raises(InputError) as caught:
        load_config(written(tmp_path, text))
    assert says in str(caught.value)


def test_a_better_sentence_leaves_stored_posteriors_valid() -> None:
    said = line_problem()
    space = said.surrogate.space
    worded = dataclasses.replace(
        space,
        parameters=tuple(dataclasses.replace(p, description="in other words") for p in space.parameters),
    )
    wider = dataclasses.replace(
        space, parameters=tuple(dataclasses.replace(p, upper=2.0 * p.upper) for p in space.parameters)
    )
    assert worded.without_texts == space.without_texts != wider.without_texts
    assert (
        dataclasses.replace(said, material=worded).identity
        == dataclasses.replace(said, material=space).identity
    )
