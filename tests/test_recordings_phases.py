"""Phases are found from the displacement alone, corners to a few hundredths of a second; protocols follow."""

import itertools

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from toys.synthetic_recordings import (
    CORNERS_S,
    KINDS,
    MOTION,
    TIME_S,
    article_recording,
    quantised,
    recording,
    supplement,
    true_force,
)

from bayeskin.errors import InputError
from bayeskin.recordings import idealised_motion, motion_of, recorded_motion, resolution_m, segment
from bayeskin.recordings.polyline import simplify
from bayeskin.types import PadMotion, Phase, Recording


def displaced(displacement_m: np.ndarray, time_s: np.ndarray = TIME_S) -> Recording:
    return Recording(time_s, displacement_m, np.zeros_like(time_s), "made", "")


def starts(phases: tuple[Phase, ...]) -> np.ndarray:
    return np.array([p.start_s for p in phases])


def assert_tiles(phases: tuple[Phase, ...], time_s: np.ndarray) -> None:
    assert phases[0].start_s == time_s[0]
    assert phases[-1].end_s == time_s[-1]
    for before, after in itertools.pairwise(phases):
        assert before.end_s == after.start_s
        assert before.start_s < before.end_s


def rounded(motion: PadMotion, time_s: np.ndarray, width_s: float) -> np.ndarray:
    """The motion as a drive follows it: corners rounded over width_s."""
    offsets = np.linspace(-0.5 * width_s, 0.5 * width_s, 21)
    return np.mean([motion.at(time_s + offset) for offset in offsets], axis=0)


