"""Reads the sections `device` and `tissue`, from a configuration or from a file that holds only these two.

All lengths in them are in millimetres. A length of the tissue may be uncertain: it then has a mean and a
standard deviation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag

from bayeskin.config.sections import Section, checked, read_toml
from bayeskin.errors import InputError
from bayeskin.geometry import BOUNDS_MM, ForceOn, Geometry, Guard, moved
from bayeskin.types import Parameter

EXPECTED = "a TOML file with the sections [device] and [tissue]"
LARGEST_SD = 1 / 3  # largest share of the mean, so that a normal prior stays away from zero
REACH = 3.0  # number of sd by which the prior of a length extends to either side of the mean
# Relative distance of a length's bounds from impossible lengths, because derivatives take small steps.
ROOM = 1e-3
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
    """An uncertain length with a mean and a standard deviation, which stands for a normal prior."""

    mean: float
    sd: Annotated[float, Field(gt=0)]


def _length_form(given: Any) -> str:
    """Returns the tag of the form in which a length is given: a number or an uncertain length."""
    return "<uncertain>" if isinstance(given, Uncertain | Mapping) else "<number>"


def _radius_form(given: Any) -> str:
    """Returns the tag of the form in which the arm's radius is given: "flat", or a form of a length."""
    return "<flat>" if isinstance(given, str) else _length_form(given)


_Number = Annotated[float, Tag("<number>")]
_Uncertain = Annotated[Uncertain, Tag("<uncertain>")]
_Flat = Annotated[Literal["flat"], Tag("<flat>")]
Length = Annotated[_Number | _Uncertain, Discriminator(_length_form)]
Radius = Annotated[_Number | _Uncertain | _Flat, Discriminator(_radius_form)]


class GuardConfig(Section):
    """The guard around each pad: its gap to the pad, and its width, as in `bayeskin.geometry.Guard`."""

    gap: float
    width: float


def _guard_form(given: Any) -> str:
    """Returns the tag of the form in which the guard is given: a guard, or none."""
    return "<guard>" if isinstance(given, GuardConfig | Mapping) else "<none>"


class DeviceConfig(Section):
    """The extensometer's lengths [mm]: the gauge, a pad along and across the pull, and its guard.

    The gauge is the distance between the pads. `force_on` says which parts the load cell holds.
    """

    gauge_mm: float = 36.0
    pad_mm: tuple[float, float] = (8.0, 8.0)
    guard_mm: Annotated[
        Annotated[GuardConfig, Tag("<guard>")] | Annotated[Literal[False], Tag("<none>")],
        Discriminator(_guard_form),
    ] = GuardConfig(gap=1.0, width=8.0)
    force_on: ForceOn = "pad"


class TissueConfig(Section):
    """The thickness of the layers and the radius of the arm below them [mm]."""

    cutis_mm: Length = 2.0
    subcutis_mm: Length = 8.0
    arm_radius_mm: Radius = 48.0


class DeviceFile(Section):
    """The content of a file that states a device and the tissue that it is used on."""

    device: DeviceConfig = DeviceConfig()
    tissue: TissueConfig = TissueConfig()


@dataclass(frozen=True)
class StatedGeometry:
    """A geometry, and the standard deviations of its uncertain lengths.

    geometry : the lengths, with the mean of each uncertain length
    sd_m : the standard deviation [m] of each uncertain length, by the name of its field in the geometry
    """

    geometry: Geometry
    sd_m: Mapping[str, float] = field(default_factory=dict)


def load_device(path: Path | str) -> StatedGeometry:
    """Reads a file with the sections `device` and `tissue`; missing keys have the values of the article.

    Raises InputError for a file that is absent or is not TOML, an unknown key, a value of the wrong type, or
    impossible lengths.
    """
    file = load_device_file(path)
    return stated_geometry(file.device, file.tissue, path)


def load_device_file(path: Path | str) -> DeviceFile:
    """Returns the sections of the file as they are written there. Raises InputError as `load_device`."""
    file = checked(DeviceFile, read_toml(Path(path), EXPECTED), path, EXPECTED)
    stated_geometry(file.device, file.tissue, path)
    return file


