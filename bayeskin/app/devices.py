"""The device of a recording: read from its file or from a form, and written as `device.toml`."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

from bayeskin import storage
from bayeskin.app.recordings import RecordingFolder
from bayeskin.config.device import (
    EXPECTED,
    DeviceFile,
    Uncertain,
    device_lines,
    load_device_file,
    stated_geometry,
)
from bayeskin.config.sections import checked
from bayeskin.errors import InputError
from bayeskin.workflow.reducing import default_path, find_reduced

_LAYERS = ("cutis", "subcutis", "arm_radius")


def device_of(folder: RecordingFolder) -> DeviceFile:
    """Returns the device of a recording; by default the article's. Raises InputError for a damaged file."""
    return load_device_file(folder.device) if folder.device.is_file() else DeviceFile()


def fields_of(file: DeviceFile) -> dict[str, str]:
    """Returns the texts of the form's fields for a device."""
    device, tissue = file.device, file.tissue
    guard = device.guard_mm or DeviceFile().device.guard_mm
    assert guard
    fields = {
        "gauge": f"{device.gauge_mm:g}",
        "pad_length": f"{device.pad_mm[0]:g}",
        "pad_width": f"{device.pad_mm[1]:g}",
        "guard": "yes" if device.guard_mm else "no",
        "guard_gap": f"{guard.gap:g}",
        "guard_width": f"{guard.width:g}",
        "force_on": device.force_on,
        "flat": "yes" if tissue.arm_radius_mm == "flat" else "",
    }
    for layer in _LAYERS:
        length = getattr(tissue, f"{layer}_mm")
        uncertain = isinstance(length, Uncertain)
        mean = length.mean if uncertain else length
        fields[layer] = "" if mean == "flat" else f"{mean:g}"
        fields[f"{layer}_sd"] = f"{length.sd:g}" if uncertain else ""
    return fields


def from_form(form: Mapping[str, str]) -> DeviceFile:
    """Returns the device that a form states. Raises InputError for a wrong field or impossible lengths."""

    def length(name: str) -> Any:
        """Returns a field's number, or its text, which is then refused as such."""
        text = form.get(name, "").strip()
        try:
            return float(text.replace(",", "."))
        except ValueError:
            return text

    def layer(name: str) -> Any:
        """Returns a length, which is uncertain if a standard deviation is given."""
        given = form.get(f"{name}_sd", "").strip()
        return {"mean": length(name), "sd": length(f"{name}_sd")} if given else length(name)

    guard = {"gap": length("guard_gap"), "width": length("guard_width")}
    plain = {
        "device": {
            "gauge_mm": length("gauge"),
            "pad_mm": [length("pad_length"), length("pad_width")],
            "guard_mm": guard if form.get("guard") == "yes" else False,
            "force_on": form.get("force_on", ""),
        },
        "tissue": {
            "cutis_mm": layer("cutis"),
            "subcutis_mm": layer("subcutis"),
            "arm_radius_mm": "flat" if form.get("flat") == "yes" else layer("arm_radius"),
        },
    }
    file = checked(DeviceFile, plain, "device", EXPECTED)
    stated_geometry(file.device, file.tissue, "device")
    return file


def state(folder: RecordingFolder, file: DeviceFile) -> None:
    """Writes the device of a recording, completely or not at all."""
    text = "\n".join(device_lines(file.device, file.tissue)) + "\n"
    storage.write_bytes(folder.device, text.encode())


def state_as(folder: RecordingFolder, other: RecordingFolder) -> None:
    """Takes the device of another recording, with its reduced model if there is one."""
    state(folder, device_of(other))
    reduced = default_path(other.device)
    if reduced.is_file():
        partial = folder.path / f".{reduced.name}.partial"
        partial.unlink(missing_ok=True)
        os.link(reduced, partial)
        os.replace(partial, default_path(folder.device))


def has_reduced_model(folder: RecordingFolder) -> bool:
    """Returns whether a reduced model for the device of a recording exists, which a diagnosis needs."""
    file = device_of(folder)
    try:
        geometry = stated_geometry(file.device, file.tissue, folder.device).geometry
        return find_reduced(geometry, [folder.config]) is not None
    except InputError:
        return False
