"""Scores verdicts by comparison with their keys. It runs after all verdicts have been written.

Besides recordings, single mechanisms are counted. One share tells how many of the mechanisms that add enough
to be named are named, whatever else is named. Another tells how many of the named mechanisms are concealed.
Shares have 90 % Wilson intervals. Those for parameters and for single mechanisms count recordings, because
the values of one recording depend on each other.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from bayeskin.mechanisms import catalogue
from bayeskin.proof.scoring.curves import FEWEST, curve
from bayeskin.proof.scoring.judgement import Judged, judge
from bayeskin.proof.scoring.shares import median, share, share_of_parts

SIZE_EDGES = (0.0, 1.0, 1.5, 2.2, 3.0, 5.0, 8.0, 15.0, np.inf)  # edges of size classes, in noise floors


def score(keys: Mapping[str, Mapping[str, Any]], answers: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Returns the scoreboard of the recordings that have both a key and an answer.

    It consists of plain numbers, lists and text.
    """
    numbers = sorted(set(keys) & set(answers))
    judged = [judge(number, keys[number], answers[number]) for number in numbers]
    nothing = [verdict for verdict in judged if verdict.kind == "nothing"]
    outside = [verdict for verdict in judged if verdict.kind == "outside"]
    inside = [verdict for verdict in judged if verdict.kind in ("alone", "pair")]
    right = [verdict for verdict in inside if verdict.right]
    return {
        "recordings": len(keys),
        "judged": len(judged),
        "false_alarms": share(verdict.answer != "nothing-missing" for verdict in nothing),
        "named": _by_class(inside, lambda group: share(v.right for v in group)),
        "named_up_to_look_alikes": _by_class(inside, lambda group: share(v.right_group for v in group)),
        "clear_mechanisms_named": share_of_parts(verdict.clear_parts_named for verdict in inside),
        "named_mechanisms_there": share_of_parts(verdict.names_concealed for verdict in judged),
        "unknown_outside": _by_class(outside, lambda group: share(v.answer == "unknown" for v in group)),
        "location_overlap": _by_class([*inside, *outside], lambda group: median(v.overlap for v in group)),
        "effect_in_interval": _by_class(right, lambda group: share_of_parts(v.inside for v in group)),
        "base_in_interval": _by_class(right, lambda group: share_of_parts(v.inside_base for v in group)),
        "base_in_interval_nothing": share_of_parts(verdict.inside_base for verdict in nothing),
        "held_out_over_floor": {
            "nothing": median(verdict.held_out for verdict in nothing),
            **_by_class(right, lambda group: median(v.held_out for v in group)),
        },
        "confusion": confusion(judged),
        "detectability": detectability(inside),
        "by_mechanism": by_mechanism([verdict for verdict in inside if verdict.kind == "alone"]),
        "each": [_row(verdict) for verdict in judged],
    }


def _by_class(verdicts: Sequence[Judged], count: Callable[[list[Judged]], dict[str, Any]]) -> dict[str, Any]:
    """Returns `count` of the verdicts on clear effects, and of those on smaller effects."""
    clear, below = [v for v in verdicts if v.clear], [v for v in verdicts if not v.clear]
    return {"clear": count(clear), "below": count(below)}


def confusion(verdicts: Iterable[Judged]) -> dict[str, dict[str, int]]:
    """Returns how often each answer was given, by concealed effect.

    Effects outside the catalogue share one row, and so do pairs.
    """
    rows: dict[str, Counter[str]] = {}
    for verdict in verdicts:
        row = verdict.kind if verdict.kind in ("pair", "outside") else verdict.label
        answer = "both" if verdict.kind == "pair" and verdict.right else verdict.answer
        rows.setdefault(row, Counter())[answer] += 1
    order = ["nothing", *sorted(catalogue()), "pair", "outside"]
    return {row: dict(rows[row]) for row in order if row in rows}


def detectability(verdicts: Sequence[Judged]) -> list[dict[str, Any]]:
    """Returns, by size, the share named right, the share right up to look-alikes, and the mean probability.

    The probability is that of the concealed mechanisms.
    """
    rows = []
    for low, high in pairwise(SIZE_EDGES):
        group = [verdict for verdict in verdicts if low <= verdict.size < high]
        rows.append(
            {
                "from": low,
                "to": None if np.isinf(high) else high,
                "size": float(np.median([verdict.size for verdict in group])) if group else None,
                "named": share(verdict.right for verdict in group),
                "up_to_look_alikes": share(verdict.right_group for verdict in group),
                "probability": float(np.mean([verdict.probability for verdict in group])) if group else None,
            }
        )
    return rows


def by_mechanism(alone: Sequence[Judged]) -> dict[str, dict[str, Any]]:
    """Returns the answers by size, and their curve, for each mechanism.

    The mechanism has to be concealed alone in at least `FEWEST` recordings.
    """
    curves = {}
    for name in sorted({verdict.label for verdict in alone}):
        group = sorted((v for v in alone if v.label == name), key=lambda verdict: verdict.size)
        if len(group) >= FEWEST:
            sizes, right = [verdict.size for verdict in group], [verdict.right for verdict in group]
            up_to = [verdict.right_group for verdict in group]
            curves[name] = {"sizes": sizes, "right": right, "up_to": up_to, "curve": curve(sizes, right)}
    return curves


def _row(verdict: Judged) -> dict[str, Any]:
    """Returns the entry of a verdict in the scoreboard."""
    keys = {"clear_parts_named": "found", "names_concealed": "there"}
    return {keys.get(name, name): value for name, value in vars(verdict).items()} | {
        "named": list(verdict.named)
    }
