"""The outputs of a diagnosis: entries of its JSON, and figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bayeskin import report
from bayeskin.mechanisms import Mechanism, with_one
from bayeskin.mismatch.contributions import Contribution
from bayeskin.mismatch.discrepancy import Discrepancy
from bayeskin.mismatch.fit import Fit
from bayeskin.mismatch.form import Form
from bayeskin.mismatch.locate import Located, Window
from bayeskin.types import Array, BinnedForce, PadMotion, Parameter


@dataclass(frozen=True)
class Remainder:
    """The rest that a set leaves: a discrepancy, and the form that is proposed for it."""

    discrepancy: Discrepancy
    form: Form


@dataclass(frozen=True)
class DrawnFit:
    """A fit as it is drawn.

    force_n (m,) [N]; band_n : edges of the predictive band of 90 %, (m,) each
    held_out_n (m,) : force of a fit to the recording's beginning, None where there is none
    located : windows that it leaves; values : summaries of its parameters
    """

    force_n: Array
    band_n: tuple[Array, Array]
    held_out_n: Array | None
    located: Located
    values: Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class DiagnosisFigures:
    """The contents of the figures: fits without and with the best set, what that has of the force.

    split_s : until when what is `held_out_n` was fitted; base : parameters of the model without mechanisms;
    remainder : None where the verdict leaves nothing to describe
    """

    before: DrawnFit
    after: DrawnFit
    split_s: float | None
    base: Sequence[Parameter]
    parts: Sequence[Contribution]
    remainder: Remainder | None


def window(one: Window) -> dict[str, Any]:
    return {
        "t0": one.start_s, "t1": one.end_s, "phase": one.phase, "cycle": one.cycle,
        "mean_residual": one.mean_n, "significance": one.significance,
    }  # fmt: skip


def candidates(fits: Mapping[tuple[str, ...], Fit], known: Mapping[str, Mechanism]) -> list[dict[str, Any]]:
    """Returns what each mechanism gains alone, or with those that it needs, the largest gain first.

    Of each fitted one the gain of log evidence on the base model, and its standard error.
    """
    rows = []
    for name in known:
        one = fits.get(with_one((), name, known))
        if one is None:
            continue
        rows.append(
            {
                "name": name,
                "delta_score": one.log_evidence - fits[()].log_evidence,
                "standard_error": _score_error(fits[()], one),
            }
        )
    return sorted(rows, key=lambda row: -float(row["delta_score"]))


def _score_error(base: Fit, one: Fit) -> float:
    """Returns the standard error of a difference of log likelihoods, from its scatter over the phases."""
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
    folder: Path, made_by: str, binned: BinnedForce, motion: PadMotion, found: DiagnosisFigures,
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
