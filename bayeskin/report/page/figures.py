"""Gives each figure its place on a page, its title, and a description of its content."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from xml.etree.ElementTree import ParseError

from bayeskin.report.page.facts import RunFacts
from bayeskin.report.page.parts import Picture
from bayeskin.report.page.svg import inline_svg

_SOBOL = "Sobol' indices of each parameter, first order and total, over time and aggregated"
_ON_SKIN = (
    "Where on the skin the markers move otherwise, {} the diagnosis",
    "Residual vectors of the markers on the skin between the pads, with the strains that the model lacks "
    "along the pull and across it.",
)
# title and description, by stage and name of the figure
FIGURES = {
    ("recording", "recording"): (
        "The recording",
        "Displacement and force over time as recorded, with shaded phases, and force over displacement.",
    ),
    ("design", "waves"): (
        "The design, wave by wave",
        "Points at which the full model was run, by pairs of parameters; later waves lie where the recording "
        "has not ruled the force out.",
    ),
    ("train", "prior_predictive"): (
        "Prediction by the prior",
        "Forces over time that the surrogate predicts for the prior, with the recorded force.",
    ),
    ("train", "validation"): (
        "The surrogate on held-out runs",
        "Errors of the surrogate on runs of the full model that were not used to train it.",
    ),
    ("map", "map_check"): (
        "Surrogate and full model at the most probable point",
        "Force over time of the full model and of the surrogate at the most probable point, with the "
        "recording and the difference.",
    ),
    ("sample", "fit"): (
        "The fit",
        "Recorded force with the predictive bands, the residual over time and over displacement, and the "
        "sources of the uncertainty.",
    ),
    ("sample", "posterior"): (
        "The posterior",
        "Marginal and pairwise distributions of the material parameters, with their priors.",
    ),
    ("sample", "posterior_noise"): (
        "The noise",
        "Marginal and pairwise distributions of the noise parameters, with their priors.",
    ),
    ("sample", "profiles"): (
        "Profile likelihoods",
        "Best fit of the recording for each value of one parameter over its prior, with the posterior.",
    ),
    ("sample", "on_skin"): ("Where on the skin the markers move otherwise than the model says", _ON_SKIN[1]),
    ("sample", "traces"): ("The chains", "Traces of each parameter over the sampler's steps, by ensemble."),
    ("sample", "residuals"): (
        "Residuals and the assumed noise",
        "Quantiles of the residuals against those of the assumed noise, and their autocorrelation with the "
        "limits for the assumed noise.",
    ),
    ("sample", "model_check"): (
        "The posterior after weighting by the full model",
        "Weights of the posterior draws under the full model, and the mean and sd of each parameter before "
        "and after weighting.",
    ),
    ("sobol", "sobol_prior_gp"): ("Over the prior, from the Gaussian process", f"{_SOBOL}, over the prior."),
    ("sobol", "sobol_prior_chaos"): ("Over the prior, from polynomial chaos", f"{_SOBOL}, over the prior."),
    ("sobol", "sobol_near_map"): (
        "Near the most probable point",
        f"{_SOBOL}, within 10 % of the most probable point.",
    ),
    ("diagnose", "located"): (
        "Where recording and model differ",
        "Recorded and modelled force, the residual with its allowed range, and windows where it leaves it.",
    ),
    ("diagnose", "candidates"): (
        "The gain of each mechanism on its own",
        "Gain in log-evidence of each mechanism over the base model, with standard errors.",
    ),
    ("diagnose", "before_after"): (
        "The fit before and after",
        "Force and residual over time and force over displacement, without and with the best set of "
        "mechanisms; the predictive band; and the residual that fits to the beginning leave in the rest.",
    ),
    ("diagnose", "base_parameters"): (
        "The base parameters before and after",
        "Posterior means and 90 % intervals of the base parameters, without and with the best set of "
        "mechanisms.",
    ),
    ("diagnose", "residual_by_phase"): (
        "The residual by phase",
        "Recorded minus modelled force in each kind of phase, without and with the best set of mechanisms.",
    ),
    ("diagnose", "contributions"): (
        "The force of each mechanism",
        "Force at the best fit minus the force without the mechanism, over time and over displacement.",
    ),
    ("diagnose", "discrepancy"): (
        "The unexplained force",
        "The part of the residual that no change of the parameters can explain, and the smooth process that "
        "describes it, over time and displacement.",
    ),
    ("diagnose", "on_skin_before"): (_ON_SKIN[0].format("before"), _ON_SKIN[1]),
    ("diagnose", "on_skin_after"): (_ON_SKIN[0].format("after"), _ON_SKIN[1]),
    ("experiment", "experiments"): (
        "What further tests would show",
        "Expected information of each protocol about the true explanation, with standard errors.",
    ),
}  # fmt: skip


def pictures(
    facts: RunFacts, stage: str, names: Iterable[str] | None = None, without: Collection[str] = ()
) -> list[Picture]:
    """Returns the figures of a stage: those of the given names, or all, with the known ones first.

    without : names of figures that are left out
    """
    drawn = facts.stage(stage).figures
    known = [name for owner, name in FIGURES if owner == stage]
    wanted = names if names is not None else [*known, *sorted(set(drawn) - set(known))]
    by_name: dict[str, list[str]] = {}
    for name in sorted(drawn, key=lambda name: (len(name), name)):
        by_name.setdefault(_of_first(name), []).append(name)
    each = dict.fromkeys(name for first in wanted for name in by_name.get(_of_first(first), ()))
    return [_picture(stage, name, drawn[name]) for name in each if _of_first(name) not in without]


def _of_first(name: str) -> str:
    """Returns the name of a figure of the first recording, for that of any of several recordings."""
    first, _, number = name.rpartition("-")
    return first if number.isdigit() else name


def _picture(stage: str, name: str, svg: str) -> Picture:
    """Returns a figure with its title and description; a figure whose file is damaged stays empty."""
    plain = name.replace("_", " ")
    unknown = plain.capitalize(), f"Figure {plain} of the stage {stage}."
    title, alt = FIGURES.get((stage, _of_first(name)), unknown)
    if name != _of_first(name):
        title = f"{title}, recording {name.rpartition('-')[2]}"
    key = f"{stage}-{name}".replace("_", "-")
    try:
        return Picture(key, title, alt, inline_svg(svg, key))
    except ParseError:
        return Picture(key, title, f"{alt} Its file is damaged.", "")
