"""A surrogate corrected by runs: exact at them, as it was far away, and kriging in between."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from toy import MOTION
from toy_inference import TRUTH, ToySurrogate

from bayeskin.mechanisms import catalogue
from bayeskin.mismatch.corrected import (
    LENGTH,
    LONGEST,
    CorrectedSurrogate,
    FullRun,
    Undiminished,
    error_lengths,
    slopes,
)
from bayeskin.mismatch.observed import ObservedSurrogate
from bayeskin.mismatch.wrapper import Sure

SURE, OFF = ToySurrogate(sd_n=0.1), ToySurrogate(bias_n=0.01, sd_n=0.1)
THETA = np.array([TRUTH[name] for name in SURE.space.names])
ALL = np.full(5, LENGTH)


class Harder(ToySurrogate):
    """Pulls a fiftieth harder than the toy, with a wave [N] that goes with log E_c."""

    def __init__(self, wave: float) -> None:
        super().__init__()
        self.wave = wave

    def predict(self, theta):
        found = super().predict(theta)
        turns = np.log(np.atleast_2d(theta)[:, :1])
        return dataclasses.replace(found, mean=1.02 * found.mean + self.wave * np.sin(turns))


def away(unit: object) -> np.ndarray:
    """THETA moved by so much in coordinates of the box."""
    box = SURE.space.box
    return box.from_unit(box.to_unit(THETA) + np.asarray(unit))


def run_at(theta: np.ndarray, sloped: bool = False, wave: float = 0.0) -> FullRun:
    here = Harder(wave)
    return FullRun(theta, here.predict_mean(theta)[0], slopes(here, theta) if sloped else None)


def error_of(run: FullRun, surrogate: ToySurrogate) -> np.ndarray:
    """Over the size of the surrogate's force."""
    mean = surrogate.predict_mean(run.theta)[0]
    return (run.force_n - mean) / rms(mean)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_at_a_run_the_force_is_the_run_s_and_nothing_is_unsure() -> None:
    runs = (run_at(THETA), run_at(away([0.1, -0.1, 0.2, 0.0, 0.1]), sloped=True))
    found = CorrectedSurrogate(OFF, runs, ALL).predict(np.array([run.theta for run in runs]))
    np.testing.assert_allclose(found.mean, [run.force_n for run in runs], atol=1e-6)
    assert found.sd().max() < 3e-3 * OFF.predict(THETA).sd().max()


@pytest.mark.parametrize("common", [0.0, 1e3])
def test_one_run_s_error_fades_unless_errors_have_a_mean_of_their_own(common: float) -> None:
    run = run_at(THETA)
    found = CorrectedSurrogate(OFF, (run,), ALL, common)
    for far in (0.05, 0.15, 0.4):
        theta = away([0.6 * far, 0.0, -0.8 * far, 0.0, 0.0])
        k = np.exp(-0.5 * (far / LENGTH) ** 2)
        weight = (common + k) / (common + 1.0)
        there, plain = found.predict(theta), OFF.predict(theta)
        expected = weight * error_of(run, OFF) * rms(plain.mean)
        np.testing.assert_allclose((there.mean - plain.mean)[0], expected, rtol=1e-3, atol=1e-7)
        left = common + 1.0 - weight * (common + k)  # 1 - k^2 without a mean, 2 (1 - k) with a large one
        np.testing.assert_allclose(there.sd(), np.sqrt(left) * plain.sd(), rtol=1e-3)
        np.testing.assert_allclose(there.mean, found.predict_mean(theta))
        np.testing.assert_array_equal(Sure(found).predict(theta).mean, found.predict_mean(theta))
        assert not Sure(found).predict(theta).sd().any()


def test_of_two_runs_the_nearer_one_s_error_counts_for_more() -> None:
    """Closed form of ordinary kriging: (1 + (k_1 - k_2) / (1 - k_12)) / 2 is the first one's weight."""
    first, second = away([0.1, 0, 0, 0, 0]), away([-0.1, 0, 0, 0, 0])
    harder, plain = run_at(first), SURE.predict_mean(second)[0]
    found = CorrectedSurrogate(SURE, (harder, FullRun(second, plain, None)), ALL, 1e6)
    theta = away([0.05, 0.1, 0, 0, 0])
    k_1, k_2, k_12 = (np.exp(-0.5 * square / LENGTH**2) for square in (0.0125, 0.0325, 0.04))
    weight = 0.5 * (1.0 + (k_1 - k_2) / (1.0 - k_12))
    change = (found.predict(theta).mean - SURE.predict_mean(theta))[0]
    expected = weight * error_of(harder, SURE) * rms(SURE.predict_mean(theta))
    np.testing.assert_allclose(change, expected, rtol=1e-3, atol=1e-7)


