"""Describes in plain words where a discrepancy is large, how it changes, and what it correlates with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayeskin.mismatch.unexplained import UNEXPLAINED, Place, Unexplained
from bayeskin.types import PHASE_IN_WORDS, Array, PhaseKind


@dataclass(frozen=True)
class FeatureSettings:
    """Thresholds with which a discrepancy is described.

    certain : number of standard deviations from zero beyond which a discrepancy is certain
    widespread : share of the bins of a kind of phase that must be certain
    one_sided : ratio of mean to RMS from which a discrepancy has one sign
    changed : ratio of the last cycle's size to the first cycle's from which it has changed
    follows : squared correlation from which a discrepancy follows a coordinate
    """

    certain: float = 2.0
    widespread: float = 0.25
    one_sided: float = 0.5
    changed: float = 1.5
    follows: float = 0.5


def describe(
    remainder: Unexplained, mean_n: Array, sd_n: Array, settings: FeatureSettings = FeatureSettings()
) -> tuple[str, ...]:
    """Returns sentences that describe a discrepancy of given mean and sd, (k,) each [N].

    They say in which phases it is certain, its sign, its trend over the cycles, and the coordinates that it
    correlates with.
    """
    at, certain = remainder.at, np.abs(mean_n) > settings.certain * sd_n
    sentences = [_in_phases(kind, at, mean_n, certain, settings) for kind in PHASE_IN_WORDS]
    sentences += [_over_cycles(at, mean_n, certain, settings), *_correlations(remainder, mean_n, settings)]
    return tuple(sentence for sentence in sentences if sentence)


def _in_phases(
    kind: PhaseKind, at: Place, mean_n: Array, certain: NDArray[np.bool_], settings: FeatureSettings
) -> str:
    """Returns the size and sign of a discrepancy in one kind of phase, if enough of its bins are certain."""
    inside = at.kind == kind
    if not inside.any() or np.mean(certain[inside]) < settings.widespread:
        return ""
    level, size = float(np.mean(mean_n[inside])), float(np.sqrt(np.mean(mean_n[inside] ** 2)))
    if abs(level) < settings.one_sided * size:
        return f"{PHASE_IN_WORDS[kind]} the difference changes its sign and is {1e3 * size:.1f} mN RMS"
    side = "above" if level > 0 else "below"
    mean_mn = f"{1e3 * abs(level):.1f} mN"
    return f"{PHASE_IN_WORDS[kind]} the recorded force is {mean_mn} {side} the model's on average"


def _over_cycles(at: Place, mean_n: Array, certain: NDArray[np.bool_], settings: FeatureSettings) -> str:
    """Returns how the size of a discrepancy changes from the first cycle to the last."""
    cycles = [cycle for cycle in np.unique(at.cycle) if cycle > 0]
    if len(cycles) < 2 or not certain.any():
        return ""
    size = [float(np.sqrt(np.mean(mean_n[at.cycle == cycle] ** 2))) for cycle in cycles]
    ratio = size[-1] / size[0] if size[0] > 0.0 else np.inf
    if 1.0 / settings.changed < ratio < settings.changed:
        return "the difference is about as large in the last cycle as in the first"
    return (
        f"the difference {'grows' if ratio > 1.0 else 'shrinks'} from {1e3 * size[0]:.1f} to "
        f"{1e3 * size[-1]:.1f} mN RMS between cycle {cycles[0]:.0f} and cycle {cycles[-1]:.0f}"
    )


def _correlations(remainder: Unexplained, mean_n: Array, settings: FeatureSettings) -> list[str]:
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
        hidden = np.linalg.norm(part) <= UNEXPLAINED.seen * np.linalg.norm(coordinate)
        if hidden or np.ptp(mean_n[inside]) == 0.0:
            continue
        r = float(np.corrcoef(part, mean_n[inside])[0, 1])
        if r * r > settings.follows:
            sentences.append(
                f"the difference {'rises' if r > 0 else 'falls'} with {description} (r² = {r * r:.2f})"
            )
    return sentences
