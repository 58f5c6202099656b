"""Draws from a seed which effects the recordings of a set conceal.

A set contains all kinds in fixed shares, or `only` the effects that are asked for, in equal numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from bayeskin.errors import InputError
from bayeskin.mechanisms import Mechanism, catalogue
from bayeskin.mechanisms.mechanism import Tissue
from bayeskin.proof.outside import OUTSIDE

# Seeds draw from these only, so that an earlier set can be made again after the catalogue has grown.
CONCEALED = (
    "backlash", "bottom-adherence", "clock-delay", "device-friction", "fibre-anisotropy", "fluid-leakage",
    "force-offset", "friction-creep", "pad-slip", "position-ripple", "pre-stretch", "preconditioning",
    "sensor-drift", "sensor-events", "slow-recovery", "solid-viscoelasticity",
    "strain-dependent-permeability", "strain-stiffening", "viscous-drag",
)  # fmt: skip
Kind = Literal["nothing", "alone", "pair", "outside"]
SHARES: dict[Kind, float] = {"nothing": 20 / 64, "alone": 22 / 64, "pair": 7 / 64, "outside": 15 / 64}
TETRAHEDRA = 0.36  # share of the recordings that are simulated on tetrahedra
SIZES = (1.0, 30.0)  # bounds of the target size, in multiples of the noise floor


@dataclass(frozen=True)
class Plan:
    """The effect that one recording is to conceal.

    label : one word for the effect
    numbers : seed of the plan's own random generator
    target : size to aim at, in multiples of the noise floor; 0 if it is drawn
    """

    label: str
    kind: Kind
    mechanisms: tuple[str, ...]
    outside: str
    tetrahedra: bool
    numbers: tuple[int, ...]
    target: float = 0.0


def plans(seed: int, count: int, only: Sequence[str] = ()) -> tuple[Plan, ...]:
    """Returns the plans of `count` recordings, in the order of their numbers.

    The same seed gives the same plans.
    only : "nothing", mechanisms of `CONCEALED`, effects of `OUTSIDE`; () gives all, in the shares of `SHARES`
    Raises InputError for any other name.
    """
    rng = np.random.default_rng([seed, 0])
    everything = catalogue()
    known = {name: everything[name] for name in CONCEALED}
    chosen = _plans_in_turn(known, only, count) if only else _plans_in_shares(rng, known, count)
    order = rng.permutation(count)
    cut_into_tetrahedra = set(rng.permutation(count)[: int(np.ceil(TETRAHEDRA * count))].tolist())
    return tuple(
        replace(chosen[i], tetrahedra=place in cut_into_tetrahedra, numbers=(seed, 1, place))
        for place, i in enumerate(order.tolist())
    )


def _plans_in_shares(rng: np.random.Generator, known: Mapping[str, Mechanism], count: int) -> list[Plan]:
    """Returns plans of all kinds, in the shares of `SHARES`."""
    counts = _counts(count)
    tissue = [n for n, m in known.items() if isinstance(m.act, Tissue)]
    alone = [*_shuffled(rng, list(known)), *_cycled(rng, tissue, counts["alone"])][: counts["alone"]]
    chosen = [_plan("nothing", known)] * counts["nothing"] + [_plan(name, known) for name in alone]
    for pair in _pairs(rng, known, counts["pair"]):
        chosen.append(Plan(" + ".join(pair), "pair", pair, "", False, ()))
    return chosen + [_plan(name, known) for name in _cycled(rng, list(OUTSIDE), counts["outside"])]


def _plans_in_turn(known: Mapping[str, Mechanism], only: Sequence[str], count: int) -> list[Plan]:
    """Returns plans that take each name in turn.

    The targets of a name that occurs n times are the middles of n classes of size.
    """
    for name in only:
        if name not in ("nothing", *known, *OUTSIDE):
            raise InputError(
                "--only", f"{name} is not known", f"use one of {', '.join(('nothing', *known, *OUTSIDE))}"
            )
    times = [len(range(place, count, len(only))) for place in range(len(only))]
    targets = [np.exp(np.interp((np.arange(n) + 0.5) / n, (0.0, 1.0), np.log(SIZES))) for n in times]
    return [
        replace(_plan(only[i % len(only)], known), target=float(targets[i % len(only)][i // len(only)]))
        for i in range(count)
    ]


def _plan(name: str, known: Mapping[str, Mechanism]) -> Plan:
    if name in known:
        return Plan(name, "alone", (*known[name].needs, name), "", False, ())
    if name == "nothing":
        return Plan(name, "nothing", (), "", False, ())
    return Plan(name, "outside", (), name, False, ())


def _counts(count: int) -> dict[Kind, int]:
    counts = {kind: int(share * count) for kind, share in SHARES.items()}
    short = sorted(SHARES, key=lambda kind: counts[kind] - SHARES[kind] * count)
    for kind in short[: count - sum(counts.values())]:
        counts[kind] += 1
    return counts


def _shuffled(rng: np.random.Generator, names: Sequence[str]) -> list[str]:
    return [names[i] for i in rng.permutation(len(names))]


def _cycled(rng: np.random.Generator, names: Sequence[str], count: int) -> list[str]:
    drawn: list[str] = []
    while len(drawn) < count:
        drawn += _shuffled(rng, names)
    return drawn[:count]


def _pairs(rng: np.random.Generator, known: Mapping[str, Mechanism], count: int) -> list[tuple[str, str]]:
    """Returns pairs of a mechanism that the full model solves and one that acts on its force.

    The two mechanisms of a pair are no look-alikes of each other.
    """
    solved = [n for n, m in known.items() if m.act.bind is not None]
    adding = [n for n, m in known.items() if m.act.bind is None and not m.needs]
    pairs = []
    for first in _cycled(rng, solved, count):
        fitting = [n for n in adding if not {*known[n].group} & {*known[first].group} & {*known}]
        pairs.append((first, _shuffled(rng, fitting)[0]))
    return pairs
