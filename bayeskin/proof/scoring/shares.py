"""Shares of hits with their intervals, and medians with their quartiles."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from scipy.stats import norm

WITHIN_SD = float(norm.ppf(0.95))  # half of a 90 % interval, in sd


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
