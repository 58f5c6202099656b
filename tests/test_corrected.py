"""A surrogate corrected by runs: exact at them, as it was far away, and kriging in between."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from toy_inference import TRUTH, ToySurrogate

from bayeskin.mismatch.corrected import LENGTH, Corrected, FullRun, slopes

SURE, OFF = ToySurrogate(), ToySurrogate(bias_n=0.01)
THETA = np.array([TRUTH[name] for name in SURE.space.names])
ALL = np.ones(5, dtype=bool)


def away(unit: object) -> np.ndarray:
    """THETA moved by so much in coordinates of the box."""
    box = SURE.space.box
    return box.from_unit(box.to_unit(THETA) + np.asarray(unit))


def run_at(theta: np.ndarray, sloped: bool = False, wave: float = 0.0) -> FullRun:
    """Of a model that pulls a fiftieth harder than the toy, with a wave [N] that goes with log E_c."""
    here = Harder(wave)
    return FullRun(theta, here.predict_mean(theta)[0], slopes(here, theta) if sloped else None)


class Harder(ToySurrogate):
    def __init__(self, wave: float) -> None:
        super().__init__()
        self.wave = wave

    def predict(self, theta):
        found = super().predict(theta)
        turns = np.log(np.atleast_2d(theta)[:, :1])
        return dataclasses.replace(found, mean=1.02 * found.mean + self.wave * np.sin(turns))


def test_at_a_run_the_force_is_the_run_s_and_nothing_is_unsure() -> None:
    runs = (run_at(THETA), run_at(away([0.1, -0.1, 0.2, 0.0, 0.1])))
    found = Corrected(OFF, runs, ALL).predict(np.array([run.theta for run in runs]))
    np.testing.assert_allclose(found.mean, [run.force_n for run in runs], atol=1e-6)
    assert found.sd().max() < 3e-3 * OFF.predict(THETA).sd().max()


@pytest.mark.parametrize("common", [0.0, 1e3])
def test_one_run_s_error_fades_unless_errors_have_a_mean_of_their_own(common: float) -> None:
    found = Corrected(OFF, (run_at(THETA),), ALL, common)
    error = run_at(THETA).force_n - OFF.predict_mean(THETA)[0]
    for far in (0.05, 0.15, 0.4):
        theta = away([0.6 * far, 0.0, -0.8 * far, 0.0, 0.0])
        k = (1.0 + (far / LENGTH) ** 2) ** -0.5
        weight = (common + k) / (common + 1.0)
        there, plain = found.predict(theta), OFF.predict(theta)
        np.testing.assert_allclose(there.mean - plain.mean, weight * error[None], rtol=1e-4, atol=1e-9)
        left = common + 1.0 - weight * (common + k)  # 1 - k^2 without a mean, 2 (1 - k) with a large one
        np.testing.assert_allclose(there.sd(), np.sqrt(left) * plain.sd(), rtol=1e-3)
        np.testing.assert_allclose(there.mean, found.predict_mean(theta))


def test_of_two_runs_the_nearer_one_s_error_counts_for_more() -> None:
    """Closed form of ordinary kriging: (1 + (k_1 - k_2) / (1 - k_12)) / 2 is the first one's weight."""
    first, second = away([0.3, 0, 0, 0, 0]), away([-0.3, 0, 0, 0, 0])
    harder, plain = run_at(first), SURE.predict_mean(second)[0]
    found = Corrected(SURE, (harder, FullRun(second, plain, None)), ALL, 1e6)
    theta = away([0.2, 0.1, 0, 0, 0])
    k_1, k_2, k_12 = ((1.0 + square / LENGTH**2) ** -0.5 for square in (0.02, 0.26, 0.36))
    weight = 0.5 * (1.0 + (k_1 - k_2) / (1.0 - k_12))
    error = harder.force_n - SURE.predict_mean(first)[0]
    change = found.predict(theta).mean - SURE.predict_mean(theta)
    np.testing.assert_allclose(change, weight * error[None], rtol=1e-3, atol=1e-8)


def test_slopes_tell_what_a_second_run_next_to_the_first_would() -> None:
    sloped = Corrected(SURE, (run_at(THETA, sloped=True, wave=0.01),), ALL)
    near = np.concatenate([np.zeros((1, 5)), 2e-2 * LENGTH * np.eye(5)])
    beside = Corrected(SURE, tuple(run_at(away(step), wave=0.01) for step in near), ALL)
    for step in ([0.05, 0.0, 0.0, 0.0, 0.0], [0.03, -0.04, 0.02, 0.0, 0.0], [0.2, 0.1, 0.0, 0.1, 0.0]):
        one, other = sloped.predict(away(step)), beside.predict(away(step))
        change = other.mean - SURE.predict_mean(away(step))
        assert np.abs(one.mean - other.mean).max() < 0.06 * np.abs(change).max()
        np.testing.assert_allclose(one.sd(), other.sd(), rtol=0.06, atol=1e-5)
    right = slopes(Harder(0.01), THETA)
    before, after = (np.abs(slopes(one, THETA) - right).max() for one in (SURE, sloped))
    assert after < 0.02 * before


def test_what_the_surrogate_has_exactly_moves_nothing_away() -> None:
    exact = np.array([True, True, True, True, False])
    theta = away([0.0, 0.0, 0.0, 0.0, 0.5])
    found = Corrected(OFF, (run_at(THETA, sloped=True),), exact).predict(theta)
    error = run_at(THETA).force_n - OFF.predict_mean(THETA)[0]
    np.testing.assert_allclose(found.mean - OFF.predict_mean(theta), error[None], rtol=1e-4, atol=1e-8)
    assert found.sd().max() < 3e-3 * OFF.predict(theta).sd().max()


def test_more_runs_leave_less_unsure() -> None:
    theta = away([0.05, 0.05, 0.0, 0.0, 0.0])
    runs = tuple(run_at(away([0.1 * i, 0.0, 0.1 * j, 0.0, 0.0])) for i in range(2) for j in range(2))
    left = [Corrected(SURE, runs[: n + 1], ALL).predict(theta).sd().max() for n in range(4)]
    assert left == sorted(left, reverse=True)
    assert left[-1] < 0.9 * left[0]


def test_it_is_known_by_its_runs() -> None:
    one, other = (Corrected(SURE, (run_at(away([u, 0, 0, 0, 0])),), ALL).provenance for u in (0.0, 0.1))
    assert one != other
