"""First stage: the recording as it is fitted, the motion that drives the model, the noise by phase."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from bayeskin import report, storage
from bayeskin.config import Config
from bayeskin.pipeline.engine import Run, Stage
from bayeskin.pipeline.provenance import caption
from bayeskin.recordings.bins import bin_recording, uniform_edges
from bayeskin.recordings.motion import idealised_motion, motion_of, recorded_motion
from bayeskin.recordings.noise import PhaseNoise, analyse, summarise
from bayeskin.recordings.read import read_recording
from bayeskin.recordings.segment import segment
from bayeskin.types import PadMotion, Phase, Recording


def pad_motion(config: Config, recording: Recording, phases: Sequence[Phase]) -> PadMotion:
    """The displacement that drives the model; the article's script takes every 50th sample, as it stands."""
    if config.model.observation == "article":
        return motion_of(recording)
    if config.recording.protocol == "idealised":
        return idealised_motion(recording, phases)
    return recorded_motion(recording, phases)


def describe(recording: Recording, noise: Sequence[PhaseNoise]) -> dict[str, Any]:
    """What is in a recording, as plain numbers and text."""
    return {
        "name": recording.name,
        "sha256": recording.sha256,
        "samples": len(recording.time_s),
        "duration_s": recording.time_s[-1] - recording.time_s[0],
        "travel_m": recording.displacement_m.max() - recording.displacement_m.min(),
        "peak_force_n": recording.force_n.max(),
        "notes": list(recording.notes),
        "phases": [vars(one) for one in noise],
    }


def in_words(description: Mapping[str, Any]) -> str:
    """The description for a person: what was taken for what, then a line a phase."""
    head = (
        f"{description['name']}: {description['samples']} samples, {description['duration_s']:.1f} s, "
        f"travel {1e3 * description['travel_m']:.2f} mm, peak force {description['peak_force_n']:.3f} N"
    )
    notes = [f"  {note}" for note in description["notes"]]
    return "\n".join([head, *notes, *(_phase_in_words(phase) for phase in description["phases"])])


def _phase_in_words(phase: Mapping[str, Any]) -> str:
    parts = [
        f"  cycle {phase['cycle']} {phase['kind']:<6} {phase['start_s']:7.2f} to {phase['end_s']:7.2f} s",
        f"noise {1e3 * phase['sd_n']:.2f} mN",
    ]
    if phase["correlation_time_s"]:
        parts.append(
            f"of which {1e3 * phase['correlated_sd_n']:.2f} mN over {phase['correlation_time_s']:.2f} s"
        )
    if phase["spikes"]:
        parts.append(f"{phase['spikes']} spikes ({phase['spikes_above']} upward)")
    parts += [
        f"step of {1e3 * size:+.1f} mN at {time:.1f} s"
        for time, size in zip(phase["step_times_s"], phase["step_sizes_n"], strict=True)
    ]
    return ", ".join(parts)


def _work(run: Run) -> Mapping[str, Any]:
    recording = read_recording(run.beside(run.config.recording.file))
    phases = segment(recording)
    analysis = analyse(recording, phases)
    edges_s = uniform_edges(recording, run.config.fit.bin_width_s)
    storage.save(run.at("recording", "recording.h5"), recording)
    storage.save(run.at("recording", "motion.h5"), pad_motion(run.config, recording, phases))
    storage.save(run.at("recording", "binned.h5"), bin_recording(recording, phases, edges_s, analysis))
    figure = report.figure_recording(recording, phases)
    report.save_figure(figure, run.at("recording", "recording"), caption(run))
    return describe(recording, summarise(analysis, phases))


def _files(run: Run) -> Iterable[Path]:
    return [run.beside(run.config.recording.file)]


STAGE = Stage("recording", "reads the recording", (), ("recording", "model", "fit"), _work, _files)
