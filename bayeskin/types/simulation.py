"""One run of the full model: its force over time, and the derivatives of the force."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayeskin.types.arrays import Array, FreezesArrays

Observation = Literal["reaction", "article", "own"]  # the force that a model reports


@dataclass(frozen=True)
class Simulation(FreezesArrays):
    """One run of the full model.

    A failed run is a value too: its `status` is not "ok", and its `message` says what to do.

    time_s, displacement_m, force_n : the accepted time steps with the corners of the protocol, (n,) each;
        `displacement_m` is the LVDT displacement
    corner : True at the protocol's corners, where the slope of the force jumps, (n,)
    stats : counts and seconds, as floats
    gradient_n : derivatives of the force by the parameters `gradient_names`, (n, r); each is multiplied by
        the change that was requested for its parameter
    """

    theta: Mapping[str, float]
    time_s: Array
    displacement_m: Array
    force_n: Array
    corner: NDArray[np.bool_]
    status: Literal["ok", "failed"]
    message: str
    stats: Mapping[str, float]
    model_hash: str
    gradient_names: tuple[str, ...] = ()
    gradient_n: Array = field(default_factory=lambda: np.zeros((0, 0)))

    def at(self, time_s: ArrayLike) -> Array:
        """Returns the force [N] at given times, by `between_steps`."""
        return self.between_steps(self.force_n, time_s)

    def between_steps(self, values: Array, time_s: ArrayLike) -> Array:
        """Returns values at given times (q,), (q, ...), from values at the time steps (n, ...).

        Between time steps, they are a monotone cubic (PCHIP) inside each phase. They are continuous at
        corners.
        """
        from scipy.interpolate import PchipInterpolator, make_interp_spline

        query = np.asarray(time_s, dtype=float)
        if len(self.time_s) == 1:  # a run that failed in its first step
            return np.broadcast_to(values[0], query.shape + values.shape[1:]).copy()
        within = np.clip(query, self.time_s[0], self.time_s[-1])
        out = np.asarray(make_interp_spline(self.time_s, values, k=1)(within))
        breaks = np.unique(np.concatenate([[0], np.flatnonzero(self.corner), [len(self.time_s) - 1]]))
        for a, b in pairwise(breaks):
            inside = (query >= self.time_s[a]) & (query <= self.time_s[b])
            if b - a >= 2 and inside.any():
                steps = slice(a, b + 1)
                out[inside] = PchipInterpolator(self.time_s[steps], values[steps])(query[inside])
        return out

    def bin_means(self, edges_s: ArrayLike) -> Array:
        """Returns the mean force [N] over each bin, (m,), by the trapezoidal rule on eleven points."""
        edges = np.asarray(edges_s, dtype=float)
        fine = edges[:-1, None] + np.linspace(0.0, 1.0, 11) * np.diff(edges)[:, None]
        return np.asarray(np.trapezoid(self.at(fine), dx=0.1, axis=1))

    def gradient_bin_means(self, edges_s: ArrayLike) -> Array:
        """Returns the mean of each column of `gradient_n` over each bin [N], (m, r)."""
        columns = [replace(self, force_n=column).bin_means(edges_s) for column in self.gradient_n.T]
        return np.stack(columns, axis=1)
