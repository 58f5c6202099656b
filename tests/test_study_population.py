"""The population of a study: against linear algebra, and what each kind of table can and cannot tell."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from toys import made_up_population as made_up
from toys import normal_hierarchy as normal

from bayeskin.study import Individual, Population, Priors, SamplerSettings, infer_population
from bayeskin.study.exact_draws import draw_coefficients, draw_covariances, draw_values
from bayeskin.study.individual import Likelihoods
from bayeskin.study.layout import Layout
from bayeskin.study.mixture import NormalMixture
from bayeskin.study.model import Model, State
from bayeskin.study.moves import Ensembles
from bayeskin.study.overlap import overlap
from bayeskin.study.sampler import draw_population
from bayeskin.types import Array, Parameter, ParameterSpace


def measured(table, true_x: Array, errors: Array) -> tuple[Array, list[Individual]]:
    """Measurements (N, d) of true_x with normal errors (N, d, d), and the posteriors of the recordings."""
    rng = np.random.default_rng(1)
    y = np.array([rng.multivariate_normal(x, error) for x, error in zip(true_x, errors, strict=True)])
    named = zip(table, y, errors, strict=True)
    return y, [normal.individual(entry.recording.name, values, error) for entry, values, error in named]


def assert_alike(state: State, other: State, close: float) -> None:
    """Compares means and sds of all parameters, in sd; `close` is four standard errors or more."""
    for a, b in zip(coordinates(state), coordinates(other), strict=True):
        sd = b.std(axis=0)
        assert np.abs((a.mean(axis=0) - b.mean(axis=0)) / sd).max() < close
        assert np.abs(np.log(a.std(axis=0) / sd)).max() < close


def coordinates(state: State) -> list[Array]:
    log_sds = [0.5 * np.log(np.diagonal(level, axis1=1, axis2=2)) for level in state.covariances]
    pairs = [level for level in state.covariances if level.shape[1] == 2]
    ties = [np.arctanh(level[:, 0, 1:] / np.sqrt(level[:, 0, :1] * level[:, 1:, 1])) for level in pairs]
    return [state.x, state.coefficients, *state.values, *log_sds, *ties]


@pytest.fixture(scope="module")
def nested() -> tuple[Ensembles, State]:
    """Moves of 200 ensembles and exact draws of the posterior for them.

    The study has three levels: subjects in two groups, their sessions, and recordings at two sites in each
    session. Some recordings are precise, and some say little.
    """
    rng = np.random.default_rng(4)
    rows = [
        (f"s{j}", "ab"[j % 2], ("arm", "leg")[k], str(t))
        for j in range(4)
        for t in range(2)
        for k in range(2)
    ]
    table = normal.entries(rows, ("subject", "group", "site", "session"))
    subject, session = np.repeat(np.arange(4), 4), np.repeat(np.arange(8), 2)
    x = np.log(6e4) + 0.4 * rng.standard_normal(4)[subject] + 0.3 * rng.standard_normal(8)[session]
    x = (x + 0.2 * np.tile([0.0, 1.0], 8) + 0.1 * rng.standard_normal(16))[:, None]
    errors = np.tile([0.05, 0.8, 0.1, 0.3], 4)[:, None, None] ** 2
    y, individuals = measured(table, x, errors)
    exact = normal.Exact.of(table, y, errors, *normal.grid(3, 24))
    likelihoods = Likelihoods.of(individuals, rng)
    state = exact.draw(4000, rng)
    state = replace(state, log_likelihood=likelihoods.log_likelihood(state.x))
    return Ensembles(exact.model, likelihoods, 200, 20), state


MOVES = {
    "coefficients": lambda moves, state, rng: draw_coefficients(moves.model, state, rng),
    "values": lambda moves, state, rng: draw_values(moves.model, state, rng),
    "covariances": lambda moves, state, rng: draw_covariances(moves.model, state, rng),
    "from the population": lambda moves, state, rng: moves.from_population(state, rng),
    "from the posteriors": lambda moves, state, rng: moves.from_posteriors(state, rng),
    "steps": lambda moves, state, rng: moves.move_recordings(state, rng),
    "steps of coefficients": lambda moves, state, rng: moves.move_coefficients(state, rng),
    "subjects' spread": lambda moves, state, rng: moves.move_spread(state, 0, rng),
    "sessions' spread": lambda moves, state, rng: moves.move_spread(state, 1, rng),
    "recordings' spread": lambda moves, state, rng: moves.move_spread(state, 2, rng),
}


@pytest.mark.parametrize("move", MOVES)
def test_each_move_leaves_exact_draws_of_the_posterior_as_they_are_distributed(nested, move: str) -> None:
    moves, start = nested
    rng, state = np.random.default_rng(5), start
    for _ in range(10):
        state = MOVES[move](moves, state, rng)
    assert any(np.any(a != b) for a, b in zip(coordinates(state), coordinates(start), strict=True))
    assert_alike(state, start, 0.08)


def test_two_tied_parameters_have_the_posterior_of_linear_algebra() -> None:
    """The effects of subjects and the errors of recordings are correlated, in opposite directions."""
    rng = np.random.default_rng(5)
    table = normal.entries([(f"s{j}",) for j in range(5) for _ in range(2)], ("subject",))
    tie = 0.25 * np.array([[1.0, 0.7], [0.7, 1.0]])
    x = np.log(6e4) + rng.multivariate_normal(np.zeros(2), tie, 5)[np.repeat(np.arange(5), 2)]
    x = x + 0.2 * rng.standard_normal((10, 2))
    ridge = np.array([[1.0, -0.9], [-0.9, 1.0]])
    errors = np.tile([0.4, 0.7], 5)[:, None, None] ** 2 * ridge
    y, individuals = measured(table, x, errors)
    covariances = normal.prior_draws(2, 30_000, rng)
    exact = normal.Exact.of(table, y, errors, covariances, np.zeros(len(covariances)))
    assert exact.effective > 800
    likelihoods = Likelihoods.of(individuals, rng)
    draws, convergence = draw_population(exact.model, likelihoods, rng, SamplerSettings())
    assert convergence.verdict.trusted
    assert_alike(draws, exact.draw(4000, rng), 0.18)


QUICK = SamplerSettings(max_sweeps=200)
MODULUS = Parameter("E_c", "Pa", 1e4, 2e6, "log-uniform", stress_power=1)
PERMEABILITY = Parameter("k_c", "m^2", 1e-16, 1e-11, "log-uniform")
SPACE = ParameterSpace((MODULUS, PERMEABILITY))


def precise(name: str, modulus: float, rng: np.random.Generator) -> Individual:
    """A posterior that knows the modulus to 2 %, and says nothing about the permeability."""
    draws = SPACE.draw(rng, 1000)
    draws[:, 0] = modulus * np.exp(0.02 * rng.standard_normal(1000))
    return Individual(name, SPACE, draws)


def inferred(table, moduli: Sequence[float], settings: SamplerSettings = QUICK) -> Population:
    rng = np.random.default_rng(7)
    individuals = [precise(e.recording.name, m, rng) for e, m in zip(table, moduli, strict=True)]
    return infer_population(table, individuals, rng, settings=settings)


def test_two_clear_groups_differ_by_their_ratio() -> None:
    table = made_up.table(subjects=8, sessions=1)
    moduli = np.array([1e5, 2e5] * 4) * np.exp(0.05 * np.array([1, 1, -1, -1, -2, -2, 2, 2]))
    modulus, permeability = inferred(table, moduli).parameters
    (contrast,) = modulus.contrasts
    assert (contrast.first, contrast.second) == ("control", "keloid")
    assert contrast.probability > 0.99
    assert contrast.ratio.low < 2.0 < contrast.ratio.high < 2.6
    assert modulus.medians["keloid"].median == pytest.approx(2e5, rel=0.1)
    assert modulus.within is None  # one recording a subject
    assert (modulus.informative, permeability.informative) == (8, 0)
    assert permeability.contrasts[0].ratio.high > 5.0
    assert permeability.at_lower == permeability.at_upper == 0


def test_a_subject_in_both_groups_is_compared_with_itself() -> None:
    """Subjects differ by a factor of four, and their two sites by 20 %, which only pairs can show."""
    subjects = np.exp(np.linspace(0.0, np.log(4.0), 6))
    rows = [
        (f"s{j}", group, side) for j in range(6) for group, side in (("healthy", "left"), ("keloid", "right"))
    ]
    rows[0], rows[1] = ("s0", "healthy", "right"), ("s0", "keloid", "left")
    rows[2], rows[3] = ("s1", "healthy", "right"), ("s1", "keloid", "left")
    table = normal.entries(rows, ("subject", "group", "site"))
    population = inferred(table, 1e5 * np.repeat(subjects, 2) * np.tile([1.0, 1.2], 6))
    group, site = population.parameters[0].contrasts
    assert group.probability > 0.95
    assert group.ratio.high / group.ratio.low < 1.5
    assert site.category == "site"
    assert site.ratio.low < 1.0 < site.ratio.high
    assert population.subjects[0].group is None


def test_values_are_shrunk_towards_the_group_and_towards_the_subject() -> None:
    table = made_up.table(subjects=6, sessions=2, groups=())
    rng = np.random.default_rng(9)
    moduli = np.repeat(1e5 * np.exp(0.1 * rng.standard_normal(6)), 2)
    individuals = [precise(e.recording.name, m, rng) for e, m in zip(table, moduli, strict=True)]
    vague = np.clip(3e5 * np.exp(0.8 * rng.standard_normal(1000)), 1e4, 2e6)
    individuals[0] = Individual("s0-0.h5", SPACE, np.column_stack([vague, individuals[0].draws[:, 1]]))
    population = infer_population(table, individuals, rng, settings=QUICK)
    (alone, _), (shrunk, _) = population.recordings[0].alone, population.recordings[0].shrunk
    assert shrunk.median == pytest.approx(moduli[0], rel=0.15)
    assert shrunk.high / shrunk.low < 0.3 * alone.high / alone.low
    assert population.subjects[0].shrunk[0].median == pytest.approx(moduli[0], rel=0.1)


def test_a_posterior_that_leans_on_a_bound_is_counted() -> None:
    table = made_up.table(subjects=3, sessions=1, groups=())
    rng = np.random.default_rng(10)
    individuals = [precise(e.recording.name, 1e5, rng) for e in table]
    low = 1e-16 * np.exp(0.5 * rng.exponential(size=1000))
    individuals[2] = Individual("low", SPACE, np.column_stack([individuals[2].draws[:, 0], low]))
    permeability = infer_population(table, individuals, rng, settings=QUICK).parameters[1]
    assert (permeability.at_lower, permeability.at_upper, permeability.informative) == (1, 0, 1)


def test_too_few_sweeps_are_not_trusted_and_the_same_generator_gives_the_same_result() -> None:
    table = made_up.table(subjects=2, sessions=1, groups=())
    settings = SamplerSettings(max_sweeps=20)
    result, same = (inferred(table, [1e5, 2e5], settings) for _ in range(2))
    assert not result.trusted
    assert result.parameters == same.parameters
    assert result.recordings == same.recordings


def test_draws_that_contradict_the_fitted_likelihood_are_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The likelihood of one recording is shifted by its width, as a bad fit might be."""
    table = made_up.table(subjects=4, sessions=2, groups=())
    moduli = 1e5 * np.exp(np.linspace(0.0, 1.0, 8))
    rng = np.random.default_rng(11)
    individuals = [
        Individual(e.recording.name, normal.space(1), m * np.exp(0.1 * rng.standard_normal((2000, 1))))
        for e, m in zip(table, moduli, strict=True)
    ]
    assert not any(
        overlapping.contradicts
        for overlapping in infer_population(table, individuals, rng, settings=QUICK).overlaps
    )
    fit, count = NormalMixture.of.__func__, itertools.count()

    def shifted(cls: type[NormalMixture], points: Array, *further) -> NormalMixture:
        mixture = fit(cls, points, *further)
        return replace(mixture, centres=mixture.centres + points.std() * (next(count) == 3))

    monkeypatch.setattr(NormalMixture, "of", classmethod(shifted))
    wrong = infer_population(table, individuals, rng, settings=QUICK).overlaps
    assert [n for n, overlapping in enumerate(wrong) if overlapping.contradicts] == [3]


def test_weighted_draws_of_a_recording_that_says_nothing_are_those_of_the_population() -> None:
    """Its prior is uniform, so the weights have to turn a uniform density into a log-normal one."""
    rng = np.random.default_rng(12)
    space = ParameterSpace((Parameter("E_c", "Pa", 1e4, 2e6, "uniform"),))
    silent = Individual("silent", space, space.draw(rng, 2000))
    model = Model.of(Layout.of(made_up.table(1, 1, ())), tuple(np.log([[1e4], [2e6]])), Priors())
    x = np.log(2e5) + 0.5 * rng.standard_normal((4000, 1, 1))
    draws = State(x, 0.0 * x[..., 0], np.full((4000, 1, 1), np.log(2e5)), (), (np.full((4000, 1, 1), 0.25),))
    overlapping = overlap(0, silent, model, draws)
    assert overlapping.shift_sd < 0.1
    assert 100 < overlapping.effective < 2000
    assert not overlapping.poor
    narrow = replace(
        draws, x=np.log(2e5) + 0.002 * (x - np.log(2e5)), covariances=(1e-6 * draws.covariances[0],)
    )
    assert overlap(0, silent, model, narrow).poor
