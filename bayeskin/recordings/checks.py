"""Refuses what cannot be a test of skin, and remarks on what is unusual in its clock."""

from __future__ import annotations

import numpy as np

from bayeskin.errors import InputError
from bayeskin.types import Array

MIN_SAMPLES = 50
# No skin test exceeds these values. Larger values mean that the header does not give the unit of the numbers.
_LARGEST = {"displacement": (0.1, "m"), "force": (1e3, "N")}
_SMALLEST_TRAVEL_M = 1e-5


def refuse_invalid(where: str, first_row: int, time_s: Array, displacement_m: Array, force_n: Array) -> None:
    """Raises InputError unless the arrays (n,) can be a skin test.

    The arrays must have enough samples, finite values, increasing times, plausible sizes, and a displacement
    that changes.
    """
    named = {"time": time_s, "displacement": displacement_m, "force": force_n}
    if len(time_s) < MIN_SAMPLES:
        raise InputError(where, f"{len(time_s)} samples", f"at least {MIN_SAMPLES}")
    for name, values in named.items():
        refuse_infinite(f"{where}, row", first_row, name, values)
    back = np.flatnonzero(np.diff(time_s) <= 0)
    if len(back):
        before, after = time_s[back[0]], time_s[back[0] + 1]
        problem = f"time {after:.6g} s after {before:.6g} s"
        raise InputError(
            f"{where}, row {first_row + back[0] + 1}", problem, "times that increase from row to row"
        )
    for name, values in (("displacement", displacement_m - displacement_m[0]), ("force", force_n)):
        largest, unit = _LARGEST[name]
        peak = int(np.argmax(np.abs(values)))
        value = abs(values[peak])
        if value > largest:
            problem = f"a {name} of {value:.4g} {unit}"
            smaller = "mm" if unit == "m" else "mN"
            expected = f"at most {largest:g} {unit} (is the column in {smaller}?)"
            raise InputError(f"{where}, row {first_row + peak}", problem, expected)
    travel = float(np.ptp(displacement_m))
    if travel < _SMALLEST_TRAVEL_M:
        problem = f"a displacement that changes by {travel:.3g} m in all"
        raise InputError(where, problem, f"at least {_SMALLEST_TRAVEL_M:g} m (is its unit right?)")


def refuse_infinite(where: str, first_row: int, what: str, values: Array) -> None:
    """Raises InputError, with the row of the first of them, if some values (n,) are not finite."""
    bad = np.flatnonzero(~np.isfinite(values))
    if len(bad):
        raise InputError(
            f"{where} {first_row + bad[0]}, column {what!r}", f"{values[bad[0]]}", "a finite number"
        )


def remarks_on_clock(time_s: Array) -> list[str]:
    """Returns notes on times (n,) that do not start at zero or leave a gap."""
    remarks = []
    if time_s[0] != 0.0:
        remarks.append(f"time starts at {time_s[0]:g} s in the file; shifted to 0")
    intervals = np.diff(time_s)
    gap, usual = int(np.argmax(intervals)), float(np.median(intervals))
    if intervals[gap] > 5 * usual:
        remarks.append(
            f"a gap of {intervals[gap]:.3g} s after {time_s[gap]:.3f} s (samples are {usual:.3g} s apart)"
        )
    return remarks
