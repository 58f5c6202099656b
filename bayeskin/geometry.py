"""Every length of a test: the device's pads and guard, the two layers of skin, the arm below them.

The origin lies midway between the pads, on the skin's bottom face: x runs along the pull, y across it, z
outward. The model is a quarter, x >= 0 and y >= 0. Its box is flat, and is then rolled onto the arm.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Literal

from bayeskin.errors import InputError

ForceOn = Literal["pad", "pad and guard"]
LENGTHS = ("cutis_m", "subcutis_m", "arm_radius_m")  # of the tissue: they may be parameters of a run

# The box reaches so many times as far as the device, or as the skin is thick where that is more: along the
# pull, where the pads are, and across it.
BOX_ALONG, BOX_ACROSS = 3.0, 2.4
BOUNDS_MM = {
    "gauge_m": (2.0, 300.0),
    "pad_length_m": (1.0, 100.0),
    "pad_width_m": (1.0, 100.0),
    "guard.gap_m": (0.1, 30.0),
    "guard.width_m": (1.0, 100.0),
    "cutis_m": (0.3, 10.0),
    "subcutis_m": (0.5, 100.0),
    "arm_radius_m": (10.0, 500.0),
}


@dataclass(frozen=True)
class Guard:
    """A U around each pad that moves with it and is open toward the other pad.

    gap_m : free skin between pad and guard, behind the pad and on both sides of it
    width_m : of the guard behind the pad, beyond the gap; and how far it reaches beyond the pad on each
        side, gap included, which is how the article's is made (8 mm; its arms are 7 mm wide)
    """

    gap_m: float = 1e-3
    width_m: float = 8e-3


@dataclass(frozen=True)
class Geometry:
    """The lengths of a test in metres; the defaults are the article's device and tissue.

    gauge_m : between the inner edges of the two pads
    pad_length_m, pad_width_m : of a whole pad, along the pull and across it
    guard : around each pad, or None
    force_on : what the load cell holds, "pad" or "pad and guard"
    cutis_m, subcutis_m : thickness of the layers
    arm_radius_m : of the skin's bottom face; None for flat skin

    Raises InputError for lengths that cannot be, or that look like another unit's.
    """

    gauge_m: float = 36e-3
    pad_length_m: float = 8e-3
    pad_width_m: float = 8e-3
    guard: Guard | None = Guard()
    force_on: ForceOn = "pad"
    cutis_m: float = 2e-3
    subcutis_m: float = 8e-3
    arm_radius_m: float | None = 48e-3

    def __post_init__(self) -> None:
        for name, bounds in BOUNDS_MM.items():
            value = self._value(name)
            if value is not None:
                _check_length(name, value, bounds)
        if self.guard is not None and self.guard.width_m <= self.guard.gap_m:
            found = f"{_mm(self.guard.width_m)} with a gap of {_mm(self.guard.gap_m)}"
            raise InputError("guard.width_m", found, "more than the gap: it reaches so far beside the pad")
        if self.force_on not in ("pad", "pad and guard"):
            raise InputError("force_on", repr(self.force_on), "'pad' or 'pad and guard'")
        if self.force_on == "pad and guard" and self.guard is None:
            raise InputError("force_on", "'pad and guard' without a guard", "'pad', or a guard")
        if self.arm_radius_m is not None and self.box_m[1] > math.pi * self.arm_radius_m:
            least = _mm(self.least_radius_m)
            expected = f"at least {least}, so that skin as wide as this device needs does not meet itself"
            raise InputError("arm_radius_m", _mm(self.arm_radius_m), expected)

    def _value(self, name: str) -> float | None:
        owner, _, field = name.rpartition(".")
        held = self.guard if owner else self
        return None if held is None else getattr(held, field)

    @property
    def half_gauge_m(self) -> float:
        """x of the pad's inner edge [m]."""
        return _exact(self.gauge_m / 2)

    @property
    def along_m(self) -> tuple[float, ...]:
        """x of the edges of pad and guard [m], ascending: the pad's two, then the guard's two behind it."""
        pad = _exact(self.half_gauge_m + self.pad_length_m)
        if self.guard is None:
            return self.half_gauge_m, pad
        inner = _exact(pad + self.guard.gap_m)
        return self.half_gauge_m, pad, inner, _exact(inner + self.guard.width_m)

    @property
    def across_m(self) -> tuple[float, ...]:
        """y of the edges of pad and guard [m], ascending: the pad's one, then the guard's two beside it."""
        pad = _exact(self.pad_width_m / 2)
        if self.guard is None:
            return (pad,)
        return pad, _exact(pad + self.guard.gap_m), _exact(pad + self.guard.width_m)

    @property
    def thickness_m(self) -> float:
        """Thickness of both layers [m]."""
        return _exact(self.subcutis_m + self.cutis_m)

    @property
    def box_m(self) -> tuple[float, float, float]:
        """Length, width and thickness of the modelled quarter before it is rolled [m]."""
        reach = max(self.along_m[-1], self.across_m[-1], self.thickness_m)
        return _exact(BOX_ALONG * reach), _exact(BOX_ACROSS * reach), self.thickness_m

    @property
    def least_radius_m(self) -> float:
        """Radius of the arm [m] below which the modelled skin would meet itself."""
        return self.box_m[1] / math.pi

    @property
    def measured_width_m(self) -> float:
        """Whole width, across the pull, of what the load cell holds [m]."""
        return self.pad_width_m if self.force_on == "pad" else _exact(2 * self.across_m[-1])

    @property
    def quarter_pad_m2(self) -> float:
        """Area of a pad's half that lies in the modelled quarter [m^2]."""
        return self.pad_length_m * self.across_m[0]

    @property
    def hash(self) -> str:
        """sha256 of all lengths and of what the load cell holds."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()


def moved(geometry: Geometry, theta: Mapping[str, float]) -> Geometry:
    """Returns a geometry with those lengths of the tissue [m] that are among the parameters theta.

    Raises InputError for lengths that cannot be.
    """
    lengths = {name: theta[name] for name in LENGTHS if name in theta}
    return replace(geometry, **lengths) if lengths else geometry  # type: ignore[arg-type]


def _exact(length_m: float) -> float:
    """The length without the rounding error of a sum: to a femtometre."""
    return round(length_m, 15)


def _mm(length_m: float) -> str:
    return f"{1e3 * length_m:.6g} mm"


def _check_length(name: str, length_m: float, bounds_mm: tuple[float, float]) -> None:
    """Raises InputError unless the length lies in its bounds."""
    low, high = bounds_mm
    if low <= round(1e3 * length_m, 12) <= high:
        return
    found, expected = _mm(length_m), f"{low:g} to {high:g} mm"
    if length_m <= 0.0:
        why = {"gauge_m": ": the pads overlap", "guard.gap_m": ": the guard lies inside the pad"}
        raise InputError(name, found + why.get(name, ""), f"above zero, {expected}")
    for factor, slip in ((1e-3, "1000 times too much"), (1e3, "1000 times too little")):
        if low <= factor * 1e3 * length_m <= high:
            found += f", {slip} by its looks: a wrong unit?"
    raise InputError(name, found, expected)
