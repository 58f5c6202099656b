"""What tissue mechanisms do to the force, beside a surrogate of the base model.

With theta the base parameters, phi those of one part of a mechanism, s its strength and F the force,

    F(theta, phi) = F_0(theta) + s G(theta, phi) ,   s = (phi_1 - neutral) / E^power ,

so that moving phi_1 off its neutral value switches the effect on and nothing remains at it. G is learnt as
any force is, amplitude and shape, from full runs with and without the mechanism at the same theta; it scales
as forces do (`similarity`).

Where a mechanism has an estimate D(F_0, phi) of its own effect, only what it leaves is learnt, in units of
the estimate's RMS over time, |D|:

    F(theta, phi) = F_0 + D + |D| (H(theta, phi) / c - 1) ,   c the force that similarity takes out,

so that H / c is near one everywhere and has a logarithm, whatever the sign of what is left.

Effects of several parts add up: what they do to each other is left to full runs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bayeskin.errors import InputError
from bayeskin.surrogates.similarity import Similarity
from bayeskin.surrogates.surrogate import ShapeSurrogate, refuse_outside
from bayeskin.surrogates.train import Kind, train
from bayeskin.surrogates.validate import Validation
from bayeskin.types import Array, Design, ParameterSpace, Prediction, Surrogate

Estimate = Callable[[Array, Array], Array]  # own parameters (n, k), force without (n, m) to its change (n, m)
SMALLEST = 5e-4  # of the base force, RMS: below it an effect is the solver's noise
SMALL = 5e-3  # from here on an effect's own relative error decides


@dataclass(frozen=True)
class Effect:
    """One part of a mechanism: `surrogate` of G, or of H, over the base's and the part's own parameters.

    The first own parameter is the strength, 0 effect at `neutral`. estimate: D, where the mechanism has one.
    """

    part: str
    mechanism: str
    neutral: float
    own: tuple[str, ...]
    surrogate: ShapeSurrogate
    estimate: Estimate | None = None

    @property
    def space(self) -> ParameterSpace:
        return self.surrogate.space

    def predict(self, theta: Array, base: Array) -> Prediction:
        """What the effect adds to the base's force (n, m), at theta (n, d) in the order of its space."""
        found = self.surrogate.predict(theta)
        if self.estimate is None:
            unit, change = strength(self.space, self.own[0], self.neutral, theta), np.zeros_like(base)
        else:
            change = self.estimate(theta[:, -len(self.own) :], base)
            unit = _rms(change) * np.exp(-Similarity(self.space).log_scale(theta))
            change = change - _rms(change)[:, None]
        return Prediction(
            change + found.mean * unit[:, None],
            found.factor * unit[:, None, None],
            found.diagonal * unit[:, None] ** 2,
        )


def _rms(values: Array) -> Array:
    """Over time, (n,)."""
    return np.asarray(np.sqrt(np.mean(values**2, axis=1)))


def strength(space: ParameterSpace, name: str, neutral: float, theta: Array) -> Array:
    """s (n,) at theta (n, d): the parameter's distance from neutral, over the modulus to its power."""
    column = space.names.index(name)
    scale = Similarity(space).log_scale(theta)
    return np.asarray((theta[:, column] - neutral) * np.exp(-space.parameters[column].stress_power * scale))


def train_effect(
    part: str,
    mechanism: str,
    neutral: float,
    own: Sequence[str],
    base: Array,
    design: Design,
    kind: Kind | str = "auto",
    seed: int = 0,
    estimate: Estimate | None = None,
) -> tuple[Effect, Validation]:
    """From runs with the effect, `design`, and the base's force (n, m) at the same base parameters.

    Rows whose effect is next to nothing are left out; the validation is of G, or of H. Raises InputError
    where too few rows show an effect.
    """
    s = strength(design.space, own[0], neutral, design.theta)
    change = design.force_n - base
    with np.errstate(invalid="ignore"):
        size = _rms(change) / _rms(base)
    shows = design.ok & (size > SMALLEST) & (np.abs(s) > 0.0)
    weights = np.where(shows, (size / (size + SMALL)) ** 2, 0.0)
    learnt = np.full_like(change, np.nan)
    if estimate is None:
        learnt[shows] = change[shows] / s[shows, None]
    else:
        guess = estimate(design.theta[:, -len(own) :], base)
        left = (change - guess)[shows] / _rms(guess)[shows, None]
        learnt[shows] = np.exp(Similarity(design.space).log_scale(design.theta[shows]))[:, None] * (
            1.0 + left
        )
    seen = replace(design, force_n=learnt, ok=shows)
    surrogate, validation = train(seen, kind, seed, weights)  # type: ignore[arg-type]
    return Effect(part, mechanism, neutral, tuple(own), surrogate, estimate), validation


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
        """The base's parameters, then each effect's own."""
        own = [effect.space.parameters[-len(effect.own) :] for effect in self.effects]
        return ParameterSpace((*self.base.space.parameters, *(p for part in own for p in part)))

    @property
    def provenance(self) -> Mapping[str, Any]:
        parts = {effect.part: dict(effect.surrogate.provenance) for effect in self.effects}
        return {**self.base.provenance, "effects": parts}

    def predict(self, theta: ArrayLike) -> Prediction:
        """Force at theta (n, d) or (d,), with its uncertainty; errors of the parts taken as independent."""
        theta = np.atleast_2d(np.asarray(theta, dtype=float))
        refuse_outside(self.space, theta)
        names = self.space.names
        found = [self.base.predict(theta[:, : self.base.space.dim])]
        for effect in self.effects:
            columns = [names.index(name) for name in effect.space.names]
            found.append(effect.predict(theta[:, columns], found[0].mean))
        return Prediction(
            mean=np.sum([one.mean for one in found], axis=0),
            factor=np.concatenate([one.factor for one in found], axis=2),
            diagonal=np.sum([one.diagonal for one in found], axis=0),
        )


def with_effects(base: ShapeSurrogate, effects: Sequence[Effect]) -> Surrogate:
    """The base's surrogate itself where there are none."""
    return WithEffects(base, tuple(effects)) if effects else base
