"""Figures of surrogates and their designs, of Sobol' indices, and of the prior's predictions."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from toys.closed_form_model import SPACE, toy_bin_means
from toys.figure_inputs import BINNED, BINS, DISPLACEMENT_M, EDGES, FORCE_N, TIME_S, drawn, headline, labels

from bayeskin import report
from bayeskin.report import style, validation
from bayeskin.types import Design, ParameterSpace, Prediction

pytestmark = pytest.mark.filterwarnings("error")


def interval(values: np.ndarray) -> np.ndarray:
    return np.stack([values - 0.02, values, values + 0.02])


def test_sobol_names_the_leading_and_the_inert_parameters() -> None:
    share = np.array([0.53, 0.41, 0.0, 0.06, 0.0])
    series = interval(np.tile(share, (BINS, 1)))
    series[:, :3] = np.nan  # no force before the test, no variance
    figure = drawn(
        report.figure_sobol(
            SPACE.names, TIME_S, DISPLACEMENT_M, series, series, interval(share), interval(share),
            "posterior",
        )
    )  # fmt: skip
    assert "Inputs: posterior." in figure.get_supxlabel()
    assert "E_{c}" in headline(figure)
    assert "53 %" in headline(figure)
    assert "below 0.5 %" in headline(figure)
    first, total, bars = figure.axes
    assert (first.get_ylabel(), total.get_ylabel()) == ("first-order index", "total index")
    assert [t.get_text() for t in bars.get_yticklabels()] == [style.symbol(n) for n in SPACE.names]
    assert len(bars.patches) == 10


def test_sobol_of_a_force_that_never_varies() -> None:
    nothing = np.full((3, BINS, 5), np.nan)
    figure = report.figure_sobol(
        SPACE.names, TIME_S, 0 * DISPLACEMENT_M, nothing, nothing, nothing[:, 0], nothing[:, 0], "prior"
    )
    assert headline(drawn(figure)).startswith("The force does not vary")


def calibrated(true_n: np.ndarray, rng: np.random.Generator) -> Prediction:
    """A prediction whose errors are exactly what it claims: 2 % common to a run, 1 % a bin of its own."""
    factor = 0.02 * np.abs(true_n)[..., None]
    own = 0.01 * np.abs(true_n)
    error = factor[..., 0] * rng.normal(size=(len(true_n), 1)) + own * rng.normal(size=true_n.shape)
    return Prediction(true_n + error, factor, own**2)


def held_out(n: int) -> np.ndarray:
    return 1e-3 * toy_bin_means(SPACE.from_unit(np.random.default_rng(12).random((n, 5))), EDGES)


def test_validation_shows_amplitude_coverage_waves_and_noise_floor() -> None:
    true = held_out(40)
    errors = np.random.default_rng(13).lognormal(-3.0, 0.3, (3, 40))
    prediction = calibrated(true, np.random.default_rng(14))
    figure = drawn(report.figure_validation(EDGES, true, prediction, np.full(BINS, 0.006), errors))
    assert "peak of the full model [N]" in labels(figure)
    assert "nominal coverage" in labels(figure)
    assert "error [mN]" in labels(figure)
    names = {line.get_label() for line in figure.axes[3].get_lines()}
    assert {"RMS error", "noise floor of the recording"} <= names
    assert "90 % intervals hold" in headline(figure)


def test_validation_of_one_run_in_one_wave_without_error() -> None:
    true = held_out(1)
    exact = Prediction(true, np.zeros((*true.shape, 1)), np.zeros_like(true))
    figure = drawn(report.figure_validation(EDGES, true, exact, np.zeros(BINS), np.zeros((1, 1))))
    assert [text.get_text() for text in figure.axes[2].texts] == ["0"]  # the only wave
    error = next(line for line in figure.axes[3].get_lines() if line.get_label() == "RMS error")
    assert not np.any(error.get_ydata())


def test_coverage_of_a_calibrated_prediction_is_nominal() -> None:
    true = held_out(400)
    nominal = np.array([0.5, 0.9])
    share, error = validation.coverage(true, calibrated(true, np.random.default_rng(15)), nominal)
    assert np.all(np.abs(share - nominal) < 3 * error)
    assert np.all(error < 0.03)
    half = calibrated(true, np.random.default_rng(15))
    narrow = Prediction(half.mean, 0.5 * half.factor, 0.25 * half.diagonal)
    assert validation.coverage(true, narrow, nominal)[0][1] == pytest.approx(
        0.589, abs=0.04
    )  # 0.5 x 1.645 sd


def test_map_check_is_in_millinewton_and_in_sd() -> None:
    sd = 0.002 * (TIME_S > 5)
    figure = drawn(report.figure_map_check(BINNED, FORCE_N, FORCE_N + 0.004 * (TIME_S > 5), sd))
    assert [ax.get_ylabel() for ax in figure.axes] == ["force [N]", "error [mN]", "error [surrogate sd]"]
    assert "at most 2 of its sd" in headline(figure)
    exact = drawn(report.figure_map_check(BINNED, FORCE_N, FORCE_N, np.zeros(BINS)))
    assert "error is 0 mN RMS" in headline(exact)


def design(waves: int, space: ParameterSpace = SPACE) -> Design:
    rng = np.random.default_rng(16)
    wave = np.repeat(np.arange(waves), 30)
    n = len(wave)
    unit = 0.5 + (rng.random((n, space.dim)) - 0.5) * 0.5 ** wave[:, None]
    ok = np.arange(n) != 7
    return Design(
        space, EDGES, space.from_unit(unit), np.zeros((n, BINS)), wave, rng.random(n) < 0.2, ok, ("",) * n,
        np.ones(n), 0, "toy",
    )  # fmt: skip


def test_waves_show_every_pair_and_the_volume_kept() -> None:
    figure = drawn(report.figure_waves(design(3), [1.0, 0.1, 0.008]))
    assert len(figure.axes) == 10 + 1
    assert figure.axes[-1].get_ylabel() == "volume kept [%]"
    assert headline(figure) == "90 runs in 3 waves close in on 0.8 % of the prior box; 1 failed"
    key = [t.get_text() for t in figure.axes[0].get_legend().get_texts()]
    assert key == ["wave 0", "wave 1", "wave 2", "held out", "failed"]


@pytest.mark.parametrize("dim", [1, 2, 3, 5])
def test_one_wave_of_any_dimension(dim: int) -> None:
    space = ParameterSpace(SPACE.parameters[:dim])
    assert "1 wave fill the prior box" in headline(drawn(report.figure_waves(design(1, space), [1.0])))


def test_prior_predictive_places_the_recorded_peak() -> None:
    scale = np.array([0.5, 0.5, 0.5, 2.0])[:, None]
    figure = drawn(report.figure_prior_predictive(BINNED, scale * BINNED.force_n))
    assert "above 75 % of the peaks that the prior predicts" in headline(figure)
    assert figure.axes[0].get_yscale() == "symlog"
    silent = dataclasses.replace(BINNED, force_n=np.zeros(BINS))
    assert "peak of 0 N" in headline(drawn(report.figure_prior_predictive(silent, np.zeros((3, BINS)))))
