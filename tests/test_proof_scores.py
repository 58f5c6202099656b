"""Scores of the proof: what counts as right, and the scoreboard of made-up verdicts."""

from __future__ import annotations

import json

import numpy as np
import pytest
from toys.made_up_verdicts import key, made_up, said

from bayeskin.mechanisms import catalogue
from bayeskin.proof import score
from bayeskin.proof.noise import floor_after, noise
from bayeskin.proof.protocol import EDGES_S, HELD_OUT_FROM_S, samples_s
from bayeskin.proof.scoring.judgement import judge, overlap
from bayeskin.proof.scoring.look_alikes import is_listed, stands_for
from bayeskin.proof.scoring.shares import share, share_of_parts


@pytest.mark.parametrize(
    ("truth", "names", "right", "group"),
    [
        ("pad-slip", ["pad-slip"], True, True),
        ("pad-slip", ["slow-recovery"], False, True),
        ("pad-slip", ["backlash"], False, False),
        ("pad-slip", ["pad-slip", "backlash"], False, False),
        ("pad-slip", ["pad-slip", "slow-recovery"], False, False),
        ("pad-slip", [], False, False),
        ("pre-stretch", ["force-offset", "strain-stiffening"], False, True),
        ("pre-stretch", ["force-offset"], False, False),
        ("strain-stiffening", ["pre-stretch"], False, False),
        ("force-offset", ["device-friction"], False, True),
        ("force-offset", ["strain-stiffening"], False, False),
        ("pad-slip + sensor-drift", ["sensor-drift", "pad-slip"], True, True),
        ("pad-slip + sensor-drift", ["sensor-drift", "preconditioning"], False, True),
        ("pad-slip + sensor-drift", ["sensor-drift"], False, False),
    ],
)
def test_a_name_is_right_alone_or_as_a_look_alike(truth, names, right, group) -> None:
    kind = "pair" if "+" in truth else "alone"
    judgement = judge("001", key(truth, kind), said(*names))
    assert (judgement.right, judgement.right_group) == (right, group)


def test_a_group_larger_than_what_is_known_to_look_alike_is_wrong() -> None:
    answer = said("pad-slip")
    answer["mechanisms"][0]["group"] = ["pad-slip", "slow-recovery", "backlash"]
    judgement = judge("001", key("pad-slip"), answer)
    assert (judgement.right, judgement.right_group) == (False, False)
    answer = said("device-friction")
    answer["mechanisms"][0]["group"] = ["viscous-drag", "force-offset"]  # each in one of its groups
    judgement = judge("001", key("device-friction"), answer)
    assert (judgement.right, judgement.right_group) == (False, False)


def test_the_probability_of_a_pair_is_that_of_its_less_probable_part() -> None:
    both = key("pad-slip + sensor-drift", "pair")
    assert judge("001", both, said("pad-slip")).probability == 0.0
    assert judge("001", both, said("pad-slip", "sensor-drift")).probability == 0.9


def test_of_a_pair_each_mechanism_that_adds_enough_counts_and_each_name() -> None:
    both = key("pad-slip + sensor-drift", "pair", sizes={"pad-slip": 8e-3, "sensor-drift": 5e-3})
    judgement = judge("001", both, said("pad-slip", "backlash"))
    assert judgement.clear_parts_named == {"pad-slip": True}  # of the other 2.5 floors remain
    assert judgement.names_concealed == {"pad-slip": True, "backlash": False}
    other = judge("002", key("nothing", "nothing", 0.0), said("backlash"))
    assert (other.clear_parts_named, other.names_concealed) == ({}, {"backlash": False})
    keys = {"001": both, "002": key("nothing", "nothing", 0.0), "003": key("sensor-drift")}
    answers = {"001": said("pad-slip", "backlash"), "002": said("backlash"), "003": said()}
    board = score(keys, answers)
    counts = [board[name] for name in ("clear_mechanisms_named", "named_mechanisms_there")]
    assert [(count["hits"], count["of"]) for count in counts] == [(1, 2), (1, 3)]


def test_an_interval_of_parameters_counts_recordings() -> None:
    single, many = (
        share([True, False]),
        share_of_parts([{"a": True, "b": True}, {"a": False, "b": False}, {}]),
    )
    assert (many["hits"], many["of"]) == (2, 4)
    assert (many["share"], many["low"], many["high"]) == (single["share"], single["low"], single["high"])


