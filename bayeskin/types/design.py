"""Parameter points with the full model's force at each of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayeskin.types.arrays import Array, FreezesArrays
from bayeskin.types.parameters import ParameterSpace


@dataclass(frozen=True)
class Design(FreezesArrays):
    """Parameter points, and the full model's force at each of them.

    theta : the points, (n, d)
    force_n : bin means of the force, (n, m); a row of NaN where the run failed
    edges_s : the edges of the bins, (m+1,)
    wave : the wave of each point, (n,): 0, 1, ...
    held_out : which points are held out, (n,) bool
    ok : which runs succeeded, (n,) bool
    messages : the messages of failed runs, (n,)
    seconds : the duration of each run, (n,)
    """

    space: ParameterSpace
    edges_s: Array
    theta: Array
    force_n: Array
    wave: NDArray[np.int64]
    held_out: NDArray[np.bool_]
    ok: NDArray[np.bool_]
    messages: tuple[str, ...]
    seconds: Array
    seed: int
    model_hash: str

    @property
    def training(self) -> NDArray[np.bool_]:
        """Returns the rows that a surrogate may be trained on, (n,)."""
        return self.ok & ~self.held_out

    @property
    def testing(self) -> NDArray[np.bool_]:
        """Returns the rows that no surrogate may be trained on, (n,)."""
        return self.ok & self.held_out
