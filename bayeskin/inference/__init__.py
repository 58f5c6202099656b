"""Bayesian inference of parameters from a recording: noise, likelihood, maximum, posterior draws and checks.

These modules know a model only through the `Surrogate` interface. Where a full run is needed, the caller
passes a function for it, or the forces of the runs.
"""

from bayeskin.inference.bands import (
    Bands,
    ForceDraws,
    Rmse,
    bands,
    bands_of,
    coverage,
    predictive_draws,
    rmse,
)
from bayeskin.inference.check import MapCheck, RefinedMap, check_map, refine_map
from bayeskin.inference.convergence import Convergence, Limits, Verdict
from bayeskin.inference.identify import Identifiability, Learned, Ridge, identifiability, noise_remarks
from bayeskin.inference.importance import Corrected, Weighed, corrected, weigh
from bayeskin.inference.inference_data import (
    draws_of,
    load_inference_data,
    save_inference_data,
    to_inference_data,
)
from bayeskin.inference.lengths import DueToLengths, due_to_lengths
from bayeskin.inference.noise_model import NoisePriors
from bayeskin.inference.normal import FittedNormal, fitted_normal
from bayeskin.inference.optimise import MapResult, StartResult, find_map
from bayeskin.inference.polish import Polished, polish_map
from bayeskin.inference.problem import LogPosterior
from bayeskin.inference.profile import Profile, profiles
from bayeskin.inference.residuals import KindCheck, ResidualCheck, check_residuals
from bayeskin.inference.sample import Posterior, SampleSettings, evenly, load_chains, sample

__all__ = [
    "Bands",
    "Convergence",
    "Corrected",
    "DueToLengths",
    "FittedNormal",
    "ForceDraws",
    "Identifiability",
    "KindCheck",
    "Learned",
    "Limits",
    "LogPosterior",
    "MapCheck",
    "MapResult",
    "NoisePriors",
    "Polished",
    "Posterior",
    "Profile",
    "RefinedMap",
    "ResidualCheck",
    "Ridge",
    "Rmse",
    "SampleSettings",
    "StartResult",
    "Verdict",
    "Weighed",
    "bands",
    "bands_of",
    "check_map",
    "check_residuals",
    "corrected",
    "coverage",
    "draws_of",
    "due_to_lengths",
    "evenly",
    "find_map",
    "fitted_normal",
    "identifiability",
    "load_chains",
    "load_inference_data",
    "noise_remarks",
    "polish_map",
    "predictive_draws",
    "profiles",
    "refine_map",
    "rmse",
    "sample",
    "save_inference_data",
    "to_inference_data",
    "weigh",
]
