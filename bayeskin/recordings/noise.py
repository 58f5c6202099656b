"""Describes the noise of each phase of a recording: sd, correlation, spikes, and steps of the zero."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from bayeskin.recordings.noise_analysis import NoiseAnalysis, analyse
from bayeskin.recordings.steps import allowed_jumps
from bayeskin.types import Array, FreezesArrays, Jumps, Phase, PhaseKind, Recording


@dataclass(frozen=True)
class PhaseNoise(FreezesArrays):
    """Noise of the force in one phase.

    `sd_n` is the sd of the noise that is faster than about a second, without spikes. It has a white part,
    `white_sd_n`, and a correlated part, `correlated_sd_n`, with correlation time `correlation_time_s`. The
    correlation time is pooled over all phases of the kind. A spike is farther than `spike_threshold_n` from
    the running median. Of the `spikes`, `spikes_above` are upward. `step_times_s` and `step_sizes_n`
    (steps,) describe shifts of the load cell's zero, with a false-alarm rate of 1 % per recording.
    """

    kind: PhaseKind
    cycle: int
    start_s: float
    end_s: float
    sd_n: float
    white_sd_n: float
    correlated_sd_n: float
    correlation_time_s: float
    spikes: int
    spikes_above: int
    spike_threshold_n: float
    step_times_s: Array
    step_sizes_n: Array


def phase_noise(recording: Recording, phases: Sequence[Phase]) -> tuple[PhaseNoise, ...]:
    """Returns the noise of each phase, in the order of `phases`.

    Raises
    ------
    InputError : no phase is long enough (about 30 samples, 15 of a slow recording) to distinguish noise from
        force, or the force never changes.
    """
    return summarise(analyse(recording, phases), phases)


def summarise(analysis: NoiseAnalysis, phases: Sequence[Phase]) -> tuple[PhaseNoise, ...]:
    """Returns the noise of each phase from a recording's analysis."""
    noises = []
    for i, (phase, (start, stop)) in enumerate(zip(phases, pairwise(analysis.bounds), strict=True)):
        shape, sd = analysis.shapes[phase.kind], analysis.local[i].phase_sd_n
        signs = analysis.despiked.events(start, stop)
        noises.append(
            PhaseNoise(
                kind=phase.kind,
                cycle=phase.cycle,
                start_s=phase.start_s,
                end_s=phase.end_s,
                sd_n=sd,
                white_sd_n=sd * float(np.sqrt(shape.white_share)),
                correlated_sd_n=sd * float(np.sqrt(1 - shape.white_share)),
                correlation_time_s=shape.time_s if shape.white_share < 1 else 0.0,
                spikes=len(signs),
                spikes_above=int(np.sum(signs > 0)),
                spike_threshold_n=analysis.despiked.threshold_sd
                * float(np.median(analysis.despiked.sd_n[start:stop])),
                step_times_s=np.array([s.time_s for s in analysis.steps[i]]),
                step_sizes_n=np.array([s.size_n for s in analysis.steps[i]]),
            )
        )
    return tuple(noises)


def jumps_of(recording: Recording, phases: Sequence[Phase]) -> Jumps:
    """Returns the jumps of force within phases that a recording's samples allow.

    Raises InputError in the cases of `phase_noise`.
    """
    analysis, by_phase = analyse(recording, phases), []
    for phase, local, (a, b) in zip(phases, analysis.local, pairwise(analysis.bounds), strict=True):
        time_s, force_n = recording.time_s[a:b], analysis.despiked.force_n[a:b]
        by_phase.append(allowed_jumps(time_s, force_n, local.at(time_s), analysis.shapes[phase.kind]))
    columns = [np.concatenate([getattr(jumps, name) for jumps in by_phase])
               for name in ("time_s", "lowest_n", "highest_n")]  # fmt: skip
    return Jumps(*columns)
