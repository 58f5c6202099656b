"""Figures of a recording and of its fit, complete for typical input and sound for degenerate input."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from toys.figure_inputs import (
    BINNED,
    BINS,
    DISPLACEMENT_M,
    FORCE_N,
    PHASES,
    RECORDING,
    TIME_S,
    drawn,
    headline,
    labels,
)

from bayeskin import report
from bayeskin.inference import ResidualCheck
from bayeskin.report import style, timeline
from bayeskin.types import Phase

pytestmark = pytest.mark.filterwarnings("error")


def test_recording_shows_phases_cycles_and_loops() -> None:
    figure = drawn(report.figure_recording(RECORDING, BINNED))
    assert labels(figure) == ["displacement [mm]", "time [s]", "force [N]", "displacement [mm]", "force [N]"]
    motion, force, loops = figure.axes
    assert {t.get_text() for t in motion.texts} == {"cycle 1", "cycle 2"}
    assert len(force.patches) == sum(p.kind != "rest" for p in PHASES)
    assert [line.get_label() for line in loops.get_lines()] == ["cycle 1", "cycle 2"]
    assert np.ptp(motion.get_lines()[0].get_ydata()) == pytest.approx(9.0)
    assert headline(figure).startswith("arm: 2 cycles to 9 mm")


@pytest.mark.parametrize("name", ["arm_$1_left_$2_.csv", "P$03_$S1.xlsx", "$", "a$b_c", r"c:\\$x_{1}$.csv"])
def test_a_files_name_is_no_markup(name: str, tmp_path: Path) -> None:
    figure = report.figure_recording(dataclasses.replace(RECORDING, name=name), BINNED)
    _, svg = report.save_figure(figure, tmp_path / "recording", "x")
    shown = re.sub(r"\s", "", "".join(re.findall(r"<!-- (.*?) -->", svg.read_text())))
    assert name in shown  # as it stands, each sign of it


def test_recording_of_nothing_but_rest() -> None:
    still = dataclasses.replace(RECORDING, displacement_m=np.zeros_like(RECORDING.time_s))
    rest = dataclasses.replace(
        BINNED, phase=np.zeros(BINS, dtype=int), phases=(Phase("rest", 0, 0.0, 130.0),)
    )
    assert headline(drawn(report.figure_recording(still, rest))).startswith("arm: 0 cycles to 0 mm")


def test_fit_tells_the_parts_of_the_uncertainty_apart() -> None:
    rng = np.random.default_rng(5)
    ensemble = FORCE_N * (1 + 0.01 * rng.normal(size=(50, 1)))
    fitted = TIME_S < 60
    predictive = {
        "mean_n": ensemble,
        "surrogate_sd_n": 0.01 * np.abs(ensemble),
        "noise_sd_n": np.full(BINS, 0.006),
        "force_n": ensemble + 0.008 * rng.normal(size=ensemble.shape),
    }
    figure = drawn(report.figure_fit(BINNED, DISPLACEMENT_M, fitted, **predictive))
    force, residual, parts, loop, _ = figure.axes
    assert {line.get_label() for line in parts.get_lines()} == {"model", "surrogate", "noise", "all"}
    assert residual.get_ylabel() == "residual [mN]"
    assert len(residual.collections) == 2  # the 50 % and the 90 % band
    shown = next(line for line in residual.get_lines() if line.get_label() == "recorded")
    expected = 1e3 * (BINNED.force_n - np.median(ensemble, axis=0))[fitted]
    np.testing.assert_allclose(shown.get_ydata(), expected)
    bar = next(line for line in force.get_lines() if line.get_linewidth() == 3)
    np.testing.assert_allclose(bar.get_xdata(), [0.0, 60.0])
    assert {line.get_label() for line in loop.get_lines()} == {"recorded", "posterior median"}
    assert "in the fitted bins" in headline(figure)


def test_fit_of_one_draw_without_surrogate_error_or_fitted_bins() -> None:
    figure = report.figure_fit(
        BINNED, DISPLACEMENT_M, np.zeros(BINS, dtype=bool),
        mean_n=FORCE_N, surrogate_sd_n=np.zeros(BINS), noise_sd_n=np.full(BINS, 0.006), force_n=FORCE_N,
    )  # fmt: skip
    assert headline(drawn(figure)).startswith("Predicted without fitting")


def test_fit_without_any_uncertainty_and_with_a_phase_kind_missing() -> None:
    no_hold = tuple(dataclasses.replace(p, kind="rest") if p.kind == "hold" else p for p in PHASES)
    bins = dataclasses.replace(BINNED, phases=no_hold)
    exact = np.tile(FORCE_N, (3, 1))
    nothing = np.zeros(BINS)
    figure = drawn(
        report.figure_fit(
            bins,
            DISPLACEMENT_M,
            np.ones(BINS, dtype=bool),
            mean_n=exact,
            surrogate_sd_n=nothing,
            noise_sd_n=nothing,
            force_n=exact,
        )
    )
    kinds = [line.get_label() for line in figure.axes[4].get_lines() if not line.get_label().startswith("_")]
    assert kinds == ["rest", "load", "unload"]
    assert "elsewhere" not in headline(figure)


def test_predictive_bands_hold_what_they_promise() -> None:
    """Model and noise, both normal: sd 5 and 12 add to 13."""
    rng = np.random.default_rng(6)
    mean = 5.0 * rng.normal(size=(20_000, 1))
    force = mean + 12.0 * rng.normal(size=mean.shape)
    bands = timeline.predictive_bands(mean, np.array([4.0]), np.full_like(mean, 12.0), force)
    half = 0.5 * (bands.high_n - bands.low_n)[:, 0]
    np.testing.assert_allclose(half, [0.6745 * 13, 1.6449 * 13], rtol=0.03)
    parts = [float(bands.parts_n[name][0]) for name in ("model", "surrogate", "noise", "all")]
    np.testing.assert_allclose(parts, 1.6449 * np.array([5.0, 4.0, 12.0, 13.0]), rtol=0.03)


def test_runs_of_true_cover_the_mask_exactly() -> None:
    assert timeline.runs_of([True, True, False, True]) == [(0, 2), (3, 4)]
    assert timeline.runs_of([False, False]) == []


def left(scores: np.ndarray, p_correlation: float) -> ResidualCheck:
    return ResidualCheck(scores, np.linspace(0.3, -0.1, 10), 0.5, p_correlation, ())


def test_what_is_left_is_drawn_against_the_assumed_noise() -> None:
    scores = np.random.default_rng(5).normal(size=200)
    figure = drawn(report.figure_residuals(left(scores, 0.2)))
    assert headline(figure) == "The residual looks like the assumed noise"
    points = figure.axes[0].lines[-1]
    assert np.array_equal(points.get_ydata(), np.sort(scores))
    assert np.all(np.diff(points.get_xdata()) > 0)
    assert figure.axes[1].patches[0].get_y() == pytest.approx(-1.96 / np.sqrt(200), rel=1e-3)
    outside = [line.get_ydata() for line in figure.axes[1].lines if line.get_color() == style.ACCENT]
    assert np.concatenate(outside) == pytest.approx(np.linspace(0.3, -0.1, 10)[:4])
    figure = drawn(report.figure_residuals(left(scores, 1e-9)))
    assert headline(figure) == "The residual is not the assumed noise"
    assert "has a different correlation" in figure.get_supxlabel().replace("\n", " ")
    lone = drawn(report.figure_residuals(ResidualCheck(scores[:1], np.empty(0), 0.5, np.nan, ())))
    assert np.array_equal(lone.axes[0].lines[-1].get_ydata(), scores[:1])
