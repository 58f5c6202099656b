"""Scores verdicts by comparison with their keys. It runs after all verdicts have been written.

A verdict is right if it names the concealed mechanisms and nothing else. It is right up to look-alikes if
each name stands for a concealed mechanism and lies in one of its groups (`LOOK_ALIKES`). A verdict whose own
group is not part of such a group is wrong, and so is a diagnosis that failed. The held-out error is that of
the full model, if the full model has made a fit, and is divided by the noise floor of the held-out part.

Besides recordings, single mechanisms are counted. One share tells how many of the mechanisms that add enough
to be named are named, whatever else is named. Another tells how many of the named mechanisms are concealed.
Shares have 90 % Wilson intervals. Those for parameters and for single mechanisms count recordings, because
the values of one recording depend on each other.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, permutations
from typing import Any

import numpy as np
from scipy.stats import norm

from bayeskin.mechanisms import catalogue
from bayeskin.proof.cases import CONCEALED
from bayeskin.proof.curves import FEWEST, curve
from bayeskin.proof.noise import floor_after
from bayeskin.proof.protocol import EDGES_S, HELD_OUT_FROM_S

# Groups that one force channel at one speed cannot tell apart. No other group is allowed.
LOOK_ALIKES = (
    {"solid-viscoelasticity", "strain-dependent-permeability", "friction-creep"},
    {"device-friction", "viscous-drag"},
    {"preconditioning", "pad-slip", "slow-recovery"},
    {"force-offset", "device-friction"},
)
# These two sets may be taken for each other, but only as whole sets.
TAKEN_FOR_EACH_OTHER = ({"pre-stretch"}, {"force-offset", "strain-stiffening"})
CLEAR = 3.0  # in multiples of the noise floor: effects of at least this size should be named
SIZE_EDGES = (0.0, 1.0, 1.5, 2.2, 3.0, 5.0, 8.0, 15.0, np.inf)  # of size classes, in multiples of the floor
WITHIN_SD = float(norm.ppf(0.95))
BASE = ("E_c", "E_s", "k_c", "k_s")
SEVERAL = "several names"
TOO_LARGE = "group too large"  # the group of look-alikes is larger than each group listed


@dataclass(frozen=True)
class Judged:
    """One verdict, compared with its key. `overlap` and `held_out` are None where they have no meaning.

    found : for each concealed mechanism whose own part is clear, whether it is named
    there : for each named mechanism, whether it is concealed
    """

    number: str
    label: str
    kind: str
    size: float
    answer: str
    named: tuple[str, ...]
    right: bool
    right_group: bool
    found: Mapping[str, bool]
    there: Mapping[str, bool]
    probability: float
    overlap: float | None
    inside: Mapping[str, bool]
    inside_base: Mapping[str, bool]
    held_out: float | None

    @property
    def clear(self) -> bool:
        return self.size >= CLEAR


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
        "clear_mechanisms_named": share_of_parts(verdict.found for verdict in inside),
        "named_mechanisms_there": share_of_parts(verdict.there for verdict in judged),
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


def judge(number: str, key: Mapping[str, Any], answer: Mapping[str, Any]) -> Judged:
    """Returns one answer of `bayeskin diagnose`, compared with its key."""
    truth, listed = set(key["mechanisms"]), answer.get("mechanisms", [])
    named = tuple(entry["name"] for entry in listed) if answer["verdict"] == "named" else ()
    right = bool(truth) and set(named) == truth
    allowed = all(is_listed(entry["name"], entry.get("group", ())) for entry in listed)
    probability = {entry["name"]: float(entry["probability"]) for entry in listed}
    fit = answer.get("fit", {}).get("after", {})
    parameters = {name: value for entry in listed for name, value in entry.get("parameters", {}).items()}
    best = fit if (fit.get("full_model") or {}).get("rmse_held_out") is None else fit["full_model"]
    held_out = best.get("rmse_held_out")
    return Judged(
        number=number,
        label=key["label"],
        kind=key["kind"],
        size=float(key["size"]),
        answer=_answer_label(answer["verdict"], named, truth, key["label"]) if allowed else TOO_LARGE,
        named=named,
        right=right and allowed,
        right_group=bool(truth) and allowed and (right or stands_for(set(named), truth)),
        found={
            name: name in named for name, part_n in key["sizes"].items() if part_n >= CLEAR * key["floor_n"]
        },
        there={name: name in truth for name in named},
        probability=min((probability.get(name, 0.0) for name in truth), default=0.0),
        overlap=overlap(
            key["windows"], [(window["t0"], window["t1"]) for window in answer.get("located", [])]
        ),
        inside=_in_interval(parameters, _in_order(key["values"], parameters)),
        inside_base=_in_interval(fit.get("theta", {}), {name: key["theta"][name] for name in BASE}),
        held_out=None if held_out is None else held_out / floor_after(key["floor_n"], HELD_OUT_FROM_S),
    )


def is_listed(name: str, group: Iterable[str]) -> bool:
    """Returns whether a mechanism and its group lie within one of the known groups of look-alikes.

    Mechanisms that no set conceals are ignored.
    """
    listed = (*LOOK_ALIKES, set.union(*TAKEN_FOR_EACH_OTHER))
    concealed = {name, *group} & set(CONCEALED)
    return name not in CONCEALED or len(concealed) == 1 or any(concealed <= known for known in listed)


def group_of(name: str) -> set[str]:
    """Returns the mechanism and all mechanisms that may be taken for it."""
    return {name}.union(*(group for group in LOOK_ALIKES if name in group))


def stands_for(named: set[str], truth: set[str]) -> bool:
    """Returns whether each mechanism of `named` can stand for one of `truth`, one to one.

    A mechanism can stand for itself and for its look-alikes.
    """
    if named in TAKEN_FOR_EACH_OTHER and truth in TAKEN_FOR_EACH_OTHER:
        return True
    if len(named) != len(truth):
        return False
    fixed = sorted(named)
    return any(
        all(n in group_of(t) for n, t in zip(fixed, order, strict=True)) for order in permutations(truth)
    )


def _answer_label(verdict: str, named: Sequence[str], truth: set[str], label: str) -> str:
    """Returns one word for an answer: the label of the case if it names exactly the concealed mechanisms."""
    if verdict != "named":
        return verdict
    if truth and set(named) == truth:
        return label
    return named[0] if len(named) == 1 else SEVERAL


def overlap(true: Iterable[Sequence[float]], said: Iterable[Sequence[float]]) -> float | None:
    """Returns the intersection over union, in bins, of two sets of windows [s]; None if both are empty."""
    true_bins, said_bins = _bins_within(true), _bins_within(said)
    union = int(np.sum(true_bins | said_bins))
    return float(np.sum(true_bins & said_bins) / union) if union else None


def _bins_within(windows: Iterable[Sequence[float]]) -> np.ndarray:
    """Returns a mask of the bins whose middles lie in one of the windows."""
    middle = 0.5 * (EDGES_S[1:] + EDGES_S[:-1])
    inside = np.zeros(len(middle), dtype=bool)
    for start, end in windows:
        inside |= (middle >= start) & (middle <= end)
    return inside


def _in_interval(said: Mapping[str, Any], truth: Mapping[str, float]) -> dict[str, bool]:
    """Returns, by name, whether the true value lies in the given 90 % interval, or in mean +- 1.645 sd.

    Parameters without either are left out.
    """
    inside = {}
    for name, value in truth.items():
        estimate = said.get(name)
        if not isinstance(estimate, Mapping):
            continue
        if "interval90" in estimate:
            low, high = estimate["interval90"]
        elif estimate.get("mean") is not None and estimate.get("sd") is not None:
            low, high = (estimate["mean"] + sign * WITHIN_SD * estimate["sd"] for sign in (-1.0, 1.0))
        else:
            continue
        inside[name] = bool(low <= value <= high)
    return inside


def _in_order(values: Mapping[str, float], said: Mapping[str, Any]) -> Mapping[str, float]:
    """Returns the true values, with the two steps of the load cell's zero in the order of the answer.

    The two steps are exchanged if the answer has them in the other order in time.
    """
    times = ("event_1_at", "event_2_at")
    if not all(name in values and isinstance(said.get(name), Mapping) for name in times):
        return values
    first, second = (said[name]["mean"] for name in times)
    if (values[times[0]] < values[times[1]]) == (first < second):
        return values
    exchanged = {"event_1_at": "event_2_at", "event_1_step": "event_2_step"}
    exchanged |= {second: first for first, second in exchanged.items()}
    return {name: values[exchanged.get(name, name)] for name in values}


def share(hits: Iterable[bool], among: int | None = None) -> dict[str, Any]:
    """Returns the number of hits, the number of values, the share of hits, and its 90 % interval.

    among : number of independent trials for the interval, if one trial gives several of the `hits`
    Source: Wilson, J. Am. Stat. Assoc. 22 (1927).
    """
    outcomes = list(hits)
    k, n = sum(outcomes), len(outcomes) if among is None else among
    if not outcomes:
        return {"hits": 0, "of": 0, "share": None, "low": None, "high": None}
    z2, p = WITHIN_SD**2, k / len(outcomes)
    middle = (p + z2 / (2 * n)) / (1 + z2 / n)
    half = WITHIN_SD * float(np.sqrt(p * (1 - p) / n + z2 / (4 * n * n))) / (1 + z2 / n)
    low, high = max(middle - half, 0.0), min(middle + half, 1.0)
    return {"hits": k, "of": len(outcomes), "share": p, "low": low, "high": high}


def share_of_parts(parts: Iterable[Mapping[str, bool]]) -> dict[str, Any]:
    """Returns the `share` of all values of several recordings. Its interval counts the recordings."""
    known = [part for part in parts if part]
    return share((value for part in known for value in part.values()), len(known))


def median(values: Iterable[float | None]) -> dict[str, Any]:
    """Returns the median and the quartiles of the values that are not None."""
    known = [value for value in values if value is not None]
    if not known:
        return {"of": 0, "median": None, "low": None, "high": None}
    low, middle, high = (float(q) for q in np.quantile(known, (0.25, 0.5, 0.75)))
    return {"of": len(known), "median": middle, "low": low, "high": high}


def _by_class(found: Sequence[Judged], of: Callable[[list[Judged]], dict[str, Any]]) -> dict[str, Any]:
    """Returns `of` for the verdicts on clear effects, and for those on smaller effects."""
    return {"clear": of([v for v in found if v.clear]), "below": of([v for v in found if not v.clear])}


def confusion(found: Iterable[Judged]) -> dict[str, dict[str, int]]:
    """Returns how often each answer was given, by concealed effect.

    Effects outside the catalogue share one row, and so do pairs.
    """
    rows: dict[str, Counter[str]] = {}
    for verdict in found:
        row = verdict.kind if verdict.kind in ("pair", "outside") else verdict.label
        answer = "both" if verdict.kind == "pair" and verdict.right else verdict.answer
        rows.setdefault(row, Counter())[answer] += 1
    order = ["nothing", *sorted(catalogue()), "pair", "outside"]
    return {row: dict(rows[row]) for row in order if row in rows}


def detectability(found: Sequence[Judged]) -> list[dict[str, Any]]:
    """Returns, by size, the share named right, the share right up to look-alikes, and the mean probability.

    The probability is that of the concealed mechanisms.
    """
    rows = []
    for low, high in pairwise(SIZE_EDGES):
        group = [verdict for verdict in found if low <= verdict.size < high]
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


def _row(one: Judged) -> dict[str, Any]:
    return {**vars(one), "named": list(one.named)}
