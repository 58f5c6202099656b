"""The load cell drifts: the reported force is F + r t. OIML R 60 limits the creep of load cells."""

from __future__ import annotations

from bayeskin.mechanisms.mechanism import ForceOfTime, Instrument, Mechanism, Place, Values, added
from bayeskin.number_format import number
from bayeskin.types import PadMotion, Parameter


def observe(values: Values, motion: PadMotion, force: ForceOfTime) -> ForceOfTime:
    """Adds r t to the force."""
    return added(force, lambda time_s: values["drift"][:, None] * time_s)


MECHANISM = Mechanism(
    name="sensor-drift",
    parameters=(Parameter("drift", "N/s", -3e-4, 3e-4, "uniform", "drift of the load cell's zero"),),
    neutral={"drift": 0.0},
    statement=lambda v: f"The load cell drifts by {number(6e4 * v['drift'], 2, sign=True)} mN a minute.",
    act=Instrument(Place.CELL, observe),
)
