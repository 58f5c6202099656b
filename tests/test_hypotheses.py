"""The rule of the verdict: probabilities that are shares of one family, whatever the evidences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bayeskin.mechanisms import catalogue
from bayeskin.mismatch.hypotheses import Evidences, Family, Judgement, hypotheses_of, judge_family

# Look-alikes of each other, one whose group is not all known, and some that are like nothing else.
NAMES = (
    "device-friction", "force-offset", "friction-creep", "sensor-drift", "solid-viscoelasticity",
    "stiffness-drift",
)  # fmt: skip
KNOWN = {name: catalogue()[name] for name in NAMES}
ODDS = np.log(0.05 / 0.95)
SETS = st.lists(st.sets(st.sampled_from(NAMES), max_size=4), max_size=5, unique_by=tuple)
EVIDENCES = st.floats(-800.0, 800.0)
CHANCES = st.floats(0.0) | st.floats(0.0, 1e-6)


@st.composite
def families(draw: st.DrawFn) -> Family:
    """Draws evidences, near each other or far apart, of a few sets and the set without mechanisms."""
    names = {tuple(sorted(chosen)) for chosen in draw(SETS)} | {()}
    near = st.floats(-4.0, 4.0)
    evidence = draw(st.sampled_from([EVIDENCES, near]))
    said = [(own, Evidences(draw(evidence), draw(evidence))) for own in sorted(names)]
    return Family([chosen for own, its in said for chosen in hypotheses_of(own, its)])


def judged(family: Family) -> Judgement:
    return judge_family(family, KNOWN, 1.0)


@given(families())
def test_probabilities_of_sets_add_up_to_one(family: Family) -> None:
    sets = {hypothesis.names for hypothesis in family.hypotheses}
    assert sum(family.probability_of_set(names) for names in sets) == pytest.approx(1.0)
    assert family.nothing + family.smooth + family.probability(NAMES) >= 1.0 - 1e-9
    assert family.probability_of_set(()) + family.probability(NAMES) == pytest.approx(1.0)
    assert family.nothing <= family.probability_of_set(()) + 1e-12


@given(families())
def test_a_mechanism_is_no_likelier_than_its_look_alikes_together(family: Family) -> None:
    for name, mechanism in KNOWN.items():
        assert family.probability([name]) <= family.probability(mechanism.group) + 1e-12
    for member in judged(family).named:
        assert member.probability == family.probability([member.name])
        assert member.probability <= member.group_probability + 1e-12
        assert member.group_probability >= 0.9
        assert member.name in member.group


@given(families())
def test_a_verdict_is_one_of_three_that_exclude_each_other(family: Family) -> None:
    verdict = judged(family)
    assert (verdict.verdict == "named") == bool(verdict.named)
    assert (verdict.verdict == "unknown") == (not verdict.named and family.nothing <= 0.5)
    assert verdict.smooth_probability == family.smooth
    assert verdict.nothing_probability == family.nothing
    names = [mechanism.name for mechanism in verdict.named]
    assert len(set(names)) == len(names)
    certain = {name for name in NAMES if family.probability([name]) >= 0.9}
    assert certain <= set(names)


@given(families(), st.floats(-1e4, 1e4))
def test_a_constant_more_in_all_evidences_changes_nothing(family: Family, constant: float) -> None:
    moved = Family(
        [replace(hypothesis, log_weight=hypothesis.log_weight + constant) for hypothesis in family.hypotheses]
    )
    for names in {hypothesis.names for hypothesis in family.hypotheses}:
        assert moved.probability_of_set(names) == pytest.approx(family.probability_of_set(names), abs=1e-9)
    assert moved.smooth == pytest.approx(family.smooth, abs=1e-9)
    assert moved.nothing == pytest.approx(family.nothing, abs=1e-9)


@given(st.sets(st.sampled_from(NAMES[:-1])), EVIDENCES, EVIDENCES)
def test_each_mechanism_and_what_has_no_name_cost_the_same_prior(
    names: set[str], alone: float, smooth: float
) -> None:
    said = Evidences(alone, smooth)
    fewer = hypotheses_of(tuple(sorted(names)), said)
    more = hypotheses_of((*sorted(names), "stiffness-drift"), said)
    for less, mechanism in zip(fewer, more, strict=True):
        assert mechanism.log_weight - less.log_weight == pytest.approx(ODDS, abs=1e-9)
    assert fewer[0].log_weight == pytest.approx(alone + len(names) * ODDS)
    assert fewer[1].log_weight - fewer[0].log_weight == pytest.approx(smooth - alone + ODDS, abs=1e-9)
    assert [mechanism.smooth for mechanism in fewer] == [False, True]


def of(**nats: float) -> Family:
    """Sets of one mechanism or none, by name with `_` for `-`, the base at 0, nothing smooth anywhere."""
    rows = [hypotheses_of((), Evidences(0.0, -50.0))]
    rows += [
        hypotheses_of((name.replace("_", "-"),), Evidences(value, -50.0)) for name, value in nats.items()
    ]
    return Family([hypothesis for row in rows for hypothesis in row])


def exact(family: Family) -> Judgement:
    """The judgement of the same hypotheses, whose evidences have no error."""
    return judged(replace(family, evidence_sd=0.0))


def test_the_verdicts_by_hand_of_evidences_without_an_error() -> None:
    assert exact(of()).verdict == "nothing-missing"
    # 19 to 1 against, e^6 for: 403 / (403 + 19)
    verdict = exact(of(sensor_drift=6.0))
    assert verdict.verdict == "named"
    assert verdict.named[0].probability == pytest.approx(np.exp(6.0) / (np.exp(6.0) + 19.0))
    assert exact(of(sensor_drift=5.0)).verdict == "unknown"  # 148 / 167, below nine in ten
    assert exact(of(sensor_drift=2.5)).verdict == "nothing-missing"  # 12 / 31
    smooth = Family([*hypotheses_of((), Evidences(0.0, 3.5))])  # e^3.5 is 33, to 19
    assert (exact(smooth).verdict, exact(smooth).named) == ("unknown", ())
    assert exact(Family(hypotheses_of((), Evidences(0.0, 2.5)))).verdict == "nothing-missing"


def mean_logistic(lead: float, sd: float) -> float:
    """The mean of 1 / (1 + exp(-x)) for a normal x, by Gauss-Hermite quadrature."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(60)
    return float(weights @ (1.0 / (1.0 + np.exp(-(lead + sd * nodes)))) / weights.sum())


