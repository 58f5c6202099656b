"""The sections `device` and `tissue` of a configuration, and the file of its own that holds only these.

Lengths in them are millimetres. Those of the tissue may be uncertain, a mean and a standard deviation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag

from bayeskin.errors import InputError
from bayeskin.geometry import BOUNDS_MM, ForceOn, Geometry, Guard, moved
from bayeskin.sections import Section, checked, read_toml
from bayeskin.types import Parameter

EXPECTED = "the sections [device] and [tissue] in TOML"
LARGEST_SD = 1 / 3  # of the mean: a normal prior that reaches zero is of no thickness
REACH = 3.0  # sd on either side of the mean, to which the prior of a length reaches
ROOM = 1e-3  # of a length, between its bounds and lengths that cannot be: derivatives take small steps
_MEANING = {
    "cutis_m": "thickness of the cutis",
    "subcutis_m": "thickness of the subcutis",
    "arm_radius_m": "radius of the arm below the skin",
}
_KEYS = {
    "gauge_m": "device.gauge_mm",
    "pad_length_m": "device.pad_mm",
    "pad_width_m": "device.pad_mm",
    "guard.gap_m": "device.guard_mm.gap",
    "guard.width_m": "device.guard_mm.width",
    "force_on": "device.force_on",
    "cutis_m": "tissue.cutis_mm",
    "subcutis_m": "tissue.subcutis_mm",
    "arm_radius_m": "tissue.arm_radius_mm",
}


class Uncertain(Section):
    """A length that is known to a standard deviation only, with a normal prior."""

    mean: float
    sd: Annotated[float, Field(gt=0)]


def _length_form(given: Any) -> str:
    """Which form a length has, by the name of its tag."""
    return "<uncertain>" if isinstance(given, Uncertain | Mapping) else "<number>"


def _radius_form(given: Any) -> str:
    return "<flat>" if isinstance(given, str) else _length_form(given)


_Number = Annotated[float, Tag("<number>")]
_Uncertain = Annotated[Uncertain, Tag("<uncertain>")]
_Flat = Annotated[Literal["flat"], Tag("<flat>")]
Length = Annotated[_Number | _Uncertain, Discriminator(_length_form)]
Radius = Annotated[_Number | _Uncertain | _Flat, Discriminator(_radius_form)]


class GuardConfig(Section):
    """The U around each pad: its gap to the pad, and its width, as `bayeskin.geometry.Guard` has them."""

    gap: float
    width: float


def _guard_form(given: Any) -> str:
    return "<guard>" if isinstance(given, GuardConfig | Mapping) else "<none>"


class DeviceConfig(Section):
    """Lengths of the extensometer [mm]: between the pads, of a pad along and across the pull, its guard."""

    gauge_mm: float = 36.0
    pad_mm: tuple[float, float] = (8.0, 8.0)
    guard_mm: Annotated[
        Annotated[GuardConfig, Tag("<guard>")] | Annotated[Literal[False], Tag("<none>")],
        Discriminator(_guard_form),
    ] = GuardConfig(gap=1.0, width=8.0)
    force_on: ForceOn = "pad"


class TissueConfig(Section):
    """Thickness of the layers and radius of the arm below them [mm]."""

    cutis_mm: Length = 2.0
    subcutis_mm: Length = 8.0
    arm_radius_mm: Radius = 48.0


class DeviceFile(Section):
    """A file that states a device, and the tissue that it is on."""

    device: DeviceConfig = DeviceConfig()
    tissue: TissueConfig = TissueConfig()


@dataclass(frozen=True)
class StatedGeometry:
    """A geometry with the standard deviations of what is uncertain.

    geometry : at the means; sd_m : by the name of its field, those that are uncertain only [m]
    """

    geometry: Geometry
    sd_m: Mapping[str, float] = field(default_factory=dict)


def load_device(path: Path | str) -> StatedGeometry:
    """Reads a file with the sections `device` and `tissue`, of which what is missing is the article's.

    Raises InputError for a file that is absent or not TOML, an unknown key, a value of the wrong kind, or
    lengths that cannot be.
    """
    file = load_device_file(path)
    return stated_geometry(file.device, file.tissue, path)


def load_device_file(path: Path | str) -> DeviceFile:
    """The file's sections as they stand there. Raises InputError as `load_device`."""
    file = checked(DeviceFile, read_toml(Path(path), EXPECTED), path, EXPECTED)
    stated_geometry(file.device, file.tissue, path)
    return file


