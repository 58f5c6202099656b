"""Assesses an explanation: how well the recording is fitted without and with mechanisms, and what remains."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bayeskin import inference
from bayeskin.mismatch.context import DiagnosisContext
from bayeskin.mismatch.contributions import Contribution, contributions
from bayeskin.mismatch.discrepancy import Discrepancy, discrepancy
from bayeskin.mismatch.explain import Explanation
from bayeskin.mismatch.fit import Fit
from bayeskin.mismatch.form import Form, propose_form
from bayeskin.mismatch.locate import Located, locate
from bayeskin.mismatch.misfit import misfit_n
from bayeskin.mismatch.on_skin import OnSkin, on_skin
from bayeskin.mismatch.resample import PosteriorDraws
from bayeskin.mismatch.set_posterior import draws_near_run
from bayeskin.types import Array, BinnedForce, PadMotion

PREDICTIVE_DRAWS = 300  # number of posterior draws from which predictive bands are computed


@dataclass(frozen=True)
class AssessedFit:
    """A fit of a set of mechanisms, and how it differs from the recording.

    drawn : draws of the posterior; band_n : edges (m,) [N] of the predictive 90 % band
    located : windows in which the fit differs from the recording
    beginning : fit to the recording's beginning, or None without one
    on_skin : where on the skin markers move otherwise than the fit says; None without markers
    """

    fit: Fit
    drawn: PosteriorDraws
    band_n: tuple[Array, Array]
    located: Located
    beginning: Fit | None
    on_skin: OnSkin | None = None

    @property
    def binned(self) -> BinnedForce:
        """Returns the recording's bins."""
        return self.fit.log_posterior.binned

    @property
    def force_n(self) -> Array:
        """Returns the force of the fit, (m,) [N]."""
        return self.fit.force_n

    @property
    def held_out_n(self) -> Array | None:
        """Returns the force (m,) [N] of the fit to the recording's beginning, or None without one."""
        return None if self.beginning is None else self.beginning.force_n

    @property
    def values(self) -> Mapping[str, Mapping[str, Any]]:
        """Returns the summaries of the parameters' draws, by name."""
        return self.drawn.summary

    @property
    def coverage90(self) -> float:
        """Returns the share of the recording's bins that lie in the predictive 90 % band."""
        return inference.coverage(self.binned, *self.band_n)

    def held_out_misfit_n(self, split_s: float | None) -> float | None:
        """Returns the RMS error [N] after split_s [s] of the fit to the beginning, or None without one."""
        if self.held_out_n is None or split_s is None:
            return None
        return misfit_n(self.binned, self.held_out_n, split_s)


@dataclass(frozen=True)
class Remainder:
    """The force that a set leaves unexplained: a discrepancy, and the form that is proposed for it."""

    discrepancy: Discrepancy
    form: Form


@dataclass(frozen=True)
class FullModelCheck:
    """The full model's run at the fit of the best set.

    fit_off_by_n : RMS difference [N] of the forward model from this run; misfit_n : RMS error [N] of this run
    """

    fit_off_by_n: float
    misfit_n: float


@dataclass(frozen=True)
class Diagnosis:
    """An explanation, and the assessed fits without and with the mechanisms of the best set.

    contributions : what each mechanism adds to the force
    remainder : the force that remains unexplained, or None where the verdict leaves nothing to describe
    full_model : check by the full model, or the reason why there is none
    """

    explanation: Explanation
    before: AssessedFit
    after: AssessedFit
    contributions: list[Contribution]
    remainder: Remainder | None
    full_model: FullModelCheck | str


def assess(context: DiagnosisContext, explanation: Explanation) -> Diagnosis:
    """Returns the diagnosis of a recording that has been explained."""
    base, best = explanation.search.fits[()].fit, explanation.emulated.fit
    beginning, seed = explanation.beginning, context.seed
    base_beginning, best_beginning = (None, None) if beginning is None else (beginning.base, beginning.best)
    motion = context.motion
    after = _assessed(best, best, explanation.emulated.draws, best_beginning, seed, motion)
    if explanation.best:
        before = _assessed(base, best, draws_near_run(base, seed), base_beginning, seed, motion)
    else:  # both are fits of the base model, whose posterior has been sampled already
        located = _located(base, best, seed)
        before = replace(
            after, fit=base, located=located, on_skin=on_skin(base.log_posterior, base.theta, motion)
        )
    return Diagnosis(
        explanation, before, after,
        contributions(explanation.best, best.theta, context.reported, context.known),
        _remainder(context, explanation, after.located),
        _check_by_full_model(context, explanation),
    )  # fmt: skip


def _assessed(
    fit: Fit, best: Fit, drawn: PosteriorDraws, beginning: Fit | None, seed: int, motion: PadMotion
) -> AssessedFit:
    """Returns an assessed fit; its noise is that of the best fit, which takes no mismatch for noise."""
    draws = inference.evenly(drawn.draws, PREDICTIVE_DRAWS)
    band_n = inference.bands(fit.log_posterior, draws, np.random.default_rng(1)).interval(0.9)
    skin = on_skin(fit.log_posterior, fit.theta, motion)
    return AssessedFit(fit, drawn, band_n, _located(fit, best, seed), beginning, skin)


def _located(fit: Fit, best: Fit, seed: int) -> Located:
    """Returns the windows in which a fit differs from the recording, with the noise of the best fit."""
    space = fit.log_posterior.surrogate.space.names
    noise = {name: best.theta[name] for name in fit.log_posterior.names if name not in space}
    return locate(fit, {**fit.theta, **noise}, seed)


def _remainder(context: DiagnosisContext, explanation: Explanation, remaining: Located) -> Remainder | None:
    """Returns the unexplained force, or None where the verdict leaves nothing to describe."""
    judgement = explanation.judgement
    if not (judgement.verdict == "unknown" or (judgement.named and remaining.windows)):
        return None
    unnamed = discrepancy(explanation.search.fits[explanation.best].fit, context.motion)
    return Remainder(unnamed, propose_form(explanation.emulated.fit, context.motion, context.seed))


def _check_by_full_model(context: DiagnosisContext, explanation: Explanation) -> FullModelCheck | str:
    """Returns the check of the best set's fit by a full run, or the reason why there is none."""
    names, result = explanation.best, explanation.search
    check = result.checks.get(names)
    if check is None:
        return "no full run was made"
    if isinstance(check.full_n, str):
        return check.full_n
    full_n = context.reported_of(names, result.fits[names].fit.theta, check.full_n)
    return FullModelCheck(check.off, misfit_n(context.binned, full_n))
