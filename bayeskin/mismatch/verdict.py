"""What a search says: nothing missing, named mechanisms, or unknown.

Nothing is missing where the model alone has most of the weight and no window is found. A mechanism is named
where it, or its group of look-alikes together, is more probable than not, if what is named explains more than
half of the squared residual beyond what is allowed. Otherwise the mismatch is unknown.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from bayeskin.mechanisms import Mechanism
from bayeskin.mismatch.locate import Located
from bayeskin.mismatch.search import Search

PROBABLE = 0.5
EXPLAINED = 0.5


@dataclass(frozen=True)
class Named:
    """One mechanism of the best set: probabilities of itself and of its group, parameters' means and sds."""

    name: str
    probability: float
    group: tuple[str, ...]
    group_probability: float
    parameters: Mapping[str, tuple[float, float, str]]
    statement: str


@dataclass(frozen=True)
class Diagnosis:
    """The verdict, what is named, and the share of the squared residual that it explains."""

    verdict: Literal["nothing-missing", "named", "unknown"]
    named: tuple[Named, ...]
    explained: float


def judge(found: Search, known: Mapping[str, Mechanism], before: Located, after: Located) -> Diagnosis:
    """The verdict on a search; `before` and `after` are located at its base and at its best set."""
    best, explained = found.best, explained_share(before, after)
    named = tuple(
        one for name in best.names if (one := _named(found, known[name])).group_probability > PROBABLE
    )
    if not best.names and not before.windows:
        return Diagnosis("nothing-missing", (), 0.0)
    if named and (explained > EXPLAINED or not after.windows):
        return Diagnosis("named", named, explained)
    return Diagnosis("unknown", (), explained)


def explained_share(before: Located, after: Located) -> float:
    """Of the squared residual beyond what is allowed."""

    def beyond(one: Located) -> float:
        return max(float(np.mean(one.residual_n**2) - np.mean(one.allowed_n**2)), 0.0)

    whole = beyond(before)
    return 1.0 - beyond(after) / whole if whole > 0.0 else 0.0


def _named(found: Search, mechanism: Mechanism) -> Named:
    best = found.best
    values = {
        p.name: (*best.mean_and_sd(p.name), p.unit) for p in mechanism.parameters if p.name in best.theta
    }
    at_best = {**mechanism.neutral, **best.theta}
    return Named(
        mechanism.name, found.probability([mechanism.name]), mechanism.group,
        found.probability(mechanism.group), values, mechanism.statement(at_best),
    )  # fmt: skip
