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
from bayeskin.pipeline.taking_up import FullResult, Remainder, TakenUp
from bayeskin.types import Array, BinnedForce, PadMotion, Parameter


@dataclass(frozen=True)
class Shown:
    """A fit as it is drawn.

    force_n (m,) : the full model's where there is a run, else the surrogate's; band_n : edges of the
    predictive band of 90 %, (m,) each; held_out_n (m,) : as force_n, of a fit to the beginning, None where
    there is none; located : windows that it leaves; values : summaries of its parameters
    """

    force_n: Array
    band_n: tuple[Array, Array]
    held_out_n: Array | None
    located: Located
    values: Mapping[str, Mapping[str, Any]]


def shown(found: Fit, taken: TakenUp, begun: Fit | None, held_out: FullResult) -> Shown:
    """Of a fit, what follows it, and the same of the recording's beginning."""
    held_out_n = None if begun is None else _full_or_fit(held_out, begun)
    force_n = _full_or_fit(taken.full, found)
    return Shown(force_n, taken.band_n, held_out_n, taken.located, taken.draws.summary)


def _full_or_fit(full: FullResult, found: Fit) -> Array:
    return full.force_n if isinstance(full, FullFit) else found.force_n


@dataclass(frozen=True)
class Found:
    """What is drawn of a mismatch: fits without and with the best set, what that has of the force.

    split_s : until when what is `held_out_n` was fitted; base : parameters of the model without mechanisms;
    remainder : None where the verdict leaves nothing to describe
    """

    before: Shown
    after: Shown
    split_s: float | None
    base: Sequence[Parameter]
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
    before, after = found.before, found.after
    figures = {
        "located": report.figure_located(binned, motion, before.located, before.force_n),
        "candidates": report.figure_candidates(candidates),
        "before_after": report.figure_before_after(binned, motion, before, after, found.split_s),
        "residual_by_phase": report.figure_residual_by_phase(binned, motion, before.located, after.located),
        "base_parameters": report.figure_base_parameters(found.base, before.values, after.values),
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
    if faint := report.faint_in_words(answer):
        lines.append(f"  {faint}")
    lines.append(f"{len(answer['located'])} windows before, {len(answer['remaining'])} after")
    for when in ("before", "after"):
        held = fits[when]["rmse_held_out"]
        rest = "" if held is None else f", {1e3 * held:.1f} mN on what follows the second hold, not fitted"
        lines.append(f"{when}: RMSE {1e3 * fits[when]['rmse']:.1f} mN{rest}")
        if (own := fits[when].get("rmse_of_mean")) is not None:
            lines.append(f"  without what the surrogate's own error takes up: {1e3 * own:.1f} mN")
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
