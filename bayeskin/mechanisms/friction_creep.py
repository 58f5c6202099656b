"""The friction that a stop locks in relaxes: dF/dt = ... - F / tau in the equation of `device-friction`.

Without `device-friction` it has no effect (`needs`).
"""

from __future__ import annotations

import numpy as np

from bayeskin.mechanisms.device_friction import friction
from bayeskin.mechanisms.mechanism import ForceOfTime, Instrument, Mechanism, Place, Values, added
from bayeskin.number_format import number
from bayeskin.types import Array, PadMotion, Parameter


def observe(values: Values, motion: PadMotion, force: ForceOfTime) -> ForceOfTime:
    """Adds the change that creep makes to the friction."""
    if "Fc" not in values:
        return force
    sliding, length, start = (values[name] for name in ("Fc", "presliding", "friction_start"))
    per_s = 1.0 / values["friction_tau"]

    def crept(time_s: Array) -> Array:
        kept = friction(motion, time_s, sliding, length, start, np.zeros_like(per_s))
        return friction(motion, time_s, sliding, length, start, per_s) - kept

    return added(force, crept)


MECHANISM = Mechanism(
    name="friction-creep",
    parameters=(
        Parameter(
            "friction_tau", "s", 3.0, 1000.0, "log-uniform", "time constant with which friction relaxes"
        ),
    ),
    neutral={"friction_tau": np.inf},
    statement=lambda v: (
        "When the motion stops, the remaining friction relaxes with a time constant of "
        f"{number(v['friction_tau'], 3)} s."
    ),
    look_alikes=("skeleton-compressibility", "solid-viscoelasticity", "strain-dependent-permeability"),
    act=Instrument(Place.DRIVE, observe),
    needs=("device-friction",),
)
