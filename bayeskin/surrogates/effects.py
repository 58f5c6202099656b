"""What tissue mechanisms do to the force, beside a surrogate of the base model.

With theta the base parameters, phi those of one part of a mechanism, s its strength and F the force,

    F(theta, phi) = F_0(theta) + s G(theta, phi) ,   s = (phi_1 - neutral) / E^power ,

so that moving phi_1 off its neutral value switches the effect on and nothing remains at it. G is learnt as
any force is, amplitude and shape, from full runs with and without the mechanism at the same theta; it scales
as forces do (`similarity`). Effects of several parts add up: what they do to each other is left to full runs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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

SMALLEST = 5e-4  # of the base force, RMS: below it an effect is the solver's noise
SMALL = 5e-3  # from here on an effect's own relative error decides


@dataclass(frozen=True)
class Effect:
    """One part of a mechanism: `surrogate` of G over the base's and the part's own parameters.

    The first own parameter is the strength, 0 effect at `neutral`.
    """

    part: str
    mechanism: str
    neutral: float
    own: tuple[str, ...]
    surrogate: ShapeSurrogate

    @property
    def space(self) -> ParameterSpace:
        return self.surrogate.space

    def predict(self, theta: Array) -> Prediction:
        """What the effect adds, at theta (n, d) in the order of its space."""
        s = strength(self.surrogate.similarity, self.own[0], self.neutral, theta)
        return self.surrogate.predict(theta, s)


def strength(similarity: Similarity, name: str, neutral: float, theta: Array) -> Array:
    """s (n,) at theta (n, d): the parameter's distance from neutral, over the modulus to its power."""
    space = similarity.space
    column = space.names.index(name)
    scale = similarity.log_scale(theta)
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
) -> tuple[Effect, Validation]:
    """From runs with the effect, `design`, and the base's force (n, m) at the same base parameters.

    Rows whose effect is next to nothing are left out; the validation is of G. Raises InputError where too
    few rows show an effect.
    """
    s = strength(Similarity(design.space), own[0], neutral, design.theta)
    change = design.force_n - base
    with np.errstate(invalid="ignore"):
        size = np.sqrt(np.mean(change**2, axis=1) / np.mean(base**2, axis=1))
    shows = design.ok & (size > SMALLEST) & (np.abs(s) > 0.0)
    weights = np.where(shows, (size / (size + SMALL)) ** 2, 0.0)
    per_strength = np.where(shows[:, None], change / np.where(shows, s, 1.0)[:, None], np.nan)
    seen = replace(design, force_n=per_strength, ok=shows)
    surrogate, validation = train(seen, kind, seed, weights)  # type: ignore[arg-type]
    return Effect(part, mechanism, neutral, tuple(own), surrogate), validation


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
        found = [self.base.predict(theta[:, : self.base.space.dim])]
        for effect, columns in zip(self.effects, self._columns, strict=True):
            found.append(effect.predict(theta[:, columns]))
        rows = [one.factor.transpose(0, 2, 1) for one in found]  # as they lie in memory
        return Prediction(
            mean=sum((one.mean for one in found[1:]), found[0].mean),
            factor=np.concatenate(rows, axis=1).transpose(0, 2, 1),
            diagonal=sum((one.diagonal for one in found[1:]), found[0].diagonal),
        )

    @cached_property
    def _columns(self) -> list[list[int]]:
        """Of each effect, where in `space` its parameters are."""
        return [[self.space.names.index(name) for name in effect.space.names] for effect in self.effects]


def with_effects(base: ShapeSurrogate, effects: Sequence[Effect]) -> Surrogate:
    """The base's surrogate itself where there are none."""
    return WithEffects(base, tuple(effects)) if effects else base
