"""What verdicts are worth beside their keys: runs after all verdicts are written.

A verdict names right when it names what is concealed and nothing else; it is right up to look-alikes when
each name it gives stands for one that is concealed and lies in one of its groups (`LOOK_ALIKES`). A verdict
whose own group is larger than one of those is wrong, and so is a diagnosis that failed. What is held out is
the full model's, where that has made a fit, over the floor of what is held out. Beside recordings single
mechanisms are counted: how many of those that add enough to be named are, whatever else is, and how many of
the named are there. Shares have 90 % Wilson intervals; those of parameters and of single mechanisms count
recordings, since those of one go together.
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

# What one force channel at one speed cannot tell apart; no other group is allowed.
LOOK_ALIKES = (
    {"solid-viscoelasticity", "strain-dependent-permeability", "friction-creep"},
    {"device-friction", "viscous-drag"},
    {"preconditioning", "pad-slip", "slow-recovery"},
    {"force-offset", "device-friction"},
)
TAKEN_FOR_EACH_OTHER = ({"pre-stretch"}, {"force-offset", "strain-stiffening"})  # only both together
CLEAR = 3.0  # of the floor: sizes from here on are to be named
SIZE_EDGES = (0.0, 1.0, 1.5, 2.2, 3.0, 5.0, 8.0, 15.0, np.inf)  # eight sizes, of the floor
WITHIN_SD = float(norm.ppf(0.95))
BASE = ("E_c", "E_s", "k_c", "k_s")
SEVERAL = "several names"
TOO_LARGE = "group too large"  # of look-alikes, larger than any that is listed


@dataclass(frozen=True)
class Judged:
    """One verdict beside its key. Overlap and ratio are None where they have no meaning.

    found : whether each concealed mechanism whose own part is clear is named; there : whether each named one
    is concealed
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
    """The scoreboard of the numbers that have both a key and an answer; plain numbers, lists and text."""
    numbers = sorted(set(keys) & set(answers))
    found = [judge(number, keys[number], answers[number]) for number in numbers]
    nothing = [one for one in found if one.kind == "nothing"]
    outside = [one for one in found if one.kind == "outside"]
    inside = [one for one in found if one.kind in ("alone", "pair")]
    right = [one for one in inside if one.right]
    return {
        "recordings": len(keys),
        "judged": len(found),
        "false_alarms": share(one.answer != "nothing-missing" for one in nothing),
        "named": _by_class(inside, lambda some: share(one.right for one in some)),
        "named_up_to_look_alikes": _by_class(inside, lambda some: share(one.right_group for one in some)),
        "clear_mechanisms_named": share_of_parts(one.found for one in inside),
        "named_mechanisms_there": share_of_parts(one.there for one in found),
        "unknown_outside": _by_class(outside, lambda some: share(one.answer == "unknown" for one in some)),
        "location_overlap": _by_class([*inside, *outside], lambda some: median(o.overlap for o in some)),
        "effect_in_interval": _by_class(right, lambda some: share_of_parts(o.inside for o in some)),
        "base_in_interval": _by_class(right, lambda some: share_of_parts(o.inside_base for o in some)),
        "base_in_interval_nothing": share_of_parts(one.inside_base for one in nothing),
        "held_out_over_floor": {
            "nothing": median(one.held_out for one in nothing),
            **_by_class(right, lambda some: median(one.held_out for one in some)),
        },
        "confusion": confusion(found),
        "detectability": detectability(inside),
        "by_mechanism": by_mechanism([one for one in inside if one.kind == "alone"]),
        "each": [_row(one) for one in found],
    }


