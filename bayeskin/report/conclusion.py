"""Puts the result of a diagnosis into a verdict and three sentences, for the terminal and for pages."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, get_args

from bayeskin.number_format import number, probability, quantity
from bayeskin.types import PHASE_IN_WORDS, PhaseKind

OPEN = 0.01  # probability from which a look-alike that may act in place of a named mechanism is stated
POSSIBLE = 0.1  # probability from which a mechanism that was not named is stated
LIKELY = 0.5  # probability from which an effect without a name is stated
MOST_LISTED = 3
COMMAND = "bayeskin experiment"
_PHASES = {"rest": "rest", "load": "loading", "hold": "hold", "unload": "unloading"}


@dataclass(frozen=True)
class Conclusion:
    """The result of a diagnosis for a reader.

    verdict : a short sentence without a full stop
    where : where recording and model differ, and by how much
    missing : what the model lacks, and how probable that is
    fit : how much better the fit is, and which test would tell more
    """

    verdict: str
    where: str
    missing: str
    fit: str

    @property
    def sentences(self) -> tuple[str, str, str]:
        """Returns the three sentences in their order."""
        return self.where, self.missing, self.fit


def conclusion_of(answer: Mapping[str, Any], further_tests: Mapping[str, Any] | None = None) -> Conclusion:
    """Returns the verdict and the three sentences of a diagnosis.

    answer : answer of `bayeskin diagnose`, which `diagnosis.json` contains
    further_tests : answer of `bayeskin experiment`, or None if there is none
    """
    return Conclusion(
        _verdict(answer), _where(answer), f"{_missing(answer)}.", f"{_fit(answer, further_tests)}."
    )


def listed(names: Sequence[str], last: str = "and") -> str:
    """Returns names as a list in words, such as "a, b and c"."""
    return f" {last} ".join(part for part in (", ".join(names[:-1]), *names[-1:]) if part)


def _verdict(answer: Mapping[str, Any]) -> str:
    if answer["verdict"] == "nothing-missing":
        return "Nothing can be named as missing" if answer["best_set"] else "Nothing is missing"
    if answer["verdict"] == "named":
        return f"The model lacks {listed([mechanism['name'] for mechanism in answer['mechanisms']])}"
    if answer["smooth_probability"] >= LIKELY:
        return "The model lacks something that has no name in the catalogue"
    return "The model lacks something that several mechanisms would explain"


def _chance(value: float) -> str:
    """Returns a probability with two digits, or with three next to 0 and 1."""
    return number(value, 2) if 0.01 <= value <= 0.99 else probability(value)


def _where(answer: Mapping[str, Any]) -> str:
    """Returns the sentence about the time windows, and about the markers if the recording has some."""
    before, windows = answer["fit"]["before"], answer["located"]
    skin = _on_skin(before.get("on_skin"))
    if not windows:
        rmse = quantity(before["rmse"], "N", 2)
        return f"The recorded force stays where the model allows it (RMS difference {rmse}){skin}."
    most = max(windows, key=lambda window: abs(window["mean_residual"]))
    side = "above" if most["mean_residual"] > 0 else "below"
    kinds = {window["phase"] for window in windows}
    phases = listed([PHASE_IN_WORDS[kind] for kind in get_args(PhaseKind) if kind in kinds])
    several = f"{len(windows)} time windows ({phases}), most in"
    count = "one time window," if len(windows) == 1 else several
    return (
        f"The recorded force differs from the model in {count} {_place(most)}, where it lies "
        f"{quantity(abs(most['mean_residual']), 'N', 2)} {side} the model on average{skin}."
    )


def _place(window: Mapping[str, Any]) -> str:
    """Returns phase, cycle and times of a window, and its recording if there are several."""
    cycle = f"of cycle {window['cycle']}" if window["cycle"] else "before the first loading"
    recording = f" of {window['recording']}" if "recording" in window else ""
    times = f"{number(window['t0'])} to {number(window['t1'])} s"
    return f"the {_PHASES[window['phase']]} {cycle}{recording} ({times})"


def _on_skin(located: Mapping[str, Any] | None) -> str:
    """Returns a clause about the markers that move otherwise than the model says; none without markers."""
    if located is None:
        return ""
    count, total = located["significant"], located["points"]
    if not count:
        return f"; all {total} markers on the skin move as the model says"
    size = quantity(located["rms_m"], "m", 2)
    return f"; {count} of {total} markers on the skin move otherwise than the model says ({size} RMS)"


def _missing(answer: Mapping[str, Any]) -> str:
    """Returns the sentence about what the model lacks, without its full stop."""
    best, smooth = answer["best_set"], answer["smooth_probability"]
    if answer["verdict"] == "nothing-missing":
        if not best:
            chance = _chance(answer["nothing_probability"])
            return f"Nothing is missing from the model (probability {chance})"
        return (
            f"The model fits better with {listed(best)}, but too little or too uncertainly to name what is "
            "missing; the skin's parameters depend on it, so do not rely on them"
        )
    if answer["verdict"] == "named":
        return _named(answer)
    if smooth >= LIKELY:
        return (
            "Something is missing that no mechanism of the catalogue describes "
            f"(probability {_chance(smooth)})"
        )
    text = (
        f"Something is missing (probability {_chance(1.0 - answer['nothing_probability'])}), but no "
        "mechanism is probable enough to be named"
    )
    candidates = _possible(answer, ())
    return f"{text}: it may be {candidates}" if candidates else text


def _named(answer: Mapping[str, Any]) -> str:
    """Returns the sentence about named mechanisms, their look-alikes, and what may act too."""
    named, smooth = answer["mechanisms"], answer["smooth_probability"]
    texts = [f"{mechanism['name']} (probability {_chance(mechanism['probability'])})" for mechanism in named]
    parts = [f"The model lacks {listed(texts)}"]
    if len(named) == 1:
        statement = named[0]["statement"].rstrip(".")
        parts = [f"{parts[0]}: {statement[:1].lower()}{statement[1:]}"]
    for mechanism in named:
        if rivals := _rivals(answer, mechanism):
            parts.append(f"{listed(rivals, 'or')} may act in place of {mechanism['name']}")
    stated = {
        *(mechanism["name"] for mechanism in named),
        *(name for m in named for name in _rivals(answer, m)),
    }
    if further := _possible(answer, stated):
        parts.append(f"{further} may act too")
    if smooth >= LIKELY:
        parts.append(f"something without a name in the catalogue acts too ({_chance(smooth)})")
    return "; ".join(parts)


def _possible(answer: Mapping[str, Any], stated: Collection[str]) -> str:
    """Returns a list in words of the mechanisms that may act, with probabilities, without those `stated`."""
    acting: dict[str, float] = {}
    for names in answer["sets"]:
        for name in set(names["mechanisms"]) - set(stated):
            acting[name] = acting.get(name, 0.0) + names["probability"]
    likeliest = sorted((name for name in acting if acting[name] >= POSSIBLE), key=lambda name: -acting[name])
    return listed([f"{name} ({_chance(acting[name])})" for name in likeliest[:MOST_LISTED]], "or")


def _rivals(answer: Mapping[str, Any], mechanism: Mapping[str, Any]) -> list[str]:
    """Returns the look-alikes that may act where a named mechanism does not, the likeliest first."""
    named = {other["name"] for other in answer["mechanisms"]}
    without = [names for names in answer["sets"] if mechanism["name"] not in names["mechanisms"]]
    chance = {
        other: sum(names["probability"] for names in without if other in names["mechanisms"])
        for other in mechanism["group"]
        if other not in named
    }
    return sorted((other for other in chance if chance[other] >= OPEN), key=lambda other: -chance[other])


def _fit(answer: Mapping[str, Any], further_tests: Mapping[str, Any] | None) -> str:
    """Returns the sentence about the fit and a further test, without its full stop."""
    before, after = answer["fit"]["before"], answer["fit"]["after"]
    rmse = [quantity(fit["rmse"], "N", 2) for fit in (before, after)]
    if not answer["best_set"]:
        return f"No mechanism improves the fit, and the RMS difference of {rmse[0]} remains"
    text = f"With {listed(answer['best_set'])}, the RMS difference {_change(before['rmse'], after['rmse'])}"
    if after["rmse_held_out"] is not None:
        held_out = answer["held_out_set"] or []
        label = "" if held_out == answer["best_set"] else f" (with {listed(held_out) or 'no mechanism'})"
        change = _change(before["rmse_held_out"], after["rmse_held_out"])
        text += f", and in the last part, which was then not fitted, it {change}{label}"
    return text + _further_test(answer, further_tests)


def _change(before_n: float, after_n: float) -> str:
    """Returns how an RMS difference changes."""
    verb = "falls" if after_n < before_n else "changes"
    return f"{verb} from {quantity(before_n, 'N', 2)} to {quantity(after_n, 'N', 2)}"


def _further_test(answer: Mapping[str, Any], further_tests: Mapping[str, Any] | None) -> str:
    """Returns a clause about the test that would tell look-alikes apart, if some remain."""
    remain = any(_rivals(answer, mechanism) for mechanism in answer["mechanisms"])
    if answer["verdict"] == "unknown":
        remain = answer["smooth_probability"] < LIKELY
    if further_tests is None:
        return f"; {COMMAND} proposes a test that would tell the explanations apart" if remain else ""
    if len(further_tests["sets"]) < 2:
        return ""
    best = further_tests["experiments"][0]
    if not best["gain_bits"] or not best["gain_bits"] > 0.0:
        return "; none of the tests that were tried would tell the explanations apart"
    seconds = number(best["seconds"])
    return f"; the test “{best['protocol']}” of {seconds} s would tell the explanations apart best"
