"""States the result of a diagnosis in the types of JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from bayeskin import inference
from bayeskin.mechanisms import Mechanism
from bayeskin.mismatch.assess import AssessedFit, Diagnosis, FullModelCheck, Remainder
from bayeskin.mismatch.fit import Fit
from bayeskin.mismatch.gains import gains
from bayeskin.mismatch.hypotheses import Family
from bayeskin.mismatch.locate import Window
from bayeskin.mismatch.misfit import misfit_n
from bayeskin.mismatch.search_record import Names, SearchResult
from bayeskin.types import Span
from bayeskin.types.joint import recording_at
from bayeskin.workflow.marker_answer import on_skin_entry


def answer_of(diagnosis: Diagnosis, known: Mapping[str, Mechanism]) -> dict[str, Any]:
    """Returns the answer of `bayeskin diagnose`; `known` are the mechanisms that were tried, by name."""
    explanation, before, after = diagnosis.explanation, diagnosis.before, diagnosis.after
    judgement, result, emulated = explanation.judgement, explanation.search, explanation.emulated
    beginning, family = explanation.beginning, result.family
    return {
        "verdict": judgement.verdict,
        "nothing_probability": judgement.nothing_probability,
        "smooth_probability": judgement.smooth_probability,
        "explained": explanation.explained,
        "located": [_window_entry(window, after.binned.spans) for window in before.located.windows],
        "remaining": [_window_entry(window, after.binned.spans) for window in after.located.windows],
        "recordings": [
            {**asdict(recording), "contradicts": recording.contradicts} for recording in explanation.agreement
        ],
        "mechanisms": _mechanism_entries(diagnosis, known),
        "unexplained": None if diagnosis.remainder is None else remainder_entry(diagnosis.remainder),
        "candidates": candidate_entries({names: fit.fit for names, fit in result.fits.items()}, known),
        "sets": [_set_entry(names, result, family) for names in result.evidences],
        "fit": {
            "before": _fit_entry(before, explanation.split_s),
            "after": {
                **_fit_entry(after, explanation.split_s),
                "emulator": {
                    "runs": emulated.runs, "off_by": emulated.error_n, "settled": emulated.settled,
                },
            },
        },
        "best_set": list(explanation.best),
        "held_out_set": None if beginning is None else list(beginning.best.names),
        "full_model": _full_model_entry(diagnosis.full_model),
    }  # fmt: skip


def _window_entry(window: Window, spans: Sequence[Span]) -> dict[str, Any]:
    """Returns the entry of a window, on its recording's own axis of time; one of several is named."""
    number = int(recording_at(spans, np.array([window.start_s]))[0])
    start_s = spans[number].start_s if spans else 0.0
    return {
        **({"recording": spans[number].name} if spans else {}),
        "t0": window.start_s - start_s, "t1": window.end_s - start_s,
        "phase": window.phase, "cycle": window.cycle,
        "mean_residual": window.mean_n, "significance": window.significance,
    }  # fmt: skip


def _mechanism_entries(diagnosis: Diagnosis, known: Mapping[str, Mechanism]) -> list[dict[str, Any]]:
    """Returns the entries of the named mechanisms."""
    sizes = {part.name: part.size_n for part in diagnosis.contributions}
    values, theta = diagnosis.after.values, diagnosis.after.fit.theta
    rows = []
    for named in diagnosis.explanation.judgement.named:
        mechanism = known[named.name]
        rows.append({
            "name": named.name, "probability": named.probability, "group": list(named.group),
            "group_probability": named.group_probability, "contribution_n": sizes.get(named.name),
            "parameters": {p.name: {**values[p.name], "unit": p.unit}
                           for p in mechanism.parameters if p.name in values},
            "statement": mechanism.statement({**mechanism.neutral, **theta}),
        })  # fmt: skip
    return rows


def remainder_entry(remainder: Remainder) -> dict[str, Any]:
    """Returns the entry of the unexplained force."""
    discrepancy, form = remainder.discrepancy, remainder.form
    return {
        "size_n": discrepancy.size_n, "share": dict(discrepancy.share), "gain_nats": discrepancy.gain_nats,
        "noticeable": discrepancy.noticeable, "features": list(discrepancy.features),
        "form": {
            "terms": [asdict(term) for term in form.terms],
            "r2_left_out": form.r2_left_out, "sentence": form.sentence,
        },
    }  # fmt: skip


def candidate_entries(fits: Mapping[Names, Fit], known: Mapping[str, Mechanism]) -> list[dict[str, Any]]:
    """Returns the entries of the fitted single mechanisms, the largest gain of log-evidence first."""
    return [
        {"name": gain.name, "delta_score": gain.nats, "standard_error": gain.standard_error}
        for gain in gains(fits, known)
    ]


def _set_entry(names: Names, result: SearchResult, family: Family) -> dict[str, Any]:
    """Returns the entry of a compared set."""
    set_fit, evidences = result.fits[names], result.evidences[names]
    return {
        "mechanisms": list(names), "probability": family.probability_of_set(names),
        "log_evidence": set_fit.fit.log_evidence, "log_evidence_alone": evidences.alone,
        "log_evidence_with_smooth": evidences.with_discrepancy,
        "settled": set_fit.settled, "runs": set_fit.runs,
    }  # fmt: skip


def _fit_entry(assessed: AssessedFit, split_s: float | None) -> dict[str, Any]:
    """Returns the entry of a fit: its errors, its coverage and its parameters.

    split_s : end of the part of the recording [s] to which the held-out prediction was fitted
    """
    binned, fit, drawn = assessed.binned, assessed.fit, assessed.drawn
    return {
        "rmse": misfit_n(binned, fit.force_n),
        "rmse_of_mean": misfit_n(binned, fit.mean_n),
        "rmse_by_phase": dict(inference.rmse(binned, fit.force_n).by_kind_n),
        "rmse_held_out": assessed.held_out_misfit_n(split_s),
        "coverage90": assessed.coverage90,
        "log_evidence": fit.log_evidence,
        "theta": drawn.summary,
        "sampled": {"settled": drawn.settled, "rhat": drawn.rhat, "effective": drawn.effective},
        **_of_markers(assessed),
    }


def _of_markers(assessed: AssessedFit) -> dict[str, Any]:
    """Returns the entry of the markers, and nothing for a recording without markers."""
    if assessed.on_skin is None:
        return {}
    fit = assessed.fit
    return {"on_skin": on_skin_entry(fit.log_posterior, fit.theta, assessed.on_skin)}


def _full_model_entry(check: FullModelCheck | str) -> dict[str, Any]:
    """Returns the entry of the check by the full model."""
    if isinstance(check, str):
        return {"message": check}
    return {"fit_off_by": check.fit_off_by_n, "rmse": check.misfit_n}
