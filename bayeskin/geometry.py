"""All lengths of a test: the pads and guard of the device, the two layers of skin, and the arm below.

The origin is midway between the pads, on the bottom face of the skin. The x axis runs along the pull, y
across it, and z outward. The model is the quarter with x >= 0 and y >= 0. Its box is flat, and is then rolled
onto the arm.
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
LENGTHS = ("cutis_m", "subcutis_m", "arm_radius_m")  # lengths of the tissue, which may be parameters of a run

# Length of the box along the pull and across it, as multiples of the device's extent, or of the skin's
# thickness where this is larger.
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
    """The U-shaped guard around each pad, which moves with the pad and is open towards the other pad.

    gap_m : the free skin between pad and guard, behind the pad and on both of its sides
    width_m : the width of the guard behind the pad, beyond the gap. It is also the distance that the guard
        reaches beyond the pad on each side, gap included. The article's guard is made in this way (8 mm; its
        arms are 7 mm wide).
    """

    gap_m: float = 1e-3
    width_m: float = 8e-3


@dataclass(frozen=True)
class Geometry:
    """The lengths of a test in metres; the defaults are the device and tissue of the article.

    gauge_m : the distance between the inner edges of the two pads
    pad_length_m, pad_width_m : the lengths of a whole pad, along the pull and across it
    guard : the guard around each pad, or None
    force_on : the parts that the load cell holds, "pad" or "pad and guard"
    cutis_m, subcutis_m : the thickness of the layers
    arm_radius_m : the radius of the skin's bottom face; None for flat skin

    Raises InputError for impossible lengths, and for lengths that seem to be in another unit.
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
            problem = f"it is {_in_mm(self.guard.width_m)} with a gap of {_in_mm(self.guard.gap_m)}"
            raise InputError(
                "guard.width_m",
                problem,
                "it must be above the gap, because beside the pad it includes the gap",
            )
        if self.force_on not in ("pad", "pad and guard"):
            raise InputError("force_on", f"{self.force_on!r} is not known", "use 'pad' or 'pad and guard'")
        if self.force_on == "pad and guard" and self.guard is None:
            raise InputError(
                "force_on",
                "'pad and guard' needs a guard, and this device has none",
                "use 'pad', or a device with a guard",
            )
        if self.arm_radius_m is not None and self.box_m[1] > math.pi * self.arm_radius_m:
            least = _in_mm(self.least_radius_m)
            remedy = f"it must be at least {least}, so that the modelled skin does not overlap itself"
            raise InputError("arm_radius_m", f"it is {_in_mm(self.arm_radius_m)}", remedy)

    def _value(self, name: str) -> float | None:
        """Returns the length with a name of `BOUNDS_MM`; None where there is no guard or the skin is flat."""
        owner, _, field = name.rpartition(".")
        part = self.guard if owner else self
        return None if part is None else getattr(part, field)

    @property
    def half_gauge_m(self) -> float:
        """Returns x of the pad's inner edge [m]."""
        return _exact(self.gauge_m / 2)

    @property
    def along_m(self) -> tuple[float, ...]:
        """Returns x of the edges of pad and guard [m], ascending.

        The two edges of the pad come first, then the two edges of the guard behind it.
        """
        pad = _exact(self.half_gauge_m + self.pad_length_m)
        if self.guard is None:
            return self.half_gauge_m, pad
        inner = _exact(pad + self.guard.gap_m)
        return self.half_gauge_m, pad, inner, _exact(inner + self.guard.width_m)

    @property
    def across_m(self) -> tuple[float, ...]:
        """Returns y of the edges of pad and guard [m], ascending.

        The one edge of the pad comes first, then the two edges of the guard beside it.
        """
        pad = _exact(self.pad_width_m / 2)
        if self.guard is None:
            return (pad,)
        return pad, _exact(pad + self.guard.gap_m), _exact(pad + self.guard.width_m)

    @property
    def thickness_m(self) -> float:
        """Returns the thickness of both layers together [m]."""
        return _exact(self.subcutis_m + self.cutis_m)

    @property
    def box_m(self) -> tuple[float, float, float]:
        """Returns length, width and thickness [m] of the modelled quarter before it is rolled."""
        reach = max(self.along_m[-1], self.across_m[-1], self.thickness_m)
        return _exact(BOX_ALONG * reach), _exact(BOX_ACROSS * reach), self.thickness_m

    @property
    def least_radius_m(self) -> float:
        """Returns the radius of the arm [m] below which the modelled skin would overlap itself."""
        return self.box_m[1] / math.pi

    @property
    def measured_width_m(self) -> float:
        """Returns the whole width [m], across the pull, of the parts that the load cell holds."""
        return self.pad_width_m if self.force_on == "pad" else _exact(2 * self.across_m[-1])

    @property
    def quarter_pad_m2(self) -> float:
        """Returns the area [m^2] of the half pad that lies in the modelled quarter."""
        return self.pad_length_m * self.across_m[0]

    @property
    def hash(self) -> str:
        """Returns the sha256 of all lengths and of the parts that the load cell holds."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()


def moved(geometry: Geometry, theta: Mapping[str, float]) -> Geometry:
    """Returns a geometry with the lengths of the tissue [m] that are among the parameters theta.

    Raises InputError for impossible lengths.
    """
    lengths = {name: theta[name] for name in LENGTHS if name in theta}
    return replace(geometry, **lengths) if lengths else geometry  # type: ignore[arg-type]


def _exact(length_m: float) -> float:
    """Returns a length rounded to a femtometre, which removes the rounding error of a sum."""
    return round(length_m, 15)


def _in_mm(length_m: float) -> str:
    """Returns a length in millimetres as text."""
    return f"{1e3 * length_m:.6g} mm"


def _check_length(name: str, length_m: float, bounds_mm: tuple[float, float]) -> None:
    """Raises InputError unless a length lies within its bounds."""
    low, high = bounds_mm
    if low <= round(1e3 * length_m, 12) <= high:
        return
    problem = f"it is {_in_mm(length_m)}"
    if length_m <= 0.0:
        reasons = {"gauge_m": ", so the pads overlap", "guard.gap_m": ", so the guard lies inside the pad"}
        raise InputError(
            name, problem + reasons.get(name, ""), f"it must be above zero, {low:g} to {high:g} mm"
        )
    for factor, text in ((1e-3, "1000 times too large"), (1e3, "1000 times too small")):
        if low <= factor * 1e3 * length_m <= high:
            problem += f", probably {text} (is the unit right?)"
    raise InputError(name, problem, f"it must be {low:g} to {high:g} mm")
