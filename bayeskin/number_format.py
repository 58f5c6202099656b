"""Writes numbers as people write them."""

from __future__ import annotations

import numpy as np

_LOW, _HIGH = 1e-4, 1e7  # outside this range, powers of ten are easier to read


def at_edge(unit: str) -> tuple[float, str]:
    """Returns the factor and the unit in which values of an SI unit are shown: lengths are in millimetres."""
    return (1e3, "mm") if unit == "m" else (1.0, unit)


def number(value: float, digits: int, sign: bool = False) -> str:
    """Returns a number with a given number of significant digits, such as 280, 0.05 or 2e-14.

    With `sign`, positive numbers have a plus sign.
    """
    if value and not _LOW <= abs(value) < _HIGH:
        return f"{value:{'+' if sign else ''}.{digits}g}"
    return np.format_float_positional(
        value, precision=digits, unique=False, fractional=False, trim="-", sign=sign
    )
