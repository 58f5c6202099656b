"""The load cell's amplifier smooths the noise of its signal, and acts as a first-order low-pass filter.

    tau dy/dt = F - y ,   y(0) = F(0)

On a ramp y lags by tau dF/dt. After each corner it approaches the new lag exponentially. If the force changes
linearly by D over a time h, the lag d = y - F has a closed form, with z = h / tau,

    d_1 = d_0 + (e^-z - 1) (d_0 + D / z) ,

for every z. The force is taken to be linear over `GRID_S` and between corners of the protocol, and may jump
at corners. Steps of the load cell's zero come before the filter, which smooths them too.

It is a look-alike of `clock-delay`. For a force that rises to 0.45 N at 1 mm/s, in bins of 0.5 s, the best
delay leaves 0.07 mN RMS of a lag with tau = 0.1 s, 1.2 mN of one with 0.5 s, and 10 mN of one with 2 s.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math

import numba
import numpy as np

from bayeskin.mechanisms.lines import stretch_of, strict
from bayeskin.mechanisms.mechanism import ForceOfTime, Instrument, Mechanism, Place, Values, added
from bayeskin.number_format import number
from bayeskin.types import Array, PadMotion, Parameter

GRID_S = 0.05
BEFORE_S = 1e-6  # the grid has a time this long before each corner, where a force may jump
QUICKEST_S = 0.01  # a smaller time constant acts as if there were none


def observe(values: Values, motion: PadMotion, force: ForceOfTime) -> ForceOfTime:
    """Adds the lag of the amplifier to the force."""
    corners, tau = motion.time_s, np.ascontiguousarray(values["amplifier_time"])
    grid_s = motion.times(GRID_S, np.union1d(corners, corners[1:-1] - BEFORE_S))
    change = np.diff(np.broadcast_to(force(grid_s), (len(tau), len(grid_s))))
    at_grid = np.zeros((len(tau), len(grid_s)))
    _follow(np.diff(grid_s), change, tau, at_grid)

    def lag(time_s: Array) -> Array:
        times = np.ascontiguousarray(np.atleast_2d(time_s))
        out = np.empty((len(tau), times.shape[1]))
        _between(grid_s, change, tau, at_grid, times, out)
        return out

    return added(force, lag)


@numba.njit(inline="always")
def _after(lag, elapsed, change, tau):
    """Returns the lag after a time over which the force changes linearly by `change`."""
    z = elapsed / tau
    return lag + math.expm1(-z) * (lag + change / z)


@strict
def _follow(steps, change, tau, at_grid):
    """Fills at_grid (n, k) with the lag after each time step.

    steps (k-1,) are the lengths of the time steps, and change (n, k-1) the changes of the forces over them.
    """
    for i in range(at_grid.shape[0]):
        for k in range(len(steps)):
            at_grid[i, k + 1] = _after(at_grid[i, k], steps[k], change[i, k], tau[i])


@strict
def _between(grid, change, tau, at_grid, times, out):
    """Fills out (n, t) with the lag at times (1 or n, t)."""
    for i in range(out.shape[0]):
        row, left = times[i if len(times) > 1 else 0], 0
        for j in range(out.shape[1]):
            left = stretch_of(grid, left, row[j])
            elapsed, step = row[j] - grid[left], grid[left + 1] - grid[left]
            out[i, j] = at_grid[i, left]
            if elapsed > 0.0:
                elapsed = min(elapsed, step)
                out[i, j] = _after(out[i, j], elapsed, change[i, left] * elapsed / step, tau[i])


MECHANISM = Mechanism(
    name="amplifier-lag",
    parameters=(
        Parameter(
            "amplifier_time",
            "s",
            0.0,
            2.0,
            "log-uniform",
            "time constant of the amplifier",
            offset=QUICKEST_S,
        ),
    ),
    neutral={"amplifier_time": 0.0},
    statement=lambda v: (
        f"The load cell's amplifier smooths the force, with a time constant of "
        f"{number(1e3 * v['amplifier_time'], 2)} ms."
    ),
    look_alikes=("clock-delay",),
    act=Instrument(Place.AMPLIFIER, observe, adds=False, settles_s=QUICKEST_S),
)