def judge(number: str, key: Mapping[str, Any], answer: Mapping[str, Any]) -> Judged:
    """One answer of `bayeskin diagnose` beside its key."""
    truth, said = set(key["mechanisms"]), answer.get("mechanisms", [])
    named = tuple(one["name"] for one in said) if answer["verdict"] == "named" else ()
    right = bool(truth) and set(named) == truth
    allowed = all(is_listed(one["name"], one.get("group", ())) for one in said)
    probable = {one["name"]: float(one["probability"]) for one in said}
    fit = answer.get("fit", {}).get("after", {})
    parameters = {name: one for mechanism in said for name, one in mechanism.get("parameters", {}).items()}
    best = fit if (fit.get("full_model") or {}).get("rmse_held_out") is None else fit["full_model"]
    held_out = best.get("rmse_held_out")
    return Judged(
        number=number,
        label=key["label"],
        kind=key["kind"],
        size=float(key["size"]),
        answer=_label(answer["verdict"], named, truth, key["label"]) if allowed else TOO_LARGE,
        named=named,
        right=right and allowed,
        right_group=bool(truth) and allowed and (right or stands_for(set(named), truth)),
        found={
            name: name in named for name, part_n in key["sizes"].items() if part_n >= CLEAR * key["floor_n"]
        },
        there={name: name in truth for name in named},
        probability=min((probable.get(name, 0.0) for name in truth), default=0.0),
        overlap=overlap(key["windows"], [(one["t0"], one["t1"]) for one in answer.get("located", [])]),
        inside=_inside(parameters, _in_order(key["values"], parameters)),
        inside_base=_inside(fit.get("theta", {}), {name: key["theta"][name] for name in BASE}),
        held_out=None if held_out is None else held_out / floor_after(key["floor_n"], HELD_OUT_FROM_S),
    )


def is_listed(name: str, group: Iterable[str]) -> bool:
    """Returns whether a mechanism and its group, as far as sets conceal these, are known to look alike."""
    listed = (*LOOK_ALIKES, set.union(*TAKEN_FOR_EACH_OTHER))
    concealed = {name, *group} & set(CONCEALED)
    return name not in CONCEALED or len(concealed) == 1 or any(concealed <= known for known in listed)


def group_of(name: str) -> set[str]:
    """The mechanism and all that may be taken for it."""
    return {name}.union(*(group for group in LOOK_ALIKES if name in group))


def stands_for(named: set[str], truth: set[str]) -> bool:
    """Whether each of `named` can be put in the place of one of `truth`, one to one, as its look-alike."""
    if named in TAKEN_FOR_EACH_OTHER and truth in TAKEN_FOR_EACH_OTHER:
        return True
    if len(named) != len(truth):
        return False
    fixed = sorted(named)
    return any(all(n in group_of(t) for n, t in zip(fixed, o, strict=True)) for o in permutations(truth))


def _label(verdict: str, named: Sequence[str], truth: set[str], label: str) -> str:
    """One word for what was said: the case's own label where it names just that."""
    if verdict != "named":
        return verdict
    if truth and set(named) == truth:
        return label
    return named[0] if len(named) == 1 else SEVERAL


def overlap(true: Iterable[Sequence[float]], said: Iterable[Sequence[float]]) -> float | None:
    """Intersection over union, in bins, of two sets of windows [s]; None where both are empty."""
    one, other = _bins(true), _bins(said)
    union = int(np.sum(one | other))
    return float(np.sum(one & other) / union) if union else None


def _bins(windows: Iterable[Sequence[float]]) -> np.ndarray:
    middle = 0.5 * (EDGES_S[1:] + EDGES_S[:-1])
    inside = np.zeros(len(middle), dtype=bool)
    for start, end in windows:
        inside |= (middle >= start) & (middle <= end)
    return inside


def _inside(said: Mapping[str, Any], truth: Mapping[str, float]) -> dict[str, bool]:
    """Whether each true value lies in the 90 % interval given, or in mean +- 1.645 sd."""
    found = {}
    for name, value in truth.items():
        one = said.get(name)
        if not isinstance(one, Mapping):
            continue
        if "interval90" in one:
            low, high = one["interval90"]
        elif one.get("mean") is not None and one.get("sd") is not None:
            low, high = (one["mean"] + sign * WITHIN_SD * one["sd"] for sign in (-1.0, 1.0))
        else:
            continue
        found[name] = bool(low <= value <= high)
    return found


