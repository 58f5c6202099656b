"""Second recordings of look-alikes: the result of a diagnosis, and the tests and skins."""

from __future__ import annotations

import numpy as np
import pytest

from bayeskin.mechanisms import catalogue


@pytest.mark.parametrize(
    ("probabilities", "result"),
    [
        ({"device-friction": 0.95}, "right"),
        ({"device-friction": 0.95, "sensor-drift": 0.99}, "right"),
        ({"device-friction": 0.85}, "open"),
        ({}, "open"),
        ({"sensor-drift": 0.99}, "open"),
        ({"viscous-drag": 0.95}, "wrong"),
        ({"device-friction": 0.95, "viscous-drag": 0.91}, "wrong"),
    ],
)
def test_the_result_of_a_diagnosis(benchmark, probabilities: dict[str, float], result: str) -> None:
    second = benchmark("second_recording")
    skin = second.Skin("friction", 1)
    assert skin.mechanism == "device-friction"
    assert second.result_of(skin, probabilities) == result


def test_what_a_mechanism_needs_is_no_wrong_name(benchmark) -> None:
    second = benchmark("second_recording")
    skin = second.Skin("relaxation in holds", 4)
    assert skin.names == ("friction-creep", "device-friction")
    assert second.result_of(skin, {"friction-creep": 0.95, "device-friction": 0.99}) == "right"


def test_the_slow_test_is_the_first_one_at_a_tenth_of_the_speed(benchmark) -> None:
    first, slow = benchmark("second_recording").FIRST, benchmark("second_recording").SLOW
    np.testing.assert_array_equal(slow.displacement_m, first.displacement_m)
    steps = np.diff(first.displacement_m) != 0.0
    np.testing.assert_allclose(np.diff(slow.time_s)[steps], 10.0 * np.diff(first.time_s)[steps])
    np.testing.assert_allclose(np.diff(slow.time_s)[~steps], np.diff(first.time_s)[~steps])


def test_the_members_of_a_group_take_turns_with_values_inside_their_priors(benchmark) -> None:
    second = benchmark("second_recording")
    for group, members in second.GROUPS.items():
        skins = [second.Skin(group, number) for number in range(1, 9)]
        assert [skin.mechanism for skin in skins[: len(members)]] == list(members)
        for skin in skins:
            assert skin.values == second.Skin(group, skin.number).values
            for parameter in catalogue()[skin.mechanism].parameters:
                assert parameter.lower <= skin.values[parameter.name] <= parameter.upper
