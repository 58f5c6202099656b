"""Dry friction of the slide, with presliding: Dahl's model.

Along the displacement u of the drive, with sliding friction Fc and presliding length l,

    dF/du = (Fc - F sgn(u')) / l     so that, moving on in one direction s from F(u0),
    F = s Fc + (F(u0) - s Fc) exp(-|u - u0| / l)

Rate-independent: a hold keeps what the motion before it left. At t = 0 it is z0 Fc. Where the friction
creeps (`friction-creep`), the same equation has the term - F / tau, and each straight stretch of the
protocol its exponential in time.

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
    """Friction (n, t) [N] at times (t,) or (n, t); parameters (n,), `per_s` = 1/tau, 0 without creep."""
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
    """Fills out (n, t) from what each stretch (n, k-1) begins at and tends to, at times (1 or n, t)."""
    for i in range(out.shape[0]):
        row, left = times[i if len(times) > 1 else 0], 0
        for j in range(out.shape[1]):
            left = stretch_of(corner_s, left, row[j])
            start, end = began[i, left], ends[i, left]
            if rate[i, left] > 0.0:
                start = end + (start - end) * math.exp(-rate[i, left] * max(row[j] - corner_s[left], 0.0))
            out[i, j] = start


def observe(values: Values, motion: PadMotion, force: ForceOfTime) -> ForceOfTime:
    """Adds the friction, without creep."""
    sliding, length, start = (values[name] for name in ("Fc", "presliding", "friction_start"))
    return added(force, lambda t: friction(motion, t, sliding, length, start, np.zeros_like(sliding)))


MECHANISM = Mechanism(
    name="device-friction",
    parameters=(
        Parameter("Fc", "N", 0.0, 0.1, "uniform", "sliding friction of the drive"),
        Parameter("presliding", "m", 5e-6, 3e-4, "log-uniform", "travel over which it turns"),
        Parameter("friction_start", "-", -1.0, 1.0, "uniform", "friction at t = 0, over Fc"),
    ),
    neutral={"Fc": 0.0, "presliding": 5e-5, "friction_start": 0.0},
    statement=lambda v: (
        f"The slide rubs: {1e3 * v['Fc']:.0f} mN against each motion, turning over within "
        f"{number(1e3 * v['presliding'], 2)} mm after a reversal and kept during holds."
    ),
    group=("device-friction", "viscous-drag", "plastic-set"),
    act=Instrument(Place.DRIVE, observe),
)
