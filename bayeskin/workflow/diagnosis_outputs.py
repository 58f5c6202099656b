"""Makes the outputs of a diagnosis: entries of its JSON, and figures."""

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
    """The force that a set leaves unexplained: a discrepancy, and the form that is proposed for it."""

    discrepancy: Discrepancy
    form: Form


@dataclass(frozen=True)
class DrawnFit:
    """The data of a fit that figures show.

    force_n : force of the fit, (m,) [N]; band_n : edges of the predictive 90 % band, (m,) each [N]
    held_out_n : force (m,) [N] of a fit to the recording's beginning, or None without one
    located : windows in which the fit differs from the recording; values : summaries of its parameters
    """

    force_n: Array
    band_n: tuple[Array, Array]
    held_out_n: Array | None
    located: Located
    values: Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class DiagnosisFigures:
    """The contents of the figures.

    before, after : fits without mechanisms and with the best set
    split_s : end of the part of the recording [s] to which the fits with `held_out_n` were made
    base : parameters of the base model; parts : contributions of the set's mechanisms to the force
    remainder : the force that remains unexplained, or None where the verdict leaves nothing to describe
    """

    before: DrawnFit
    after: DrawnFit
    split_s: float | None
    base: Sequence[Parameter]
    parts: Sequence[Contribution]
    remainder: Remainder | None


def window(one: Window) -> dict[str, Any]:
    """Returns the entry of a window in the JSON."""
    return {
        "t0": one.start_s, "t1": one.end_s, "phase": one.phase, "cycle": one.cycle,
        "mean_residual": one.mean_n, "significance": one.significance,
    }  # fmt: skip


def candidates(fits: Mapping[tuple[str, ...], Fit], known: Mapping[str, Mechanism]) -> list[dict[str, Any]]:
    """Returns the gain of each fitted mechanism alone, or with the mechanisms that it needs.

    Each entry has the gain of log-evidence over the base model, and its standard error. The largest gain
    comes first.
    """
    rows = []
    for name in known:
        fit = fits.get(with_one((), name, known))
        if fit is None:
            continue
        rows.append(
            {
                "name": name,
                "delta_score": fit.log_evidence - fits[()].log_evidence,
                "standard_error": _score_error(fits[()], fit),
            }
        )
    return sorted(rows, key=lambda row: -float(row["delta_score"]))


def _score_error(base: Fit, fit: Fit) -> float:
    """Returns the standard error of a difference of log-likelihoods, from its scatter over the phases."""
    differences = _log_likelihood_by_phase(fit) - _log_likelihood_by_phase(base)
    return float(np.sqrt(len(differences)) * differences.std(ddof=1)) if len(differences) > 1 else 0.0


def _log_likelihood_by_phase(fit: Fit) -> Array:
    """Returns the log-likelihood of each phase at a fit, given the other phases, (b,)."""
    log_posterior = fit.log_posterior
    return log_posterior.block_log_likelihood(_theta(fit))[0]


def _theta(fit: Fit) -> Array:
    """Returns the values of a fit in SI, (1, D)."""
    log_posterior = fit.log_posterior
    return log_posterior.from_sampling(log_posterior.vector(fit.theta))[None]


def unexplained(left: Remainder) -> dict[str, Any]:
    """Returns the entry of the unexplained force in the JSON."""
    discrepancy, form = left.discrepancy, left.form
    return {
        "size_n": discrepancy.size_n, "share": dict(discrepancy.share), "gain_nats": discrepancy.gain_nats,
        "noticeable": discrepancy.noticeable, "features": list(discrepancy.features),
        "form": {
            "terms": [asdict(term) for term in form.terms],
            "r2_left_out": form.r2_left_out, "sentence": form.sentence,
        },
    }  # fmt: skip


def draw(
    folder: Path, made_by: str, binned: BinnedForce, motion: PadMotion, found: DiagnosisFigures,
    candidates: Sequence[Mapping[str, Any]],
) -> list[Path]:  # fmt: skip
    """Writes the figures into a folder and returns their paths.

    made_by : description of the run, which is stored in the figures' metadata
    """
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
