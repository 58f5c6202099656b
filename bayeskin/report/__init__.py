"""Draws a figure of every result.

Each `figure_...` function returns a matplotlib figure, and `save_figure` writes it as PNG and SVG.
"""

from bayeskin.report.before_after import (
    figure_base_parameters,
    figure_before_after,
    figure_residual_by_phase,
)
from bayeskin.report.check import figure_model_check
from bayeskin.report.discrepancy import figure_discrepancy, figure_experiments
from bayeskin.report.fields import SurfaceField, figure_fields
from bayeskin.report.fit import figure_fit
from bayeskin.report.mismatch import figure_candidates, figure_contributions, figure_located
from bayeskin.report.on_skin import figure_on_skin
from bayeskin.report.posterior import figure_posterior
from bayeskin.report.prior import figure_prior_predictive
from bayeskin.report.profiles import figure_profiles
from bayeskin.report.proof import figure_detectability, figure_proof, half_in_words
from bayeskin.report.recording import figure_recording
from bayeskin.report.residuals import figure_residuals
from bayeskin.report.save import save_figure
from bayeskin.report.sobol import figure_sobol
from bayeskin.report.study import figure_population, figure_recordings
from bayeskin.report.traces import figure_traces
from bayeskin.report.validation import figure_map_check, figure_validation
from bayeskin.report.waves import figure_waves

__all__ = [
    "SurfaceField",
    "figure_base_parameters",
    "figure_before_after",
    "figure_candidates",
    "figure_contributions",
    "figure_detectability",
    "figure_discrepancy",
    "figure_experiments",
    "figure_fields",
    "figure_fit",
    "figure_located",
    "figure_map_check",
    "figure_model_check",
    "figure_on_skin",
    "figure_population",
    "figure_posterior",
    "figure_prior_predictive",
    "figure_profiles",
    "figure_proof",
    "figure_recording",
    "figure_recordings",
    "figure_residual_by_phase",
    "figure_residuals",
    "figure_sobol",
    "figure_traces",
    "figure_validation",
    "figure_waves",
    "half_in_words",
    "save_figure",
]
