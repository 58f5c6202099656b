"""The first stage: reads the recording, and derives the bins to fit, the protocol and the noise by phase."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayeskin import report, storage
from bayeskin.errors import InputError
from bayeskin.finite_element import ModelSpec
from bayeskin.inference.noise_model import bins_in_windows
from bayeskin.recordings import (
    NoiseAnalysis,
    analyse,
    bin_recording,
    covered_s,
    describe_json,
    idealised_motion,
    motion_of,
    read_recording,
    recorded_motion,
    segment,
    summarise,
    uniform_edges,
)
from bayeskin.types import BinnedForce, PadMotion, Phase, Recording
from bayeskin.workflow.engine import Run, Stage
from bayeskin.workflow.provenance import caption


def pad_motion(
    spec: ModelSpec, recording: Recording, phases: Sequence[Phase], protocol: str = "recorded"
) -> PadMotion:
    """Returns the displacement that drives the model.

    For a formulation with fixed steps, this is every 50th sample, unchanged, as in the article's script.
    """
    if spec.formulation.fixed_discretisation:
        return motion_of(recording)
    if protocol == "idealised":
        return idealised_motion(recording, phases)
    return recorded_motion(recording, phases)


def fitted_bins(run: Run, binned: BinnedForce) -> NDArray[np.bool_]:
    """Returns which bins enter the fit, (m,) bool."""
    return bins_in_windows(binned, run.config.fit.windows_s) >= 0


@dataclass(frozen=True)
class Prepared:
    """A recording in the form in which it is fitted."""

    phases: Sequence[Phase]
    analysis: NoiseAnalysis
    motion: PadMotion
    binned: BinnedForce


def prepared(run: Run, recording: Recording) -> Prepared:
    """Returns phases, noise, protocol and bins of a recording, as the configuration asks for them."""
    phases = segment(recording)
    analysis = analyse(recording, phases)
    motion = pad_motion(run.config.model.spec(), recording, phases, run.config.recording.protocol)
    edges_s = uniform_edges(covered_s(recording, motion), run.config.fit.bin_width_s)
    return Prepared(phases, analysis, motion, bin_recording(recording, phases, edges_s, analysis))


def _prepare_recording(run: Run) -> Mapping[str, Any]:
    """Prepares the recording, writes it with a figure, and returns the stage's summary."""
    recording = read_recording(run.beside(run.config.recording.file))
    fitted = prepared(run, recording)
    _refuse_empty_windows(run, fitted.binned)
    storage.save(run.at("recording", "recording.h5"), recording)
    storage.save(run.at("recording", "motion.h5"), fitted.motion)
    storage.save(run.at("recording", "binned.h5"), fitted.binned)
    figure = report.figure_recording(recording, fitted.binned)
    report.save_figure(figure, run.at("recording", "recording"), caption(run))
    return describe_json(recording, fitted.phases, summarise(fitted.analysis, fitted.phases))


def _refuse_empty_windows(run: Run, binned: BinnedForce) -> None:
    """Raises InputError for a window to fit that contains no bin.

    Later stages would detect this only after hours.
    """
    windows = run.config.fit.windows_s or ()
    occupied = set(bins_in_windows(binned, windows or None).tolist())
    for index, (start, end) in enumerate(windows):
        if index not in occupied:
            where = f"{run.config_path}: fit.windows_s"
            first, last = binned.edges_s[[0, -1]]
            expected = f"windows that contain a bin of the recording, {first:g} to {last:g} s"
            raise InputError(where, f"[{start:g}, {end:g}]", expected)


def _files(run: Run) -> Iterable[Path]:
    """Returns the file that the stage reads."""
    return [run.beside(run.config.recording.file)]


STAGE = Stage(
    "recording", "reads the recording", (), ("recording", "model", "fit"), _prepare_recording, _files
)
