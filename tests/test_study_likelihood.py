"""The likelihood of a recording, fitted to draws of its posterior: shapes, priors, bounds, and refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from toys import normal_hierarchy as normal

from bayeskin.errors import InputError
from bayeskin.study import Individual
from bayeskin.study.individual import Likelihoods, log_prior
from bayeskin.study.mixture import NormalMixture
from bayeskin.types import Array, Correlation, Parameter, ParameterSpace

LOG_UNIFORM = ParameterSpace(
    (Parameter("E_c", "Pa", 1e4, 2e6, "log-uniform"), Parameter("k_s", "m^2", 1e-16, 1e-11, "log-uniform"))
)


def resampled(space: ParameterSpace, log_likelihood, rng: np.random.Generator) -> Individual:
    """Draws of a posterior: draws of the prior, each kept with a chance in proportion to its likelihood."""
    theta = space.draw(rng, 200_000)
    kept = np.log(rng.random(len(theta))) < log_likelihood(np.log(theta))
    return Individual("r", space, theta[kept][:2000])


def fitted(individual: Individual, x: Array) -> Array:
    """The fitted log-likelihood at points x (n, d), relative to its mean over them."""
    log = Likelihoods.of([individual], np.random.default_rng(0)).log_likelihood(x[:, None])[:, 0]
    return log - log.mean()


def test_a_normal_likelihood_is_exact_after_division_by_a_normal_prior() -> None:
    y, errors = np.array([11.0, 10.5]), np.array([[0.04, 0.01], [0.01, 0.09]])
    x = y + np.random.default_rng(1).uniform(-1.0, 1.0, (200, 2))
    exact = -0.5 * np.einsum("ni,ij,nj->n", x - y, np.linalg.inv(errors), x - y)
    assert fitted(normal.individual("r", y, errors), x) == pytest.approx(exact - exact.mean(), abs=0.1)


def test_a_recording_that_says_nothing_has_a_flat_likelihood() -> None:
    rng = np.random.default_rng(2)
    log = fitted(
        Individual("r", LOG_UNIFORM, LOG_UNIFORM.draw(rng, 2000)), np.log(LOG_UNIFORM.draw(rng, 500))
    )
    assert log.std() < 0.1


def test_a_curved_ridge_that_ends_at_a_bound_keeps_its_shape() -> None:
    """The sum of both parameters is measured, on their logarithms, so that each has an upper end only."""

    def log_likelihood(x: Array) -> Array:
        stiff = np.log(np.exp(x[:, 0]) + 1e16 * np.exp(x[:, 1]))
        return -0.5 * ((stiff - np.log(1.2e5)) / 0.2) ** 2

    individual = resampled(LOG_UNIFORM, log_likelihood, np.random.default_rng(3))
    x = np.log(individual.draws)
    exact = log_likelihood(x)
    error = fitted(individual, x) - (exact - exact.mean())
    assert error.std() < 0.35
    assert np.log(individual.draws).std(axis=0).min() > 0.5  # each parameter alone is hardly known


PRIORS = pytest.mark.parametrize(
    "parameter",
    [
        Parameter("E_c", "Pa", 1e4, 2e6, "uniform"),
        Parameter("E_c", "Pa", 1e4, 2e6, "log-uniform", offset=2e5),
        Parameter("E_c", "Pa", 1e4, 2e6, "normal", centre=3e5, spread=3e5),
        Parameter("E_c", "Pa", 1e4, 2e6, "log-normal", centre=3e5, spread=1.0),
    ],
    ids=["uniform", "offset", "normal", "log-normal"],
)


@PRIORS
def test_the_density_of_a_prior_is_that_of_the_logarithm(parameter: Parameter) -> None:
    space = ParameterSpace((parameter,))
    x = np.linspace(*np.log([1e4, 2e6]), 20_001)
    density = np.exp(log_prior(space, x[:, None]))
    assert np.trapezoid(density, x) == pytest.approx(1.0, rel=1e-4)
    below = np.mean(space.draw(np.random.default_rng(0), 50_000) < 2e5)
    assert np.trapezoid(density * (x < np.log(2e5)), x) == pytest.approx(below, abs=0.01)


@PRIORS
def test_the_prior_under_which_draws_were_made_does_not_matter(parameter: Parameter) -> None:
    space = ParameterSpace((parameter,))

    def log_likelihood(x: Array) -> Array:
        return -0.5 * ((x[:, 0] - np.log(1.5e5)) / 0.25) ** 2

    x = np.log(1.5e5) + np.linspace(-0.5, 0.5, 40)[:, None]
    exact = log_likelihood(x)
    individual = resampled(space, log_likelihood, np.random.default_rng(4))
    assert fitted(individual, x) == pytest.approx(exact - exact.mean(), abs=0.25)


def test_the_correlation_of_a_prior_is_divided_out() -> None:
    first, second = (
        Parameter(name, "Pa", 1e3, 1e7, "log-normal", centre=1e5, spread=0.5) for name in ("E_c", "E_s")
    )
    space = ParameterSpace((first, second), (Correlation("E_c", "E_s", 0.9),))

    def log_likelihood(x: Array) -> Array:
        return -0.5 * np.sum(((x - np.log(1e5)) / 0.5) ** 2, axis=1)

    individual = resampled(space, log_likelihood, np.random.default_rng(6))
    x = np.log(individual.draws[:100])
    exact = log_likelihood(x)
    assert np.std(fitted(individual, x) - exact) < 0.15  # 0.6 where the correlation is left in


def test_nothing_lies_outside_the_bounds_of_a_recordings_own_prior() -> None:
    rng = np.random.default_rng(7)
    wide = replace(LOG_UNIFORM.parameters[0], upper=1e7)
    spaces = (LOG_UNIFORM, ParameterSpace((wide, LOG_UNIFORM.parameters[1])))
    both = Likelihoods.of([Individual("r", space, space.draw(rng, 500)) for space in spaces], rng)
    x = np.log(np.tile([4e6, 1e-13], (1, 2, 1)))
    assert np.isfinite(both.log_likelihood(x)).tolist() == [[False, True]]
    assert np.exp(both.bounds[1]) == pytest.approx([1e7, 1e-11])
    assert np.isfinite(both.log_likelihood(both.draw(300, rng))).all()


def test_draws_of_the_fit_are_those_of_the_posterior() -> None:
    rng = np.random.default_rng(8)
    individual = normal.individual("r", np.array([11.0, 10.0]), np.array([[0.3, 0.2], [0.2, 0.3]]))
    drawn = Likelihoods.of([individual], rng).draw(20_000, rng)[:, 0]
    own = np.log(individual.draws)
    assert drawn.mean(axis=0) == pytest.approx(own.mean(axis=0), abs=0.02)
    assert np.cov(drawn.T) == pytest.approx(np.cov(own.T), abs=0.02)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"draws": np.ones((200, 3))}, "3"),
        ({"draws": LOG_UNIFORM.draw(np.random.default_rng(0), 50)}, "50 draws"),
        ({"draws": np.full((200, 2), np.nan)}, "outside the bounds"),
        ({"draws": np.tile([[1e5, 1e-13]], (200, 1))}, "mostly repeated"),
        ({"space": ParameterSpace((Parameter("p_init", "Pa", -1.0, 9e5, "uniform"),) * 1
                                  + (LOG_UNIFORM.parameters[1],))}, "positive values"),
    ],
)  # fmt: skip
def test_draws_that_cannot_be_used_are_refused(change: dict, said: str) -> None:
    arguments = {"space": LOG_UNIFORM, "draws": LOG_UNIFORM.draw(np.random.default_rng(0), 200)} | change
    with pytest.raises(InputError, match=said):
        Individual("arm-3", **arguments)


def test_recordings_with_other_parameters_are_refused() -> None:
    rng = np.random.default_rng(0)
    fewer = ParameterSpace(LOG_UNIFORM.parameters[:1])
    recordings = [Individual(name, space, space.draw(rng, 200)) for name, space in
                  (("arm-1", LOG_UNIFORM), ("arm-2", fewer))]  # fmt: skip
    with pytest.raises(
        InputError, match=r"arm-2: its parameters are E_c; they must be E_c, k_s, as in arm-1"
    ):
        Likelihoods.of(recordings, rng)


def test_a_mixture_of_two_normals_is_found_again() -> None:
    rng = np.random.default_rng(11)
    narrow, wide = np.array([[0.3, 0.0], [0.2, 0.1]]), np.array([[1.0, 0.0], [-0.8, 0.5]])
    points = np.concatenate([
        np.array([2.0, 0.0]) + rng.standard_normal((1500, 2)) @ narrow.T,
        np.array([-1.0, 1.0]) + rng.standard_normal((500, 2)) @ wide.T,
    ])  # fmt: skip
    mixture = NormalMixture.of(points, rng)
    assert np.sort(np.exp(mixture.log_weights)) == pytest.approx([0.25, 0.75], abs=0.03)
    first = int(np.argmax(mixture.log_weights))
    assert mixture.centres[first] == pytest.approx([2.0, 0.0], abs=0.05)
    root = np.linalg.inv(mixture.whiten[first])
    assert root @ root.T == pytest.approx(narrow @ narrow.T, abs=0.01)
    sums = np.exp(mixture.log_parts(np.stack(np.meshgrid(*[np.linspace(-6, 6, 241)] * 2), -1).reshape(-1, 2)))
    assert sums.sum() * 0.05**2 == pytest.approx(1.0, abs=1e-3)
