"""Points fill the box, and history matching rules out only what is ruled out."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import qmc
from toys.closed_form_model import SPACE, toy_force

from bayeskin.design import default_space, first_wave, posterior_wave, sobol_points
from bayeskin.errors import InputError
from bayeskin.history_matching import misfit_bounds, next_wave
from bayeskin.types import Array, Parameter, ParameterSpace, Prediction

SQUARE = ParameterSpace((Parameter("a", "m", 0.0, 1.0, "uniform"), Parameter("b", "m", 0.0, 1.0, "uniform")))
TIMES_S = np.array([10.0, 15, 17, 20, 30, 44, 50, 62, 75, 80, 100, 110, 125])
TRUTH = SPACE.from_unit([[0.5, 0.4, 0.6, 0.5, 0.3]])


def exact(model: Callable[[Array], Array], sd_n: float = 0.0) -> Callable[[Array], Prediction]:
    """A surrogate that is the model, and claims to know it to within `sd_n`."""

    def predict(theta: Array) -> Prediction:
        mean = model(theta)
        return Prediction(mean, np.zeros((*mean.shape, 1)), np.full(mean.shape, sd_n**2))

    return predict


def skin(theta: Array) -> Array:
    """The toy at forces of a skin test: a peak of 0.8 N at the truth."""
    return 1e-3 * toy_force(theta, TIMES_S)


def offsets(theta: Array) -> Array:
    """A model whose misfit to (0, 0) is known: rms = |a - b| whatever a + b."""
    difference = theta[:, :1] - theta[:, 1:2]
    return np.concatenate([difference, -difference], axis=1)


def test_the_default_box_is_the_articles_literature_range() -> None:
    space = default_space()
    assert space.names == ("E_c", "E_s", "k_c", "k_s", "p_init")
    assert [p.unit for p in space.parameters] == ["Pa", "Pa", "m^2", "m^2", "Pa"]
    np.testing.assert_array_equal(space.lower, [1e4, 1e3, 1e-16, 1e-16, -670.0])
    np.testing.assert_array_equal(space.upper, [2e6, 5e5, 1e-11, 1e-11, 2144.0])
    assert space.is_log.tolist() == [True, True, True, True, False]
    assert all(p.source and p.description for p in space.parameters)


@settings(deadline=None)
@given(st.integers(0, 300), st.integers(0, 300), st.integers(0, 2**31))
def test_a_longer_sequence_starts_with_the_shorter_one(n: int, more: int, seed: int) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # about powers of two, too
        long = sobol_points(SPACE, n + more, seed)
        np.testing.assert_array_equal(sobol_points(SPACE, n, seed), long[:n])
        np.testing.assert_array_equal(sobol_points(SPACE, more, seed, skip=n), long[n:])
    assert SPACE.contains(long).all()


def test_points_fill_the_prior_better_than_chance() -> None:
    unit = SPACE.to_unit(sobol_points(SPACE, 128, seed=0))
    chance = np.random.default_rng(0).uniform(size=(20, 128, 5))
    assert qmc.discrepancy(unit) < 0.3 * min(qmc.discrepancy(points) for points in chance)
    for column in unit.T:  # one point in each of 128 equal slices of every parameter's prior
        assert sorted(np.floor(column * 128)) == list(range(128))


def test_seeds_differ_and_seed_zero_is_one_of_them() -> None:
    zero, first = sobol_points(SPACE, 8, 0), sobol_points(SPACE, 8, 1)
    assert not np.any(zero == first)
    np.testing.assert_array_equal(sobol_points(SPACE, 8, 0), zero)
    with pytest.raises(InputError):
        sobol_points(SPACE, -1, 0)
    with pytest.raises(InputError):
        sobol_points(SPACE, 1, -1)


def test_wave_zero_can_be_enlarged_and_its_test_points_are_independent() -> None:
    small, large = first_wave(SPACE, 20, 6, seed=5), first_wave(SPACE, 50, 6, seed=5)
    np.testing.assert_array_equal(large.theta[~large.held_out][:20], small.theta[~small.held_out])
    np.testing.assert_array_equal(large.theta[large.held_out], small.theta[small.held_out])
    assert (small.number, small.seed, small.held_out.sum()) == (0, 5, 6)
    assert (small.record["training"], small.record["held_out"]) == (20, 6)
    assert len(np.unique(large.theta, axis=0)) == 56


def test_misfit_bounds_are_the_triangle_inequality() -> None:
    rng = np.random.default_rng(2)
    mean, sd, force = rng.normal(size=(50, 30)), rng.uniform(0, 0.2, (50, 30)), rng.normal(size=30)
    fitted = rng.uniform(size=30) < 0.5
    low, high = misfit_bounds(mean, sd, force, fitted)
    # One error common to all bins is the worst case for a norm; two sd of it stay within three.
    for sign in (-2.0, 2.0):
        misfit = np.sqrt(np.mean((force - mean - sign * sd)[:, fitted] ** 2, axis=1))
        assert np.all((low <= misfit) & (misfit <= high))
    unmeasured = np.where(fitted, force, np.nan)
    np.testing.assert_array_equal(misfit_bounds(mean, sd, unmeasured, fitted)[0], low)
    with pytest.raises(InputError):
        misfit_bounds(mean, sd, force, np.zeros(30))


@settings(deadline=None)
@given(st.floats(0.0, 2.0), st.floats(0.0, 0.3), st.floats(1e-3, 0.5), st.floats(1.0, 3.0))
def test_the_best_point_is_never_ruled_out(shift: float, sd: float, floor: float, factor: float) -> None:
    """However wrong the model is everywhere (`shift`), as long as the surrogate's error is honest."""
    rng = np.random.default_rng(3)
    truth = rng.normal(size=(200, 12))
    mean = truth + sd * rng.normal(size=(200, 12))
    force = np.full(12, shift)
    low, high = misfit_bounds(mean, np.full_like(mean, sd), force, np.ones(12))
    keep = low <= factor * max(high.min(), floor)
    misfit = np.sqrt(np.mean((force - truth) ** 2, axis=1))
    assert keep[misfit.argmin()]
    assert np.all(keep[misfit <= floor])
    if sd == 0.0:
        np.testing.assert_array_equal(keep, misfit <= factor * max(misfit.min(), floor))


