"""Breathing or the pulse moves the arm under the device.

    F + (a + s F) sin(2 pi t / T + phi)

A small displacement to and fro changes the force by the skin's stiffness. The stiffness of soft tissue grows
linearly with its force, dF/du = A (F + B) (Fung, Am. J. Physiol. 213 (1967), 1532-1544). One part of the
amplitude is therefore independent of the force, and the other part is proportional to it. An arm that turns
or swells under the pads changes the pull by a share of the pull. The share s describes this too.

At rest adults breathe 12 to 20 times a minute (Chourpiliadis & Bhardwaj, Physiology, Respiratory Rate,
StatPearls 2022); hearts beat 50 to 90 times (Nanchen, Heart 104 (2018), 1048). Amplitudes are chosen for
this test: 30 mN correspond to a displacement of 0.6 mm at 50 mN/mm. The period is constant, as in paced
breathing; free breathing falls out of step after some breaths. Means over bins of a width h cannot
distinguish a period T from 1 / (1 / h - 1 / T): with h = 0.5 s, a pulse of 0.8 s looks like a smaller swing
of 1.3 s.
"""

from __future__ import annotations

import numpy as np

from bayeskin.mechanisms.mechanism import ForceOfTime, Instrument, Mechanism, Place, Values
from bayeskin.number_format import number
from bayeskin.types import Array, PadMotion, Parameter

SHORTEST_S, LONGEST_S = 0.6, 8.0  # bounds of the period


def observe(values: Values, motion: PadMotion, force: ForceOfTime) -> ForceOfTime:
    """Adds the swing to the force."""
    amplitude, share, period, phase = (
        values[f"motion_{part}"][:, None] for part in ("amplitude", "share", "period", "phase")
    )

    def swinging(time_s: Array) -> Array:
        still = force(time_s)
        return np.asarray(still + (amplitude + share * still) * np.sin(2.0 * np.pi * time_s / period + phase))

    return swinging


MECHANISM = Mechanism(
    name="periodic-motion",
    parameters=(
        Parameter("motion_amplitude", "N", 0.0, 0.03, "uniform", "amplitude of the swing at zero force"),
        Parameter("motion_period", "s", SHORTEST_S, LONGEST_S, "log-uniform", "period of the swing"),
        Parameter("motion_phase", "rad", -np.pi, np.pi, "uniform", "phase of the swing at t = 0"),
        Parameter("motion_share", "-", 0.0, 0.1, "uniform", "share of the force that adds to the amplitude"),
    ),
    neutral={"motion_amplitude": 0.0, "motion_period": 4.0, "motion_phase": 0.0, "motion_share": 0.0},
    statement=lambda v: (
        f"The arm moves to and fro under the device with a period of {number(v['motion_period'], 2)} s; the "
        f"force swings to either side by {1e3 * v['motion_amplitude']:.1f} mN plus "
        f"{number(100 * v['motion_share'], 2)} % of its value."
    ),
    parts=(("motion_amplitude", "motion_period", "motion_phase"), ("motion_share",)),
    act=Instrument(Place.ARM, observe, adds=False, repeats_s=SHORTEST_S),
)