def test_what_is_held_out_has_a_floor_of_its_own() -> None:
    time_s = samples_s()
    made_n = noise(np.random.default_rng(1), time_s, 2e-3)
    quiet = np.abs(made_n - np.median(made_n)) < 10e-3  # no spikes
    bins = np.digitize(time_s, EDGES_S) - 1
    means = np.array([made_n[quiet & (bins == i)].mean() for i in range(len(EDGES_S) - 1)])
    late = EDGES_S[:-1] > HELD_OUT_FROM_S
    ratio = np.sqrt(np.mean(means[late] ** 2) / np.mean(means**2))
    assert floor_after(1.0, HELD_OUT_FROM_S) == pytest.approx(ratio, rel=0.05)


def test_the_catalogue_s_own_groups_are_allowed_and_mutual() -> None:
    for name, mechanism in catalogue().items():
        assert is_listed(name, mechanism.group), name
    assert stands_for({"viscous-drag"}, {"device-friction"})
    assert stands_for({"device-friction"}, {"viscous-drag"})


def test_steps_of_the_cell_have_no_order() -> None:
    truth = {"event_1_at": 0.2, "event_1_step": 0.01, "event_2_at": 0.7, "event_2_step": -0.02}
    answer = said("sensor-events")
    swapped = {"event_1_at": 0.7, "event_1_step": -0.02, "event_2_at": 0.2, "event_2_step": 0.01}
    answer["mechanisms"][0]["parameters"] = {
        name: {"mean": value, "sd": 1e-3, "unit": "-"} for name, value in swapped.items()
    }
    assert all(judge("001", key("sensor-events", values=truth), answer).inside.values())


def test_overlap_is_intersection_over_union_of_bins() -> None:
    assert overlap([(0.0, 10.0)], [(5.0, 15.0)]) == pytest.approx(1 / 3)
    assert overlap([(0.0, 10.0)], []) == 0.0
    assert overlap([], []) is None


def test_wilson_s_interval_is_that_of_the_books() -> None:
    right_share = share([True] * 9 + [False])
    assert (right_share["hits"], right_share["of"], right_share["share"]) == (9, 10, 0.9)
    assert right_share["low"] == pytest.approx(0.6526, abs=2e-3)
    assert right_share["high"] == pytest.approx(0.9774, abs=2e-3)
    assert share([])["share"] is None


def test_a_scoreboard_of_made_up_verdicts_counts_as_it_should() -> None:
    keys, answers = made_up()
    board = score(keys, answers)
    assert board["judged"] == len(keys)
    assert (board["false_alarms"]["hits"], board["false_alarms"]["of"]) == (1, 3)
    assert (board["named"]["clear"]["hits"], board["named"]["clear"]["of"]) == (2, 4)
    assert board["named_up_to_look_alikes"]["clear"]["hits"] == 3
    assert (board["named"]["below"]["hits"], board["named"]["below"]["of"]) == (0, 1)
    assert (board["unknown_outside"]["clear"]["hits"], board["unknown_outside"]["clear"]["of"]) == (1, 2)
    assert (board["effect_in_interval"]["clear"]["hits"], board["effect_in_interval"]["clear"]["of"]) == (
        1,
        2,
    )
    assert (board["base_in_interval"]["clear"]["hits"], board["base_in_interval"]["clear"]["of"]) == (1, 2)
    floor_n = floor_after(2e-3, HELD_OUT_FROM_S)
    assert board["held_out_over_floor"]["clear"]["median"] == pytest.approx(2.5e-3 / floor_n)
    assert board["location_overlap"]["clear"]["median"] == 0.0
    assert board["confusion"]["nothing"] == {"nothing-missing": 2, "sensor-drift": 1}
    assert board["confusion"]["outside"] == {"unknown": 1, "strain-stiffening": 1}
    assert sum(row["named"]["of"] for row in board["detectability"]) == 5
    assert json.loads(json.dumps(board, allow_nan=False)) == board


@pytest.mark.parametrize(
    ("full", "rmse_n"),
    [
        (None, 3e-3),
        ({"message": "failed"}, 3e-3),
        ({"rmse_held_out": None}, 3e-3),
        ({"rmse_held_out": 2e-3}, 2e-3),
    ],
)
def test_held_out_is_the_full_model_s_where_it_has_a_fit(full: dict | None, rmse_n: float) -> None:
    answer = said("force-offset", fit={"after": {"rmse_held_out": 3e-3, "full_model": full}})
    judgement = judge("001", key("force-offset"), answer)
    assert judgement.held_out == pytest.approx(rmse_n / floor_after(2e-3, HELD_OUT_FROM_S))


def test_a_group_larger_than_one_listed_is_no_answer_of_the_confusion_matrix() -> None:
    answer = said("device-friction")
    assert judge("001", key("device-friction"), answer).answer == "device-friction"
    answer["mechanisms"][0]["group"] = ["device-friction", "pad-slip", "backlash"]
    judgement = judge("001", key("device-friction"), answer)
    assert (judgement.right, judgement.answer) == (False, "group too large")
