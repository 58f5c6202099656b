"""Which cases are concealed in a set, drawn from its seed: what, how strongly, in which skin.

A set has all kinds in fixed shares, or `only` what is asked for, in equal numbers. Base parameters are drawn
from the default box where the peak force is that of a skin test and the subcutis is not much stiffer than the
cutis (on a stiff one a soft cutis folds), a mechanism's from their priors. Of many draws that one is taken
whose size, by the shipped models, is nearest to a target that is log-uniform over `SIZES`, or spread so
evenly in a set of what was asked for; where none comes near, the nearest.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Literal

import numpy as np

from bayeskin.errors import InputError
from bayeskin.mechanisms import Mechanism, bin_means, catalogue, observed, solved
from bayeskin.mechanisms.mechanism import Tissue
from bayeskin.proof.noise import FLOORS_N
from bayeskin.proof.outside import OUTSIDE
from bayeskin.proof.protocol import EDGES_S, MOTION, SURROGATE
from bayeskin.proof.refit_residual import ALONE, Refit, rms
from bayeskin.reduced.files import load_reduced
from bayeskin.reduced.model import ReducedModel
from bayeskin.reduced.simulate import simulate_reduced
from bayeskin.shipped import shipped
from bayeskin.surrogates import load_surrogate
from bayeskin.types import Array, ParameterSpace

# A seed draws from these alone, so that a set of the past can be made again whatever the catalogue has since.
CONCEALED = (
    "backlash", "bottom-adherence", "clock-delay", "device-friction", "fibre-anisotropy", "fluid-leakage",
    "force-offset", "friction-creep", "pad-slip", "position-ripple", "pre-stretch", "preconditioning",
    "sensor-drift", "sensor-events", "slow-recovery", "solid-viscoelasticity",
    "strain-dependent-permeability", "strain-stiffening", "viscous-drag",
)  # fmt: skip
Kind = Literal["nothing", "alone", "pair", "outside"]
SHARES: dict[Kind, float] = {"nothing": 20 / 64, "alone": 22 / 64, "pair": 7 / 64, "outside": 15 / 64}
TETRAHEDRA = 0.36  # of the recordings
PEAK_N = (0.1, 2.0)
STIFFEST_BELOW = 2.0  # E_s over E_c, at most
SIZES = (1.0, 30.0)  # of the noise floor
NEAR = 0.2  # of a logarithm: how near to its target a size is near enough
REDUCED = "surrogates/article-device-reduced.h5"
FOLDING = 0.15  # of the stiffness at rest: runs that come nearer to folding are not used
LEAST_SHARE = 0.25  # of a pair's size, that each of the two should have
BATCH, BATCHES, FITTED = 16, 16, 3  # draws at a time, how often, and how many of each are fitted


@dataclass(frozen=True)
class Plan:
    """What one recording is to conceal; `label` is one word for it, `numbers` its own stream of chance.

    target : size to aim at, of the floor; 0 where chance decides
    """

    label: str
    kind: Kind
    mechanisms: tuple[str, ...]
    outside: str
    tetrahedra: bool
    numbers: tuple[int, ...]
    target: float = 0.0


@dataclass(frozen=True)
class Case:
    """A plan with its numbers: theta and values of parameters (SI), strength of what is outside."""

    plan: Plan
    theta: Mapping[str, float]
    values: Mapping[str, float] = field(default_factory=dict)
    strength: float = 0.0
    floor_n: float = 0.0
    target: float = 0.0  # size aimed at, of the floor


def plans(seed: int, count: int, only: Sequence[str] = ()) -> tuple[Plan, ...]:
    """Returns what each of `count` recordings conceals, in the order of their numbers. Same seed, same plans.

    only : "nothing", mechanisms of `CONCEALED`, effects of `OUTSIDE`; () is all in the shares of `SHARES`.
    Raises InputError for any other name.
    """
    rng = np.random.default_rng([seed, 0])
    everything = catalogue()
    known = {name: everything[name] for name in CONCEALED}
    chosen = _asked_for(known, only, count) if only else _mixed(rng, known, count)
    order = rng.permutation(count)
    cut = set(rng.permutation(count)[: int(np.ceil(TETRAHEDRA * count))].tolist())
    return tuple(
        replace(chosen[i], tetrahedra=place in cut, numbers=(seed, 1, place))
        for place, i in enumerate(order.tolist())
    )


def _mixed(rng: np.random.Generator, known: Mapping[str, Mechanism], count: int) -> list[Plan]:
    counts = _counts(count)
    tissue = [n for n, m in known.items() if isinstance(m.act, Tissue)]
    alone = [*_shuffled(rng, list(known)), *_cycled(rng, tissue, counts["alone"])][: counts["alone"]]
    chosen = [_plan("nothing", known)] * counts["nothing"] + [_plan(name, known) for name in alone]
    for pair in _pairs(rng, known, counts["pair"]):
        chosen.append(Plan(" + ".join(pair), "pair", pair, "", False, ()))
    return chosen + [_plan(name, known) for name in _cycled(rng, list(OUTSIDE), counts["outside"])]


def _asked_for(known: Mapping[str, Mechanism], only: Sequence[str], count: int) -> list[Plan]:
    """Each in turn; of one that is there n times the targets are the middles of n classes of size."""
    for name in only:
        if name not in ("nothing", *known, *OUTSIDE):
            raise InputError("--only", name, f"nothing, or one of {', '.join((*known, *OUTSIDE))}")
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
    found = {kind: int(share * count) for kind, share in SHARES.items()}
    short = sorted(SHARES, key=lambda kind: found[kind] - SHARES[kind] * count)
    for kind in short[: count - sum(found.values())]:
        found[kind] += 1
    return found


def _shuffled(rng: np.random.Generator, names: Sequence[str]) -> list[str]:
    return [names[i] for i in rng.permutation(len(names))]


def _cycled(rng: np.random.Generator, names: Sequence[str], count: int) -> list[str]:
    found: list[str] = []
    while len(found) < count:
        found += _shuffled(rng, names)
    return found[:count]


def _pairs(rng: np.random.Generator, known: Mapping[str, Mechanism], count: int) -> list[tuple[str, str]]:
    """One that the full model solves and one that adds to its force, no look-alikes of each other."""
    solved = [n for n, m in known.items() if m.act.bind is not None]
    adding = [n for n, m in known.items() if m.act.bind is None and not m.needs]
    found = []
    for first in _cycled(rng, solved, count):
        fitting = [n for n in adding if not {*known[n].group} & {*known[first].group} & {*known}]
        found.append((first, _shuffled(rng, fitting)[0]))
    return found


@dataclass(frozen=True)
class Screen:
    """Predicts what a case's force will be, well enough to choose its size.

    refit : the base model, by its surrogate; model : says how mechanisms change its force
    """

    refit: Refit
    model: ReducedModel
    known: Mapping[str, Mechanism]

    def force(self, names: Sequence[str], theta: Array, values: Mapping[str, Array]) -> Array:
        """Bin means (n, m) at theta (n, 5) with mechanisms at values (n,) each; NaN where no run finishes."""
        changes = [self._change(names, one, {name: value[i] for name, value in values.items()})
                   for i, one in enumerate(theta)]  # fmt: skip
        return np.asarray(self.refit.force(theta) + np.array(changes))

    def _change(self, names: Sequence[str], theta: Array, values: Mapping[str, float]) -> Array:
        """What mechanisms add to the bin means (m,) of a skin."""
        mechanisms = [self.known[name] for name in names]
        skin, within = _named(self, theta), solved(mechanisms)
        runs = [simulate_reduced(self.model, MOTION, {**skin, **values}, some, least_stiffness=FOLDING)
                for some in (within, [])]  # fmt: skip
        if any(run.status != "ok" for run in runs):
            return np.full(len(EDGES_S) - 1, np.nan)
        beyond = [one for one in mechanisms if one not in within]
        rows = {name: np.array([value]) for name, value in values.items()}
        seen = observed(beyond, rows, MOTION, lambda time_s: np.atleast_2d(runs[0].at(time_s)))
        return np.asarray(bin_means(seen, MOTION, EDGES_S, beyond)[0] - runs[1].bin_means(EDGES_S))


@cache
def shipped_screen() -> Screen:
    """With the surrogate and the reduced model that come with bayeskin."""
    model = load_reduced(shipped(REDUCED))
    return Screen(Refit(load_surrogate(shipped(SURROGATE))), model, catalogue())


def draw(plan: Plan, attempt: int, screen: Screen) -> Case:
    """The numbers of a plan; another `attempt` draws others. Same plan and attempt, same case."""
    rng = np.random.default_rng([*plan.numbers, attempt])
    floor_n = float(rng.uniform(*FLOORS_N))
    target = float(np.exp(rng.uniform(*np.log(SIZES))))
    if plan.mechanisms:
        return _sized(plan, rng, screen, floor_n, plan.target or target)
    theta, _ = _skins(rng, screen, 1)
    strength = 0.0
    if plan.outside:
        strength = float(np.exp(rng.uniform(*np.log(OUTSIDE[plan.outside].strengths))))
    return Case(plan, _named(screen, theta[0]), {}, strength, floor_n)


def _sized(plan: Plan, rng: np.random.Generator, screen: Screen, floor_n: float, target: float) -> Case:
    """The draw whose size is nearest to the target; of a pair, with both parts in it.

    Straight lines about theta choose a few of each batch, which are then fitted.
    """
    parameters = ParameterSpace(tuple(p for n in plan.mechanisms for p in screen.known[n].parameters))
    best, found = np.inf, None
    for _ in range(BATCHES):
        theta, base_n = _skins(rng, screen, BATCH)
        drawn = parameters.from_unit(rng.random((BATCH, parameters.dim)))
        drawn = np.clip(drawn, parameters.lower, parameters.upper)
        values = dict(zip(parameters.names, drawn.T, strict=True))
        all_n = screen.force(plan.mechanisms, theta, values)
        size = rms(screen.refit.linear(all_n - base_n, theta)) / floor_n
        short = _one_sided(plan, screen, theta, values, all_n, size * floor_n)
        usable = (np.abs(all_n).max(axis=1) < PEAK_N[1]) & (all_n.max(axis=1) > PEAK_N[0])  # not where NaN
        short[~usable] = np.inf
        for row in np.argsort(_far(size, target) + short)[: min(FITTED, usable.sum())]:
            fitted = rms(screen.refit.residual(all_n[row], theta[row], ALONE)) / floor_n
            far = _far(fitted, target) + short[row]
            if far < best:
                best, found = far, (theta[row], {name: float(v[row]) for name, v in values.items()})
        if best < NEAR:
            break
    if found is None:
        found_n = f"no draw of {', '.join(plan.mechanisms)} with a peak of {PEAK_N[0]:g} to {PEAK_N[1]:g} N"
        raise InputError("proof", found_n, f"one among {BATCHES * BATCH}")
    return Case(plan, _named(screen, found[0]), found[1], 0.0, floor_n, target)


def _far(size: Array, target: float) -> Array:
    return np.asarray(np.abs(np.log(np.maximum(size, 1e-9) / target)))


def _one_sided(
    plan: Plan, screen: Screen, theta: Array, values: Mapping[str, Array], all_n: Array, size_n: Array
) -> Array:
    """By how much (n,), in logarithms, a mechanism of several falls short of its share."""
    short = np.zeros(len(theta))
    for name in plan.mechanisms if len(plan.mechanisms) > 1 else ():
        rest_n = screen.force([n for n in plan.mechanisms if n != name], theta, values)
        own_n = rms(screen.refit.linear(all_n - rest_n, theta))
        short += np.maximum(np.log(LEAST_SHARE * size_n / np.maximum(own_n, 1e-12)), 0.0)
    return short


def _skins(rng: np.random.Generator, screen: Screen, count: int) -> tuple[Array, Array]:
    """theta (count, 5) from the default box where the peak is a skin test's, and the base's force there."""
    space = screen.refit.surrogate.space
    theta, force = np.empty((0, space.dim)), np.empty((0, len(EDGES_S) - 1))
    while len(theta) < count:
        more = np.clip(space.from_unit(rng.random((4 * count, space.dim))), space.lower, space.upper)
        more_n = screen.refit.force(more)
        peak = more_n.max(axis=1)
        kept = (peak > PEAK_N[0]) & (peak < PEAK_N[1]) & (more[:, 1] < STIFFEST_BELOW * more[:, 0])
        theta, force = np.concatenate([theta, more[kept]]), np.concatenate([force, more_n[kept]])
    return theta[:count], force[:count]


def _named(screen: Screen, theta: Array) -> dict[str, float]:
    return dict(zip(screen.refit.surrogate.space.names, theta.tolist(), strict=True))
