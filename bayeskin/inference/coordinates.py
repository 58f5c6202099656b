"""Coordinates in which moves are proposed: ridges straight, and no walls.

A parameter that the data leave as the prior had it is uniform between two walls, and proposals that
leap over a wall are lost: with several such parameters nearly all are. So every sampling coordinate
outside the shear's group is replaced by its normal score y, x = low + (high - low) Phi(y), in which a
uniform prior is a standard normal. The chain itself stays in sampling coordinates; what the change of
volume does to a move's acceptance is in `log_volume`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from bayeskin.inference.reparametrisation import Shear
from bayeskin.types import Array, _FreezesArrays

_EDGE = 1e-14  # nearest to a wall that a score is taken


@dataclass(frozen=True)
class MoveCoordinates(_FreezesArrays):
    """The map from sampling coordinates x (n, D), inside the box low..high (D,), to y (n, D)."""

    shear: Shear | None
    low: Array
    high: Array

    @property
    def scored(self) -> NDArray[np.bool_]:
        """Which columns are normal scores, (D,) bool."""
        return np.ones(len(self.low), bool) if self.shear is None else ~self.shear.group

    def forward(self, x: Array) -> Array:
        """y of x, (n, D)."""
        y = np.array(x if self.shear is None else self.shear.straight(x))
        c = self.scored
        share = (y[:, c] - self.low[c]) / (self.high[c] - self.low[c])
        y[:, c] = ndtri(np.clip(share, _EDGE, 1.0 - _EDGE))
        return y

    def back(self, y: Array) -> Array:
        """x of y, (n, D)."""
        x, c = np.array(y), self.scored
        x[:, c] = self.low[c] + (self.high[c] - self.low[c]) * ndtr(y[:, c])
        return x if self.shear is None else self.shear.back(x)

    def log_volume(self, y: Array) -> Array:
        """log |dx / dy| (n,), up to a constant; the shear itself keeps volumes."""
        return np.asarray(-0.5 * np.sum(y[:, self.scored] ** 2, axis=1))
