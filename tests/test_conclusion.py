"""Tests of the verdict and the three sentences that state the result of a diagnosis."""

from __future__ import annotations

from typing import Any

import pytest
from toys.finished_run import summaries

from bayeskin.report.conclusion import Conclusion, conclusion_of

WINDOW = {"t0": 10.0, "t1": 19.0, "phase": "load", "cycle": 1, "mean_residual": -0.0356, "significance": 1e-3}
SLOW = {"protocol": "quarter speed", "seconds": 187.0, "gain_bits": 0.95}


def concluded(further_tests: dict[str, Any] | None = None, **changed: Any) -> Conclusion:
    """The conclusion of the finished run without its markers, with changed facts."""
    answer = summaries()["diagnose"]
    for fit in answer["fit"].values():
        del fit["on_skin"]
    return conclusion_of({**answer, **changed}, further_tests)


def a_set(probability: float, *names: str) -> dict[str, Any]:
    return {"mechanisms": list(names), "probability": probability}


def test_the_largest_of_the_windows_is_stated_with_its_place_and_side() -> None:
    hold = {**WINDOW, "phase": "hold", "mean_residual": 0.004}
    assert concluded(located=[hold, WINDOW]).where == (
        "The recorded force differs from the model in 2 time windows (while loading and in holds), most in "
        "the loading of cycle 1 (10 to 19 s), where it lies 36 mN below the model on average."
    )
    above = concluded(located=[{**hold, "recording": "second"}]).where
    assert "differs from the model in one time window, the hold of cycle 1 of second (10 to 19 s)" in above
    rest = {**WINDOW, "phase": "rest", "cycle": 0}
    assert "one time window, the rest before the first loading (10 to" in concluded(located=[rest]).where
    assert above.endswith("it lies 4 mN above the model on average.")
    assert concluded(located=[]).where == (
        "The recorded force stays where the model allows it (RMS difference 80 mN)."
    )


@pytest.mark.parametrize(
    ("significant", "clause"),
    [
        (0, "; all 25 markers on the skin move as the model says."),
        (7, "; 7 of 25 markers on the skin move otherwise than the model says (0.12 mm RMS)."),
    ],
)
def test_markers_are_part_of_the_first_sentence(significant: int, clause: str) -> None:
    fit = summaries()["diagnose"]["fit"]
    on_skin = {"points": 25, "significant": significant, "rms_m": 1.2e-4}
    marked = {**fit, "before": {**fit["before"], "on_skin": on_skin}}
    assert concluded(fit=marked).where.endswith(clause)
    assert concluded(fit=marked, located=[]).where.endswith(clause)


def test_a_named_mechanism_is_stated_with_its_effect_and_what_may_act_too() -> None:
    said = concluded(sets=[a_set(0.6, "device-friction"), a_set(0.3, "device-friction", "pad-slip")])
    assert said.verdict == "The model lacks device-friction"
    assert said.missing == (
        "The model lacks device-friction (probability 0.98): the slide rubs: 60 mN; pad-slip (0.3) may act "
        "too."
    )
    sure = concluded(sets=[a_set(0.99, "device-friction"), a_set(0.005, "pad-slip")])
    assert sure.missing.endswith("60 mN.")


def test_several_named_mechanisms_are_one_list() -> None:
    first = summaries()["diagnose"]["mechanisms"][0]
    second = {**first, "name": "pad-slip", "probability": 0.9999}
    said = concluded(mechanisms=[first, second], smooth_probability=0.8)
    assert said.verdict == "The model lacks device-friction and pad-slip"
    assert said.missing == (
        "The model lacks device-friction (probability 0.98) and pad-slip (probability > 0.999); "
        "something without a name in the catalogue acts too (0.8)."
    )


def test_a_look_alike_that_may_act_instead_is_stated_with_the_test_that_tells_more() -> None:
    sets = [a_set(0.6, "device-friction"), a_set(0.35, "viscous-drag"), a_set(0.001, "pad-slip")]
    said = concluded(sets=sets)
    assert said.missing.endswith("60 mN; viscous-drag may act in place of device-friction.")
    assert said.fit.endswith("; bayeskin experiment proposes a test that would tell the explanations apart.")
    explanations = [["device-friction"], ["viscous-drag"]]
    tested = concluded({"sets": explanations, "experiments": [SLOW]}, sets=sets).fit
    assert tested.endswith("; the test “quarter speed” of 187 s would tell the explanations apart best.")
    none = concluded({"sets": explanations, "experiments": [{**SLOW, "gain_bits": None}]}, sets=sets).fit
    assert none.endswith("; none of the tests that were tried would tell the explanations apart.")
    assert ";" not in concluded({"sets": explanations[:1], "experiments": []}, sets=sets).fit
    assert ";" not in concluded(sets=sets[:1]).fit


def test_nothing_is_missing_with_its_probability_unless_a_set_fits_better() -> None:
    nothing = concluded(verdict="nothing-missing", nothing_probability=0.93, mechanisms=[], best_set=[])
    assert nothing.verdict == "Nothing is missing"
    assert nothing.missing == "Nothing is missing from the model (probability 0.93)."
    assert nothing.fit == "No mechanism improves the fit, and the RMS difference of 80 mN remains."
    faint = concluded(verdict="nothing-missing", nothing_probability=0.6, mechanisms=[])
    assert faint.verdict == "Nothing can be named as missing"
    assert faint.missing.startswith("The model fits better with device-friction, but too little")
    assert faint.fit == "With device-friction, the RMS difference falls from 80 mN to 25 mN."


def test_something_unknown_is_outside_the_catalogue_or_has_several_causes() -> None:
    outside = concluded(verdict="unknown", smooth_probability=0.97, mechanisms=[])
    assert outside.verdict == "The model lacks something that has no name in the catalogue"
    assert outside.missing == (
        "Something is missing that no mechanism of the catalogue describes (probability 0.97)."
    )
    sets = [a_set(0.5, "pad-slip"), a_set(0.4, "backlash"), a_set(0.05, "pre-stretch")]
    several = concluded(verdict="unknown", nothing_probability=0.02, mechanisms=[], sets=sets)
    assert several.verdict == "The model lacks something that several mechanisms would explain"
    assert several.missing == (
        "Something is missing (probability 0.98), but no mechanism is probable enough to be named: it may be "
        "pad-slip (0.5) or backlash (0.4)."
    )
    assert several.fit.endswith(
        "; bayeskin experiment proposes a test that would tell the explanations apart."
    )


def test_the_part_that_was_not_fitted_is_stated_with_its_own_set() -> None:
    fit = summaries()["diagnose"]["fit"]
    held_out = {
        "before": {**fit["before"], "rmse_held_out": 0.017},
        "after": {**fit["after"], "rmse_held_out": 0.02},
    }
    said = concluded(fit=held_out, held_out_set=["pad-slip"]).fit
    assert said.endswith("which was then not fitted, it changes from 17 mN to 20 mN (with pad-slip).")
    assert concluded(fit=held_out, held_out_set=["device-friction"]).fit.endswith("17 mN to 20 mN.")