@pytest.mark.parametrize("nats", [-8.0, 0.0, 6.0, 9.0, 14.0])
def test_a_probability_is_the_mean_over_the_error_of_a_mechanism(nats: float) -> None:
    family = of(sensor_drift=nats)
    expected = mean_logistic(nats + ODDS, family.evidence_sd)
    assert family.probability(["sensor-drift"]) == pytest.approx(expected, abs=2e-3)


def test_of_two_mechanisms_both_have_an_error() -> None:
    family = of(sensor_drift=100.0, stiffness_drift=104.0)
    expected = mean_logistic(4.0, np.sqrt(2.0) * family.evidence_sd)
    assert family.probability(["stiffness-drift"]) == pytest.approx(expected, abs=2e-3)


def test_sets_that_share_a_mechanism_share_its_error() -> None:
    """The probability of a second mechanism beside a certain one depends on the second's error alone."""
    said = {("sensor-drift",): 100.0, ("sensor-drift", "stiffness-drift"): 107.0}
    rows = [hypotheses_of(names, Evidences(nats, nats - 50.0)) for names, nats in said.items()]
    family = Family([hypothesis for row in rows for hypothesis in row])
    expected = mean_logistic(7.0 + ODDS, family.evidence_sd)
    assert family.probability(["stiffness-drift"]) == pytest.approx(expected, abs=2e-3)


@pytest.mark.parametrize("evidence_sd", [0.0, 3.0, 30.0])
def test_an_error_tells_nothing_about_a_discrepancy(evidence_sd: float) -> None:
    for names in ((), ("sensor-drift",)):
        only = Family(hypotheses_of(names, Evidences(0.0, 3.5)), evidence_sd)
        assert only.smooth == pytest.approx(np.exp(3.5) / (np.exp(3.5) + 19.0))


def test_a_lead_of_a_few_nats_names_nothing_and_one_of_tens_of_nats_is_certain() -> None:
    assert judged(of(sensor_drift=6.0)).verdict == "unknown"
    (mechanism,) = judged(of(sensor_drift=30.0)).named
    assert mechanism.probability > 0.999


def test_of_look_alikes_that_share_the_chances_the_likeliest_is_named() -> None:
    (mechanism,) = judged(of(device_friction=20.0, force_offset=20.5)).named
    assert mechanism.name == "force-offset"
    assert mechanism.probability < 0.9
    assert mechanism.group_probability == pytest.approx(1.0, abs=1e-4)
    assert judged(of(sensor_drift=20.0, stiffness_drift=20.5)).verdict == "unknown"  # not alike


def test_a_mechanism_is_not_named_for_a_likelier_look_alike() -> None:
    """Only one of the two states the other as its look-alike, and that one is the less likely."""
    pair = ("sensor-drift", "stiffness-drift")
    known = {**KNOWN, "sensor-drift": replace(KNOWN["sensor-drift"], look_alikes=pair[1:])}
    assert judge_family(of(sensor_drift=20.0, stiffness_drift=20.5), known, 1.0).named == ()
    (mechanism,) = judge_family(of(sensor_drift=20.5, stiffness_drift=20.0), known, 1.0).named
    assert (mechanism.name, mechanism.group) == ("sensor-drift", pair)


def test_a_device_whose_model_knows_few_mechanisms_has_a_verdict() -> None:
    """Look-alikes that the model was not trained for have no probability."""
    few = {name: KNOWN[name] for name in ("device-friction", "friction-creep")}
    pair = ("device-friction", "friction-creep")
    said = {(): Evidences(0.0, 0.0), pair: Evidences(30.0, 0.0)}
    family = Family([hypothesis for names, its in said.items() for hypothesis in hypotheses_of(names, its)])
    assert [mechanism.name for mechanism in judge_family(family, few, 1.0).named] == list(pair)


def test_nothing_is_named_beside_something_smooth_that_is_most_of_the_misfit() -> None:
    """A friction that a Gaussian process gains by, which explains 782 nats by itself."""
    said = {(): Evidences(0.0, 782.0), ("device-friction",): Evidences(30.0, 830.0)}
    family = Family([hypothesis for names, its in said.items() for hypothesis in hypotheses_of(names, its)])
    assert family.probability(["device-friction"]) > 0.99
    little = judge_family(family, KNOWN, 0.8)
    assert (little.verdict, little.named) == ("unknown", ())
    (mechanism,) = judge_family(family, KNOWN, 0.95).named
    assert mechanism.name == "device-friction"
    alone = Family(hypotheses_of(("device-friction",), Evidences(30.0, 20.0)))
    assert judge_family(alone, KNOWN, 0.2).verdict == "named"  # nothing smooth: a small effect is one
