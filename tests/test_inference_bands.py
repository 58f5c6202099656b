"""Predictive bands of a posterior, and errors of the fit by window and kind of phase."""

import dataclasses

import numpy as np
import pytest
from toys import closed_form_model
from toys.inference_problems import (
    HOLDS,
    NOISE,
    TRUTH,
    ToySurrogate,
    around_truth,
    empty_recording,
    toy_problem,
)

from bayeskin.errors import InputError
from bayeskin.inference import bands, coverage, predictive_draws, rmse
from bayeskin.inference.model_error import ModelError
from bayeskin.inference.noise_model import draw_noise, noise_chain


@pytest.mark.parametrize("sd_n", [5e-4, 1e-2])  # a surrogate far better and far worse than the noise
def test_the_parts_of_the_bands_are_what_they_are_called(sd_n: float) -> None:
    problem = toy_problem(surrogate=ToySurrogate(sd_n=sd_n))
    draws = around_truth(600, 0.01)
    draws[:, -1] = 100.0
    predicted = bands(problem, draws, np.random.default_rng(0))
    drawn = predictive_draws(problem, draws, np.random.default_rng(0))
    assert predicted.sd_model_n == pytest.approx(drawn.mean_n.std(axis=0))
    assert predicted.sd_surrogate_n == pytest.approx(problem.predict(draws).sd()[0])
    kinds = np.array([p.kind for p in problem.binned.phases])[problem.binned.phase]
    hold = predicted.sd_noise_n[kinds == "hold"]
    assert hold == pytest.approx(np.sqrt(NOISE["sd_hold"] ** 2 + 1e-6), rel=0.01)
    whole = np.diff(predicted.interval(0.9), axis=0)[0] / (2 * 1.645)
    assert whole.mean() == pytest.approx(predicted.sd_total_n.mean(), rel=0.05)
    with pytest.raises(InputError, match=r"0\.5 or 0\.9"):
        predicted.interval(0.8)


def test_bands_cover_further_recordings_of_the_same_skin_as_often_as_they_say() -> None:
    """Its error, which is that of the first recording, is known from that one only."""
    rng, covered = np.random.default_rng(2), []
    theta = np.tile([*TRUTH.values(), *NOISE.values()], (500, 1))
    surrogate = ToySurrogate(sd_n=1e-2)
    prediction = surrogate.predict(theta[:1])
    for _ in range(20):
        truth = prediction.mean[0] + prediction.factor[0] @ rng.standard_normal(3)
        chain = noise_chain(empty_recording())
        first, *others = truth + draw_noise(
            chain, theta[:6, 5:], np.repeat(prediction.diagonal, 6, axis=0), rng
        )
        problem = toy_problem(surrogate=surrogate)
        problem = dataclasses.replace(problem, binned=dataclasses.replace(problem.binned, force_n=first))
        low, high = bands(problem, theta, rng).interval(0.9)
        covered += [coverage(dataclasses.replace(problem.binned, force_n=f), low, high) for f in others]
    assert np.mean(covered) == pytest.approx(0.9, abs=0.02)


def test_an_error_of_the_model_is_in_the_bands_as_the_recording_shows_it() -> None:
    """A model that pulls two hundredths too hard: the bands are about the recording, and narrow."""
    problem = toy_problem(surrogate=ToySurrogate(sd_n=1e-9))
    error = ModelError(closed_form_model.MOTION, problem.binned.edges_s, 0.02)
    mean = problem.predict([list(TRUTH.values())]).mean[0]
    binned = dataclasses.replace(problem.binned, force_n=1.02 * mean)
    problem = dataclasses.replace(problem, binned=binned, model_error=error)
    theta = np.tile([*TRUTH.values(), *NOISE.values()], (200, 1))
    predicted = bands(problem, theta, np.random.default_rng(1))
    np.testing.assert_allclose(predicted.mean_n, 1.02 * mean, atol=2e-3)
    assert predicted.sd_model_n.max() < 0.2 * 0.02 * mean.max()
    assert predicted.sd_surrogate_n.max() < 1e-6


def test_kinds_that_were_not_fitted_take_the_largest_noise() -> None:
    problem = toy_problem(windows=HOLDS)
    theta = np.array([[*TRUTH.values(), 3e-3, 2.0, 6.0]])
    drawn = predictive_draws(problem, theta, np.random.default_rng(0))
    assert drawn.noise_sd_n[0] == pytest.approx(np.full(130, np.sqrt(9e-6 + 1e-6)))


def test_rmse_is_told_by_window_and_kind() -> None:
    problem = toy_problem()
    residual = np.where(problem.binned.phase == 2, 3.0, 1.0)
    errors = rmse(problem.binned, problem.binned.force_n - residual, [(15.0, 45.0), (45.0, 55.0), (0.2, 0.4)])
    assert errors.by_window_n[:2] == (3.0, 1.0)
    assert np.isnan(errors.by_window_n[2])
    assert errors.by_kind_n["hold"] == pytest.approx(np.sqrt(5.0))
    assert errors.whole_n == pytest.approx(np.sqrt((30 * 9 + 100) / 130))
