"""The adhesive creeps: beyond a threshold force the pads slide on the skin, and do not slide back.

    ds/dt = r sgn(F) max(|F| - F0, 0) ,   the skin sees u - s

where F is the force beyond that at the start of the test.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayeskin.finite_element.problem import Sites
from bayeskin.finite_element.tissue import SeriesElement, TissueLaw
from bayeskin.mechanisms.mechanism import ForceOfTime, Instrument, Mechanism, Place, Values
from bayeskin.mechanisms.series import lost_in_series, mean_beyond
from bayeskin.number_format import number
from bayeskin.types import Array, PadMotion, Parameter


class Slip(SeriesElement):
    """Slip at a rate [m/(N s)] beyond a threshold force [N].

    The memory holds the slip [m] and the force [N].
    """

    def __init__(self, rate: float, threshold_n: float) -> None:
        self._rate, self._threshold_n = rate, threshold_n

    def follow(self, force_n: float, elapsed_s: float, before: Array) -> Array:
        more = self._rate * elapsed_s * mean_beyond(float(before[1]), force_n, self._threshold_n)
        return np.array([before[0] + more, force_n])


def bind(values: Mapping[str, float], sites: Sites) -> TissueLaw:
    """Returns the tissue law for `slip_rate` and `slip_threshold`."""
    return TissueLaw(series=Slip(values["slip_rate"], values["slip_threshold"]))


def observe(values: Values, motion: PadMotion, force: ForceOfTime) -> ForceOfTime:
    """Returns the reported force by the shortcut of `series`."""
    return lost_in_series(motion, force, rate=values["slip_rate"], threshold_n=values["slip_threshold"])


MECHANISM = Mechanism(
    name="pad-slip",
    parameters=(
        Parameter(
            "slip_rate",
            "m/(N s)",
            0.0,
            1e-3,
            "log-uniform",
            "speed of the slip per force above the threshold",
            stress_power=-1,
            offset=1e-6,
        ),
        Parameter(
            "slip_threshold", "N", 0.0, 0.3, "uniform", "force above which the pads slip", stress_power=1
        ),
    ),
    neutral={"slip_rate": 0.0, "slip_threshold": 0.1},
    statement=lambda v: (
        f"The pads slip on the skin by {number(1e3 * v['slip_rate'], 2)} mm a second for each newton above "
        f"{number(v['slip_threshold'], 2)} N, and do not slip back."
    ),
    look_alikes=("plastic-set", "preconditioning", "slow-recovery"),
    act=Instrument(Place.PADS, observe, bind, adds=False),
)
