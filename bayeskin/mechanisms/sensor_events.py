"""The load cell's zero jumps at two moments: F + sum_i s_i H(t - t_i).

The moments are shares of the recording's duration, so that one prior suits all recordings.

The prior excludes the first and the last fiftieth of a recording. A step there would be an offset, or have no
effect. A step happens between one sample and the next. Where the samples show no step, a slower effect acts.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayeskin.mechanisms.mechanism import ForceOfTime, Instrument, Mechanism, Place, Values, added
from bayeskin.types import Array, Jumps, PadMotion, Parameter

EVENTS = (1, 2)


def observe(values: Values, motion: PadMotion, force: ForceOfTime) -> ForceOfTime:
    """Adds the steps to the force."""

    def steps(time_s: Array) -> Array:
        share = time_s / motion.time_s[-1]
        return sum(
            values[f"event_{i}_step"][:, None] * (share >= values[f"event_{i}_at"][:, None]) for i in EVENTS
        )

    return added(force, steps)


def refuted(values: Values, motion: PadMotion, jumps: Jumps) -> NDArray[np.bool_]:
    """Returns for which values (n,) the samples contradict the larger of the two steps.

    The smaller step is not tested, because it may stand for a slow effect.
    """
    sizes = np.array([values[f"event_{i}_step"] for i in EVENTS])
    moments = np.array([values[f"event_{i}_at"] for i in EVENTS]) * motion.time_s[-1]
    larger = np.argmax(np.abs(sizes), axis=0), np.arange(sizes.shape[1])
    return jumps.refute(moments[larger], sizes[larger])


MECHANISM = Mechanism(
    name="sensor-events",
    parameters=tuple(
        parameter
        for i in EVENTS
        for parameter in (
            Parameter(
                f"event_{i}_at", "-", 0.02, 0.98, "uniform", "moment of a step, as a share of the duration"
            ),
            Parameter(f"event_{i}_step", "N", -0.05, 0.05, "uniform", "step of the load cell's zero"),
        )
    ),
    neutral={f"event_{i}_{part}": value for i in EVENTS for part, value in (("at", 0.5), ("step", 0.0))},
    statement=lambda v: (
        "The load cell's zero jumps: "
        + ", ".join(
            f"by {1e3 * v[f'event_{i}_step']:+.0f} mN after {100 * v[f'event_{i}_at']:.0f} % of the recording"
            for i in EVENTS
        )
        + "."
    ),
    parts=tuple((f"event_{i}_step", f"event_{i}_at") for i in EVENTS),
    act=Instrument(Place.CELL, observe, refuted=refuted),
)