def stated_geometry(device: DeviceConfig, tissue: TissueConfig, where: object) -> StatedGeometry:
    """Returns the geometry [m] that both sections state.

    Raises InputError, which names `where`, for impossible lengths.
    """
    guard, radius = device.guard_mm, _mean_of(tissue.arm_radius_mm)
    try:
        geometry = Geometry(
            gauge_m=_metres(device.gauge_mm),
            pad_length_m=_metres(device.pad_mm[0]),
            pad_width_m=_metres(device.pad_mm[1]),
            guard=Guard(_metres(guard.gap), _metres(guard.width)) if guard else None,
            force_on=device.force_on,
            cutis_m=_metres(_mean_of(tissue.cutis_mm)),
            subcutis_m=_metres(_mean_of(tissue.subcutis_mm)),
            arm_radius_m=None if radius == "flat" else _metres(radius),
        )
    except InputError as error:
        raise InputError(f"{where}: {_KEYS[error.where]}", error.problem, error.remedy) from None
    sd_m = {}
    for name, value in tissue:
        if isinstance(value, Uncertain):
            if value.sd > LARGEST_SD * value.mean:
                problem = f"an sd of {value.sd:g} mm is too large for a mean of {value.mean:g} mm"
                raise InputError(f"{where}: tissue.{name}", problem, "it must be at most a third of the mean")
            sd_m[name.removesuffix("m")] = _metres(value.sd)
    return StatedGeometry(geometry, sd_m)


def length_parameters(stated: StatedGeometry) -> tuple[Parameter, ...]:
    """Returns the parameters of a geometry's uncertain lengths [m].

    Their normal priors are truncated to lengths that can be meshed.
    """
    parameters: dict[str, Parameter] = {}
    for name, sd in stated.sd_m.items():
        mean = getattr(stated.geometry, name)
        low, high = (1e-3 * bound for bound in BOUNDS_MM[name])
        if name == "arm_radius_m":
            thickest = {layer: p.upper for layer, p in parameters.items()}
            flat = replace(stated.geometry, arm_radius_m=None)
            low = max(low, moved(flat, thickest).least_radius_m)
        lower, upper = max(mean - REACH * sd, low * (1.0 + ROOM)), min(mean + REACH * sd, high * (1.0 - ROOM))
        parameters[name] = Parameter(
            name, "m", lower, upper, "normal", _MEANING[name], "[tissue] of the configuration",
            centre=mean, spread=sd,
        )  # fmt: skip
    return tuple(parameters.values())


def device_lines(device: DeviceConfig, tissue: TissueConfig) -> list[str]:
    """Returns both sections as lines of TOML: every key with its value and a comment."""
    guard = device.guard_mm
    pad = ", ".join(f"{length:g}" for length in device.pad_mm)
    guard_text = f"{{ gap = {guard.gap:g}, width = {guard.width:g} }}" if guard else "false"
    return [
        "[device]  # lengths in mm",
        f"gauge_mm = {device.gauge_mm:g}  # distance between the inner edges of the pads",
        f"pad_mm = [{pad}]  # length along the pull, width across it",
        f"guard_mm = {guard_text}  # gap between pad and guard, width of the guard; false: no guard",
        f'force_on = "{device.force_on}"  # the parts that the load cell holds: "pad" or "pad and guard"',
        "",
        "[tissue]  # lengths in mm",
        f"cutis_mm = {_length_as_toml(tissue.cutis_mm)}  # thickness of the upper layer",
        f"subcutis_mm = {_length_as_toml(tissue.subcutis_mm)}  # thickness of the lower layer",
        f"arm_radius_mm = {_length_as_toml(tissue.arm_radius_mm)}"
        '  # radius of the arm below the skin, or "flat"',
    ]


def _length_as_toml(value: Any) -> str:
    """Returns a length as TOML."""
    if isinstance(value, Uncertain):
        return f"{{ mean = {value.mean:g}, sd = {value.sd:g} }}"
    return '"flat"' if value == "flat" else f"{value:g}"


def _mean_of(value: Any) -> Any:
    """Returns the mean of an uncertain length, and any other value unchanged."""
    return value.mean if isinstance(value, Uncertain) else value


def _metres(length_mm: float) -> float:
    """Returns a length in metres, without the rounding error of the product."""
    return round(1e-3 * length_mm, 15)
