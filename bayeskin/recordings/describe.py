"""Describes a recording, as text for a reader and as plain values for a program."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from bayeskin.number_format import number
from bayeskin.recordings.bins import BIN_WIDTH_S, fitting_width_s
from bayeskin.recordings.noise import PhaseNoise
from bayeskin.recordings.segment import resolution_m
from bayeskin.types import Phase, Recording

_HEADINGS = (
    "phase",
    "cycle",
    "from [s]",
    "to [s]",
    "travel [mm]",
    "noise [mN]",
    "corr. [s]",
    "spikes",
    "steps",
)
_WIDTHS = (7, 5, 9, 9, 16, 10, 9, 6, 5)


def describe(recording: Recording, phases: Sequence[Phase], noise: Sequence[PhaseNoise]) -> str:
    """Returns the description of a recording as several lines of text.

    The lines contain the notes on how the file was read, the ranges of displacement and force, one row for
    each phase, every step of the load cell's zero, and what the recording cannot tell.
    """
    facts = describe_json(recording, phases, noise)
    displacement, force = facts["displacement_m"], facts["force_n"]
    lines = [
        f"{facts['name']}: {facts['samples']} samples at {number(facts['sampling_hz'], 4)} Hz, "
        f"{facts['duration_s']:.2f} s, {facts['cycles']} cycle{'s' * (facts['cycles'] != 1)}",
        *(f"  {note}" for note in recording.notes),
        f"  displacement {1e3 * displacement['min']:.3f} to {1e3 * displacement['max']:.3f} mm "
        f"(resolution {number(1e3 * displacement['resolution'], 2)} mm), "
        f"force {number(force['min'], 4)} to {number(force['max'], 4)} N",
        "",
        "  ".join(f"{title:>{width}}" for title, width in zip(_HEADINGS, _WIDTHS, strict=True)),
    ]
    lines += [_row(phase) for phase in facts["phases"]]
    steps = [(step, phase) for phase in facts["phases"] for step in phase["steps"]]
    lines += ["", "steps of the load cell's zero:" + ("" if steps else " none")]
    for step, phase in steps:
        size, where = f"{1e3 * step['size_n']:+6.1f} mN", f"in the {phase['kind']} of cycle {phase['cycle']}"
        lines.append(f"  {step['time_s']:8.2f} s  {size}  {where}")
    if facts["cannot_tell"]:
        lines += ["", "what this recording cannot tell:", *(f"  {said}" for said in facts["cannot_tell"])]
    return "\n".join(lines)


def describe_json(
    recording: Recording, phases: Sequence[Phase], noise: Sequence[PhaseNoise]
) -> dict[str, Any]:
    """Returns the content of `describe` in SI units, as numbers, text, lists and mappings only."""
    time_s, displacement_m, force_n = recording.time_s, recording.displacement_m, recording.force_n
    return {
        "name": recording.name,
        "sha256": recording.sha256,
        "notes": list(recording.notes),
        "samples": len(time_s),
        "duration_s": float(time_s[-1] - time_s[0]),
        "sampling_hz": float(1.0 / np.median(np.diff(time_s))),
        "displacement_m": {
            "min": float(displacement_m.min()),
            "max": float(displacement_m.max()),
            "resolution": resolution_m(displacement_m),
        },
        "force_n": {"min": float(force_n.min()), "max": float(force_n.max())},
        "cycles": max(phase.cycle for phase in phases),
        "phases": [
            _phase_facts(recording, phase, phase_noise)
            for phase, phase_noise in zip(phases, noise, strict=True)
        ],
        "cannot_tell": _cannot_tell(recording, phases),
    }


def _cannot_tell(recording: Recording, phases: Sequence[Phase]) -> list[str]:
    """Returns sentences on what a protocol without some phases, or with few samples, does not determine."""
    kinds, interval_s = {phase.kind for phase in phases}, float(np.median(np.diff(recording.time_s)))
    said = []
    if "hold" not in kinds:
        said.append(
            "There is no hold, so the force never relaxes at a constant displacement. The permeabilities and "
            "mechanisms with a memory can hardly be told from the stiffness."
        )
    if "unload" not in kinds:
        said.append(
            "There is no unloading, so there is no hysteresis. Friction, damage and plastic set can hardly "
            "be told from the stiffness."
        )
    width_s = fitting_width_s(recording)
    if width_s > BIN_WIDTH_S:
        said.append(
            f"Samples are {number(interval_s, 2)} s apart. Spikes and steps of the force can hardly be told "
            f"from noise. Bins need a width of {number(width_s, 2)} s (fit.bin_width_s)."
        )
    return said


def _phase_facts(recording: Recording, phase: Phase, noise: PhaseNoise) -> dict[str, Any]:
    start_m, end_m = np.interp([phase.start_s, phase.end_s], recording.time_s, recording.displacement_m)
    return {
        "kind": phase.kind,
        "cycle": phase.cycle,
        "start_s": phase.start_s,
        "end_s": phase.end_s,
        "start_m": float(start_m),
        "end_m": float(end_m),
        "noise_sd_n": noise.sd_n,
        "noise_white_sd_n": noise.white_sd_n,
        "noise_correlated_sd_n": noise.correlated_sd_n,
        "noise_correlation_time_s": noise.correlation_time_s,
        "spikes": noise.spikes,
        "spikes_above": noise.spikes_above,
        "spike_threshold_n": noise.spike_threshold_n,
        "steps": [
            {"time_s": float(t), "size_n": float(size)}
            for t, size in zip(noise.step_times_s, noise.step_sizes_n, strict=True)
        ],
    }


def _row(phase: dict[str, Any]) -> str:
    cells = (
        phase["kind"],
        phase["cycle"],
        f"{phase['start_s']:.2f}",
        f"{phase['end_s']:.2f}",
        f"{1e3 * phase['start_m']:.2f} to {1e3 * phase['end_m']:.2f}",
        f"{1e3 * phase['noise_sd_n']:.2f}",
        f"{phase['noise_correlation_time_s']:.3f}",
        phase["spikes"],
        len(phase["steps"]),
    )
    return "  ".join(f"{cell!s:>{width}}" for cell, width in zip(cells, _WIDTHS, strict=True))
