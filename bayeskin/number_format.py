"""Formats numbers and units for readers, the same in the terminal, in figures and on the page of a run."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_LONGEST, _SMALLEST = 5, -4  # numbers between these powers of ten are written out
_FAR = 100.0  # smallest ratio of an interval's ends at which each end may have its own unit
# A value of at least `size` is printed in the unit `name`, the largest first: (size in SI, factor, name).
_SCALES = {
    "Pa": ((1e6, 1e-6, "MPa"), (1e3, 1e-3, "kPa"), (0.0, 1.0, "Pa")),
    "N": ((1.0, 1.0, "N"), (0.0, 1e3, "mN")),
    "m": ((1.0, 1.0, "m"), (0.0, 1e3, "mm")),
}


def at_edge(unit: str) -> tuple[float, str]:
    """Returns the factor and the unit of a column or axis of an SI unit: lengths are in millimetres."""
    return (1e3, "mm") if unit == "m" else (1.0, unit)


def unit_text(unit: str) -> str:
    """Returns the printed form of a unit: ``m^2`` becomes m², and a pure number has no unit."""
    text = re.sub(r"\^(-?\d+)", lambda power: power[1].translate(_RAISED), unit)
    return "" if text in ("-", "1") else text


def number(value: float | None, digits: int = 3, sign: bool = False) -> str:
    """Returns a number with at most `digits` significant digits, or a dash if it is None or not finite.

    With `sign`, positive numbers have a plus sign.
    """
    if value is None or not math.isfinite(value):
        return "–"
    value = float(f"{value:.{digits - 1}e}") + 0.0  # the sum has no negative zero
    power = math.floor(math.log10(abs(value))) if value else 0
    plus = "+" if sign else ""
    if _SMALLEST <= power < _LONGEST:
        text = _short(f"{value:{plus}.{max(digits - 1 - power, 0)}f}")
    else:
        mantissa = _short(f"{value / 10.0**power:{plus}.{digits - 1}f}")
        text = f"{mantissa} × 10{str(power).translate(_RAISED)}"
    return text.replace("-", "−")


def scale(values: Sequence[float | None], unit: str) -> tuple[float, str]:
    """Returns the factor and the printed unit that suit all `values`, which are given in the SI `unit`."""
    reach = max((abs(value) for value in values if value is not None), default=0.0)
    for size, factor, name in _SCALES.get(unit, ()):
        if reach >= size:
            return factor, name
    return 1.0, unit_text(unit)


def quantity(value: float | None, unit: str, digits: int = 3) -> str:
    """Returns a number, given in the SI `unit`, with a unit that suits it, such as "50.8 kPa"."""
    return with_unit(value, *scale([value], unit), digits)


def with_unit(value: float | None, factor: float, name: str, digits: int = 3) -> str:
    """Returns a number times `factor` with the name of its unit, or a dash for None."""
    if value is None:
        return "–"
    return f"{number(factor * value, digits)} {name}".rstrip()


def interval(low: float, high: float, unit: str, beside: float | None = None) -> str:
    """Returns an interval with one unit, such as "13.9 to 87 kPa", or with two, such as "10 kPa to 2 MPa".

    With a number `beside` it, the unit suits all three numbers.
    """
    factor, name = scale([low, high, beside], unit)
    if beside is None and scale([low], unit)[1] != name and abs(high) >= _FAR * abs(low) > 0.0:
        return f"{quantity(low, unit)} to {quantity(high, unit)}"
    return f"{number(factor * low)} to {with_unit(high, factor, name)}"


def with_interval(value: float, low: float, high: float, unit: str = "", digits: int = 2) -> str:
    """Returns a number, given in the SI `unit`, with an interval, such as "2 [0.9, 4.1] × 10⁻¹⁴ m²"."""
    factor, name = scale([value, low, high], unit)
    power = math.floor(math.log10(abs(factor * value))) if value else 0
    power = 0 if _SMALLEST <= power < _LONGEST else power
    middle, *ends = (number(factor * bound / 10.0**power, digits) for bound in (value, low, high))
    times = f"× 10{str(power).translate(_RAISED)}" if power else ""
    return " ".join(part for part in (f"{middle} [{ends[0]}, {ends[1]}]", times, name) if part)


def percent(share: float | None, digits: int = 3) -> str:
    """Returns a share as a percentage, or a dash for None."""
    return "–" if share is None else f"{number(100 * share, digits)} %"


def probability(value: float) -> str:
    """Returns a probability with three decimals at most; next to 0 and 1 it states a limit."""
    if value < 0.001:
        return "< 0.001"
    return "> 0.999" if value > 0.999 else number(round(value, 3), 3)


def _short(text: str) -> str:
    """Returns a decimal number without trailing zeros."""
    return text.rstrip("0").rstrip(".") if "." in text else text
