"""What mechanisms that the full model solves do to the force, beside a surrogate of the base model.

With theta the base parameters, phi those of one part of a mechanism, s its strength and F the force,

    F(theta, phi) = F_0(theta) + s G(theta, phi) ,   s = (phi_1 - neutral) / E^power ,

so that moving phi_1 off its neutral value switches the effect on and nothing remains at it. G is learnt as
any force is, amplitude and shape, from runs with and without the mechanism at the same theta: many of a
coarse model, corrected by few of the model itself (`two_fidelities`); it scales as forces do (`similarity`).

Where a mechanism has an estimate D(F_0, phi) of its own effect, only what it leaves is learnt, in units of
the estimate's RMS over time, |D|:

    F(theta, phi) = F_0 + D + |D| (H(theta, phi) / c - 1) ,   c the force that similarity takes out,

so that H / c is near one everywhere and has a logarithm, whatever the sign of what is left.

Effects of several parts add up, and an estimate is of the force F_0 that the mechanisms before it make, those
without an estimate first, then in the order in which they are given (`composed`). What two do to each other
beyond that (`benchmarks/pairs.py`) is an effect of its own, s the product of their strengths, where that is
worth it, and else left to full runs.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from bayeskin.distinct import at_distinct, mean_at_distinct
from bayeskin.errors import InputError
from bayeskin.surrogates.screening import active_inputs
from bayeskin.surrogates.similarity import Similarity
from bayeskin.surrogates.surrogate import ShapeSurrogate, refuse_outside
from bayeskin.surrogates.train import Kind, train
from bayeskin.surrogates.two_fidelities import correct
from bayeskin.surrogates.validate import Validation
from bayeskin.types import Array, Design, ParameterSpace, Prediction, Surrogate

T = TypeVar("T")
Estimate = Callable[[Array, Array], Array]  # own parameters (n, k), force without (n, m) to its change (n, m)
SMALLEST = 5e-4  # of the base force, RMS: below it an effect is the solver's noise
SMALL = 5e-3  # from here on an effect's own relative error decides


@dataclass(frozen=True)
class Effect:
    """One part of a mechanism, or what the parts of two do beyond both: `surrogate` of G, or of H, over the
    base's parameters and their `own`.

    neutral: of each strength its value without effect, one a mechanism. estimate: D, where a part has one.
    """

    part: str
    mechanisms: tuple[str, ...]
    neutral: Mapping[str, float]
    own: tuple[str, ...]
    surrogate: ShapeSurrogate
    estimate: Estimate | None = None

    @property
    def about(self) -> dict[str, Any]:
        """What a manifest says of it, for `effect_of`."""
        return {
            "part": self.part, "mechanisms": list(self.mechanisms), "neutral": dict(self.neutral),
            "own": list(self.own), "estimate": _told(self.surrogate, self.own, self.estimate),
        }  # fmt: skip

    @property
    def space(self) -> ParameterSpace:
        return self.surrogate.space

    def predict(self, theta: Array, base: Array) -> Prediction:
        """What the effect adds to a force (n, m), at theta (n, d) in the order of its space."""
        times, beside = self._scaled(theta, base)
        found = self.surrogate.predict(theta, times)
        return replace(found, mean=found.mean + beside)

    def predict_mean(self, theta: Array, base: Array) -> Array:
        """The mean (n, m) of `predict` alone."""
        times, beside = self._scaled(theta, base)
        return self.surrogate.predict_mean(theta, times) + beside

    def _scaled(self, theta: Array, base: Array) -> tuple[Array, Array | float]:
        """How many times (n,) what is learnt adds to the force, and what comes to it, (n, m)."""
        similarity = self.surrogate.similarity
        if self.estimate is None:
            return strength(similarity, self.neutral, theta), 0.0
        change = self.estimate(theta[:, -len(self.own) :], base)
        size = _rms(change)
        return size * np.exp(-similarity.log_scale(theta)), change - size[:, None]


def _rms(values: Array) -> Array:
    """Over time, (n,)."""
    return np.asarray(np.sqrt(np.mean(values**2, axis=1)))


def effect_of(about: Mapping[str, Any], surrogate: ShapeSurrogate, estimate: Estimate | None) -> Effect:
    """The effect that `Effect.about` tells of. Raises InputError if it was learnt beside another estimate."""
    if "estimate" not in about:
        raise InputError(
            f"effect {about['part']}", "a file of a former version", "bayeskin effects, run anew"
        )
    own = tuple(about["own"])
    learnt, now = about["estimate"], _told(surrogate, own, estimate)
    if (learnt is None) != (now is None) or (now is not None and not np.isclose(learnt, now, rtol=1e-6)):
        raise InputError(
            f"effect {about['part']}", "learnt beside another estimate", "bayeskin effects, run anew"
        )
    return Effect(about["part"], tuple(about["mechanisms"]), about["neutral"], own, surrogate, estimate)


def _told(surrogate: ShapeSurrogate, own: Sequence[str], estimate: Estimate | None) -> float | None:
    """A number by which an estimate is told from another: what it makes of a force that grows."""
    if estimate is None:
        return None
    space = surrogate.space
    middle = space.from_unit(np.full((1, space.dim), 0.5))[:, -len(own) :]
    return float(_rms(estimate(middle, np.linspace(0.0, 1.0, len(surrogate.edges_s) - 1)[None]))[0])


def strength(similarity: Similarity, neutral: Mapping[str, float], theta: Array) -> Array:
    """s (n,) at theta (n, d): each strength's distance from neutral, over the modulus to its power; of two
    their product."""
    space, found = similarity.space, np.ones(len(theta))
    scale = similarity.log_scale(theta)
    for name, value in neutral.items():
        column = space.names.index(name)
        found *= (theta[:, column] - value) * np.exp(-space.parameters[column].stress_power * scale)
    return found


def composed(
    neither_n: Array, alone_n: Sequence[Array], own: Sequence[Array], estimates: Sequence[Estimate | None]
) -> Array:
    """Force (n, m) that exact surrogates of effects of several mechanisms make together, in the order given,
    from runs without and with each.

    Those without an estimate add up. Each with one is then taken of the force so far.
    neither_n, alone_n (n, m) each; own (n, k): each effect's parameters, for its estimate where it has one
    """
    effects = list(zip(alone_n, own, estimates, strict=True))
    found = neither_n + sum(one - neither_n for one, _, estimate in effects if estimate is None)
    for one, values, estimate in effects:
        if estimate is not None:
            here, there = estimate(values, neither_n), estimate(values, found)
            found = found + there + (_rms(there) / _rms(here))[:, None] * (one - neither_n - here)
    return found


@dataclass(frozen=True)
class Pair:
    """Runs with an effect, `design`, and the force (n, m) of the same model at the same points without it."""

    design: Design
    without_n: Array

    def change(self) -> Array:
        """What the mechanism does to the force (n, m) [N]; NaN where a run failed."""
        return np.asarray(self.design.force_n - self.without_n)


def train_effect(
    part: str,
    mechanisms: Sequence[str],
    neutral: Mapping[str, float],
    own: Sequence[str],
    coarse: Pair,
    fine: Pair,
    kind: Kind | str = "auto",
    seed: int = 0,
    estimate: Estimate | None = None,
) -> tuple[Effect, Validation]:
    """From runs of a coarse model, corrected by those of the fine one.

    Rows whose effect is next to nothing are left out; the validation is of G, or of H, in the fine model.
    Raises InputError where too few rows show an effect.
    """
    (seen, weights), (corrects, its) = (_learnt(one, neutral, own, estimate) for one in (coarse, fine))
    active = active_inputs(seen, weights)
    surrogate, _ = train(seen, kind, seed, weights, active=active)  # type: ignore[arg-type]
    surrogate, validation = correct(surrogate, corrects, its)
    return Effect(part, tuple(mechanisms), neutral, tuple(own), surrogate, estimate), validation


def _learnt(
    pair: Pair, neutral: Mapping[str, float], own: Sequence[str], estimate: Estimate | None
) -> tuple[Design, Array]:
    """The design whose force is G, or H, and weights (n,) of its rows, 0 where no effect shows."""
    design, change = pair.design, pair.change()
    similarity = Similarity(design.space)
    s = strength(similarity, neutral, design.theta)
    with np.errstate(invalid="ignore"):
        size = _rms(change) / _rms(pair.without_n)
        shows = design.ok & (size > SMALLEST) & (np.abs(s) > 0.0)
    weights = np.where(shows, (size / (size + SMALL)) ** 2, 0.0)
    learnt = np.full_like(change, np.nan)
    if estimate is None:
        learnt[shows] = change[shows] / s[shows, None]
    else:
        guess = estimate(design.theta[:, -len(own) :], pair.without_n)
        left = (change - guess)[shows] / _rms(guess)[shows, None]
        scale = np.exp(similarity.log_scale(design.theta[shows]))
        learnt[shows] = scale[:, None] * (1.0 + left)
    return replace(design, force_n=learnt, ok=shows), weights


@dataclass(frozen=True)
class WithEffects:
    """Satisfies `types.Surrogate`: the base's force and that of each effect, over all their parameters."""

    base: ShapeSurrogate
    effects: tuple[Effect, ...]

    def __post_init__(self) -> None:
        for effect in self.effects:
            ours = self.base.edges_s
            if len(effect.surrogate.edges_s) != len(ours) or not np.allclose(effect.surrogate.edges_s, ours):
                raise InputError(f"effect {effect.part}", "other bins", "those of the base's surrogate")

    @property
    def edges_s(self) -> Array:
        return self.base.edges_s

    @cached_property
    def space(self) -> ParameterSpace:
        """The base's parameters, then each effect's own, those of two parts once."""
        own = {p.name: p for effect in self.effects for p in effect.space.parameters[-len(effect.own) :]}
        return ParameterSpace((*self.base.space.parameters, *own.values()))

    @property
    def provenance(self) -> Mapping[str, Any]:
        parts = {effect.part: dict(effect.surrogate.provenance) for effect in self.effects}
        return {**self.base.provenance, "effects": parts}

    def predict(self, theta: ArrayLike) -> Prediction:
        """Force at theta (n, d) or (d,), with its uncertainty; errors of the parts taken as independent.

        An estimate is of a force with errors, which grow as the force does.
        """
        theta = np.atleast_2d(np.asarray(theta, dtype=float))
        refuse_outside(self.space, theta)
        base = theta[:, : self.base.space.dim]
        found = [at_distinct(lambda these, _: self.base.predict(these), base, base)]
        grown = np.ones((len(self.effects) + 1, len(theta)))  # of each one's error, by estimates of its force
        for effect, known, own, before in self._ordered:
            without = sum((found[i].mean for i in before), found[0].mean)
            predict = partial(_of_columns, effect.predict, own)
            found.append(at_distinct(predict, theta[:, known], without))
            if effect.estimate is not None:
                grown[[0, *before]] *= _rms(without + found[-1].mean) / _rms(without)
        rows = [times[:, None, None] * one.factor.transpose(0, 2, 1)  # as they lie in memory
                for times, one in zip(grown, found, strict=True)]  # fmt: skip
        return Prediction(
            mean=sum((one.mean for one in found[1:]), found[0].mean),
            factor=np.concatenate(rows, axis=1).transpose(0, 2, 1),
            diagonal=np.sum(
                [times[:, None] ** 2 * one.diagonal for times, one in zip(grown, found, strict=True)], axis=0
            ),
        )

    def predict_mean(self, theta: ArrayLike) -> Array:
        """The mean (n, m) of `predict` alone."""
        theta = np.atleast_2d(np.asarray(theta, dtype=float))
        refuse_outside(self.space, theta)
        base = theta[:, : self.base.space.dim]
        found = [mean_at_distinct(lambda these, _: self.base.predict_mean(these), base, base)]
        for effect, known, own, before in self._ordered:
            without = sum((found[i] for i in before), found[0])
            predict = partial(_of_columns, effect.predict_mean, own)
            found.append(mean_at_distinct(predict, theta[:, known], without))
        return np.asarray(sum(found[1:], found[0]))

    def correlation(self, theta: Array, at: Array) -> Array:
        """Of the error along each column of the factor, at theta (n, d) with that at a point (d,): (n, r)."""
        base = self.base.space.dim
        found = [self.base.correlation(theta[:, :base], at[:base])]
        for effect, known, own, _ in self._ordered:
            columns = [known[column] for column in own]
            found.append(effect.surrogate.correlation(theta[:, columns], at[columns]))
        return np.concatenate(found, axis=1)

    @cached_property
    def _ordered(self) -> list[tuple[Effect, list[int], list[int], list[int]]]:
        """Effects in the order of `composed`; of each, which columns of theta it depends on, which of these
        are its own space's, and which ones (the base is 0) make the force that it is an estimate of."""
        place = {name: column for column, name in enumerate(self.space.names)}
        found: list[tuple[Effect, list[int], list[int], list[int]]] = []
        for effect in sorted(self.effects, key=lambda one: one.estimate is not None):
            columns = [place[name] for name in effect.space.names]
            before = [
                i
                for i, (one, *_) in enumerate(found, start=1)
                if effect.estimate and len(one.mechanisms) == 1 and one.mechanisms != effect.mechanisms
            ]
            seen = {column for i in before for column in found[i - 1][1]}  # fmt: skip
            known = sorted(seen.union(columns))
            found.append((effect, known, [known.index(column) for column in columns], before))
        return found


def _of_columns(predict: Callable[[Array, Array], T], columns: list[int], theta: Array, without: Array) -> T:
    return predict(theta[:, columns], without)


def effects_among(effects: Sequence[Effect], mechanisms: Collection[str]) -> list[Effect]:
    """Those of a set of mechanisms, and of its pairs where each part is there."""
    found = [effect for effect in effects if set(effect.mechanisms) <= set(mechanisms)]
    alone = {name for effect in found if len(effect.mechanisms) == 1 for name in effect.own}
    return [effect for effect in found if alone.issuperset(effect.own)]


def with_effects(base: ShapeSurrogate, effects: Sequence[Effect]) -> Surrogate:
    """The base's surrogate itself where there are none."""
    return WithEffects(base, tuple(effects)) if effects else base
