"""Surrounding tissue is recruited and returns slowly: a Kelvin-Voigt element in series with the skin.

    ds/dt = (c F - s) / tau ,   the skin sees u - s

The compliance c is the reciprocal of the element's stiffness, so that c = 0 switches it off. Over a time h in
which F goes linearly from F_0 to F_1, with z = h / tau and phi = (1 - e^-z) / z,

    s_1 = e^-z s_0 + c [ (phi - e^-z) F_0 + (1 - phi) F_1 ] .

The element is tissue, but it acts like the series elements of the instrument, between pads and skin.

Range: the stiffness is at least 0.5 N/mm; recovery takes seconds to minutes (Wan Abas & Barbenel, J. Biomed.
Eng. 4 (1982), 33-38).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayeskin.finite_element.problem import Sites
from bayeskin.finite_element.tissue import SeriesElement, TissueLaw
from bayeskin.mechanisms.mechanism import ForceOfTime, Instrument, Mechanism, Place, Values
from bayeskin.mechanisms.series import lost_in_series
from bayeskin.number_format import number
from bayeskin.types import Array, PadMotion, Parameter


class KelvinVoigt(SeriesElement):
    """An element with a compliance [m/N] and a time constant [s].

    The memory holds the lost displacement [m] and the force [N].
    """

    def __init__(self, compliance: float, time_s: float) -> None:
        self._compliance, self._time_s = compliance, time_s

    def follow(self, force_n: float, elapsed_s: float, before: Array) -> Array:
        z = elapsed_s / self._time_s
        keep, phi = np.exp(-z), -np.expm1(-z) / z
        force = (phi - keep) * before[1] + (1.0 - phi) * force_n
        return np.array([keep * before[0] + self._compliance * force, force_n])


def bind(values: Mapping[str, float], sites: Sites) -> TissueLaw:
    """Returns the tissue law for `recovery_compliance` and `recovery_time`."""
    return TissueLaw(series=KelvinVoigt(values["recovery_compliance"], values["recovery_time"]))


def observe(values: Values, motion: PadMotion, force: ForceOfTime) -> ForceOfTime:
    """Returns the reported force by the shortcut of `series`."""
    slow, time_s = values["recovery_compliance"], values["recovery_time"]
    return lost_in_series(motion, force, recovery=slow, recovery_s=time_s)


MECHANISM = Mechanism(
    name="slow-recovery",
    parameters=(
        Parameter(
            "recovery_compliance",
            "m/N",
            0.0,
            2e-3,
            "log-uniform",
            "compliance of the surrounding tissue",
            stress_power=-1,
            offset=2e-5,
        ),
        Parameter("recovery_time", "s", 1.0, 300.0, "log-uniform", "time constant of yield and return"),
    ),
    neutral={"recovery_compliance": 0.0, "recovery_time": 30.0},
    statement=lambda v: (
        f"The surrounding tissue yields by {number(1e3 * v['recovery_compliance'], 2)} mm for each newton, "
        f"with a time constant of {v['recovery_time']:.0f} s, and returns as slowly."
    ),
    act=Instrument(Place.PADS, observe, bind, adds=False, of_skin=True),
)
