"""Builds the likelihood of a run's markers: the reduced model runs at the design's points."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from bayeskin.errors import InputError
from bayeskin.execution.local import Lost
from bayeskin.forward.marker_runs import MarkerRuns
from bayeskin.forward.posterior import marker_likelihood
from bayeskin.inference.marker_likelihood import MarkerLikelihood
from bayeskin.reduced.files import load_reduced
from bayeskin.surrogates.focus import focus
from bayeskin.surrogates.marker_surrogate import train_marker_surrogate
from bayeskin.types import Array, BinnedForce, Design, Markers, PadMotion
from bayeskin.workflow.engine import Run
from bayeskin.workflow.executor import executor
from bayeskin.workflow.model import model_spec
from bayeskin.workflow.recording import fitted_bins, recorded_markers
from bayeskin.workflow.reducing import reduced_file

FEWEST_A_PARAMETER = 4  # fewest runs for each parameter from which displacements can be learnt


def likelihood_of_markers(
    run: Run, design: Design, binned: BinnedForce, motion: PadMotion
) -> MarkerLikelihood | None:
    """Returns the likelihood of a run's markers, or None where it has none.

    design : points at which the reduced model runs; points that it cannot run are left out
    Raises InputError for a device without a reduced model, and where too few runs finish.
    """
    markers = recorded_markers(run.folder / "recording")
    if markers is None:
        return None
    weights = focus(design, binned, fitted_bins(run, binned))
    theta, weights = design.theta[design.training], weights[design.training]
    points = [dict(zip(design.space.names, map(float, row), strict=True)) for row in theta]
    moved_m = _runs(run, markers, motion, points)
    ok = np.isfinite(moved_m).all(axis=(1, 2, 3))
    if ok.sum() < FEWEST_A_PARAMETER * design.space.dim:
        raise InputError("markers", f"only {ok.sum()} runs finish", "the design needs more points")
    provenance = {"design_seed": design.seed, "model_hash": design.model_hash, "runs": int(ok.sum())}
    surrogate = train_marker_surrogate(design.space, theta[ok], moved_m[ok], weights[ok], provenance)
    run.reporter.log(f"markers: {ok.sum()} runs, error {1e6 * surrogate.rms_error_m:.2f} µm RMS")
    spec = replace(model_spec(run), refinement=load_reduced(_file(run)).refinement)
    likelihood = marker_likelihood(markers, surrogate, spec, motion)
    return replace(likelihood, errors_m=np.concatenate([likelihood.errors_m, surrogate.errors_m]))


def _file(run: Run) -> Path:
    """Returns the file of the device's reduced model. Raises InputError where there is none."""
    return reduced_file(run.config.geometry(run.config_path).geometry, [run.config_path])


def _runs(run: Run, markers: Markers, motion: PadMotion, points: list[dict[str, float]]) -> Array:
    """Returns displacements (n, t - 1, p, 2) [m] at points; NaN where a run failed. No run is made twice."""
    geometry = run.config.geometry(run.config_path).geometry
    file = _file(run)
    runs = MarkerRuns(file, geometry, motion, markers)
    computed_from = [load_reduced(file).hash, geometry.hash, vars(motion), vars(markers)]
    unknown = np.full((len(markers.time_s) - 1, len(markers.points), 2), np.nan)
    with executor(run) as run_all, run.store("markers", computed_from) as store:
        todo = [point for point in points if point not in store]
        for number, result in run_all(runs, todo):
            failed = isinstance(result, str | Lost)
            store.add(todo[number], {"moved_m": unknown if failed else result})
            run.reporter.progress("markers", (number + 1) / len(todo), f"{number + 1} of {len(todo)} runs")
        return np.array([store.read(point, dict)["moved_m"] for point in points])
