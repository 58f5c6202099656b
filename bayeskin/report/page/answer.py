"""Makes the answer at the top of a page.

It says which parameters the skin has, how far they can be trusted, and which physics the model lacks.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

from bayeskin.report.mismatch import faint_in_words
from bayeskin.report.page.facts import RunFacts
from bayeskin.report.page.numbers import interval, number, percent, quantity, scale, with_unit
from bayeskin.report.page.parts import Answer, Bar, ParameterSummary, Verdict

# Each row holds a phrase with which a sentence of `inference.identify` begins after the parameter's name, the
# words that the page shows for it, and the tone of these words.
_LEARNT: tuple[tuple[str, str, str], ...] = (
    ("the data informs it weakly", "weakly informed", "doubt"),
    ("the data informs it", "informed", "good"),
    ("the data does not inform it", "not informed", "none"),
)
_THREE = ("low_90", "median", "high_90")


def answer(facts: RunFacts) -> Answer:
    """Returns the answer of a run, as far as it is finished."""
    return Answer(
        _parameter_rows(facts), _material_verdict(facts), _trust_verdict(facts), _missing_physics(facts)
    )


def sentences(facts: RunFacts) -> dict[str, str]:
    """Returns the sentence about each parameter by its name, without the name at the front."""
    lines = facts.said("sample").get("identifiability", [])
    return {name: text for name, _, text in (line.partition(": ") for line in lines)}


def without_numbers(sentence: str) -> str:
    """Returns a sentence about a parameter without its median and interval, which stand beside it."""
    return re.sub(r": median [^;]*", "", sentence)


def learnt(sentence: str) -> tuple[str, str]:
    """Returns in a few words how well the data informs a parameter, and the tone of these words."""
    return next(((word, tone) for start, word, tone in _LEARNT if sentence.startswith(start)), ("", "none"))


def prior_range(said: Mapping[str, Any]) -> str:
    """Returns the prior of a parameter as text, from its entry in the table of the stage `sample`."""
    prior = said["prior"]
    about = f" about {quantity(prior['centre'], said['unit'])}" if prior["kind"].endswith("normal") else ""
    return f"{prior['kind']}{about}, {interval(prior['lower'], prior['upper'], said['unit'])}"


def _parameter_rows(facts: RunFacts) -> list[ParameterSummary]:
    """Returns a row for each parameter of the posterior."""
    summaries, known_sentences = facts.said("sample").get("parameters", {}), sentences(facts)
    rows = []
    for name, meaning in facts.parameters.items():
        if name not in summaries:
            continue
        summary, sentence = summaries[name], known_sentences.get(name, "")
        word, tone = learnt(sentence)
        leans = re.search(r"leans on the prior's (\w+) bound", sentence)
        rows.append(
            ParameterSummary(
                name,
                meaning,
                with_unit(summary["median"], *scale([summary[key] for key in _THREE], summary["unit"])),
                interval(summary["low_90"], summary["high_90"], summary["unit"], beside=summary["median"]),
                word + (f", at the prior's {leans.group(1)} bound" if leans else ""),
                tone,
                prior_range(summary),
                _bar(summary),
            )
        )
    return rows


def _bar(said: Mapping[str, Any]) -> Bar:
    """Returns the position of the 90 % interval in the prior's range, in logarithms for a log prior."""
    prior = said["prior"]
    line = math.log if prior["kind"].startswith("log") and prior["lower"] > 0 else float
    low, high = line(prior["lower"]), line(prior["upper"])
    left, median, right = (100.0 * (line(said[key]) - low) / (high - low) for key in _THREE)
    return Bar(round(left, 2), round(right - left, 2), round(median, 2))


def _material_verdict(facts: RunFacts) -> Verdict:
    """Returns the text above the parameters, or why there are none yet."""
    sampled = facts.stage("sample")
    if not sampled.done:
        reason = [f"The posterior has not been sampled: the stage sample is {sampled.standing}."]
        return Verdict("not known yet", "none", reason, f"bayeskin run {facts.config_path}")
    ridges = facts.said("sample")["ridges"]
    lines = ["Posterior median and 90 % interval; the bar shows where they lie in the prior's range."]
    return Verdict("", "none", [*lines, *(f"{ridge}." for ridge in ridges)])


def _trust_verdict(facts: RunFacts) -> Verdict:
    """Returns whether the posterior can be trusted, with reasons."""
    summary = facts.said("sample")
    if not summary:
        return Verdict("not known yet", "none", ["There is no posterior yet."])
    checks = facts.said("map").get("checks", [])
    doubts = [check["message"] for check in checks[-1:] if not check["passes"]]
    trusted = summary["ok"] and not doubts
    rmse = summary["rmse"]
    fit = (
        f"The posterior mean has an RMSE of {quantity(rmse['whole_n'], 'N')} over the whole recording; the "
        f"90 % band holds {percent(summary['coverage_90_fitted'])} of the fitted bins."
    )
    lines = [*doubts, *(summary["reasons"] if not summary["ok"] else [])]
    lines += [] if lines else ["The chains have converged, and the surrogate agrees with the full model."]
    lines += [fit, *(f"{remark[0].upper()}{remark[1:]}." for remark in summary["remarks"])]
    return Verdict("trusted" if trusted else "not trusted", "good" if trusted else "doubt", lines)


def _missing_physics(facts: RunFacts) -> Verdict:
    """Returns which physics the model lacks, from the diagnosis."""
    diagnosis = facts.said("diagnose")
    if not diagnosis:
        standing = facts.stage("diagnose").standing
        reason = [f"The physics that is missing is not known: the stage diagnose is {standing}."]
        return Verdict("not known yet", "none", reason, f"bayeskin diagnose {facts.config_path}")
    rmse = [quantity(diagnosis["fit"][when]["rmse"], "N") for when in ("before", "after")]
    probability = number(diagnosis["smooth_probability"])
    smooth_line = f"Probability of a smooth effect that is not in the catalogue: {probability}."
    if diagnosis["verdict"] == "nothing-missing":
        fit_line = f"The recording stays within what the model allows ({rmse[0]} RMSE)."
        lines = [fit_line, smooth_line]
        if faint := faint_in_words(diagnosis):
            return Verdict("nothing that could be named", "doubt", [faint, *lines])
        return Verdict("nothing", "good", lines)
    lines = [
        f"{mechanism['statement']} (probability {number(mechanism['probability'])})"
        for mechanism in diagnosis["mechanisms"]
    ]
    lines.append(f"The RMSE is {rmse[0]} without and {rmse[1]} with the best set of mechanisms.")
    remaining = len(diagnosis["remaining"])
    if remaining:
        lines.append(f"{remaining} window{'s' * (remaining != 1)} of the recording remain unexplained.")
    lines.append(smooth_line)
    if diagnosis["verdict"] == "named":
        return Verdict("named", "doubt", lines)
    if diagnosis["best_set"]:
        lines.append(f"The best set of the catalogue is {', '.join(diagnosis['best_set'])}.")
    several = diagnosis["smooth_probability"] < 0.5
    word = "something that several causes would explain" if several else "something outside the catalogue"
    return Verdict(word, "doubt", lines)
