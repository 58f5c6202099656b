"""Finds the phases of a test (rest, load, hold, unload) from the displacement alone.

A polyline through the displacement gives the pieces. Straight lines are then fitted to both sides of each
corner, and the corner is placed where they meet. Therefore neither the resolution of the LVDT nor the
rounding by the drive moves the corner.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from bayeskin.errors import InputError
from bayeskin.recordings.polyline import simplify
from bayeskin.types import Array, Phase, PhaseKind, Recording


@dataclass(frozen=True)
class SegmentSettings:
    """Settings of the search for phases. Shares are shares of the whole travel of the displacement.

    tolerance : largest distance of the polyline from the displacement, if the resolution is finer
    still : a piece that moves less than this share is still (drift, overshoot)
    rest : a still piece closer to the lowest level than this share is a rest, else a hold
    shortest_still_s : a dwell at a turning point that is shorter than this [s] is not a phase
    speed_change : a ramp whose speed changes by a larger factor has a corner there
    shortest_ramp_s : both parts of such a ramp must last at least this long [s]
    shortest_ramp : and this many sampling intervals, because a corner may lie between two samples
    trim_s : duration [s] that a line fit ignores at a piece's rounded end, at most a tenth of the piece
    rounding : smaller steps of the displacement are rounding in the computer
    largest_step : largest step of an LVDT
    """

    tolerance: float = 0.005
    still: float = 0.03
    rest: float = 0.05
    shortest_still_s: float = 0.2
    speed_change: float = 1.5
    shortest_ramp_s: float = 0.5
    shortest_ramp: float = 1.5
    trim_s: float = 0.5
    rounding: float = 1e-9
    largest_step: float = 0.0125


SEGMENT = SegmentSettings()


@dataclass(frozen=True)
class _Piece:
    """Samples start..stop that move in one direction: -1, 0 (still) or 1."""

    start: int
    stop: int
    direction: int


def resolution_m(displacement_m: Array) -> float:
    """Returns the resolution of the displacement [m]: the larger of its smallest step and its noise's sd.

    Steps that rounding in the computer makes do not count. Where samples are far apart, the drive moves by
    more than the LVDT's step between them, so a step counts as at most 1.25 % of the travel.
    """
    travel = float(np.ptp(displacement_m))
    steps = np.diff(np.unique(displacement_m))
    steps = steps[steps > SEGMENT.rounding * travel]
    step = min(float(steps.min(initial=np.inf)), SEGMENT.largest_step * travel)
    second = np.diff(displacement_m, 2)
    limit = max(5 * 1.4826 * float(np.median(np.abs(second))), 2 * step)
    noise = float(np.sqrt(np.mean(second[np.abs(second) <= limit] ** 2) / 6.0))
    return max(step, noise)


def segment(recording: Recording) -> tuple[Phase, ...]:
    """Returns the phases that together cover the recording, from the displacement alone.

    Cycle 1 begins with the first loading. A loading after an unloading or a rest begins the next cycle. A
    loading after a hold or another loading continues its cycle. A still phase within 5 % of the travel from
    the lowest level is a rest, and any other still phase is a hold. Turning points where the drive dwells for
    less than 0.2 s have no phase of their own.

    Raises
    ------
    InputError : the displacement neither rises nor falls, or moves little more than its noise.
    """
    time_s = recording.time_s
    smooth = median_filter(recording.displacement_m, 5, mode="nearest")
    travel = float(np.ptp(smooth))
    tolerance = max(SEGMENT.tolerance * travel, 4 * resolution_m(recording.displacement_m))
    if travel < 5 * tolerance:
        raise InputError(
            recording.name,
            f"the displacement moves {travel:.3g} m, little more than its noise",
            "a test needs loading and unloading",
        )
    knots = simplify(time_s, smooth, tolerance, np.empty(0, dtype=np.int64))
    still_m = SEGMENT.still * travel
    pieces = _merge(_fragments(time_s, smooth, knots, still_m), time_s, smooth, still_m)
    if not any(piece.direction for piece in pieces):
        raise InputError(
            recording.name, "the displacement never rises or falls", "a test needs a loading or an unloading"
        )
    corners = [_corner_s(time_s, smooth, a, b) for a, b in pairwise(pieces)]
    edges = [float(time_s[0]), *corners, float(time_s[-1])]
    return _name_phases(pieces, edges, smooth)


def _fragments(time_s: Array, smooth: Array, knots: NDArray[np.int64], still_m: float) -> list[_Piece]:
    """Returns the pieces of the polyline.

    A piece that moves little is still, unless it moves at least half as fast as the slowest ramp.
    """
    moved = np.abs(np.diff(smooth[knots]))
    speed = moved / np.diff(time_s[knots])
    ramps = speed[moved >= still_m]
    still = (moved < still_m) & (speed < 0.5 * ramps.min(initial=np.inf))
    directions = np.where(still, 0, np.sign(np.diff(smooth[knots]))).astype(int)
    return [_Piece(int(a), int(b), int(d)) for (a, b), d in zip(pairwise(knots), directions, strict=True)]


def _merge(fragments: list[_Piece], time_s: Array, smooth: Array, still_m: float) -> list[_Piece]:
    """Returns the pieces after neighbours of equal direction are joined.

    Small movements (overshoot) become still, and short dwells disappear.
    """
    pieces = [
        replace(piece, direction=0) if abs(smooth[piece.stop] - smooth[piece.start]) < still_m else piece
        for piece in _join_equal(fragments, time_s, smooth, still_m)
    ]
    pieces = _join_equal(pieces, time_s, smooth, still_m)
    kept = [
        piece
        for piece in pieces
        if piece.direction or time_s[piece.stop] - time_s[piece.start] >= SEGMENT.shortest_still_s
    ]
    return _join_equal(kept, time_s, smooth, still_m)


def _join_equal(pieces: list[_Piece], time_s: Array, smooth: Array, still_m: float) -> list[_Piece]:
    """Joins neighbours of equal direction, unless both are ramps and their speeds differ."""
    joined: list[_Piece] = []
    for piece in pieces:
        last = joined[-1] if joined else None
        if (
            last is not None
            and last.direction == piece.direction
            and not _are_separate_ramps(last, piece, time_s, smooth, still_m)
        ):
            joined[-1] = replace(piece, start=last.start)
        else:
            joined.append(piece)
    return joined


def _are_separate_ramps(a: _Piece, b: _Piece, time_s: Array, smooth: Array, still_m: float) -> bool:
    """Returns whether two neighbours are separate ramps: both long and far enough, with different speeds."""
    moved = np.array([abs(smooth[p.stop] - smooth[p.start]) for p in (a, b)])
    lasted = np.array([time_s[p.stop] - time_s[p.start] for p in (a, b)])
    speed = moved / lasted
    interval_s = float(np.median(np.diff(time_s)))
    shortest_s = max(SEGMENT.shortest_ramp_s, SEGMENT.shortest_ramp * interval_s)
    if a.direction == 0 or moved.min() < still_m or lasted.min() < shortest_s:
        return False
    return bool(speed.max() > SEGMENT.speed_change * speed.min())


def _fit_line(time_s: Array, smooth: Array, start: int, stop: int) -> tuple[float, float]:
    """Returns the slope and intercept of the least-squares line through samples start..stop."""
    if stop - start < 2:
        stop = min(start + 2, len(time_s) - 1)
        start = max(0, stop - 2)
    t, y = time_s[start : stop + 1], smooth[start : stop + 1]
    middle = t.mean()
    slope = float(np.dot(t - middle, y) / np.dot(t - middle, t - middle))
    return slope, float(y.mean() - slope * middle)


def _near_half(time_s: Array, piece: _Piece, at_end: bool) -> tuple[int, int]:
    """Returns the first and last sample of the half of a piece next to a corner, without the rounded end."""
    length = time_s[piece.stop] - time_s[piece.start]
    trim = min(0.1 * length, SEGMENT.trim_s)
    near, far = trim, max(0.5 * length, trim)
    if at_end:
        window = (time_s[piece.stop] - far, time_s[piece.stop] - near)
    else:
        window = (time_s[piece.start] + near, time_s[piece.start] + far)
    start, stop = np.searchsorted(time_s, window)
    return int(start), int(min(stop, len(time_s) - 1))


def _corner_s(time_s: Array, smooth: Array, before: _Piece, after: _Piece) -> float:
    """Returns the time [s] at which the lines through both sides of a corner meet.

    If the lines do not meet near the knot of the polyline, the time of the knot is returned.
    """
    slope_a, intercept_a = _fit_line(time_s, smooth, *_near_half(time_s, before, at_end=True))
    slope_b, intercept_b = _fit_line(time_s, smooth, *_near_half(time_s, after, at_end=False))
    knot_s = 0.5 * float(time_s[before.stop] + time_s[after.start])
    reach = 0.25 * min(time_s[before.stop] - time_s[before.start], time_s[after.stop] - time_s[after.start])
    if slope_a == slope_b:
        return knot_s
    meeting_s = (intercept_b - intercept_a) / (slope_a - slope_b)
    reach = max(reach, SEGMENT.shortest_still_s)
    return float(meeting_s) if abs(meeting_s - knot_s) <= reach else knot_s


def _name_phases(pieces: list[_Piece], edges: list[float], smooth: Array) -> tuple[Phase, ...]:
    levels = [float(np.median(smooth[p.start : p.stop + 1])) for p in pieces]
    low, travel = float(np.min(smooth)), float(np.ptp(smooth))
    phases: list[Phase] = []
    cycle = 0
    for i, (piece, level) in enumerate(zip(pieces, levels, strict=True)):
        kind: PhaseKind = "load" if piece.direction > 0 else "unload"
        if piece.direction == 0:
            kind = "rest" if level < low + SEGMENT.rest * travel else "hold"
        elif kind == "load" and not (phases and phases[-1].kind in ("hold", "load")):
            cycle += 1
        phases.append(Phase(kind, cycle, edges[i], edges[i + 1]))
    return tuple(phases)
