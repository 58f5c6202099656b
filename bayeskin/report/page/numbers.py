"""Numbers as people read them: three digits, units with their prefixes, typographic minus and powers."""

from __future__ import annotations

import math
from collections.abc import Sequence

from bayeskin.report.style import unit_text

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_LONGEST, _SMALLEST = 5, -3  # powers of ten between which numbers are written out
_FAR = 100.0  # ratio of an interval's ends from which on each has its own unit
_KEPT = "\u00a0"  # a space at which no line ends
# From which size on a unit gets another name, largest first: (size in SI, factor, name).
_SCALES = {
    "Pa": ((1e6, 1e-6, "MPa"), (1e3, 1e-3, "kPa"), (0.0, 1.0, "Pa")),
    "N": ((1.0, 1.0, "N"), (0.0, 1e3, "mN")),
    "m": ((1.0, 1.0, "m"), (0.0, 1e3, "mm")),
}


def number(value: float | None, digits: int = 3) -> str:
    """A number with at most `digits` significant digits; a dash for none."""
    if value is None or not math.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    value = float(f"{value:.{digits - 1}e}")
    power = math.floor(math.log10(abs(value)))
    if _SMALLEST <= power < _LONGEST:
        text = _short(f"{value:.{max(digits - 1 - power, 0)}f}")
    else:
        mantissa = _short(f"{value / 10.0**power:.{digits - 1}f}")
        text = f"{mantissa}{_KEPT}×{_KEPT}10" + str(power).translate(_RAISED)
    return text.replace("-", "−")


def scale(values: Sequence[float | None], unit: str) -> tuple[float, str]:
    """Factor and printed unit in which all of `values`, given in the SI `unit`, read well."""
    reach = max((abs(value) for value in values if value is not None), default=0.0)
    for size, factor, name in _SCALES.get(unit, ()):
        if reach >= size:
            return factor, name
    return 1.0, unit_text(unit)


def quantity(value: float | None, unit: str) -> str:
    """A number with its unit, such as "50.8 kPa"; a dash for none."""
    return with_unit(value, *scale([value], unit))


def with_unit(value: float | None, factor: float, name: str) -> str:
    """A number times `factor`, with the name of that unit."""
    if value is None:
        return "–"
    return number(factor * value) + (f"{_KEPT}{name}" if name else "")


def interval(low: float, high: float, unit: str, beside: float | None = None) -> str:
    """Two numbers with one unit, such as "13.9 to 87 kPa", or with two, such as "10 kPa to 2 MPa".

    With a number `beside` them, in the unit in which all three read well.
    """
    factor, name = scale([low, high, beside], unit)
    if beside is None and scale([low], unit)[1] != name and abs(high) >= _FAR * abs(low) > 0.0:
        return f"{quantity(low, unit)} to {quantity(high, unit)}"
    return f"{number(factor * low)} to {with_unit(high, factor, name)}"


def percent(share: float | None) -> str:
    return "–" if share is None else f"{number(100 * share)}{_KEPT}%"


def _short(text: str) -> str:
    return text.rstrip("0").rstrip(".") if "." in text else text
