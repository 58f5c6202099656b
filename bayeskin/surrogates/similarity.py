"""Reduces the number of inputs of a surrogate by a similarity law: forces scale with stresses.

The equations are quasi-static and the constituents are almost incompressible. If the moduli are multiplied by
c and the permeabilities by 1/c, the forces are therefore multiplied by c. With a modulus E as reference,

    F(E, E_2, k) = E f(E_2 / E, k E)

One direction of the parameter space therefore needs no runs at all. The compressibility of fluid and grains
causes a deviation from this law (about 1e-4 at E = 1 MPa). The held-out error includes this deviation.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bayeskin.types import Array, ParameterSpace


@dataclass(frozen=True)
class Similarity:
    """Converts the parameters of a space to inputs under the similarity law.

    `Parameter.stress_power` says how each parameter scales. Without a positive parameter of stress power 1
    the law does not apply, and the inputs are the coordinates in the unit cube.
    """

    space: ParameterSpace

    @cached_property
    def _powers(self) -> Array:
        """Returns the stress powers (d,) of the parameters, with 0 for those that cannot be scaled.

        A parameter can be scaled if it is positive everywhere, or with its offset.
        """
        return np.array(
            [p.stress_power if p.lower + p.offset > 0.0 else 0 for p in self.space.parameters], dtype=float
        )

    @cached_property
    def _reference(self) -> int | None:
        """Returns the index of the reference modulus, or None if there is none."""
        moduli = [i for i, p in enumerate(self.space.parameters) if p.stress_power == 1 and p.lower > 0.0]
        return int(moduli[0]) if len(moduli) else None

    @property
    def dim(self) -> int:
        """Returns the number of inputs."""
        return self.space.dim - (self._reference is not None)

    def inputs(self, theta: Array) -> Array:
        """Returns the inputs (n, dim) on which the scaled force depends, for theta (n, d).

        They lie in [0, 1] over the box.
        """
        unit, reference, powers = self.space.to_unit(theta), self._reference, self._powers
        if reference is None:
            return unit
        low, width = self._range
        value = (self._scaled(theta, theta[:, reference]) - low) / width
        return np.asarray(np.where(powers != 0.0, value, unit)[:, np.arange(len(powers)) != reference])

    @cached_property
    def _range(self) -> tuple[Array, Array]:
        """Returns the minimum of `_scaled` over the box and the width of its range, (d,) each."""
        corners = np.repeat([self.space.lower, self.space.upper], 2, axis=0)
        modulus = np.tile([self.space.lower[self._reference], self.space.upper[self._reference]], 2)
        values = self._scaled(corners, modulus)
        low, width = values.min(axis=0), np.ptp(values, axis=0)
        return low, np.where(width > 0.0, width, 1.0)

    def _scaled(self, theta: Array, modulus: Array) -> Array:
        """Returns log(theta / E^power + offset / E_mid^power), (n, d); E_mid is the middle of E's prior."""
        powers = self._powers
        value = theta * modulus[:, None] ** -powers + self._offset
        return np.log(np.where(powers != 0.0, value, 1.0))

    @cached_property
    def _offset(self) -> Array:
        """Returns the offsets (d,) divided by E_mid^power."""
        reference = self._reference
        assert reference is not None
        middle = np.sqrt(self.space.lower[reference] * self.space.upper[reference])
        return np.array([p.offset for p in self.space.parameters]) * middle**-self._powers

    def log_scale(self, theta: Array) -> Array:
        """Returns the logarithm (n,) of the factor to which the force is proportional at fixed inputs."""
        return np.zeros(len(theta)) if self._reference is None else np.log(theta[:, self._reference])
