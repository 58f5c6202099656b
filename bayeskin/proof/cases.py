"""Draws the numbers of a plan: how strong its effect is, and in which skin it is concealed.

The base parameters are drawn from the default box. They are kept if the peak force is that of a skin test and
the subcutis is not much stiffer than the cutis, because a soft cutis on a stiff subcutis folds. Parameters of
mechanisms are drawn from their priors.

Each case with mechanisms has a target size, drawn log-uniformly over `SIZES`. In a set of only some effects
the targets are spread evenly over the same range in logarithm. Of many draws the case takes the draw whose
size, by the shipped models, is nearest to the target, even if none comes near.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from bayeskin.errors import InputError
from bayeskin.proof.noise import FLOORS_N
from bayeskin.proof.outside import OUTSIDE
from bayeskin.proof.plans import SIZES, Plan
from bayeskin.proof.protocol import EDGES_S
from bayeskin.proof.refit_residual import ALONE, rms
from bayeskin.proof.screen import Screen
from bayeskin.types import STIFFEST_BELOW, Array, ParameterSpace


@dataclass(frozen=True)
class CaseSearchSettings:
    """Settings of the search for a case.

    peak_n : bounds of the peak force [N]
    near : difference in logarithm from its target at which a size is near enough
    least_share : share of the size of several mechanisms that each of them should have
    batch, batches, fitted : draws in a batch, largest number of batches, draws of a batch that are fitted
    """

    peak_n: tuple[float, float] = (0.1, 2.0)
    near: float = 0.2
    least_share: float = 0.25
    batch: int = 16
    batches: int = 16
    fitted: int = 3


CASES = CaseSearchSettings()


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
    return Case(plan, screen.by_name(theta[0]), {}, strength, floor_n)


def _nearest_draw(
    plan: Plan, rng: np.random.Generator, screen: Screen, floor_n: float, target: float
) -> Case:
    """Returns the draw whose size is nearest to the target.

    Of several mechanisms, each should contribute its share of the size. A fit that is linear about theta
    chooses a few draws of each batch, for which the base model is then fitted in full.
    Raises InputError if no draw has a peak in `CASES.peak_n`.
    """
    parameters = ParameterSpace(tuple(p for n in plan.mechanisms for p in screen.known[n].parameters))
    best, nearest = np.inf, None
    for _ in range(CASES.batches):
        theta, base_n = _base_draws(rng, screen, CASES.batch)
        drawn = parameters.from_unit(rng.random((CASES.batch, parameters.dim)))
        drawn = np.clip(drawn, parameters.lower, parameters.upper)
        values = dict(zip(parameters.names, drawn.T, strict=True))
        all_n = screen.force(plan.mechanisms, theta, values)
        size = rms(screen.refit.linear(all_n - base_n, theta)) / floor_n
        short = _shortfall(plan, screen, theta, values, all_n, size * floor_n)
        # Both comparisons are False for a failed run, whose force is NaN.
        usable = (np.abs(all_n).max(axis=1) < CASES.peak_n[1]) & (all_n.max(axis=1) > CASES.peak_n[0])
        short[~usable] = np.inf
        for row in np.argsort(_distance(size, target) + short)[: min(CASES.fitted, usable.sum())]:
            fitted = rms(screen.refit.residual(all_n[row], theta[row], ALONE)) / floor_n
            distance = _distance(fitted, target) + short[row]
            if distance < best:
                best, nearest = distance, (theta[row], {name: float(v[row]) for name, v in values.items()})
        if best < CASES.near:
            break
    if nearest is None:
        low_n, high_n = CASES.peak_n
        tried = f"{CASES.batches * CASES.batch} draws of {', '.join(plan.mechanisms)}"
        problem = f"none of {tried} has a peak of {low_n:g} to {high_n:g} N"
        raise InputError("proof", problem, "use another seed")
    return Case(plan, screen.by_name(nearest[0]), nearest[1], 0.0, floor_n, target)


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
        short += np.maximum(np.log(CASES.least_share * size_n / np.maximum(part_n, 1e-12)), 0.0)
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
        usable = (peak > CASES.peak_n[0]) & (peak < CASES.peak_n[1])
        kept = usable & (trial[:, 1] < STIFFEST_BELOW * trial[:, 0])
        theta, force = np.concatenate([theta, trial[kept]]), np.concatenate([force, trial_n[kept]])
    return theta[:count], force[:count]
