"""Draws the training cases of a reduced model: parameters from the prior, mechanisms, geometry and protocol.

A reduced model is not tied to any protocol. It learns from short random protocols that contain all that a
protocol may do: unload fully, hold at zero, load slowly or fast.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bayeskin.geometry import Geometry
from bayeskin.types import PadMotion, ParameterSpace

BASE = "base"  # the kind of runs without a mechanism
SETS = "sets"  # the kind of runs with one to four mechanisms


@dataclass(frozen=True)
class CaseSettings:
    """Settings of the drawing of training cases.

    accompanied : fraction of a mechanism's runs in which one or two other mechanisms act as well
    moved_base, moved : fraction of the base model's runs, and of the other runs, in which the layers have
        other thicknesses and the arm has another radius
    thickness_range, radius_range : largest relative changes of the layers and of the arm
    """

    accompanied: float = 0.5
    moved_base: float = 0.5
    moved: float = 0.25
    thickness_range: float = 0.4
    radius_range: float = 0.3


CASES = CaseSettings()


@dataclass(frozen=True)
class Protocols:
    """Bounds of the random protocols: largest displacement [m], range of speeds [m/s] and of holds [s].

    returns, rests : fraction of the protocols that unload fully, and fraction that hold after unloading
    """

    largest_m: float = 10e-3
    speeds_m_s: tuple[float, float] = (0.1e-3, 5e-3)
    holds_s: tuple[float, float] = (2.0, 300.0)
    returns: float = 0.3
    rests: float = 0.6


@dataclass(frozen=True)
class Case:
    """The input of one training run: values of all parameters, names of mechanisms, geometry and protocol."""

    theta: Mapping[str, float]
    mechanisms: tuple[str, ...]
    geometry: Geometry
    motion: PadMotion


@dataclass(frozen=True)
class Trained:
    """The region that a reduced model is trained for: priors, geometry and protocols.

    base : priors of the model without mechanisms
    mechanisms : priors of each mechanism's parameters, by the name of the mechanism
    """

    geometry: Geometry
    base: ParameterSpace
    mechanisms: Mapping[str, ParameterSpace]
    protocols: Protocols = Protocols()

    def case(self, kind: str, index: int, seed: int) -> Case:
        """Returns case `index` of a kind: "base", "sets", or the name of a mechanism that acts in it."""
        rng = np.random.default_rng([seed, index, *kind.encode()])
        names = self._names(kind, rng)
        moved = CASES.moved_base if kind == BASE else CASES.moved
        return Case(
            self._theta(names, rng), names, self._moved(moved, rng), random_motion(rng, self.protocols)
        )

    def _names(self, kind: str, rng: np.random.Generator) -> tuple[str, ...]:
        if kind == BASE:
            return ()
        chosen = () if kind == SETS else (kind,)
        if kind == SETS:
            count = int(rng.integers(1, 5))
        else:
            count = int(rng.integers(1, 3)) if rng.uniform() < CASES.accompanied else 0
        others = sorted(set(self.mechanisms) - set(chosen))
        return tuple(sorted([*chosen, *rng.choice(others, min(count, len(others)), replace=False).tolist()]))

    def _theta(self, names: Sequence[str], rng: np.random.Generator) -> dict[str, float]:
        theta = _drawn(self.base, rng)
        for name in names:
            theta |= _drawn(self.mechanisms[name], rng)
        return theta

    def _moved(self, share: float, rng: np.random.Generator) -> Geometry:
        g, (cutis, subcutis, radius) = self.geometry, rng.uniform(-1.0, 1.0, 3)
        if rng.uniform() >= share:
            return g
        return replace(
            g,
            cutis_m=g.cutis_m * (1.0 + CASES.thickness_range * cutis),
            subcutis_m=g.subcutis_m * (1.0 + CASES.thickness_range * subcutis),
            arm_radius_m=None
            if g.arm_radius_m is None
            else g.arm_radius_m * (1.0 + CASES.radius_range * radius),
        )


def _drawn(space: ParameterSpace, rng: np.random.Generator) -> dict[str, float]:
    return dict(zip(space.names, map(float, space.from_unit(rng.uniform(size=space.dim))), strict=True))


def random_motion(rng: np.random.Generator, bounds: Protocols) -> PadMotion:
    """Returns a random protocol of four or five phases: load, hold, unload, often hold, load."""
    smallest_m = 0.03 * bounds.largest_m
    time_s, height_m = [0.0], [0.0]

    def go(to_m: float) -> None:
        if abs(to_m - height_m[-1]) < smallest_m:
            to_m = height_m[-1] + smallest_m
        time_s.append(time_s[-1] + abs(to_m - height_m[-1]) / float(_log_uniform(rng, bounds.speeds_m_s)))
        height_m.append(to_m)

    def hold() -> None:
        time_s.append(time_s[-1] + float(_log_uniform(rng, bounds.holds_s)))
        height_m.append(height_m[-1])

    first_m = rng.uniform(0.3, 1.0) * bounds.largest_m
    go(first_m)
    hold()
    go(0.0 if rng.uniform() < bounds.returns else rng.uniform(0.0, 0.7) * first_m)
    if rng.uniform() < bounds.rests:
        hold()
    go(rng.uniform(0.7 * first_m, bounds.largest_m))
    return PadMotion(np.array(time_s), np.array(height_m))


def _log_uniform(rng: np.random.Generator, bounds: tuple[float, float]) -> float:
    return float(np.exp(rng.uniform(np.log(bounds[0]), np.log(bounds[1]))))