def test_the_kept_fraction_and_box_are_those_of_a_known_region() -> None:
    """|a - b| <= 1.5 floor is a band along the diagonal, of area 1 - (1 - 1.5 floor)^2."""
    for floor in (0.1, 0.01, 1e-4):
        wave = next_wave(SQUARE, exact(offsets), np.zeros(2), np.ones(2), floor, 64, 16, wave=1, seed=9)
        area = 1.0 - (1.0 - 1.5 * floor) ** 2
        assert wave.record["kept_fraction"] == pytest.approx(area, rel=0.15)
        assert np.all(np.abs(np.diff(wave.theta, axis=1)) <= 1.5 * floor)
        assert (wave.record["training"], wave.record["held_out"]) == (64, 16)
        assert max(wave.record["lower"].values()) < 0.05
        assert min(wave.record["upper"].values()) > 0.95
        along = np.sort(wave.theta[~wave.held_out].mean(axis=1))
        assert np.max(np.diff(along, prepend=0.0, append=1.0)) < 0.12, "no part of the band is empty"


@pytest.mark.parametrize("sd_n", [0.02, 0.002])
def test_the_next_wave_keeps_the_truth_and_shrinks_the_box(sd_n: float) -> None:
    """The recording has what the model lacks: a ripple of four noise floors."""
    ripple_n = 0.012 * np.sign(np.sin(1.0 + np.arange(len(TIMES_S))))
    force_n = skin(TRUTH)[0] + ripple_n
    predict, floor_n = exact(skin, sd_n), 0.003
    wave = next_wave(SPACE, predict, force_n, np.ones(len(TIMES_S)), floor_n, 48, 16, wave=1, seed=4)
    record = wave.record
    assert record["kept_fraction"] < (0.2 if sd_n > 0.01 else 0.03)
    low, _ = misfit_bounds(skin(TRUTH), np.full((1, len(TIMES_S)), sd_n), force_n, np.ones(len(TIMES_S)))
    assert low[0] <= record["limit_n"], "the truth passes"
    lower, upper = np.array(list(record["lower"].values())), np.array(list(record["upper"].values()))
    assert np.all((lower <= TRUTH[0]) & (TRUTH[0] <= upper))
    misfit = np.sqrt(np.mean((force_n - skin(wave.theta)) ** 2, axis=1))
    assert np.all(misfit - 3 * sd_n <= record["limit_n"] + 1e-12)
    assert (wave.held_out.sum(), len(wave.theta)) == (16, 64)
    # The pressure leaves no trace in the force: nothing of its range may be ruled out.
    pressure = SPACE.to_unit(np.array([lower, upper]))[:, 4]
    np.testing.assert_allclose(pressure, [0.0, 1.0], atol=0.03)


