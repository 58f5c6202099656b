"""The top of a page: what the skin is made of, how sure that is, what is missing."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

from bayeskin.report.mismatch import faint_in_words
from bayeskin.report.page.facts import RunFacts
from bayeskin.report.page.numbers import interval, number, percent, quantity, scale, with_unit
from bayeskin.report.page.parts import Answer, Bar, Made, Verdict

# The sentences of `inference.identify` begin with one of these, after the parameter's name.
_LEARNT: tuple[tuple[str, str, str], ...] = (
    ("the data informs it weakly", "weakly informed", "doubt"),
    ("the data informs it", "informed", "good"),
    ("the data does not inform it", "not informed", "none"),
)
_THREE = ("low_90", "median", "high_90")


def answer(facts: RunFacts) -> Answer:
    """Returns the answer of a run, as far as it is finished."""
    return Answer(_made(facts), _made_of(facts), _sure(facts), _missing(facts))


def sentences(facts: RunFacts) -> dict[str, str]:
    """Returns the sentences about each parameter, without its name at the front."""
    lines = facts.said("sample").get("identifiability", [])
    return {name: text for name, _, text in (line.partition(": ") for line in lines)}


def without_numbers(sentence: str) -> str:
    """Returns the sentence about a parameter whose median and interval stand beside it."""
    return re.sub(r": median [^;]*", "", sentence)


def learnt(sentence: str) -> tuple[str, str]:
    """In two words what the data says of a parameter, and the tone to say it in."""
    return next(((word, tone) for start, word, tone in _LEARNT if sentence.startswith(start)), ("", "none"))


def prior_range(said: Mapping[str, Any]) -> str:
    """The prior of one parameter of the stage `sample`'s table."""
    prior = said["prior"]
    about = f" about {quantity(prior['centre'], said['unit'])}" if prior["kind"].endswith("normal") else ""
    return f"{prior['kind']}{about}, {interval(prior['lower'], prior['upper'], said['unit'])}"


def _made(facts: RunFacts) -> list[Made]:
    table, spoken = facts.said("sample").get("parameters", {}), sentences(facts)
    rows = []
    for name, meaning in facts.parameters.items():
        if name not in table:
            continue
        said, sentence = table[name], spoken.get(name, "")
        word, tone = learnt(sentence)
        leans = re.search(r"leans on the prior's (\w+) bound", sentence)
        rows.append(
            Made(
                name,
                meaning,
                with_unit(said["median"], *scale([said[key] for key in _THREE], said["unit"])),
                interval(said["low_90"], said["high_90"], said["unit"], beside=said["median"]),
                word + (f", at the prior's {leans.group(1)} bound" if leans else ""),
                tone,
                prior_range(said),
                _bar(said),
            )
        )
    return rows


def _bar(said: Mapping[str, Any]) -> Bar:
    prior = said["prior"]
    line = math.log if prior["kind"].startswith("log") and prior["lower"] > 0 else float
    low, high = line(prior["lower"]), line(prior["upper"])
    left, median, right = (100.0 * (line(said[key]) - low) / (high - low) for key in _THREE)
    return Bar(round(left, 2), round(right - left, 2), round(median, 2))


def _made_of(facts: RunFacts) -> Verdict:
    sampled = facts.stage("sample")
    if not sampled.done:
        why = [f"The posterior has not been sampled: the stage sample is {sampled.standing}."]
        return Verdict("not known yet", "none", why, f"bayeskin run {facts.config_path}")
    ridges = facts.said("sample")["ridges"]
    lines = ["Posterior median and 90 % interval; the bar shows where they lie in the prior's range."]
    return Verdict("", "none", [*lines, *(f"{ridge}." for ridge in ridges)])


def _sure(facts: RunFacts) -> Verdict:
    said = facts.said("sample")
    if not said:
        return Verdict("not known yet", "none", ["There is no posterior to trust or not to trust."])
    checked = facts.said("map").get("checks", [])
    doubts = [one["message"] for one in checked[-1:] if not one["passes"]]
    trusted = said["ok"] and not doubts
    rmse = said["rmse"]
    fit = (
        f"The posterior mean leaves {quantity(rmse['whole_n'], 'N')} RMSE over the whole recording; its 90 % "
        f"band holds {percent(said['coverage_90_fitted'])} of the fitted bins."
    )
    lines = [*doubts, *(said["reasons"] if not said["ok"] else [])]
    lines += [] if lines else ["Chains, surrogate and the full model at the most probable point agree."]
    lines += [fit, *(f"{one[0].upper()}{one[1:]}." for one in said["remarks"])]
    return Verdict("trusted" if trusted else "not trusted", "good" if trusted else "doubt", lines)


def _missing(facts: RunFacts) -> Verdict:
    said = facts.said("diagnose")
    if not said:
        standing = facts.stage("diagnose").standing
        why = [f"Nobody has looked yet: the stage diagnose is {standing}."]
        return Verdict("not known yet", "none", why, f"bayeskin diagnose {facts.config_path}")
    both = [quantity(said["fit"][when]["rmse"], "N") for when in ("before", "after")]
    chance = number(said["smooth_probability"])
    beyond = f"Something smooth that is not in the catalogue: probability {chance}."
    if said["verdict"] == "nothing-missing":
        within = f"The recording stays within what the model allows ({both[0]} RMSE)."
        lines = [within, beyond]
        if faint := faint_in_words(said):
            return Verdict("nothing that could be named", "doubt", [faint, *lines])
        return Verdict("nothing", "good", lines)
    lines = [f"{one['statement']} (probability {number(one['probability'])})" for one in said["mechanisms"]]
    lines.append(f"RMSE {both[0]} without, {both[1]} with what was found.")
    left = len(said["remaining"])
    if left:
        lines.append(f"{left} window{'s' * (left != 1)} of the recording remain unexplained.")
    lines.append(beyond)
    if said["verdict"] == "named":
        return Verdict("named", "doubt", lines)
    if said["best_set"]:
        lines.append(f"Of the catalogue {', '.join(said['best_set'])} fits best.")
    several = said["smooth_probability"] < 0.5
    word = "something that several causes would explain" if several else "something that has no name here"
    return Verdict(word, "doubt", lines)
