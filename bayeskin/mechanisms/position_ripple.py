"""The screw or the gear causes a ripple while the drive moves. Its phase is locked to the position.

The reported force is F + a sin(2 pi u / L + phi) where du/dt is not 0.
"""

from __future__ import annotations

import numpy as np

from bayeskin.mechanisms.mechanism import ForceOfTime, Instrument, Mechanism, Place, Values, added
from bayeskin.mechanisms.viscous_drag import speed_of
from bayeskin.number_format import number
from bayeskin.types import Array, PadMotion, Parameter

SHORTEST_M, LONGEST_M = 1e-4, 1e-3  # bounds of the period
AT_REST_M_S = 2e-5  # a slower drive counts as at rest


def observe(values: Values, motion: PadMotion, force: ForceOfTime) -> ForceOfTime:
    """Adds the ripple to the force."""
    period, amplitude, phase = (
        values[f"ripple_{part}"][:, None] for part in ("period", "amplitude", "phase")
    )

    def ripple(time_s: Array) -> Array:
        moves = np.abs(speed_of(motion, time_s)) > AT_REST_M_S
        return np.asarray(amplitude * np.sin(2.0 * np.pi * motion.at(time_s) / period + phase) * moves)

    return added(force, ripple)


MECHANISM = Mechanism(
    name="position-ripple",
    parameters=(
        Parameter(
            "ripple_period",
            "m",
            SHORTEST_M,
            LONGEST_M,
            "log-uniform",
            "travel after which the ripple repeats",
        ),
        Parameter("ripple_amplitude", "N", 0.0, 0.015, "uniform", "amplitude of the ripple"),
        Parameter(
            "ripple_phase", "rad", -np.pi, np.pi, "uniform", "phase of the ripple at zero displacement"
        ),
    ),
    neutral={"ripple_period": 5e-4, "ripple_amplitude": 0.0, "ripple_phase": 0.0},
    statement=lambda v: (
        "While the drive moves, the force has a ripple with an amplitude of "
        f"{1e3 * v['ripple_amplitude']:.1f} mN and a period of {number(1e3 * v['ripple_period'], 2)} mm "
        "of travel."
    ),
    act=Instrument(Place.DRIVE, observe, repeats_m=SHORTEST_M),
    parts=(("ripple_amplitude", "ripple_period", "ripple_phase"),),
)
