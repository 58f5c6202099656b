"""Force and displacement have time stamps from different clocks: the reported force is F(t - d)."""

from __future__ import annotations

import numpy as np

from bayeskin.mechanisms.mechanism import ForceOfTime, Instrument, Mechanism, Place, Values
from bayeskin.types import PadMotion, Parameter


def observe(values: Values, motion: PadMotion, force: ForceOfTime) -> ForceOfTime:
    """Returns the force d seconds earlier.

    Before the start of the recording it is the force at the start, and after its end the force at the end.
    """
    end_s = motion.time_s[-1]
    return lambda time_s: force(np.clip(time_s - values["delay"][:, None], 0.0, end_s))


MECHANISM = Mechanism(
    name="clock-delay",
    parameters=(Parameter("delay", "s", -1.0, 1.0, "uniform", "delay of the time stamps of the force"),),
    neutral={"delay": 0.0},
    statement=lambda v: (
        f"The time stamps of the force are {1e3 * abs(v['delay']):.0f} ms too "
        f"{'late' if v['delay'] > 0 else 'early'} compared with those of the displacement."
    ),
    act=Instrument(Place.CLOCK, observe, adds=False),
)
