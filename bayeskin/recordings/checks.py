"""Refuses what cannot be a test of skin, and remarks on what is unusual in its clock."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayeskin.errors import InputError
from bayeskin.number_format import number
from bayeskin.types import Array


@dataclass(frozen=True)
class PlausibleTest:
    """Sizes that a test of skin can have.

    samples, least_travel_m : least number of samples, and least travel
    largest_m, largest_n : no skin test exceeds these values; larger values mean that the header does not give
        the unit of the numbers
    """

    samples: int = 50
    least_travel_m: float = 1e-5
    largest_m: float = 0.1
    largest_n: float = 1e3


PLAUSIBLE = PlausibleTest()


def refuse_invalid(where: str, first_row: int, time_s: Array, displacement_m: Array, force_n: Array) -> None:
    """Raises InputError unless the arrays (n,) can be a skin test.

    The arrays must have enough samples, finite values, increasing times, plausible sizes, and a displacement
    that changes.
    """
    named = {"time": time_s, "displacement": displacement_m, "force": force_n}
    if len(time_s) < PLAUSIBLE.samples:
        raise InputError(
            where, f"the number of samples is {len(time_s)}", f"it must be at least {PLAUSIBLE.samples}"
        )
    for name, values in named.items():
        refuse_infinite(f"{where}, row", first_row, name, values)
    back = np.flatnonzero(np.diff(time_s) <= 0)
    if len(back):
        before, after = time_s[back[0]], time_s[back[0] + 1]
        problem = f"the time is {after:.6g} s after {before:.6g} s"
        raise InputError(
            f"{where}, row {first_row + back[0] + 1}", problem, "times must increase from row to row"
        )
    for name, values, largest, unit in (
        ("displacement", displacement_m - displacement_m[0], PLAUSIBLE.largest_m, "m"),
        ("force", force_n, PLAUSIBLE.largest_n, "N"),
    ):
        peak = int(np.argmax(np.abs(values)))
        value = abs(values[peak])
        if value > largest:
            problem = f"the {name} is {value:.4g} {unit}"
            smaller = "mm" if unit == "m" else "mN"
            remedy = f"it must be at most {largest:g} {unit} (is the column in {smaller}?)"
            raise InputError(f"{where}, row {first_row + peak}", problem, remedy)
    travel = float(np.ptp(displacement_m))
    if travel < PLAUSIBLE.least_travel_m:
        problem = f"the displacement changes by {travel:.3g} m in all"
        raise InputError(
            where, problem, f"it must change by at least {PLAUSIBLE.least_travel_m:g} m (is its unit right?)"
        )


def refuse_infinite(where: str, first_row: int, what: str, values: Array) -> None:
    """Raises InputError, with the row of the first of them, if some values (n,) are not finite."""
    bad = np.flatnonzero(~np.isfinite(values))
    if len(bad):
        raise InputError(
            f"{where} {first_row + bad[0]}, column {what!r}",
            f"the value is {values[bad[0]]}",
            "it must be a finite number",
        )


def remarks_on_clock(time_s: Array) -> list[str]:
    """Returns notes on times (n,) that do not start at zero or leave a gap."""
    remarks = []
    if time_s[0] != 0.0:
        remarks.append(f"time starts at {number(time_s[0], 6)} s in the file; shifted to 0")
    intervals = np.diff(time_s)
    gap, usual = int(np.argmax(intervals)), float(np.median(intervals))
    if intervals[gap] > 5 * usual:
        remarks.append(
            f"a gap of {number(intervals[gap])} s after {time_s[gap]:.3f} s "
            f"(samples are {number(usual)} s apart)"
        )
    return remarks