@pytest.mark.parametrize("noise_m", [0.0, 3e-6, 1e-5])
@pytest.mark.parametrize("seed", range(3))
def test_corners_are_found_to_two_hundredths_of_a_second(noise_m: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    seen = rounded(MOTION, TIME_S, 0.2) + noise_m * rng.normal(size=len(TIME_S))
    phases = segment(displaced(quantised(seen, 1e-5)))
    assert [p.kind for p in phases] == KINDS
    assert [p.cycle for p in phases] == [0, 1, 1, 1, 1, 2, 2, 2, 2]
    np.testing.assert_allclose(starts(phases), CORNERS_S[:-1], atol=0.02)
    assert_tiles(phases, TIME_S)


def test_ripple_and_overshoot_make_no_phases_of_their_own() -> None:
    u = MOTION.at(TIME_S)
    u = u + 4e-5 * np.sin(2 * np.pi * u / 0.375e-3)  # 24 periods: the holds stay where they were
    for top_s in (15.03, 75.0):
        after = TIME_S - top_s
        u = u + np.where(after > 0, 1.5e-4 * np.exp(-np.clip(after, 0, None) / 0.1), 0.0) * (after < 5)
    phases = segment(displaced(quantised(u, 1e-5)))
    assert [p.kind for p in phases] == KINDS
    np.testing.assert_allclose(starts(phases), CORNERS_S[:-1], atol=0.02)


def test_a_turning_point_above_zero_with_a_short_dwell_is_one_corner() -> None:
    motion = PadMotion(
        np.array([0.0, 5.0, 14.0, 40.0, 47.7, 47.75, 55.4, 80.0, 89.0, 100.0]),
        1e-3 * np.array([0.0, 0.0, 9.0, 9.0, 1.3, 1.3, 9.0, 9.0, 0.0, 0.0]),
    )
    time_s = 0.01 * np.arange(10001)
    phases = segment(recording(np.zeros_like(time_s), motion, time_s))
    assert [p.kind for p in phases] == ["rest", "load", "hold", "unload", "load", "hold", "unload", "rest"]
    assert [p.cycle for p in phases] == [0, 1, 1, 1, 2, 2, 2, 2]
    assert phases[4].start_s == pytest.approx(47.725, abs=0.02)
    heights = idealised_motion(displaced(quantised(motion.at(time_s), 1e-5), time_s), phases).displacement_m
    np.testing.assert_allclose(1e3 * heights, [0, 0, 9, 9, 1.3, 9, 9, 0, 0], atol=1e-9)


def test_a_staircase_is_one_cycle_and_a_change_of_speed_a_corner() -> None:
    motion = PadMotion(
        np.array([0.0, 5.0, 10.0, 20.0, 25.0, 35.0, 36.0, 50.0]), 1e-3 * np.array([0.0, 0, 4, 4, 8, 8, 0, 0])
    )
    time_s = 0.01 * np.arange(5001)
    phases = segment(recording(np.zeros_like(time_s), motion, time_s))
    assert [(p.kind, p.cycle) for p in phases] == [
        ("rest", 0), ("load", 1), ("hold", 1), ("load", 1), ("hold", 1), ("unload", 1), ("rest", 1)
    ]  # fmt: skip
    two_speeds = PadMotion(np.array([0.0, 5.0, 25.0, 29.0, 50.0]), 1e-3 * np.array([0.0, 0, 2, 6, 6]))
    phases = segment(recording(np.zeros_like(time_s), two_speeds, time_s))
    assert [p.kind for p in phases] == ["rest", "load", "load", "hold"]
    np.testing.assert_allclose(starts(phases), [0, 5, 25, 29], atol=0.02)


@given(
    st.lists(
        st.tuples(st.floats(2, 9), st.floats(0.3, 3.0), st.floats(1.0, 20.0), st.floats(1.0, 20.0)),
        min_size=1,
        max_size=4,
    ),
    st.sampled_from([0.01, 0.02, 0.05]),
)
@example([(2.0, 2.64453125, 1.69140625, 1.0), (2.0, 1.0, 1.0, 1.0)], 0.02)  # a fast ramp's rounded end
@settings(max_examples=40, deadline=None)
def test_any_protocol_of_load_hold_unload_rest_is_recovered(
    cycles: list[tuple[float, float, float, float]], interval_s: float
) -> None:
    top_mm = max(height for height, *_ in cycles)
    times, heights = [0.0, 3.0], [0.0, 0.0]
    for height, speed, hold_s, rest_s in cycles:
        height = max(height, 0.4 * top_mm)
        for rise_s, level in (
            (height / speed, height),
            (hold_s, height),
            (height / speed, 0.0),
            (rest_s, 0.0),
        ):
            times.append(times[-1] + rise_s)
            heights.append(level)
    time_s = interval_s * np.arange(int(times[-1] / interval_s) + 1)
    motion = PadMotion(np.array(times), 1e-3 * np.array(heights))
    phases = segment(displaced(quantised(motion.at(time_s), 1e-5), time_s))
    assert [p.kind for p in phases] == ["rest", *(["load", "hold", "unload", "rest"] * len(cycles))]
    np.testing.assert_allclose(starts(phases), times[:-1], atol=0.05)
    assert_tiles(phases, time_s)


def test_a_pull_without_a_hold_is_one_phase() -> None:
    phases = segment(displaced(quantised(7e-5 * TIME_S, 1e-5)))
    assert [(p.kind, p.cycle, p.start_s, p.end_s) for p in phases] == [("load", 1, 0.0, TIME_S[-1])]


def test_noise_alone_is_refused() -> None:
    noise = 1e-5 * np.round(np.random.default_rng(0).normal(size=len(TIME_S)))
    with pytest.raises(InputError, match="little more than its noise"):
        segment(displaced(noise))


@pytest.mark.parametrize("interval_s", [0.2, 0.5, 1.0])
@pytest.mark.parametrize("step_m", [0.0, 1e-5])
def test_phases_of_few_samples_are_found(interval_s: float, step_m: float) -> None:
    time_s = np.arange(0.0, 130.0, interval_s)
    for motion in (
        MOTION,
        PadMotion(np.round(CORNERS_S), MOTION.displacement_m),
    ):  # corners off and on samples
        seen = motion.at(time_s)
        phases = segment(displaced(quantised(seen, step_m) if step_m else seen, time_s))
        assert [p.kind for p in phases] == KINDS
        np.testing.assert_allclose(starts(phases), motion.time_s[:-1], atol=0.4 * interval_s)


def test_resolution_is_the_least_step_or_the_noise() -> None:
    u = rounded(MOTION, TIME_S, 0.2)
    assert resolution_m(quantised(u, 1e-5)) == pytest.approx(1e-5, rel=1e-6)
    noisy = u + 2e-5 * np.random.default_rng(1).normal(size=len(u))
    assert resolution_m(noisy) == pytest.approx(2e-5, rel=0.1)
    seldom = np.repeat([0.0, 1.2e-3, 2.4e-3, 3.6e-3, 4.8e-3, 6e-3], 20)
    assert resolution_m(seldom) <= 0.05 * 6e-3  # the drive moved so far between samples
    assert resolution_m(quantised(u, 1e-5) * (1 + 1e-15)) == pytest.approx(1e-5, rel=1e-6)


def test_simplify_stays_within_its_tolerance_and_keeps_what_is_fixed() -> None:
    x = np.linspace(0, 10, 2001)
    y = np.sin(x)
    for tolerance in (1e-1, 1e-2, 1e-3):
        kept = simplify(x, y, tolerance, np.array([777]))
        assert 777 in kept
        assert np.abs(np.interp(x, x[kept], y[kept]) - y).max() <= tolerance
        assert len(kept) < 5 / np.sqrt(tolerance)


def test_the_idealised_protocol_is_the_one_that_was_meant() -> None:
    seen = displaced(quantised(rounded(MOTION, TIME_S, 0.2), 1e-5))
    motion = idealised_motion(seen, segment(seen))
    np.testing.assert_allclose(motion.time_s, np.round(CORNERS_S, 1), atol=1e-12)
    np.testing.assert_allclose(motion.displacement_m, MOTION.displacement_m, atol=1e-12)


def test_the_recorded_protocol_follows_every_sample_and_has_the_corners() -> None:
    seen = displaced(quantised(rounded(MOTION, TIME_S, 0.2), 1e-5))
    phases = segment(seen)
    motion = recorded_motion(seen, phases)
    assert np.abs(motion.at(seen.time_s) - seen.displacement_m).max() <= 2.001e-5
    assert np.isin(starts(phases), motion.time_s).all()
    assert (np.diff(motion.time_s) > 0).all()
    assert (motion.time_s[0], motion.time_s[-1]) == (0.0, TIME_S[-1])
    assert len(motion.time_s) < 100


def test_the_sampled_protocol_is_every_fiftieth_sample() -> None:
    recorded = recording(true_force())
    motion = motion_of(recorded)
    np.testing.assert_array_equal(motion.time_s, recorded.time_s[::50])
    np.testing.assert_array_equal(motion.displacement_m, recorded.displacement_m[::50])


def test_the_articles_recording_has_four_cycles_the_third_of_which_is_cut_short() -> None:
    real = article_recording()
    phases = segment(real)
    assert [p.kind for p in phases] == [
        "rest", *["load", "hold", "unload"] * 4, "rest"
    ]  # fmt: skip
    assert [p.cycle for p in phases] == [0, 1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4, 4]
    assert_tiles(phases, real.time_s)
    unload, load = phases[9], phases[10]
    assert unload.end_s == load.start_s == pytest.approx(214.51, abs=0.02)
    motion = idealised_motion(real, phases)
    assert motion.displacement_m[10] == pytest.approx(1.76e-3)
    speeds = np.diff(motion.displacement_m) / np.diff(motion.time_s)
    moving = np.abs(speeds) > 1e-5
    np.testing.assert_allclose(np.abs(speeds[moving]), 1e-3, rtol=0.02)
    closely = recorded_motion(real, phases)
    assert np.abs(closely.at(real.time_s) - real.displacement_m).max() <= 2.001e-5


def test_the_articles_script_used_every_fiftieth_sample() -> None:
    real = article_recording()
    time_s, pad_m = np.loadtxt(supplement("reference/article_forward.csv"), delimiter=",", skiprows=1).T[:2]
    motion = motion_of(real)
    np.testing.assert_allclose(motion.time_s[1:], time_s, atol=1e-6)
    np.testing.assert_allclose(0.5 * motion.displacement_m[1:], pad_m, atol=1e-9)
