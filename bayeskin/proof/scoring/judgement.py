"""Compares one verdict with its key.

A verdict is right if it names the concealed mechanisms and nothing else. It is right up to look-alikes if
each name stands for a concealed mechanism and lies in one of its groups (`LOOK_ALIKES`). A verdict whose own
group is not part of such a group is wrong, and so is a diagnosis that failed. The held-out error is that of
the full model, if the full model has made a fit, and is divided by the noise floor of the held-out part.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayeskin.proof.noise import floor_after
from bayeskin.proof.protocol import EDGES_S, HELD_OUT_FROM_S
from bayeskin.proof.scoring.look_alikes import is_listed, stands_for
from bayeskin.proof.scoring.shares import WITHIN_SD

CLEAR = 3.0  # noise floors; effects of at least this size should be named
BASE = ("E_c", "E_s", "k_c", "k_s")
SEVERAL = "several names"
TOO_LARGE = "group too large"  # the group of look-alikes is larger than each group listed


@dataclass(frozen=True)
class Judged:
    """One verdict, compared with its key. `overlap` and `held_out` are None where they have no meaning.

    clear_parts_named : for each concealed mechanism whose own part is clear, whether it is named
    names_concealed : for each named mechanism, whether it is concealed
    """

    number: str
    label: str
    kind: str
    size: float
    answer: str
    named: tuple[str, ...]
    right: bool
    right_group: bool
    clear_parts_named: Mapping[str, bool]
    names_concealed: Mapping[str, bool]
    probability: float
    overlap: float | None
    inside: Mapping[str, bool]
    inside_base: Mapping[str, bool]
    held_out: float | None

    @property
    def clear(self) -> bool:
        """Returns whether the effect is so large that it should be named."""
        return self.size >= CLEAR


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
        clear_parts_named={
            name: name in named for name, part_n in key["sizes"].items() if part_n >= CLEAR * key["floor_n"]
        },
        names_concealed={name: name in truth for name in named},
        probability=min((probability.get(name, 0.0) for name in truth), default=0.0),
        overlap=overlap(
            key["windows"], [(window["t0"], window["t1"]) for window in answer.get("located", [])]
        ),
        inside=_in_interval(parameters, _in_order(key["values"], parameters)),
        inside_base=_in_interval(fit.get("theta", {}), {name: key["theta"][name] for name in BASE}),
        held_out=None if held_out is None else held_out / floor_after(key["floor_n"], HELD_OUT_FROM_S),
    )


def _answer_label(verdict: str, named: Sequence[str], truth: set[str], label: str) -> str:
    """Returns one word for an answer: the label of the case if it names exactly the concealed mechanisms."""
    if verdict != "named":
        return verdict
    if truth and set(named) == truth:
        return label
    return named[0] if len(named) == 1 else SEVERAL


def overlap(true: Iterable[Sequence[float]], located: Iterable[Sequence[float]]) -> float | None:
    """Returns the intersection over union, in bins, of two sets of windows [s]; None if both are empty."""
    true_bins, located_bins = _bins_within(true), _bins_within(located)
    union = int(np.sum(true_bins | located_bins))
    return float(np.sum(true_bins & located_bins) / union) if union else None


def _bins_within(windows: Iterable[Sequence[float]]) -> NDArray[np.bool_]:
    """Returns a mask of the bins whose middles lie in one of the windows."""
    middle = 0.5 * (EDGES_S[1:] + EDGES_S[:-1])
    inside = np.zeros(len(middle), dtype=bool)
    for start, end in windows:
        inside |= (middle >= start) & (middle <= end)
    return inside


def _in_interval(estimates: Mapping[str, Any], truth: Mapping[str, float]) -> dict[str, bool]:
    """Returns, by name, whether the true value lies in the given 90 % interval, or in mean +- 1.645 sd.

    Parameters without either are left out.
    """
    inside = {}
    for name, value in truth.items():
        estimate = estimates.get(name)
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


def _in_order(values: Mapping[str, float], estimates: Mapping[str, Any]) -> Mapping[str, float]:
    """Returns the true values, with the two steps of the load cell's zero in the order of the answer.

    The two steps are exchanged if the answer has them in the other order in time.
    """
    times = ("event_1_at", "event_2_at")
    if not all(name in values and isinstance(estimates.get(name), Mapping) for name in times):
        return values
    first, second = (estimates[name]["mean"] for name in times)
    if (values[times[0]] < values[times[1]]) == (first < second):
        return values
    exchanged = {"event_1_at": "event_2_at", "event_1_step": "event_2_step"}
    exchanged |= {second: first for first, second in exchanged.items()}
    return {name: values[exchanged.get(name, name)] for name in values}
