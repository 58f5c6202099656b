"""Makes the answer at the top of a page.

It says which parameters the skin has, how far they can be trusted, and which physics the model lacks.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from bayeskin.inference.identify import Informed
from bayeskin.number_format import interval, percent, quantity, scale, with_unit
from bayeskin.report.conclusion import conclusion_of, listed
from bayeskin.report.page.facts import RunFacts
from bayeskin.report.page.parts import Answer, Bar, ParameterSummary, Verdict
from bayeskin.report.words import prior_in_words

_TONES = {Informed.WELL: "good", Informed.WEAKLY: "doubt", Informed.NOT: "none"}
_THREE = ("low_90", "median", "high_90")


def answer(facts: RunFacts) -> Answer:
    """Returns the answer of a run, as far as it is finished."""
    return Answer(
        _parameter_rows(facts), _material_verdict(facts), _trust_verdict(facts), _missing_physics(facts)
    )


def _parameter_rows(facts: RunFacts) -> list[ParameterSummary]:
    """Returns a row for each parameter of the posterior."""
    summaries, known = facts.said("sample").get("parameters", {}), facts.said("sample").get("learned", {})
    rows = []
    for name, meaning in facts.parameters.items():
        if name not in summaries:
            continue
        summary, informed = summaries[name], Informed(known[name]["informed"])
        bounds = [f"at the prior's {side} bound" for side in known[name]["leans_on"]]
        rows.append(
            ParameterSummary(
                name,
                meaning,
                with_unit(summary["median"], *scale([summary[key] for key in _THREE], summary["unit"])),
                interval(summary["low_90"], summary["high_90"], summary["unit"], beside=summary["median"]),
                ", ".join([informed, *bounds]),
                _TONES[informed],
                prior_in_words(summary["prior"], summary["unit"]),
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
        return Verdict("not known yet", "none", reason, facts.command("run"))
    ridges = facts.said("sample")["ridges"]
    lines = ["Posterior median and 90 % interval; the bar shows where they lie in the prior's range."]
    return Verdict("", "none", [*lines, *(f"{ridge}." for ridge in ridges), *_bias(facts)])


def _bias(facts: RunFacts) -> list[str]:
    """Returns sentences about the bias of the parameters by what the model lacks, with the corrected values.

    The list is empty where nothing is known to be missing.
    """
    diagnosis = facts.said("diagnose")
    if not diagnosis or diagnosis["verdict"] == "nothing-missing":
        return []
    if diagnosis["verdict"] == "unknown":
        return ["The model lacks something without a name, which biases these values by an unknown amount."]
    names = listed(diagnosis["best_set"])
    summaries, corrected = facts.said("sample")["parameters"], diagnosis["fit"]["after"]["theta"]
    values = []
    for name, summary in summaries.items():
        if name in facts.parameters and name in corrected:
            low, high = corrected[name]["interval90"]
            values.append(f"{name} {interval(low, high, summary['unit'])}")
    return [
        f"These values are of the model without {names}; what it lacks biases them.",
        f"With {names}, the 90 % intervals are: {'; '.join(values)}.",
    ]


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
    lines += [fit, *summary["remarks"]]
    return Verdict("trusted" if trusted else "not trusted", "good" if trusted else "doubt", lines)


def _missing_physics(facts: RunFacts) -> Verdict:
    """Returns the conclusion of the diagnosis, or why there is none yet."""
    diagnosis = facts.said("diagnose")
    if diagnosis:
        conclusion = conclusion_of(diagnosis, facts.said("experiment") or None)
        nothing = diagnosis["verdict"] == "nothing-missing" and not diagnosis["best_set"]
        return Verdict(conclusion.verdict, "good" if nothing else "doubt", conclusion.sentences)
    standing = facts.stage("diagnose").standing
    reason = [f"The physics that is missing is not known: the stage diagnose is {standing}."]
    return Verdict("not known yet", "none", reason, facts.command("diagnose"))
