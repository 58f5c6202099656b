"""Makes protocols for the model from a recording's displacement: idealised, sampled, or followed closely."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bayeskin.recordings.polyline import simplify
from bayeskin.recordings.segment import resolution_m
from bayeskin.types import Array, PadMotion, Phase, Recording


@dataclass(frozen=True)
class CornerSettings:
    """Settings of the displacement at corners.

    rounding_s : half width [s] over which a drive rounds a corner; it contains a turning point's extreme
    clear_s : duration [s] that is ignored at both ends of a still phase when its level is measured
    """

    rounding_s: float = 0.1
    clear_s: float = 0.5


def corner_heights_m(
    recording: Recording, phases: Sequence[Phase], settings: CornerSettings = CornerSettings()
) -> Array:
    """Returns the displacement [m] (len(phases) + 1,) at the corners, as the protocol intended it.

    Beside a still phase it is the level of that phase. Between a loading and an unloading it is the extreme
    that the recording reaches. At all other corners it is the recorded displacement.
    """
    time_s, displacement_m = recording.time_s, recording.displacement_m
    heights = []
    for i in range(len(phases) + 1):
        still = [p for p in phases[max(i - 1, 0) : i + 1] if p.kind in ("rest", "hold")]
        corner_s = phases[i].start_s if i < len(phases) else phases[-1].end_s
        if still:
            clear = min(settings.clear_s, 0.2 * (still[0].end_s - still[0].start_s))
            inside = (time_s >= still[0].start_s + clear) & (time_s <= still[0].end_s - clear)
            heights.append(float(np.median(displacement_m[inside])))
            continue
        near = displacement_m[np.abs(time_s - corner_s) <= settings.rounding_s]
        if i in (0, len(phases)) or phases[i - 1].kind == phases[i].kind:
            heights.append(float(np.interp(corner_s, time_s, displacement_m)))
        else:
            heights.append(float(near.min() if phases[i].kind == "load" else near.max()))
    return np.array(heights)


def idealised_motion(
    recording: Recording, phases: Sequence[Phase], time_step_s: float = 0.1, height_step_m: float = 1e-5
) -> PadMotion:
    """Returns the protocol as straight lines between corners with rounded times and displacements.

    The last corner is the recording's end, rounded up. Corners whose times become equal are merged.
    """
    times = [*(p.start_s for p in phases), phases[-1].end_s]
    ticks = np.rint(np.array(times) / time_step_s)
    ticks[0] = 0.0
    ticks[-1] = np.ceil(times[-1] / time_step_s - 1e-6)
    heights = np.rint(corner_heights_m(recording, phases) / height_step_m) * height_step_m
    ticks, kept = np.unique(ticks, return_index=True)
    return PadMotion(np.round(ticks * time_step_s, 9), np.round(heights[kept], 12))


def motion_of(recording: Recording, every: int = 50) -> PadMotion:
    """Returns the recorded displacement at every `every`-th sample (the article's script used 50)."""
    return PadMotion(recording.time_s[::every], recording.displacement_m[::every])


def recorded_motion(recording: Recording, phases: Sequence[Phase]) -> PadMotion:
    """Returns a polyline that stays within twice the LVDT's resolution of every sample.

    The polyline has knots at the corners. The drive rounds the corners, and the polyline takes the
    displacement that was recorded there.
    """
    corners = np.array([p.start_s for p in phases[1:]])
    corners = corners[~np.isin(corners, recording.time_s)]
    time_s = np.concatenate([recording.time_s, corners])
    order = np.argsort(time_s, kind="stable")
    recorded = np.interp(time_s, recording.time_s, recording.displacement_m)[order]
    time_s = time_s[order]
    fixed = np.searchsorted(time_s, [p.start_s for p in phases[1:]])
    knots = simplify(time_s, recorded, 2 * resolution_m(recording.displacement_m), fixed)
    return PadMotion(time_s[knots], recorded[knots])
