"""What is said and drawn of a diagnosis: entries of its JSON, figures, lines of text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bayeskin import report
from bayeskin.mechanisms import Mechanism, with_one
from bayeskin.mismatch.contributions import Contribution
from bayeskin.mismatch.fit import Fit
from bayeskin.mismatch.full_fit import FullFit
from bayeskin.mismatch.locate import Located, Window
from bayeskin.mismatch.search import Search
from bayeskin.mismatch.verdict import Named
from bayeskin.pipeline.taking_up import FullResult, Remainder
from bayeskin.types import Array, BinnedForce, PadMotion


@dataclass(frozen=True)
class Found:
    """What is known of a mismatch: sets tried, residuals without and with the best, its parts of the force.

    full : the full model without and with the best; remainder : None where the verdict leaves nothing to
    describe
    """

    search: Search
    full: Sequence[FullResult]
    before: Located
    after: Located
    parts: Sequence[Contribution]
    remainder: Remainder | None


def window(one: Window) -> dict[str, Any]:
    return {
        "t0": one.start_s, "t1": one.end_s, "phase": one.phase, "cycle": one.cycle,
        "mean_residual": one.mean_n, "significance": one.significance,
    }  # fmt: skip


def mechanism(
    one: Named, known: Mechanism, parts: Sequence[Contribution], values: Mapping[str, Mapping[str, Any]],
    best: Mapping[str, float],
) -> dict[str, Any]:  # fmt: skip
    """An entry of a named mechanism, `known`; `parts` are those of the best set, `values` summaries of its
    parameters, `best` the most probable ones."""
    parameters = {p.name: {**values[p.name], "unit": p.unit} for p in known.parameters if p.name in values}
    return {
        "name": one.name, "probability": one.probability, "group": list(one.group),
        "group_probability": one.group_probability, "explains_n": one.explains_n,
        "contribution_n": next((part.size_n for part in parts if part.name == one.name), None),
        "parameters": parameters, "statement": known.statement({**known.neutral, **best}),
    }  # fmt: skip


def candidates(found: Search, known: Mapping[str, Mechanism]) -> list[dict[str, Any]]:
    """Each mechanism added to the base alone, or with those that it needs: gain of log evidence, and the
    standard error of that sum. None of a mechanism of which the surrogate is unsure."""
    rows = []
    for name in known:
        one = found.fits.get(with_one((), name, known))
        if one is None:
            continue
        rows.append(
            {
                "name": name,
                "delta_score": one.log_evidence - found.base.log_evidence,
                "standard_error": _score_error(found.base, one),
            }
        )
    return sorted(rows, key=lambda row: -float(row["delta_score"]))


def _score_error(base: Fit, one: Fit) -> float:
    """Of a difference of log likelihoods, from its scatter over the phases."""
    differences = _blocks(one) - _blocks(base)
    return float(np.sqrt(len(differences)) * differences.std(ddof=1)) if len(differences) > 1 else 0.0


def _blocks(found: Fit) -> Array:
    log_posterior = found.log_posterior
    return log_posterior.block_log_likelihood(_theta(found))[0]


def _theta(found: Fit) -> Array:
    log_posterior = found.log_posterior
    return log_posterior.from_sampling(log_posterior.vector(found.theta))[None]


def unexplained(left: Remainder) -> dict[str, Any]:
    found, form = left.discrepancy, left.form
    return {
        "size_n": found.size_n, "share": dict(found.share), "gain_nats": found.gain_nats,
        "noticeable": found.noticeable, "features": list(found.features),
        "form": {
            "terms": [asdict(term) for term in form.terms],
            "r2_left_out": form.r2_left_out, "sentence": form.sentence,
        },
    }  # fmt: skip


def draw(
    folder: Path, made_by: str, binned: BinnedForce, motion: PadMotion, found: Found,
    candidates: Sequence[Mapping[str, Any]],
) -> list[Path]:  # fmt: skip
    """Writes the figures into a folder, the run in their metadata; returns their paths."""
    before_n, after_n = _full_or_fit(found)
    figures = {
        "located": report.figure_located(binned, motion, found.before, before_n),
        "candidates": report.figure_candidates(candidates),
        "before_after": report.figure_before_after(binned, motion, before_n, after_n),
        "residual_by_phase": report.figure_residual_by_phase(binned, motion, found.before, found.after),
    }
    if found.parts:
        figures["contributions"] = report.figure_contributions(binned, motion, found.parts)
    if found.remainder is not None:
        figures["discrepancy"] = report.figure_discrepancy(binned, motion, found.remainder.discrepancy)
    return [
        path
        for name, figure in figures.items()
        for path in report.save_figure(figure, folder / name, made_by)
    ]


def _full_or_fit(found: Found) -> list[Array]:
    """Forces (m,) before and after: the full model's where there is a run, else the fit's."""
    fits = (found.search.base.force_n, found.search.best.force_n)
    pairs = zip(found.full, fits, strict=True)
    return [full.force_n if isinstance(full, FullFit) else fit for full, fit in pairs]


def in_words(answer: Mapping[str, Any]) -> str:
    fits = answer["fit"]
    lines = [f"verdict: {answer['verdict']}"]
    lines += [
        f"  {one['name']} (probability {one['probability']:.2f}): {one['statement']}"
        for one in answer["mechanisms"]
    ]
    if (lacking := answer.get("unknown_probability")) is not None:
        lines.append(f"  something else, outside this catalogue: probability at most {lacking:.2f}")
    if (believed := answer.get("set_probability")) is not None:
        text = "probability against something smooth without a name"
        lines.append(f"  {', '.join(answer['best_set'])}: {text} {believed:.2f}")
    lines.append(f"{len(answer['located'])} windows before, {len(answer['remaining'])} after")
    for when in ("before", "after"):
        held = fits[when]["rmse_held_out"]
        rest = "" if held is None else f", {1e3 * held:.1f} mN on what follows the second hold, not fitted"
        lines.append(f"{when}: RMSE {1e3 * fits[when]['rmse']:.1f} mN{rest}")
        lines += _full_in_words(fits[when]["full_model"])
        if (left := fits[when].get("rmse_left_out")) is not None:
            lines.append(f"  each phase by a fit without it: RMSE {1e3 * left:.1f} mN")
        if not fits[when]["sampled"]["settled"]:
            lines.append(f"  intervals are rough: R-hat of the draws {fits[when]['sampled']['rhat']:.2f}")
    lines += _left_in_words(answer["unexplained"]) if answer["unexplained"] else []
    best = ", ".join(f"{one['name']} {one['delta_score']:+.1f}" for one in answer["candidates"][:5])
    lines += [f"candidates alone, log evidence gained: {best}"]
    if answer["unsure"]:
        lines.append(f"the surrogate is too unsure here of: {', '.join(answer['unsure'])}")
    if answer.get("refuted"):
        lines.append(f"the recording's samples show nothing of: {', '.join(answer['refuted'])}")
    lines.append(f"outputs in {answer['folder']}")
    return "\n".join(lines)


def _full_in_words(full: Mapping[str, Any] | None) -> list[str]:
    if full is None:
        return []
    if "message" in full:
        return [f"  full model: failed: {full['message']}"]
    rmse, off = (1e3 * full[name] for name in ("rmse", "fit_off_by"))
    held = full["rmse_held_out"]
    rest = "" if held is None else f", {1e3 * held:.1f} mN on what follows the second hold, not fitted"
    return [f"  full model: RMSE {rmse:.1f} mN{rest}; the surrogate's fit is off by {off:.1f} mN"]


def _left_in_words(left: Mapping[str, Any]) -> list[str]:
    if not left["noticeable"]:
        return ["left unexplained: nothing beyond noise and the surrogate's error"]
    shares = ", ".join(f"{100 * share:.0f} % {name}" for name, share in left["share"].items())
    size = f"left unexplained: {1e3 * left['size_n']:.1f} mN RMS ({shares}; {left['gain_nats']:.0f} nats)"
    return [size, *(f"  {line}" for line in (*left["features"], left["form"]["sentence"]))]
