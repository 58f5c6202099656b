"""The load cell's zero is not the zero of the skin's force: the reported force is F + F0."""

from __future__ import annotations

import numpy as np

from bayeskin.mechanisms.mechanism import ForceOfTime, Instrument, Mechanism, Place, Values, added
from bayeskin.number_format import number
from bayeskin.types import PadMotion, Parameter


def observe(values: Values, motion: PadMotion, force: ForceOfTime) -> ForceOfTime:
    """Adds F0 [N] to the force."""
    return added(force, lambda time_s: values["F0"][:, None] * np.ones_like(time_s))


MECHANISM = Mechanism(
    name="force-offset",
    parameters=(Parameter("F0", "N", -0.15, 0.05, "uniform", "force reported at zero force"),),
    neutral={"F0": 0.0},
    statement=lambda v: (
        f"The load cell reads {number(1e3 * v['F0'], sign=True)} mN when the skin exerts no force."
    ),
    also_possible=("device-friction",),
    act=Instrument(Place.CELL, observe),
)
