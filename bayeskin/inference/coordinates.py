"""Coordinates in which moves are proposed: they have straight ridges and no bounds.

A parameter that the data do not inform stays uniform between the two bounds of its prior. A proposal beyond a
bound is lost; with several such parameters nearly all proposals are lost. Therefore every sampling coordinate
outside the shear's group is replaced by its normal score y, with x = low + (high - low) Phi(y). A uniform
prior of x is a standard normal of y. The chain itself stays in sampling coordinates. `log_volume` gives the
change of volume, which enters the acceptance of a move.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from bayeskin.inference.reparametrisation import Shear
from bayeskin.types import Array, FreezesArrays

_EDGE = 1e-14  # smallest distance from a bound at which a score is taken, as a share of the box


@dataclass(frozen=True)
class MoveCoordinates(FreezesArrays):
    """The map from sampling coordinates x (n, D), inside the box low..high (D,), to y (n, D)."""

    shear: Shear | None
    low: Array
    high: Array

    @property
    def scored(self) -> NDArray[np.bool_]:
        """Returns which columns are normal scores, (D,) bool."""
        return np.ones(len(self.low), bool) if self.shear is None else ~self.shear.group

    def forward(self, x: Array) -> Array:
        """Returns y (n, D) of x (n, D)."""
        y = np.array(x if self.shear is None else self.shear.straight(x))
        c = self.scored
        share = (y[:, c] - self.low[c]) / (self.high[c] - self.low[c])
        y[:, c] = ndtri(np.clip(share, _EDGE, 1.0 - _EDGE))
        return y

    def back(self, y: Array) -> Array:
        """Returns x (n, D) of y (n, D)."""
        x, c = np.array(y), self.scored
        x[:, c] = self.low[c] + (self.high[c] - self.low[c]) * ndtr(y[:, c])
        return x if self.shear is None else self.shear.back(x)

    def log_volume(self, y: Array) -> Array:
        """Returns log |dx / dy| (n,), up to a constant; the shear itself keeps volumes."""
        return np.asarray(-0.5 * np.sum(y[:, self.scored] ** 2, axis=1))
