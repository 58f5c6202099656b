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
        """Stress powers (d,) of the parameters that can be scaled: positive ones, or 0 with an offset."""
        return np.array(
            [p.stress_power if p.lower + p.offset > 0.0 else 0 for p in self.space.parameters], dtype=float
        )

    @cached_property
    def _reference(self) -> int | None:
        found = [i for i, p in enumerate(self.space.parameters) if p.stress_power == 1 and p.lower > 0.0]
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
        low, width = self._range
        value = (self._scaled(theta, theta[:, reference]) - low) / width
        return np.asarray(np.where(powers != 0.0, value, unit)[:, np.arange(len(powers)) != reference])

    @cached_property
    def _range(self) -> tuple[Array, Array]:
        """Lowest of `_scaled` over the box and how far up it reaches, (d,) each."""
        corners = np.repeat([self.space.lower, self.space.upper], 2, axis=0)
        modulus = np.tile([self.space.lower[self._reference], self.space.upper[self._reference]], 2)
        found = self._scaled(corners, modulus)
        low, width = found.min(axis=0), np.ptp(found, axis=0)
        return low, np.where(width > 0.0, width, 1.0)

    def _scaled(self, theta: Array, modulus: Array) -> Array:
        """log(theta / E^power + offset / E_mid^power), (n, d); E_mid the middle of its prior."""
        powers = self._powers
        value = theta * modulus[:, None] ** -powers + self._offset
        return np.log(np.where(powers != 0.0, value, 1.0))

    @cached_property
    def _offset(self) -> Array:
        """Offsets (d,) over E_mid^power."""
        reference = self._reference
        assert reference is not None
        middle = np.sqrt(self.space.lower[reference] * self.space.upper[reference])
        return np.array([p.offset for p in self.space.parameters]) * middle**-self._powers

    def log_scale(self, theta: Array) -> Array:
        """Logarithm (n,) of what the force is proportional to at fixed inputs."""
        return np.zeros(len(theta)) if self._reference is None else np.log(theta[:, self._reference])
