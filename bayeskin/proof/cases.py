"""Draws the cases of a set from its seed: which effect is concealed, how strong it is, and in which skin.

A set contains all kinds in fixed shares, or `only` the effects that are asked for, in equal numbers. The base
parameters are drawn from the default box. They are kept if the peak force is that of a skin test and the
subcutis is not much stiffer than the cutis, because a soft cutis on a stiff subcutis folds. Parameters of
mechanisms are drawn from their priors.

Each case with mechanisms has a target size, drawn log-uniformly over `SIZES`. In a set of `only` some effects
the targets are spread evenly over the same range in logarithm. Of many draws the case takes the draw whose
size, by the shipped models, is nearest to the target, even if none comes near.
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
PEAK_N = (0.1, 2.0)
STIFFEST_BELOW = 2.0  # upper bound of E_s / E_c
SIZES = (1.0, 30.0)  # bounds of the target size, in multiples of the noise floor
NEAR = 0.2  # difference in logarithm from its target at which a size is near enough
REDUCED = "surrogates/article-device-reduced.h5"
FOLDING = 0.15  # share of the stiffness at rest; runs that fall below it are too near folding to be used
LEAST_SHARE = 0.25  # share of the size of several mechanisms that each of them should have
BATCH, BATCHES, FITTED = 16, 16, 3  # draws in a batch, batches, draws of a batch that are fitted


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


@dataclass(frozen=True)
class Case:
    """A plan with its numbers.

    theta, values : parameters of the base model and of the mechanisms, SI
    strength : strength of an effect outside the catalogue
    floor_n : noise floor [N]
    target : size aimed at, in multiples of the noise floor
    """

    plan: Plan
    theta: Mapping[str, float]
    values: Mapping[str, float] = field(default_factory=dict)
    strength: float = 0.0
    floor_n: float = 0.0
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


@dataclass(frozen=True)
class Screen:
    """Predicts the force of a case, well enough to choose the size of its effect.

    refit : the base model, by its surrogate
    model : the reduced model, which predicts how mechanisms change the force
    known : mechanisms by name
    """

    refit: Refit
    model: ReducedModel
    known: Mapping[str, Mechanism]

    def force(self, names: Sequence[str], theta: Array, values: Mapping[str, Array]) -> Array:
        """Returns bin means (n, m) at theta (n, 5), with mechanisms at values (n,) each.

        They are NaN where a run fails.
        """
        changes = [self._change(names, row, {name: value[i] for name, value in values.items()})
                   for i, row in enumerate(theta)]  # fmt: skip
        return np.asarray(self.refit.force(theta) + np.array(changes))

    def _change(self, names: Sequence[str], theta: Array, values: Mapping[str, float]) -> Array:
        """Returns the change (m,) of the bin means that mechanisms make at theta (5,)."""
        mechanisms = [self.known[name] for name in names]
        theta_named, within_model = _by_name(self, theta), solved(mechanisms)
        runs = [simulate_reduced(self.model, MOTION, {**theta_named, **values}, used, least_stiffness=FOLDING)
                for used in (within_model, [])]  # fmt: skip
        if any(run.status != "ok" for run in runs):
            return np.full(len(EDGES_S) - 1, np.nan)
        on_force = [mechanism for mechanism in mechanisms if mechanism not in within_model]
        rows = {name: np.array([value]) for name, value in values.items()}
        reported = observed(on_force, rows, MOTION, lambda time_s: np.atleast_2d(runs[0].at(time_s)))
        return np.asarray(bin_means(reported, MOTION, EDGES_S, on_force)[0] - runs[1].bin_means(EDGES_S))


@cache
def shipped_screen() -> Screen:
    """Returns a screen with the surrogate and the reduced model that come with bayeskin."""
    model = load_reduced(shipped(REDUCED))
    return Screen(Refit(load_surrogate(shipped(SURROGATE))), model, catalogue())


def draw(plan: Plan, attempt: int, screen: Screen) -> Case:
    """Returns a case of a plan.

    The same plan and `attempt` give the same case; another attempt gives another case.
    """
    rng = np.random.default_rng([*plan.numbers, attempt])
    floor_n = float(rng.uniform(*FLOORS_N))
    target = float(np.exp(rng.uniform(*np.log(SIZES))))
    if plan.mechanisms:
        return _nearest_draw(plan, rng, screen, floor_n, plan.target or target)
    theta, _ = _base_draws(rng, screen, 1)
    strength = 0.0
    if plan.outside:
        strength = float(np.exp(rng.uniform(*np.log(OUTSIDE[plan.outside].strengths))))
    return Case(plan, _by_name(screen, theta[0]), {}, strength, floor_n)


def _nearest_draw(
    plan: Plan, rng: np.random.Generator, screen: Screen, floor_n: float, target: float
) -> Case:
    """Returns the draw whose size is nearest to the target.

    Of several mechanisms, each should contribute its share of the size. A fit that is linear about theta
    chooses a few draws of each batch, for which the base model is then fitted in full.
    Raises InputError if no draw has a peak in `PEAK_N`.
    """
    parameters = ParameterSpace(tuple(p for n in plan.mechanisms for p in screen.known[n].parameters))
    best, nearest = np.inf, None
    for _ in range(BATCHES):
        theta, base_n = _base_draws(rng, screen, BATCH)
        drawn = parameters.from_unit(rng.random((BATCH, parameters.dim)))
        drawn = np.clip(drawn, parameters.lower, parameters.upper)
        values = dict(zip(parameters.names, drawn.T, strict=True))
        all_n = screen.force(plan.mechanisms, theta, values)
        size = rms(screen.refit.linear(all_n - base_n, theta)) / floor_n
        short = _shortfall(plan, screen, theta, values, all_n, size * floor_n)
        # Both comparisons are False for a failed run, whose force is NaN.
        usable = (np.abs(all_n).max(axis=1) < PEAK_N[1]) & (all_n.max(axis=1) > PEAK_N[0])
        short[~usable] = np.inf
        for row in np.argsort(_distance(size, target) + short)[: min(FITTED, usable.sum())]:
            fitted = rms(screen.refit.residual(all_n[row], theta[row], ALONE)) / floor_n
            distance = _distance(fitted, target) + short[row]
            if distance < best:
                best, nearest = distance, (theta[row], {name: float(v[row]) for name, v in values.items()})
        if best < NEAR:
            break
    if nearest is None:
        found_n = f"no draw of {', '.join(plan.mechanisms)} with a peak of {PEAK_N[0]:g} to {PEAK_N[1]:g} N"
        raise InputError("proof", found_n, f"at least one such draw among {BATCHES * BATCH}")
    return Case(plan, _by_name(screen, nearest[0]), nearest[1], 0.0, floor_n, target)


def _distance(size: Array, target: float) -> Array:
    """Returns how far sizes are from a target, as differences in logarithm."""
    return np.asarray(np.abs(np.log(np.maximum(size, 1e-9) / target)))


def _shortfall(
    plan: Plan, screen: Screen, theta: Array, values: Mapping[str, Array], all_n: Array, size_n: Array
) -> Array:
    """Returns by how much (n,), in logarithm, several mechanisms fall short of their shares of the size."""
    short = np.zeros(len(theta))
    for name in plan.mechanisms if len(plan.mechanisms) > 1 else ():
        without_n = screen.force([n for n in plan.mechanisms if n != name], theta, values)
        part_n = rms(screen.refit.linear(all_n - without_n, theta))
        short += np.maximum(np.log(LEAST_SHARE * size_n / np.maximum(part_n, 1e-12)), 0.0)
    return short


def _base_draws(rng: np.random.Generator, screen: Screen, count: int) -> tuple[Array, Array]:
    """Returns theta (count, 5) from the default box, and the bin means (count, m) of the base model there.

    The peak force is that of a skin test, and the subcutis is not much stiffer than the cutis.
    """
    space = screen.refit.surrogate.space
    theta, force = np.empty((0, space.dim)), np.empty((0, len(EDGES_S) - 1))
    while len(theta) < count:
        trial = np.clip(space.from_unit(rng.random((4 * count, space.dim))), space.lower, space.upper)
        trial_n = screen.refit.force(trial)
        peak = trial_n.max(axis=1)
        kept = (peak > PEAK_N[0]) & (peak < PEAK_N[1]) & (trial[:, 1] < STIFFEST_BELOW * trial[:, 0])
        theta, force = np.concatenate([theta, trial[kept]]), np.concatenate([force, trial_n[kept]])
    return theta[:count], force[:count]


def _by_name(screen: Screen, theta: Array) -> dict[str, float]:
    return dict(zip(screen.refit.surrogate.space.names, theta.tolist(), strict=True))
