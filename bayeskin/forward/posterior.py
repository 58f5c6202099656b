"""The posterior of a forward model's parameters given a recording, as `run` and `diagnose` both build it."""

from __future__ import annotations

import numpy as np

from bayeskin.finite_element.accuracy import mesh_error
from bayeskin.finite_element.simulate import ModelSpec
from bayeskin.inference import LogPosterior, NoisePriors
from bayeskin.inference.marker_error import mesh_correction, smooth_errors
from bayeskin.inference.marker_likelihood import MarkerLikelihood, PredictsMarkers
from bayeskin.inference.model_error import ErrorSizes, ModelError
from bayeskin.inference.noise_model import Windows
from bayeskin.inference.problem import Excludes
from bayeskin.types import Array, BinnedForce, Markers, PadMotion, ParameterSpace, Surrogate

UNKNOWN_MESH = 5e-3  # RMS error of bricks that no study was made of, over the force (docs/discretisation.md)


def posterior_of(
    force: Surrogate, spec: ModelSpec, binned: BinnedForce, motion: PadMotion, noise: NoisePriors,
    priors: ParameterSpace, windows: Windows | None = None, excludes: Excludes | None = None,
) -> LogPosterior:  # fmt: skip
    """Returns the posterior, with the errors of the full model within the likelihood.

    force : predicts the force of the model `spec`, from a surrogate or from runs near by
    noise, priors : of the noise and of the parameters; windows : fitted parts of the recording [s], None for
        the whole; excludes : says where the prior is zero
    Raises InputError where force, bins, windows and priors do not belong together.
    """
    error = model_error(spec, motion, binned.edges_s)
    return LogPosterior(
        force, binned, None if windows is None else tuple(windows), noise, priors, None, excludes, error
    )


def marker_likelihood(
    markers: Markers, model: PredictsMarkers, spec: ModelSpec, motion: PadMotion
) -> MarkerLikelihood:
    """Returns the likelihood of markers, with the errors of the full model's displacements.

    spec : the full model whose displacements `model` predicts
    """
    correction_m, amplitude_m = mesh_correction(markers, spec.refinement)
    errors_m = np.concatenate([amplitude_m[None], smooth_errors(markers, motion, spec.geometry.gauge_m)])
    return MarkerLikelihood(markers, model, correction_m, errors_m)


def model_error(spec: ModelSpec, motion: PadMotion, edges_s: Array) -> ModelError | None:
    """Returns the errors that are allowed for of a model's force in bins.

    None for a model whose error cannot be estimated, such as that of the article or of the user's own.
    """
    if spec.formulation.error_unknown:
        return None
    known = mesh_error(spec.mesh_hash)
    mesh = UNKNOWN_MESH if known is None else known.rms
    return ModelError(motion, edges_s, float(np.hypot(mesh, ErrorSizes().calibration)))
