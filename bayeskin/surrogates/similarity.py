"""Similarity: fewer inputs, because forces scale with stresses.

The equations are quasi-static and their constituents all but incompressible, so moduli multiplied by c
and permeabilities by 1/c give forces multiplied by c. Hence, with a modulus E for reference,

    F(E, E_2, k) = E f(E_2 / E, k E)

and one direction of the parameter space needs no runs at all. What the compressibility of fluid and
grains takes from the law (some 1e-4 at E = 1 MPa) shows in the held-out error like any other.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bayeskin.types import Array, ParameterSpace


@dataclass(frozen=True)
class Similarity:
    """A parameter space seen through the law; `Parameter.stress_power` says how each enters.

    Without a positive parameter of stress power 1 there is no law: the inputs are the unit cube.
    """

    space: ParameterSpace

    @cached_property
    def _powers(self) -> Array:
        """Stress powers (d,) of the parameters that can be scaled: the positive ones."""
        return np.array([p.stress_power if p.lower > 0.0 else 0 for p in self.space.parameters], dtype=float)

    @cached_property
    def _reference(self) -> int | None:
        found = np.flatnonzero(self._powers == 1.0)
        return int(found[0]) if len(found) else None

    @property
    def dim(self) -> int:
        """Number of inputs."""
        return self.space.dim - (self._reference is not None)

    def inputs(self, theta: Array) -> Array:
        """Coordinates (n, dim) on which the scaled force depends, in [0, 1] over the box; theta (n, d)."""
        unit, reference, powers = self.space.to_unit(theta), self._reference, self._powers
        if reference is None:
            return unit
        lower, upper = np.log(self._positive(self.space.lower)), np.log(self._positive(self.space.upper))
        value = np.log(self._positive(theta)) - powers * np.log(theta[:, [reference]])
        ends = np.stack([powers * lower[reference], powers * upper[reference]])
        low, high = lower - ends.max(axis=0), upper - ends.min(axis=0)
        scaled = powers != 0.0
        width = np.where(high > low, high - low, 1.0)
        return np.delete(np.where(scaled, (value - low) / width, unit), reference, axis=1)

    def log_scale(self, theta: Array) -> Array:
        """Logarithm (n,) of what the force is proportional to at fixed inputs."""
        return np.zeros(len(theta)) if self._reference is None else np.log(theta[:, self._reference])

    def _positive(self, values: Array) -> Array:
        return np.where(self._powers != 0.0, values, 1.0)
