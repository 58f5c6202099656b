"""What a search says: nothing missing, named mechanisms, or unknown.

A mechanism is named where it, or a look-alike in its place, has nine chances in ten, and leaving it out of
its set costs more than the full model's own error, if no window is left or what is named explains nine tenths
of the squared residual beyond what is allowed. Where the full model was fitted, its evidence has to be
for the set, too. And the set has to be nine times as probable as something smooth without a name in its
place (`discrepancy`), which bends as it likes and pays for that, and to predict phases left out better than
the model without it. Nothing is missing where none is named and no window is found, or what goes beyond the
allowed is within the model's own error. Otherwise the mismatch is unknown.

The probability that something acts which no set has is at most that of Sellke, Bayarri & Berger (2001,
The American Statistician 55:62): where the farthest window that the believed fit leaves (of the best set, or
of none) is met by chance with probability p < 1/e, no alternative of a broad class makes it likelier by more
than 1 / (-e p ln p). Before the recording is seen it is taken to be as probable as any one mechanism.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import xlogy

from bayeskin.mechanisms import Mechanism
from bayeskin.mismatch.fit import Fit
from bayeskin.mismatch.locate import Located, model_error
from bayeskin.mismatch.search import PRIOR, Search

PROBABLE = 0.9
EXPLAINED = 0.9
NOTICEABLE = 2.0  # of the full model's own error


@dataclass(frozen=True)
class Named:
    """One mechanism of the best set: probabilities of itself, and of it or a look-alike not in the set.

    explains_n : RMS of what the set explains and would not without it
    """

    name: str
    probability: float
    group: tuple[str, ...]
    group_probability: float
    explains_n: float


@dataclass(frozen=True)
class Diagnosis:
    """The verdict, what is named, and the share of the squared residual that it explains.

    unknown_probability : at most, that something acts which is outside the catalogue
    believed : whether the evidence is for the best set
    """

    verdict: Literal["nothing-missing", "named", "unknown"]
    named: tuple[Named, ...]
    explained: float
    unknown_probability: float
    believed: bool


@dataclass(frozen=True)
class Evidence:
    """Logarithms of the evidence of a fit, and of it with something smooth without a name beside it."""

    alone: float
    with_more: float


def set_probability(names: Sequence[str], without: Evidence, best: Evidence) -> float:
    """Of the best set, alone or beside something without a name, against none of it, likewise."""
    odds = float(np.log(PRIOR / (1.0 - PRIOR)))
    logs = np.array([without.alone, without.with_more + odds, best.alone, best.with_more + odds])
    logs[2:] += len(names) * odds
    share = np.exp(logs - logs.max())
    return float(share[2:].sum() / share.sum())


def judge(
    found: Search, known: Mapping[str, Mechanism], before: Located, after: Located,
    full_weights: tuple[float | None, float | None] = (None, None), probability: float = 1.0,
    left_out_n: tuple[float | None, float | None] = (None, None),
) -> Diagnosis:  # fmt: skip
    """The verdict on a search; `before` and `after` are located at its base and at its best set.

    full_weights : of these two by the full model, where that could be fitted; a set that it could not be
    fitted with, though without any, is not believed. probability : `set_probability`; left_out_n : RMS errors
    of these two on phases that they were not fitted to, None where there is but one
    """
    best, explained = found.best, explained_share(before, after)
    least = NOTICEABLE * model_error(best.log_posterior)
    without, with_set = full_weights
    believed = probability > PROBABLE and (without is None or (with_set is not None and with_set > without))
    believed = believed and (left_out_n[0] is None or left_out_n[1] is None or left_out_n[1] < left_out_n[0])
    named = tuple(
        one
        for name in (best.names if believed else ())
        if (one := _named(found, known[name])).group_probability > PROBABLE and one.explains_n > least
    )
    if not named and (not before.windows or beyond_allowed(before) < least):
        chance = 1.0 if before.windows else before.chance  # the model's own error may be all of it
        return Diagnosis("nothing-missing", (), 0.0, unknown_probability(chance), believed)
    something_else = unknown_probability((after if believed else before).chance)
    if named and (explained > EXPLAINED or not after.windows):
        return Diagnosis("named", named, explained, something_else, believed)
    return Diagnosis("unknown", (), explained, something_else, believed)


def unknown_probability(chance: float) -> float:
    """At most, that a fit lacks something whose farthest window goes so far by chance (0 to 1)."""
    factor = 1.0 if chance > 1.0 / math.e else -float(xlogy(math.e * chance, chance))
    return PRIOR / (PRIOR + (1.0 - PRIOR) * factor)


def _rms(found: Fit) -> float:
    bins = found.log_posterior.chain.bins
    return float(np.sqrt(np.mean((found.log_posterior.chain.force_n - found.force_n[bins]) ** 2)))


def explains(found: Search, name: str) -> float:
    """RMS [N] of what the best set explains and the likeliest of its subsets tried without `name` does not.

    What another mechanism could explain in its place is for the probabilities to say.
    """
    rest = set(found.best.names) - {name}
    without = max((one for one in found.fits.values() if set(one.names) <= rest), key=found.weight)
    return float(np.sqrt(max(_rms(without) ** 2 - _rms(found.best) ** 2, 0.0)))


def beyond_allowed(located: Located) -> float:
    """RMS residual [N] beyond what is allowed of it."""
    square = np.mean(located.residual_n**2) - np.mean(located.allowed_n**2)
    return float(np.sqrt(max(float(square), 0.0)))


def explained_share(before: Located, after: Located) -> float:
    """Of the squared residual beyond what is allowed."""
    whole = beyond_allowed(before) ** 2
    return 1.0 - beyond_allowed(after) ** 2 / whole if whole > 0.0 else 0.0


def _named(found: Search, mechanism: Mechanism) -> Named:
    beside = set(found.best.names) - {mechanism.name}
    return Named(
        mechanism.name, found.probability([mechanism.name]), mechanism.group,
        found.probability(sorted(set(mechanism.group) - beside)), explains(found, mechanism.name),
    )  # fmt: skip