def test_the_same_seed_gives_the_same_wave_and_another_another() -> None:
    def make(n: int, seed: int) -> Array:
        wave = next_wave(SQUARE, exact(offsets), np.zeros(2), [True, False], 0.1, n, 8, wave=2, seed=seed)
        return wave.theta[~wave.held_out]

    np.testing.assert_array_equal(make(16, 0), make(16, 0))
    np.testing.assert_array_equal(make(32, 0)[:16], make(16, 0))
    assert not np.any(make(16, 0) == make(16, 1))


def test_a_part_too_thin_to_fill_gives_fewer_points_and_says_so() -> None:
    """A curved part, where |a - sin(9 b)/2 - 1/2| must be a millionth: boxes do not help."""

    def bent(theta: Array) -> Array:
        return theta[:, :1] - 0.5 - 0.5 * np.sin(9.0 * theta[:, 1:2])

    wave = next_wave(SQUARE, exact(bent), np.zeros(1), np.ones(1), 1e-6, 64, 8, wave=1, seed=0)
    assert wave.record["training"] == np.sum(~wave.held_out) < 64
    assert np.abs(bent(wave.theta)).max() <= wave.record["limit_n"]


def test_a_waves_points_cannot_be_changed() -> None:
    wave = first_wave(SPACE, 4, 1, seed=0)
    with pytest.raises(ValueError, match="read-only"):
        wave.theta[0, 0] = 1.0
    assert not replace(wave, theta=wave.theta[:2], held_out=wave.held_out[:2]).theta.flags.writeable


def test_a_wave_of_a_posterior_reaches_its_tails_and_is_tested_where_its_draws_lie() -> None:
    rng = np.random.default_rng(3)
    draws = np.clip([0.5, 0.6] + [1e-3, 0.1] * rng.standard_normal((600, 2)), 0.0, 1.0)
    draws = np.concatenate([draws, draws[:50]])  # walkers that stayed
    wave = posterior_wave(SQUARE, draws, draws, 40, 30, 3, 1)
    assert (wave.number, wave.held_out.sum(), len(wave.theta)) == (3, 30, 70)
    assert len(np.unique(wave.theta, axis=0)) == 70
    apart = (wave.theta - draws.mean(axis=0)) / draws.std(axis=0)
    assert np.all(apart[~wave.held_out].std(axis=0) > 1.3)
    assert np.all(np.abs(apart[wave.held_out].std(axis=0) - 1.0) < 0.3)
    assert wave.record["kept_fraction"] < 0.01
    few = posterior_wave(SQUARE, draws[:10], draws[:10], 40, 4, 3, 1)
    assert (few.held_out.sum(), len(few.theta)) == (4, 10)
