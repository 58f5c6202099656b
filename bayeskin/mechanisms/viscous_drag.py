"""The drive has a drag proportional to its speed: the reported force is F + c du/dt."""

from __future__ import annotations

import numpy as np

from bayeskin.mechanisms.mechanism import ForceOfTime, Instrument, Mechanism, Place, Values, added
from bayeskin.types import Array, PadMotion, Parameter


def speed_of(motion: PadMotion, time_s: Array) -> Array:
    """Returns the speed of the LVDT [m/s] at times of any shape.

    At a corner it is the speed of the stretch that begins there.
    """
    speed = np.append(np.diff(motion.displacement_m) / np.diff(motion.time_s), 0.0)
    stretch = np.searchsorted(motion.time_s, time_s, side="right") - 1
    return np.asarray(np.where(stretch >= 0, speed[stretch], 0.0))


def observe(values: Values, motion: PadMotion, force: ForceOfTime) -> ForceOfTime:
    """Adds c du/dt to the force."""
    return added(force, lambda time_s: values["drag"][:, None] * speed_of(motion, time_s))


MECHANISM = Mechanism(
    name="viscous-drag",
    parameters=(Parameter("drag", "N s/m", 0.0, 40.0, "uniform", "drag of the drive per speed"),),
    neutral={"drag": 0.0},
    statement=lambda v: f"The drive has a viscous drag of {v['drag']:.0f} mN for each mm/s of its speed.",
    act=Instrument(Place.DRIVE, observe),
)