def _in_order(values: Mapping[str, float], said: Mapping[str, Any]) -> Mapping[str, float]:
    """The truth, its two steps of the load cell's zero in the order in time of those that are said."""
    times = ("event_1_at", "event_2_at")
    if not all(name in values and isinstance(said.get(name), Mapping) for name in times):
        return values
    first, second = (said[name]["mean"] for name in times)
    if (values[times[0]] < values[times[1]]) == (first < second):
        return values
    other = {"event_1_at": "event_2_at", "event_1_step": "event_2_step"}
    other |= {second: first for first, second in other.items()}
    return {name: values[other.get(name, name)] for name in values}


def share(hits: Iterable[bool], among: int | None = None) -> dict[str, Any]:
    """How many of how many, their share, its 90 % interval after Wilson (J. Am. Stat. Assoc. 22, 1927).

    among : the number of trials, where several hits are of one
    """
    said = list(hits)
    k, n = sum(said), len(said) if among is None else among
    if not said:
        return {"hits": 0, "of": 0, "share": None, "low": None, "high": None}
    z2, p = WITHIN_SD**2, k / len(said)
    middle = (p + z2 / (2 * n)) / (1 + z2 / n)
    half = WITHIN_SD * float(np.sqrt(p * (1 - p) / n + z2 / (4 * n * n))) / (1 + z2 / n)
    low, high = max(middle - half, 0.0), min(middle + half, 1.0)
    return {"hits": k, "of": len(said), "share": p, "low": low, "high": high}


def share_of_parts(parts: Iterable[Mapping[str, bool]]) -> dict[str, Any]:
    """`share` of all values of several recordings, whose interval counts the recordings."""
    known = [part for part in parts if part]
    return share((value for part in known for value in part.values()), len(known))


def median(values: Iterable[float | None]) -> dict[str, Any]:
    """Median of those that are not None, with quartiles."""
    known = [value for value in values if value is not None]
    if not known:
        return {"of": 0, "median": None, "low": None, "high": None}
    low, middle, high = (float(q) for q in np.quantile(known, (0.25, 0.5, 0.75)))
    return {"of": len(known), "median": middle, "low": low, "high": high}


def _by_class(found: Sequence[Judged], of: Callable[[list[Judged]], dict[str, Any]]) -> dict[str, Any]:
    return {"clear": of([o for o in found if o.clear]), "below": of([o for o in found if not o.clear])}


def confusion(found: Iterable[Judged]) -> dict[str, dict[str, int]]:
    """How often each answer was given, by what was concealed; what is outside and pairs are one row each."""
    rows: dict[str, Counter[str]] = {}
    for one in found:
        row = one.kind if one.kind in ("pair", "outside") else one.label
        answer = "both" if one.kind == "pair" and one.right else one.answer
        rows.setdefault(row, Counter())[answer] += 1
    order = ["nothing", *sorted(catalogue()), "pair", "outside"]
    return {row: dict(rows[row]) for row in order if row in rows}


def detectability(found: Sequence[Judged]) -> list[dict[str, Any]]:
    """Share named right, up to look-alikes, and mean probability of what is concealed, by size."""
    rows = []
    for low, high in pairwise(SIZE_EDGES):
        some = [one for one in found if low <= one.size < high]
        rows.append(
            {
                "from": low,
                "to": None if np.isinf(high) else high,
                "size": float(np.median([one.size for one in some])) if some else None,
                "named": share(one.right for one in some),
                "up_to_look_alikes": share(one.right_group for one in some),
                "probability": float(np.mean([one.probability for one in some])) if some else None,
            }
        )
    return rows


def by_mechanism(alone: Sequence[Judged]) -> dict[str, dict[str, Any]]:
    """Of each mechanism that is concealed by itself often enough: every answer by size, and their curve."""
    found = {}
    for name in sorted({one.label for one in alone}):
        some = sorted((one for one in alone if one.label == name), key=lambda one: one.size)
        if len(some) >= FEWEST:
            sizes, right = [one.size for one in some], [one.right for one in some]
            up_to = [one.right_group for one in some]
            found[name] = {"sizes": sizes, "right": right, "up_to": up_to, "curve": curve(sizes, right)}
    return found


def _row(one: Judged) -> dict[str, Any]:
    return {**vars(one), "named": list(one.named)}
