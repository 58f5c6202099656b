"""Gives each figure its place on a page, its title, and a description of its content."""

from __future__ import annotations

from collections.abc import Iterable
from xml.etree.ElementTree import ParseError

from bayeskin.report.page.facts import RunFacts
from bayeskin.report.page.parts import Picture
from bayeskin.report.page.svg import inline_svg

_SOBOL = "Sobol' indices of each parameter over time, first order and total, and aggregated"
# title and description, by stage and name of the figure
_KNOWN = {
    ("recording", "recording"): (
        "The recording",
        "Displacement and force over time as recorded, phases shaded, and force over displacement.",
    ),
    ("design", "waves"): (
        "The design, wave by wave",
        "Points at which the full model was run, by pairs of parameters; later waves lie where the recording "
        "has not ruled the force out.",
    ),
    ("train", "prior_predictive"): (
        "What the prior expects",
        "Forces over time that the surrogate gives over the prior, with the recorded force among them.",
    ),
    ("train", "validation"): (
        "The surrogate on held-out runs",
        "Errors of the surrogate on full runs that it was not trained on.",
    ),
    ("map", "map_check"): (
        "Surrogate and full model at the most probable point",
        "Force over time of the full model and of the surrogate at the most probable point, with the "
        "recording and the difference.",
    ),
    ("sample", "fit"): (
        "The fit",
        "Recorded force with the predictive bands, the residual over time and over displacement, and the "
        "parts of the uncertainty.",
    ),
    ("sample", "posterior"): (
        "The posterior",
        "Marginal distributions of the material parameters beside their priors, and pairs of them.",
    ),
    ("sample", "posterior_noise"): (
        "The noise",
        "Marginal distributions of the noise's parameters beside their priors, and pairs of them.",
    ),
    ("sample", "profiles"): (
        "Profile likelihoods",
        "How well the recording can be fitted with one parameter held, over its prior, beside the posterior.",
    ),
    ("sample", "traces"): ("The chains", "Traces of each parameter over the sampling's steps, by ensemble."),
    ("sample", "residuals"): (
        "What the fit leaves, against the assumed noise",
        "Quantiles of what the fit leaves against those of the assumed noise, and its autocorrelation with "
        "the limits that the assumed noise keeps.",
    ),
    ("sample", "model_check"): (
        "The posterior by the full model",
        "Weights that the full model gives draws of the posterior, and what they do to each parameter's mean "
        "and sd.",
    ),
    ("sobol", "sobol_prior_gp"): ("Over the prior, from the Gaussian process", f"{_SOBOL}, over the prior."),
    ("sobol", "sobol_prior_chaos"): ("Over the prior, from polynomial chaos", f"{_SOBOL}, over the prior."),
    ("sobol", "sobol_near_map"): (
        "Near the most probable point",
        f"{_SOBOL}, within 10 % of the most probable point.",
    ),
    ("diagnose", "located"): (
        "Where recording and model differ",
        "Recorded and modelled force, the residual with what is allowed, and windows where it leaves that.",
    ),
    ("diagnose", "candidates"): (
        "What each mechanism gains by itself",
        "Log evidence that each mechanism of the catalogue gains over the base model, with standard errors.",
    ),
    ("diagnose", "before_after"): (
        "The fit before and after",
        "Force and residual over time and force over displacement, without and with the mechanisms found; "
        "the predictive band, and what fits to the beginning leave of the rest.",
    ),
    ("diagnose", "base_parameters"): (
        "What becomes of the base's parameters",
        "Posterior means and 90 % intervals of the base's parameters, without and with the mechanisms found.",
    ),
    ("diagnose", "residual_by_phase"): (
        "The residual by phase",
        "Recorded minus modelled force in each kind of phase, without and with the mechanisms found.",
    ),
    ("diagnose", "contributions"): (
        "What each mechanism adds to the force",
        "Force of each mechanism over time and over displacement, at the best fit less that without it.",
    ),
    ("diagnose", "discrepancy"): (
        "What is left, described",
        "The residual beyond what parameters take up, and the smooth process that describes it, over time "
        "and displacement.",
    ),
    ("experiment", "experiments"): (
        "What further tests would tell",
        "Expected information of each protocol about which explanation is true, with standard errors.",
    ),
}  # fmt: skip


def pictures(facts: RunFacts, stage: str, names: Iterable[str] | None = None) -> list[Picture]:
    """Returns the figures of a stage: those of the given names, or all, with the known ones first."""
    drawn = facts.stage(stage).figures
    known = [name for owner, name in _KNOWN if owner == stage]
    wanted = names if names is not None else [*known, *sorted(set(drawn) - set(known))]
    return [_picture(stage, name, drawn[name]) for name in wanted if name in drawn]


def _picture(stage: str, name: str, svg: str) -> Picture:
    """Returns a figure with its title and description; a figure whose file is damaged stays empty."""
    plain = name.replace("_", " ")
    title, alt = _KNOWN.get((stage, name), (plain.capitalize(), f"Figure {plain} of the stage {stage}."))
    key = f"{stage}-{name}".replace("_", "-")
    try:
        return Picture(key, title, alt, inline_svg(svg, key))
    except ParseError:
        return Picture(key, title, f"{alt} Its file is damaged.", "")
