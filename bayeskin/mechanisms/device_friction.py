"""Dry friction of the slide, with presliding, by Dahl's model.

Let u be the displacement of the drive, Fc the sliding friction and l the presliding length. Then

    dF/du = (Fc - F sgn(u')) / l ,

and in a motion from F(u0) in one direction s

    F = s Fc + (F(u0) - s Fc) exp(-|u - u0| / l) .

Friction does not depend on the speed: a hold keeps the friction that the motion before it left. At t = 0 the
friction is z0 Fc. If the friction creeps (`friction-creep`), its equation in time has the additional term
- F / tau. It then relaxes exponentially in time over each linear stretch of the protocol.

Source: P. Dahl, A solid friction model, Aerospace Corp. TOR-158(3107-18), 1968.
"""

from __future__ import annotations

import math

import numpy as np

from bayeskin.mechanisms.lines import stretch_of, strict
from bayeskin.mechanisms.mechanism import ForceOfTime, Instrument, Mechanism, Place, Values, added
from bayeskin.number_format import number
from bayeskin.types import Array, PadMotion, Parameter


def friction(
    motion: PadMotion, time_s: Array, sliding_n: Array, length_m: Array, start: Array, per_s: Array
) -> Array:
    """Returns the friction (n, t) [N] at times (t,) or (n, t).

    sliding_n, length_m, start (n,) : sliding friction, presliding length, and friction at t = 0 over Fc
    per_s (n,) : 1 / tau of the creep, 0 without creep
    """
    speed = np.diff(motion.displacement_m) / np.diff(motion.time_s)
    rate = np.abs(speed) / length_m[:, None] + per_s[:, None]  # (n, k-1)
    ends = sliding_n[:, None] * speed / (length_m[:, None] * np.where(rate > 0.0, rate, 1.0))
    at_corner = [start * sliding_n]
    for j, lasts_s in enumerate(np.diff(motion.time_s)):
        at_corner.append(ends[:, j] + (at_corner[-1] - ends[:, j]) * np.exp(-rate[:, j] * lasts_s))
    began = np.stack(at_corner[:-1], axis=1)
    times = np.ascontiguousarray(np.atleast_2d(time_s))
    out = np.empty((len(sliding_n), times.shape[1]))
    _relax(motion.time_s, rate, ends, began, times, out)
    return out


@strict
def _relax(corner_s, rate, ends, began, times, out):  # type: ignore[no-untyped-def]
    """Fills out (n, t) with the friction at times (1 or n, t).

    In each stretch (n, k-1) of the protocol the friction starts at `began` and tends to `ends`.
    """
    for i in range(out.shape[0]):
        row, left = times[i if len(times) > 1 else 0], 0
        for j in range(out.shape[1]):
            left = stretch_of(corner_s, left, row[j])
            start, end = began[i, left], ends[i, left]
            if rate[i, left] > 0.0:
                start = end + (start - end) * math.exp(-rate[i, left] * max(row[j] - corner_s[left], 0.0))
            out[i, j] = start


def observe(values: Values, motion: PadMotion, force: ForceOfTime) -> ForceOfTime:
    """Adds the friction, without creep, to the force."""
    sliding, length, start = (values[name] for name in ("Fc", "presliding", "friction_start"))
    return added(force, lambda t: friction(motion, t, sliding, length, start, np.zeros_like(sliding)))


MECHANISM = Mechanism(
    name="device-friction",
    parameters=(
        Parameter("Fc", "N", 0.0, 0.1, "uniform", "sliding friction of the drive"),
        Parameter(
            "presliding",
            "m",
            5e-6,
            3e-4,
            "log-uniform",
            "presliding length, over which friction changes sign",
        ),
        Parameter("friction_start", "-", -1.0, 1.0, "uniform", "friction at t = 0, as a share of Fc"),
    ),
    neutral={"Fc": 0.0, "presliding": 5e-5, "friction_start": 0.0},
    statement=lambda v: (
        f"The slide has a dry friction of {1e3 * v['Fc']:.0f} mN against the motion, which changes sign over "
        f"a presliding length of {number(1e3 * v['presliding'], 2)} mm and persists during holds."
    ),
    look_alikes=("plastic-set", "viscous-drag"),
    act=Instrument(Place.DRIVE, observe),
)
