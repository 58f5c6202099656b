"""Tests of elements in series with the skin, which a spring replaces: closed forms and derivatives."""

from __future__ import annotations

import numpy as np
import pytest

from bayeskin.finite_element.series import (
    REST_S,
    SERIES_TOLERANCE,
    Drive,
    SeriesSolver,
    lost_slopes,
    memory_slopes,
    on_the_way,
    total,
    yielding,
)
from bayeskin.finite_element.tissue import TissueLaw
from bayeskin.mechanisms.backlash import Play
from bayeskin.mechanisms.slow_recovery import KelvinVoigt
from bayeskin.types import PadMotion

STIFFNESS, COMPLIANCE = 60.0, 5e-3  # N/m by the drive's displacement, m/N
MOTION = PadMotion(np.array([0.0, 10.0, 20.0]), np.array([0.0, 5e-3, 5e-3]))


class Spring:
    """A skin whose force is its stiffness times the drive's displacement that is left, the pads' doubled."""

    def __init__(self) -> None:
        self.solves = 0

    def __call__(self, pads_m: float) -> tuple[np.ndarray, float]:
        self.solves += 1
        return np.array([pads_m]), STIFFNESS * 2.0 * pads_m

    def solved(self, series: SeriesSolver, time_s: float, elapsed_s: float, before, expected_m=None):
        return series.solve(time_s, elapsed_s, before, expected_m, self, lambda x, pads_m: self(pads_m))


def driven(*elements) -> Drive:
    return on_the_way(MOTION, [TissueLaw(series=element) for element in elements])


def test_a_spring_behind_a_compliant_frame_is_two_springs_in_series():
    drive, skin = driven(Play(0.0, COMPLIANCE)), Spring()
    series = SeriesSolver(drive)
    expected_n = STIFFNESS * MOTION.at(8.0) / (1.0 + COMPLIANCE * STIFFNESS)
    (_, force_n), lost = skin.solved(series, 8.0, 8.0, drive.at_rest)
    allowed_m = SERIES_TOLERANCE * drive.largest_m
    assert force_n == pytest.approx(expected_n, abs=STIFFNESS * allowed_m)
    assert total(lost) == pytest.approx(COMPLIANCE * expected_n, abs=allowed_m)
    before = skin.solves
    skin.solved(series, 9.0, 1.0, lost)
    assert skin.solves - before == 2  # the answer is known by then


def test_a_guess_of_where_the_pads_will_be_saves_solves():
    drive, skin = driven(Play(0.0, COMPLIANCE)), Spring()
    share = 1.0 / (1.0 + COMPLIANCE * STIFFNESS)
    expected_m = 0.5 * share * float(MOTION.at(8.0))
    (x, _), _ = skin.solved(SeriesSolver(drive), 8.0, 8.0, drive.at_rest, expected_m)
    assert skin.solves == 1
    assert x[0] == expected_m


def test_nothing_is_lost_before_the_test_nor_without_elements():
    opened = on_the_way(MOTION, [TissueLaw(opening_m=1e-3), TissueLaw(series=Play(0.0, COMPLIANCE))])
    (x, _), lost = Spring().solved(SeriesSolver(opened), REST_S, 1.0, opened.at_rest)
    assert x[0] == 0.5e-3
    assert total(lost) == 0.0
    (x, _), lost = Spring().solved(SeriesSolver(driven()), 8.0, 8.0, ())
    assert x[0] == 0.5 * MOTION.at(8.0)
    assert lost == ()


def test_a_skin_that_cannot_be_solved_for_is_no_solution():
    drive = driven(Play(0.0, COMPLIANCE))
    series = SeriesSolver(drive)
    assert series.solve(8.0, 8.0, drive.at_rest, None, lambda pads_m: None, lambda x, pads_m: None) is None
    skin = Spring()
    assert series.solve(8.0, 8.0, drive.at_rest, None, skin, lambda x, pads_m: None) is None


def test_derivatives_are_those_of_two_springs_in_series():
    """Derivatives of F = k u / (1 + c k) by the compliance c, the stiffness k and the displacement u."""
    u, k, c, step = 4e-3, STIFFNESS, COMPLIANCE, 1e-8
    drive = driven(Play(0.0, c))
    force_n = k * u / (1 + c * k)
    before, none = drive.at_rest, (np.zeros((1, 3)),)
    after = drive.follow(force_n, 1.0, before)
    varied = [driven(Play(0.0, c + step)), drive, drive]
    left_m = u - c * force_n
    held = np.array([0.0, left_m, k])  # of the force with what is lost held
    softness = yielding(lambda n: drive.follow(n, 1.0, before), force_n, 1e-3)
    more, lost = lost_slopes(
        held, np.zeros(3), softness, k,
        lambda slopes_n: memory_slopes(varied, step, force_n, slopes_n, 1.0, before, none, after),
    )  # fmt: skip
    expected = np.array([-(k**2) * u, u, k * (1 + c * k)]) / (1 + c * k) ** 2
    np.testing.assert_allclose(held - k * more, expected, rtol=1e-5)
    np.testing.assert_allclose(lost[0][0], more, rtol=1e-5)


def test_derivatives_of_a_memory_go_with_those_before():
    """The Kelvin-Voigt element keeps e^-z of what was lost, whatever it was."""
    element, step = KelvinVoigt(COMPLIANCE, 8.0), 1e-6
    drive, before = driven(element), (np.array([1e-3, 0.2]),)
    after = drive.follow(0.3, 4.0, before)
    slopes = memory_slopes(
        [drive], step, 0.3, np.zeros(1), 4.0, before, (np.array([[2.0], [0.0]]),), after
    )  # fmt: skip
    assert slopes[0][0, 0] == pytest.approx(2.0 * np.exp(-0.5), rel=1e-6)
