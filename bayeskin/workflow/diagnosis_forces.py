"""The forces of a diagnosis's fits in each recording, which the figures and the page of the run show."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from bayeskin.mismatch.assess import AssessedFit, Diagnosis
from bayeskin.mismatch.context import DiagnosisContext
from bayeskin.mismatch.locate import Located
from bayeskin.types import Array, BinnedForce

FORCES = "forces.json"


@dataclass(frozen=True)
class FitInRecording:
    """A fit in one recording, on the recording's own axis of time; see `AssessedFit`."""

    force_n: Array
    band_n: tuple[Array, Array]
    held_out_n: Array | None
    located: Located


def in_recording(fit: AssessedFit, binned: BinnedForce, number: int) -> FitInRecording:
    """Returns a fit in one recording."""
    bins, located, held_out_n = binned.slices[number], fit.located, fit.held_out_n
    if binned.spans:
        span = binned.spans[number]
        inside = (located.bins >= bins.start) & (located.bins < bins.stop)
        windows = tuple(
            replace(window, start_s=window.start_s - span.start_s, end_s=window.end_s - span.start_s)
            for window in located.windows
            if span.start_s - 1e-9 <= window.start_s < span.end_s
        )
        located = replace(
            located, windows=windows, bins=located.bins[inside] - bins.start,
            residual_n=located.residual_n[inside], allowed_n=located.allowed_n[inside],
        )  # fmt: skip
    return FitInRecording(
        fit.force_n[bins], (fit.band_n[0][bins], fit.band_n[1][bins]),
        None if held_out_n is None else held_out_n[bins], located,
    )  # fmt: skip


def forces_of(context: DiagnosisContext, diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Returns recorded and fitted forces [N] over time for each recording, in the types of JSON.

    The band is the one of 90 % after the diagnosis. The windows are those in which the recording differs from
    the model before it.
    """
    binned = context.binned
    names = [span.name for span in binned.spans] or [""]
    entries = []
    for number, (name, part) in enumerate(zip(names, binned.parts, strict=True)):
        before, after = (in_recording(fit, binned, number) for fit in (diagnosis.before, diagnosis.after))
        entries.append({
            "name": name,
            "time_s": part.time_s, "recorded_n": part.force_n,
            "before_n": before.force_n, "after_n": after.force_n,
            "low_90_n": after.band_n[0], "high_90_n": after.band_n[1],
            "windows": [
                {"start_s": window.start_s, "end_s": window.end_s, "mean_n": window.mean_n}
                for window in before.located.windows
            ],
        })  # fmt: skip
    return entries
