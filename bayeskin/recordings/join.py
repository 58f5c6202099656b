"""Lays several recordings of one skin end to end on one axis of time, with a pause between two of them.

The pause is drawn in figures, and separates the noise of the recordings. It says nothing about the time that
passed between the tests, and the model's skin is at rest at the start of each recording.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np

from bayeskin.types import Array, BinnedForce, Jumps, PadMotion, Recording, Span
from bayeskin.types.joint import end_to_end

PAUSE_S = 20.0  # between the end of a recording and the start of the next one on the common axis
RETURN_S = 1.0  # time in which the drawn pads return to their first place at the start of a pause


def spans_of(recordings: Sequence[Recording], motions: Sequence[PadMotion]) -> tuple[Span, ...]:
    """Returns the parts of a common axis of time that recordings cover, with their protocols."""
    spans, start_s = [], 0.0
    for recording, motion in zip(recordings, motions, strict=True):
        end_s = start_s + float(max(recording.time_s[-1], motion.time_s[-1]))
        spans.append(Span(recording.name, start_s, end_s))
        start_s = float(np.ceil(end_s)) + PAUSE_S
    return tuple(spans)


def join_samples(recordings: Sequence[Recording], spans: Sequence[Span]) -> Recording:
    """Returns the samples of all recordings on the common axis of time."""
    return Recording(
        np.concatenate([r.time_s + span.start_s for r, span in zip(recordings, spans, strict=True)]),
        np.concatenate([r.displacement_m for r in recordings]),
        np.concatenate([r.force_n for r in recordings]),
        " + ".join(r.name for r in recordings),
        hashlib.sha256("".join(r.sha256 for r in recordings).encode()).hexdigest(),
        tuple(f"{r.name}: {note}" for r in recordings for note in r.notes),
    )


def join_motions(motions: Sequence[PadMotion], spans: Sequence[Span]) -> PadMotion:
    """Returns the protocols of all recordings on the common axis of time."""
    time_s: list[Array] = []
    displacement_m: list[Array] = []
    for number, (motion, span) in enumerate(zip(motions, spans, strict=True)):
        time_s.append(motion.time_s + span.start_s)
        displacement_m.append(motion.displacement_m)
        if number + 1 < len(spans):
            time_s.append(np.array([span.end_s + RETURN_S]))
            displacement_m.append(motions[number + 1].displacement_m[:1])
    return PadMotion(np.concatenate(time_s), np.concatenate(displacement_m), tuple(spans))


def join_bins(parts: Sequence[BinnedForce], spans: Sequence[Span]) -> BinnedForce:
    """Returns the bins of all recordings on the common axis of time; the bin of a pause has no force."""
    counts = np.cumsum([0, *(len(part.phases) for part in parts)])
    phase = [part.phase + count for part, count in zip(parts, counts, strict=False)]
    pauses = [np.array([bins[-1]]) for bins in phase]
    return BinnedForce(
        np.concatenate([part.edges_s + span.start_s for part, span in zip(parts, spans, strict=True)]),
        end_to_end([part.force_n for part in parts], np.nan),
        end_to_end([part.variance_n2 for part in parts], np.nan),
        np.concatenate([c for part in parts for c in (np.zeros(2), part.correlation)][1:]),
        np.concatenate([bins for pair in zip(phase, pauses, strict=True) for bins in pair][:-1]),
        tuple(p.later(span.start_s) for part, span in zip(parts, spans, strict=True) for p in part.phases),
        tuple(spans),
    )


def join_jumps(parts: Sequence[Jumps], spans: Sequence[Span]) -> Jumps:
    """Returns the jumps that the samples of all recordings allow, on the common axis of time."""
    return Jumps(
        np.concatenate([part.time_s + span.start_s for part, span in zip(parts, spans, strict=True)]),
        np.concatenate([part.lowest_n for part in parts]),
        np.concatenate([part.highest_n for part in parts]),
    )