def test_what_is_known_correlates_as_derivatives_of_the_law_do() -> None:
    """By finite differences, in lengths; runs with slopes and without, one exact parameter."""
    lengths = np.array([0.15, 0.3, np.inf, 0.2, 2.0])
    inexact = np.isfinite(lengths)
    places = [[0.0] * 5, [0.1, 0.05, 0.3, -0.1, 0.0], [-0.05, 0.1, 0.0, 0.15, 0.1]]
    runs = tuple(
        run_at(away(place), sloped=sloped) for place, sloped in zip(places, (True, False, True), strict=True)
    )
    found = CorrectedSurrogate(SURE, runs, lengths, common=2.5)
    box, h = SURE.space.box, 1e-4
    at = np.array([box.to_unit(run.theta)[inexact] for run in runs]) / lengths[inexact]

    def law(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.exp(-0.5 * np.sum((a - b) ** 2)) + 2.5)

    steps = h * np.eye(4)
    sides = [
        (law(at[i], at[j] + e) - law(at[i], at[j] - e)) / (2 * h)
        for i in range(3)
        for j in (0, 2)
        for e in steps
    ]
    np.testing.assert_allclose(found._known[:3, 3:].ravel(), sides, atol=1e-6)
    mixed = [
        (law(a + e, b + f) - law(a + e, b - f) - law(a - e, b + f) + law(a - e, b - f)) / (4 * h * h)
        for a in at[[0, 2]] for e in steps for b in at[[0, 2]] for f in steps
    ]  # fmt: skip
    inner = found._known[3:, 3:]
    without = inner - np.diag(np.diag(inner)) + np.eye(8)  # what slopes are wrong by stands on the diagonal
    np.testing.assert_allclose(without.ravel(), mixed, atol=1e-5)
    assert np.all(np.diag(inner) >= 1.0)
    forces = [law(a, b) for a in at for b in at]
    np.testing.assert_allclose(found._known[:3, :3].ravel(), forces, atol=1e-5)
    theta = away([0.02, 0.03, 0.1, 0.04, -0.05])
    here = box.to_unit(theta)[inexact] / lengths[inexact]
    expected = [law(here, one) for one in at]
    expected += [(law(here, at[j] + e) - law(here, at[j] - e)) / (2 * h) for j in (0, 2) for e in steps]
    np.testing.assert_allclose(found._correlation(theta[None])[0], expected, atol=1e-6)


def test_slopes_tell_what_the_surrogate_s_are_wrong_by() -> None:
    run = run_at(THETA, sloped=True, wave=0.01)
    unsure = ToySurrogate(sd_n=1.0)  # so that what slopes are wrong by is little
    right = slopes(Harder(0.01), THETA)
    wrong = np.abs(slopes(unsure, THETA) - right).max()
    uneven = np.array([0.15, 0.3, 0.1, 0.2, 2.0])
    for lengths in (ALL, uneven):
        assert np.abs(slopes(CorrectedSurrogate(unsure, (run,), lengths), THETA) - right).max() < 0.05 * wrong
    assert (
        np.abs(
            slopes(CorrectedSurrogate(unsure, (dataclasses.replace(run, slopes_n=None),), ALL), THETA) - right
        ).max()
        > 0.2 * wrong
    )


def test_slopes_that_a_surrogate_knows_better_are_not_followed() -> None:
    """A coarse mesh's are wrong by a fiftieth, which is many sd of a good surrogate."""
    good = ToySurrogate(sd_n=1e-5)
    right = slopes(good, THETA)
    run = FullRun(THETA, good.predict_mean(THETA)[0], 1.02 * right)
    found = slopes(CorrectedSurrogate(good, (run,), ALL), THETA)
    assert np.abs(found - right).max() < 0.05 * np.abs(0.02 * right).max()


def test_errors_that_the_surrogate_denies_leave_it_less_sure() -> None:
    theta = away([0.3, 0.0, 0.0, 0.0, 0.0])
    denying, run = ToySurrogate(sd_n=1e-4), run_at(THETA)
    error = rms(run.force_n - denying.predict_mean(THETA)[0])
    times = error / rms(denying.predict(THETA).sd())
    assert times > 5.0
    sd = CorrectedSurrogate(denying, (run,), ALL).predict(theta).sd()
    k = np.exp(-0.5 * (0.3 / LENGTH) ** 2)
    np.testing.assert_allclose(sd, times * np.sqrt(1 - k**2) * denying.predict(theta).sd(), rtol=1e-3)


