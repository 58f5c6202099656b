"""Describes in plain words where a discrepancy is large, how it changes, and what it correlates with."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayeskin.mismatch.unexplained import Place, Unexplained
from bayeskin.types import Array

CERTAIN = 2.0  # standard deviations from zero beyond which a discrepancy is certain
WIDESPREAD = 0.25  # share of the bins of a kind of phase that must be certain
CHANGED = 1.5  # ratio of the last cycle's size to the first cycle's from which it has changed
FOLLOWS = 0.5  # squared correlation from which a discrepancy follows a coordinate
SEEN = 1e-3  # smallest share of a coordinate's norm that must remain after the parameters' part is removed
WORDS = {"rest": "at rest", "load": "while loading", "hold": "in holds", "unload": "while unloading"}


def describe(rest: Unexplained, mean_n: Array, sd_n: Array) -> tuple[str, ...]:
    """Returns sentences that describe a discrepancy of given mean and sd, (k,) each [N].

    They say in which phases it is certain, its sign, its trend over the cycles, and the coordinates that it
    correlates with.
    """
    at, certain = rest.at, np.abs(mean_n) > CERTAIN * sd_n
    sentences = [_in_phases(kind, at, mean_n, certain) for kind in WORDS]
    sentences += [_over_cycles(at, mean_n, certain), *_correlations(rest, mean_n)]
    return tuple(sentence for sentence in sentences if sentence)


def _in_phases(kind: str, at: Place, mean_n: Array, certain: NDArray[np.bool_]) -> str:
    """Returns the size and sign of a discrepancy in one kind of phase, if enough of its bins are certain."""
    inside = at.kind == kind
    if not inside.any() or np.mean(certain[inside]) < WIDESPREAD:
        return ""
    level, size = float(np.mean(mean_n[inside])), float(np.sqrt(np.mean(mean_n[inside] ** 2)))
    if abs(level) < 0.5 * size:
        return f"{WORDS[kind]} the difference changes its sign and is {1e3 * size:.1f} mN RMS"
    side = "above" if level > 0 else "below"
    return f"{WORDS[kind]} the recorded force is {1e3 * abs(level):.1f} mN {side} the model's on average"


def _over_cycles(at: Place, mean_n: Array, certain: NDArray[np.bool_]) -> str:
    """Returns how the size of a discrepancy changes from the first cycle to the last."""
    cycles = [cycle for cycle in np.unique(at.cycle) if cycle > 0]
    if len(cycles) < 2 or not certain.any():
        return ""
    size = [float(np.sqrt(np.mean(mean_n[at.cycle == cycle] ** 2))) for cycle in cycles]
    ratio = size[-1] / size[0] if size[0] > 0.0 else np.inf
    if 1.0 / CHANGED < ratio < CHANGED:
        return "the difference is about as large in the last cycle as in the first"
    return (
        f"the difference {'grows' if ratio > 1.0 else 'shrinks'} from {1e3 * size[0]:.1f} to "
        f"{1e3 * size[-1]:.1f} mN RMS between cycle {cycles[0]:.0f} and cycle {cycles[-1]:.0f}"
    )


def _correlations(remainder: Unexplained, mean_n: Array) -> list[str]:
    """Returns the coordinates that a discrepancy correlates with.

    Only the part of a coordinate that the parameters cannot explain is compared.
    """
    at, everywhere = remainder.at, np.ones(len(mean_n), bool)
    coordinates = [
        ("displacement while the pads move", at.displacement_m, at.direction != 0.0),
        ("displacement over all phases", at.displacement_m, everywhere),
        ("the signed speed", at.speed_m_s, everywhere),
        ("the logarithm of the time in a hold", np.log1p(at.since_s), at.kind == "hold"),
        ("the logarithm of the time at rest", np.log1p(at.since_s), at.kind == "rest"),
        ("time", at.time_s, everywhere),
    ]
    sentences = []
    for description, coordinate, inside in coordinates:
        part = remainder.beyond(np.where(inside, coordinate, 0.0))[inside]
        if np.linalg.norm(part) <= SEEN * np.linalg.norm(coordinate) or np.ptp(mean_n[inside]) == 0.0:
            continue
        r = float(np.corrcoef(part, mean_n[inside])[0, 1])
        if r * r > FOLLOWS:
            sentences.append(
                f"the difference {'rises' if r > 0 else 'falls'} with {description} (r² = {r * r:.2f})"
            )
    return sentences
