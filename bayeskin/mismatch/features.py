"""What a discrepancy looks like, in plain words."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayeskin.mismatch.unexplained import Place, Unexplained
from bayeskin.types import Array

CERTAIN = 2.0  # standard deviations from zero
WIDESPREAD = 0.25  # of a phase kind's bins
CHANGED = 1.5  # ratio of the last cycle's size to the first's
FOLLOWS = 0.5  # squared correlation
SEEN = 1e-3  # of an axis' length that must remain beyond what parameters take up
WORDS = {"rest": "at rest", "load": "while loading", "hold": "in holds", "unload": "while unloading"}


def describe(rest: Unexplained, mean_n: Array, sd_n: Array) -> tuple[str, ...]:
    """Where a discrepancy of mean and sd (k,) stands out, its sign, trend over cycles, what it follows."""
    at, certain = rest.at, np.abs(mean_n) > CERTAIN * sd_n
    lines = [_of_kind(kind, at, mean_n, certain) for kind in WORDS]
    lines += [_over_cycles(at, mean_n, certain), *_followed(rest, mean_n)]
    return tuple(line for line in lines if line)


def _of_kind(kind: str, at: Place, mean_n: Array, certain: NDArray[np.bool_]) -> str:
    inside = at.kind == kind
    if not inside.any() or np.mean(certain[inside]) < WIDESPREAD:
        return ""
    level, size = float(np.mean(mean_n[inside])), float(np.sqrt(np.mean(mean_n[inside] ** 2)))
    if abs(level) < 0.5 * size:
        return f"{WORDS[kind]} of changing sign, {1e3 * size:.1f} mN RMS"
    side = "above" if level > 0 else "below"
    return f"{WORDS[kind]} the recorded force is {1e3 * abs(level):.1f} mN {side} the model's on average"


def _over_cycles(at: Place, mean_n: Array, certain: NDArray[np.bool_]) -> str:
    cycles = [cycle for cycle in np.unique(at.cycle) if cycle > 0]
    if len(cycles) < 2 or not certain.any():
        return ""
    size = [float(np.sqrt(np.mean(mean_n[at.cycle == cycle] ** 2))) for cycle in cycles]
    ratio = size[-1] / size[0] if size[0] > 0.0 else np.inf
    if 1.0 / CHANGED < ratio < CHANGED:
        return "about as large in the last cycle as in the first"
    return (
        f"{'grows' if ratio > 1.0 else 'fades'} from {1e3 * size[0]:.1f} to {1e3 * size[-1]:.1f} mN RMS "
        + (f"between cycle {cycles[0]:.0f} and cycle {cycles[-1]:.0f}")
    )


def _followed(rest: Unexplained, mean_n: Array) -> list[str]:
    """What the discrepancy rises or falls along, beyond what parameters take up of it."""
    at, everywhere = rest.at, np.ones(len(mean_n), bool)
    axes = [
        ("displacement while the pads move", at.displacement_m, at.direction != 0.0),
        ("displacement over all phases", at.displacement_m, everywhere),
        ("speed and direction", at.speed_m_s, everywhere),
        ("the logarithm of time since the corner in holds", np.log1p(at.since_s), at.kind == "hold"),
        ("the logarithm of time since the corner at rest", np.log1p(at.since_s), at.kind == "rest"),
        ("time", at.time_s, everywhere),
    ]
    lines = []
    for words, axis, inside in axes:
        shape = rest.beyond(np.where(inside, axis, 0.0))[inside]
        if np.linalg.norm(shape) <= SEEN * np.linalg.norm(axis) or np.ptp(mean_n[inside]) == 0.0:
            continue
        r = float(np.corrcoef(shape, mean_n[inside])[0, 1])
        if r * r > FOLLOWS:
            lines.append(f"{'rises' if r > 0 else 'falls'} with {words} (r² = {r * r:.2f})")
    return lines