def test_undiminished_it_is_as_unsure_at_a_run_as_away_from_it() -> None:
    corrected = CorrectedSurrogate(OFF, (run_at(THETA, sloped=True),), ALL)
    denied = CorrectedSurrogate(ToySurrogate(sd_n=1e-4), corrected.runs, ALL)
    theta = np.array([THETA, away([0.1, -0.1, 0.2, 0.0, 0.1])])
    for one in (corrected, denied):
        found, own = Undiminished(one).predict(theta), one.inner.predict(theta)
        np.testing.assert_array_equal(found.mean, one.predict_mean(theta))
        np.testing.assert_allclose(found.sd(), np.sqrt(one.excess) * own.sd(), rtol=1e-12)
        assert (found.sd()[0] > 10.0 * one.predict(theta).sd()[0]).all()
    assert corrected.excess == 1.0
    assert denied.excess > 10.0


def test_what_the_surrogate_has_exactly_moves_nothing_away() -> None:
    lengths = np.array([*ALL[:4], np.inf])
    theta = away([0.0, 0.0, 0.0, 0.0, 0.5])
    run = run_at(THETA, sloped=True)
    found = CorrectedSurrogate(OFF, (run,), lengths).predict(theta)
    expected = error_of(run, OFF) * rms(OFF.predict_mean(theta))
    np.testing.assert_allclose((found.mean - OFF.predict_mean(theta))[0], expected, rtol=1e-3, atol=1e-6)
    assert found.sd().max() < 3e-3 * OFF.predict(theta).sd().max()


def test_more_runs_leave_less_unsure() -> None:
    theta = away([0.05, 0.05, 0.0, 0.0, 0.0])
    runs = tuple(run_at(away([0.1 * i, 0.0, 0.1 * j, 0.0, 0.0])) for i in range(2) for j in range(2))
    left = [CorrectedSurrogate(SURE, runs[: n + 1], ALL).predict(theta).sd().max() for n in range(4)]
    assert left == sorted(left, reverse=True)
    assert left[-1] < 0.9 * left[0]


def test_it_is_known_by_its_runs() -> None:
    one, other = (
        CorrectedSurrogate(SURE, (run_at(away([u, 0, 0, 0, 0])),), ALL).provenance for u in (0.0, 0.1)
    )
    assert one != other


class Alike(ToySurrogate):
    """Its error is alike over known lengths, all over the box of p_init; a fifth is noise of each point."""

    lengths = np.array([0.3, 0.5, 0.2, 4.0, np.inf])

    def correlation(self, theta, at):
        apart = (self.space.box.to_unit(theta) - self.space.box.to_unit(at[None])) / self.lengths
        alike = 0.8 * np.exp(-0.5 * np.sum(apart**2, axis=1))
        return np.repeat(alike[:, None], self.modes.shape[1], axis=1)


def test_errors_are_alike_as_far_as_the_surrogate_says() -> None:
    exact = np.array([False, True, False, False, False])
    found = error_lengths(Alike(), THETA, exact)
    np.testing.assert_allclose(found, [0.3, np.inf, 0.2, 4.0, LONGEST], rtol=1e-6)
    np.testing.assert_array_equal(error_lengths(SURE, THETA, exact), np.where(exact, np.inf, LENGTH))


def test_a_run_leaves_what_the_force_does_not_know_as_it_was() -> None:
    """Beside a run with another p_init the force is the run's, and hardly less sure."""
    lengths = error_lengths(Alike(sd_n=0.1), THETA, np.zeros(5, dtype=bool))
    found = CorrectedSurrogate(Alike(sd_n=0.1), (run_at(THETA),), lengths)
    other = away([0.0, 0.0, 0.0, 0.0, 0.4])
    np.testing.assert_allclose(found.predict(other).mean[0], run_at(THETA).force_n, rtol=2e-3)
    assert found.predict(other).sd().max() < 0.05 * OFF.predict(other).sd().max()


def test_an_instrument_takes_nothing_from_what_errors_have_in_common() -> None:
    seen = ObservedSurrogate(Alike(), (catalogue()["force-offset"],), MOTION)
    theta, more = away([0.1, 0.0, 0.1, 0.0, 0.0]), [0.02]
    found = seen.correlation(np.append(theta, more)[None], np.append(THETA, [-0.1]))
    np.testing.assert_array_equal(found, Alike().correlation(theta, THETA))
    exact = np.array([False] * 5 + [True])
    expected = [0.3, 0.5, 0.2, 4.0, LONGEST, np.inf]
    np.testing.assert_allclose(error_lengths(seen, np.append(THETA, more), exact), expected, rtol=1e-6)
    plain = ObservedSurrogate(SURE, seen.mechanisms, MOTION)
    np.testing.assert_array_equal(
        error_lengths(plain, np.append(THETA, more), exact), [LENGTH] * 5 + [np.inf]
    )
