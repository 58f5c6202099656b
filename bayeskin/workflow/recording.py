"""The first stage: reads the recordings, and derives the bins to fit, the protocol and the noise by phase."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayeskin import report, storage
from bayeskin.config import RecordingConfig
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
from bayeskin.recordings.join import join_bins, join_motions, join_samples, spans_of
from bayeskin.types import BinnedForce, PadMotion, Phase, Recording
from bayeskin.types.joint import figure_name
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


def prepared(run: Run, recording: Recording, protocol: str) -> Prepared:
    """Returns phases, noise, protocol and bins of a recording, as the configuration asks for them."""
    phases = segment(recording)
    analysis = analyse(recording, phases)
    motion = pad_motion(run.config.model.spec(), recording, phases, protocol)
    edges_s = uniform_edges(covered_s(recording, motion), run.config.fit.bin_width_s)
    return Prepared(phases, analysis, motion, bin_recording(recording, phases, edges_s, analysis))


def _prepare_recordings(run: Run) -> Mapping[str, Any]:
    """Prepares the recordings, writes them with a figure of each, and returns the stage's summary.

    Several recordings are laid end to end. The summary then has what they have in common, and an entry for
    each of them.
    """
    recordings = [_named(run, section) for section in run.config.each_recording]
    parts = [
        prepared(run, recording, section.protocol)
        for recording, section in zip(recordings, run.config.each_recording, strict=True)
    ]
    facts = [
        describe_json(recording, part.phases, summarise(part.analysis, part.phases))
        for recording, part in zip(recordings, parts, strict=True)
    ]
    samples, motion, binned = recordings[0], parts[0].motion, parts[0].binned
    if len(parts) > 1:
        spans = spans_of(recordings, [part.motion for part in parts])
        samples = join_samples(recordings, spans)
        motion = join_motions([part.motion for part in parts], spans)
        binned = join_bins([part.binned for part in parts], spans)
    _refuse_empty_windows(run, binned)
    storage.save(run.at("recording", "recording.h5"), samples)
    storage.save(run.at("recording", "motion.h5"), motion)
    storage.save(run.at("recording", "binned.h5"), binned)
    for number, (recording, part) in enumerate(zip(recordings, parts, strict=True)):
        figure = report.figure_recording(recording, part.binned)
        report.save_figure(figure, run.at("recording", figure_name("recording", number)), caption(run))
    if len(parts) == 1:
        return facts[0]
    total = {key: sum(fact[key] for fact in facts) for key in ("samples", "duration_s")}
    return {**facts[0], "name": samples.name, "sha256": samples.sha256, **total, "recordings": facts}


def _named(run: Run, section: RecordingConfig) -> Recording:
    """Returns a recording; one of several has the name of its file."""
    file = run.beside(section.file)
    recording = read_recording(file)
    return replace(recording, name=file.stem) if run.config.recordings else recording


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
            raise InputError(
                where,
                f"the window [{start:g}, {end:g}] contains no bin of the recording",
                f"it must lie within {first:g} to {last:g} s",
            )


def _files(run: Run) -> Iterable[Path]:
    """Returns the files that the stage reads."""
    return [run.beside(section.file) for section in run.config.each_recording]


STAGE = Stage(
    "recording", "reads the recordings", (), ("recording", "model", "fit"), _prepare_recordings, _files
)
