"""Lost motion (backlash) of the drive and compliance of the frame.

The skin sees the displacement p - c F, where c is the compliance of the frame. The displacement p trails the
drive's displacement u as a nut with a gap g does. It starts at the lower end of the play:

    p(t) = max(u - g, min(u, p(t-))) ,   p(0) = 0 .

After each reversal, and at the first motion, the drive therefore moves over g without effect.
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


def trailing(motion: PadMotion, gap_m: float) -> PadMotion:
    """Returns the motion behind the gap, with its own corners."""
    time_s, behind = [float(motion.time_s[0])], [float(motion.displacement_m[0])]
    for t0, t1, u0, u1 in zip(
        motion.time_s[:-1],
        motion.time_s[1:],
        motion.displacement_m[:-1],
        motion.displacement_m[1:],
        strict=True,
    ):
        p0 = behind[-1]
        p1 = max(u1 - gap_m, min(u1, p0))
        if p1 != p0:
            taken_up = p0 + gap_m if u1 > u0 else p0  # the drive meets the other side of the gap here
            t = t0 + (taken_up - u0) / (u1 - u0) * (t1 - t0)
            if t0 + 1e-9 < t < t1 - 1e-9:
                time_s.append(float(t))
                behind.append(p0)
        time_s.append(float(t1))
        behind.append(float(p1))
    return PadMotion(np.array(time_s), np.array(behind))


class Play(SeriesElement):
    """A gap [m] and a compliance [m/N]. The memory is the displacement by which the frame yields [m]."""

    remembers = 1

    def __init__(self, gap_m: float, compliance: float) -> None:
        self._gap_m, self._compliance = gap_m, compliance

    def moved(self, motion: PadMotion) -> PadMotion:
        return trailing(motion, self._gap_m)

    def follow(self, force_n: float, elapsed_s: float, before: Array) -> Array:
        return np.array([self._compliance * force_n])


def bind(values: Mapping[str, float], sites: Sites) -> TissueLaw:
    """Returns the tissue law for `gap` and `frame_compliance`."""
    return TissueLaw(series=Play(values["gap"], values["frame_compliance"]))


def observe(values: Values, motion: PadMotion, force: ForceOfTime) -> ForceOfTime:
    """Returns the reported force by the shortcut of `series`."""
    return lost_in_series(motion, force, gap_m=values["gap"], compliance=values["frame_compliance"])


MECHANISM = Mechanism(
    name="backlash",
    parameters=(
        Parameter("gap", "m", 0.0, 3e-4, "uniform", "lost motion of the drive"),
        Parameter(
            "frame_compliance", "m/N", 0.0, 2e-3, "uniform", "compliance of the frame", stress_power=-1
        ),
    ),
    neutral={"gap": 0.0, "frame_compliance": 0.0},
    statement=lambda v: (
        f"At each reversal the drive moves {number(1e3 * v['gap'], 2)} mm without effect, and the frame "
        f"yields {number(1e3 * v['frame_compliance'], 2)} mm for each newton."
    ),
    act=Instrument(Place.PADS, observe, bind, adds=False),
)
