"""The adhesive creeps: beyond a threshold the pads slide on the skin, and stay where they slid.

    ds/dt = r sgn(F) max(|F| - F0, 0) ,   the skin sees u - s

with F the force since the start of the test.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayeskin.mechanisms.mechanism import ForceOfTime, Instrument, Mechanism, Place, Values
from bayeskin.mechanisms.series import lost_in_series
from bayeskin.model.problem import Problem
from bayeskin.model.tissue import SeriesElement, TissueLaw
from bayeskin.types import Array, PadMotion, Parameter


def slid(before_n: Array, now_n: Array, elapsed_s: float, rate: Array, threshold_n: Array) -> Array:
    """Slip [m] in a time over which the force goes straight from one value to another."""
    onward = _mean_beyond(before_n - threshold_n, now_n - threshold_n)
    back = _mean_beyond(-before_n - threshold_n, -now_n - threshold_n)
    return rate * elapsed_s * (onward - back)


def _mean_beyond(a: Array, b: Array) -> Array:
    """Mean of what is positive on a straight line from a to b."""
    low, high = np.minimum(a, b), np.maximum(a, b)
    across = np.maximum(high, 0.0) ** 2 / (2.0 * np.maximum(high - low, 1e-30))
    return np.where(low >= 0.0, 0.5 * (a + b), np.where(high <= 0.0, 0.0, across))


class Slip(SeriesElement):
    """Memory: slip [m], force [N]."""

    def __init__(self, rate: float, threshold_n: float) -> None:
        self._rate, self._threshold_n = np.array(rate), np.array(threshold_n)

    def follow(self, force_n: float, elapsed_s: float, before: Array) -> Array:
        more = slid(before[1], np.array(force_n), elapsed_s, self._rate, self._threshold_n)
        return np.array([before[0] + float(more), force_n])


class PadSlip(TissueLaw):
    """The slip of a rate [m/(N s)] beyond a threshold [N]."""

    def __init__(self, rate: float, threshold_n: float) -> None:
        self.series = Slip(rate, threshold_n)


def bind(values: Mapping[str, float], problem: Problem) -> TissueLaw:
    """The law of `slip_rate` and `slip_threshold`."""
    return PadSlip(values["slip_rate"], values["slip_threshold"])


def observe(values: Values, motion: PadMotion, force: ForceOfTime) -> ForceOfTime:
    """The shortcut of `series`."""
    rate, threshold = values["slip_rate"], values["slip_threshold"]
    return lost_in_series(
        motion,
        force,
        len(rate),
        lambda before, now, elapsed_s, lost: lost + slid(before, now, elapsed_s, rate, threshold),
    )


MECHANISM = Mechanism(
    name="pad-slip",
    parameters=(
        Parameter(
            "slip_rate",
            "m/(N s)",
            0.0,
            1e-3,
            "log-uniform",
            "creep of the adhesive",
            stress_power=-1,
            offset=1e-6,
        ),
        Parameter(
            "slip_threshold", "N", 0.0, 0.3, "uniform", "force that it bears without creep", stress_power=1
        ),
    ),
    neutral={"slip_rate": 0.0, "slip_threshold": 0.1},
    statement=lambda v: (
        f"The pads slip on the skin, {1e3 * v['slip_rate']:.2g} mm a second for each newton beyond "
        f"{v['slip_threshold']:.2g} N, and do not come back."
    ),
    group=("pad-slip", "preconditioning", "slow-recovery"),
    act=Instrument(Place.PADS, observe, bind),
)