def stated_geometry(device: DeviceConfig, tissue: TissueConfig, where: object) -> StatedGeometry:
    """The geometry in metres of two sections. Raises InputError, of `where`, for lengths that cannot be."""
    guard, radius = device.guard_mm, _mean(tissue.arm_radius_mm)
    try:
        geometry = Geometry(
            gauge_m=_metres(device.gauge_mm),
            pad_length_m=_metres(device.pad_mm[0]),
            pad_width_m=_metres(device.pad_mm[1]),
            guard=Guard(_metres(guard.gap), _metres(guard.width)) if guard else None,
            force_on=device.force_on,
            cutis_m=_metres(_mean(tissue.cutis_mm)),
            subcutis_m=_metres(_mean(tissue.subcutis_mm)),
            arm_radius_m=None if radius == "flat" else _metres(radius),
        )
    except InputError as error:
        raise InputError(f"{where}: {_KEYS[error.where]}", error.found, error.expected) from None
    sd_m = {}
    for name, value in tissue:
        if isinstance(value, Uncertain):
            if value.sd > LARGEST_SD * value.mean:
                found = f"sd {value.sd:g} of a mean of {value.mean:g} mm"
                raise InputError(f"{where}: tissue.{name}", found, "an sd of at most a third of the mean")
            sd_m[name.removesuffix("m")] = _metres(value.sd)
    return StatedGeometry(geometry, sd_m)


def length_parameters(stated: StatedGeometry) -> tuple[Parameter, ...]:
    """The parameters of a geometry's uncertain lengths [m]: normal priors, cut to what can be meshed."""
    found: dict[str, Parameter] = {}
    for name, sd in stated.sd_m.items():
        mean = getattr(stated.geometry, name)
        low, high = (1e-3 * bound for bound in BOUNDS_MM[name])
        if name == "arm_radius_m":
            thickest = {layer: p.upper for layer, p in found.items()}
            flat = replace(stated.geometry, arm_radius_m=None)
            low = max(low, moved(flat, thickest).least_radius_m)
        lower, upper = max(mean - REACH * sd, low * (1.0 + ROOM)), min(mean + REACH * sd, high * (1.0 - ROOM))
        found[name] = Parameter(
            name, "m", lower, upper, "normal", _MEANING[name], "[tissue] of the configuration",
            centre=mean, spread=sd,
        )  # fmt: skip
    return tuple(found.values())


def device_lines(device: DeviceConfig, tissue: TissueConfig) -> list[str]:
    """Both sections as lines of TOML, every key with its value and a comment."""
    guard = device.guard_mm
    pad = ", ".join(f"{length:g}" for length in device.pad_mm)
    shown_guard = f"{{ gap = {guard.gap:g}, width = {guard.width:g} }}" if guard else "false"
    return [
        "[device]  # lengths in mm",
        f"gauge_mm = {device.gauge_mm:g}  # between the pads' inner edges",
        f"pad_mm = [{pad}]  # along the pull, across it",
        f"guard_mm = {shown_guard}  # from the pad, of the guard; or false: none",
        f'force_on = "{device.force_on}"  # what the load cell holds; or "pad and guard"',
        "",
        "[tissue]  # lengths in mm",
        f"cutis_mm = {_shown(tissue.cutis_mm)}",
        f"subcutis_mm = {_shown(tissue.subcutis_mm)}",
        f'arm_radius_mm = {_shown(tissue.arm_radius_mm)}  # below the skin; or "flat"',
    ]


def _shown(value: Any) -> str:
    if isinstance(value, Uncertain):
        return f"{{ mean = {value.mean:g}, sd = {value.sd:g} }}"
    return '"flat"' if value == "flat" else f"{value:g}"


def _mean(value: Any) -> Any:
    return value.mean if isinstance(value, Uncertain) else value


def _metres(length_mm: float) -> float:
    """Metres, without the rounding error of the product."""
    return round(1e-3 * length_mm, 15)
