"""Writes a configuration for a recording of the user's own, and chooses the surrogate that it uses."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bayeskin.config.device import DeviceFile, StatedGeometry, load_device_file, stated_geometry
from bayeskin.errors import InputError
from bayeskin.geometry import Geometry
from bayeskin.json_files import plain
from bayeskin.recordings import (
    BIN_WIDTH_S,
    describe,
    describe_json,
    fitting_width_s,
    idealised_motion,
    phase_noise,
    read_recording,
    segment,
    shown,
)
from bayeskin.reduced.files import load_reduced
from bayeskin.reduced.region import protocol_outside
from bayeskin.shipped import shipped
from bayeskin.types import PadMotion
from bayeskin.workflow.configuration_text import (
    configuration_text,
    full_design_section,
    reduced_design_section,
    surrogate_section,
    wide_bins_section,
)
from bayeskin.workflow.importing import markers_beside
from bayeskin.workflow.output_paths import check_ending
from bayeskin.workflow.reducing import find_reduced
from bayeskin.workflow.shipping import shipped_for


def new_config(files: Sequence[Path], out: Path | None = None, device: Path | None = None) -> dict[str, Any]:
    """Writes a configuration that fits recordings of one skin, and reports what they contain.

    By default it lies beside the first recording. The configuration of a single recording uses a shipped
    surrogate where one was trained on the recording's protocol and device. Otherwise it has a design of its
    own, by the reduced model where the device has one. Tracks that were imported with a single recording are
    used too. The sections of the file `device` are written into it.
    Raises InputError, with nothing written, for a file that is no recording of a test, two files of one name,
    an impossible device, or an `out` that exists already.
    """
    stated = None if device is None else load_device_file(device)
    recordings = [read_recording(file) for file in files]
    out = out or files[0].with_suffix(".toml")
    check_ending(out, ".toml")
    if out.exists():
        raise InputError(f"-o {out}", "this file exists already", "give the name of a new file")
    phases = [segment(recording) for recording in recordings]
    both = list(zip(recordings, phases, strict=True))
    described = [(*pair, phase_noise(*pair)) for pair in both]
    description, motions = (
        "\n\n".join(describe(*parts) for parts in described),
        [idealised_motion(*p) for p in both],
    )
    geometry, single = _geometry(stated), len(files) == 1
    width_s = max(map(fitting_width_s, recordings))
    tracks = markers_beside(files[0]) if single and markers_beside(files[0]).exists() else None
    # shipped surrogates need all of these
    usual = single and not geometry.sd_m and width_s == BIN_WIDTH_S and tracks is None
    surrogate = shipped_for(motions[0], geometry.geometry) if usual else None
    reduced = None if surrogate else _reduced_for(motions, geometry.geometry, out)
    source, section = _surrogate_source(surrogate, reduced)
    references = [_reference(file, out) for file in files]
    _refuse_names(references)
    if width_s != BIN_WIDTH_S:
        section = [*wide_bins_section(width_s), "", *section]
    text = configuration_text(
        _name(out), references, description, section, surrogate is not None, stated,
        None if tracks is None else _reference(tracks, out),
    )  # fmt: skip
    out.parent.mkdir(parents=True, exist_ok=True)
    with open(out, "x", encoding="utf-8") as handle:
        handle.write(text)
    facts = [describe_json(*parts) for parts in described]
    contents = facts[0] if single else {"recordings": facts}
    answer = {"ok": True, "out": out, "surrogate": surrogate.name if surrogate else None, **contents}
    return plain(
        {**answer, "text": f"{description}\n\nwritten to {out}, with {source}\nnext: bayeskin run {out}"}
    )


def _reference(file: Path, out: Path) -> str:
    """Returns the path of a file relative to the configuration `out`."""
    return Path(os.path.relpath(file.resolve(), out.resolve().parent)).as_posix()


def new_demo(out: Path | None = None) -> dict[str, Any]:
    """Writes the demo's configuration, by default demo.toml, and the demo's recording beside it.

    Raises InputError, with nothing written, where one of these files exists already.
    """
    out = out or Path("demo.toml")
    recording = out.with_name("demo-recording.h5")  # demo.h5 is already the name of the surrogate
    check_ending(out, ".toml")
    for file in (out, recording):
        if file.exists():
            raise InputError(file, "this file exists already", "use a folder without it")
    text = shipped("runs/demo.toml").read_text(encoding="utf-8")
    out.parent.mkdir(parents=True, exist_ok=True)
    recording.write_bytes(shipped("data/demo.h5").read_bytes())
    out.write_text(text.replace('"../data/demo.h5"', '"demo-recording.h5"'), encoding="utf-8")
    commands = f"bayeskin run {out} && bayeskin diagnose {out}"
    return plain({"ok": True, "out": out, "text": f"written to {out}\nnext: {commands}"})


def _refuse_names(references: Sequence[str]) -> None:
    """Raises InputError for the name of a file that is not UTF-8."""
    for reference in references:
        if shown(reference) != reference:
            remedy = "give the file a name in UTF-8, or write another file by `bayeskin import`"
            raise InputError(shown(reference), "a configuration cannot contain this name", remedy)


def _geometry(stated: DeviceFile | None) -> StatedGeometry:
    """Returns the geometry of a device, by default the article's."""
    file = stated or DeviceFile()
    return stated_geometry(file.device, file.tissue, "device")


def _reduced_for(motions: Sequence[PadMotion], geometry: Geometry, out: Path) -> Path | None:
    """Returns the file of a reduced model with which a run of the configuration `out` can make its design.

    Returns None where no such model was trained for the protocols.
    """
    file = find_reduced(geometry, [out])
    if file is None:
        return None
    trained = load_reduced(file).trained.protocols
    return None if any(protocol_outside(trained, motion) for motion in motions) else file


def _surrogate_source(surrogate: Path | None, reduced: Path | None) -> tuple[str, list[str]]:
    """Returns how a run gets its surrogate, in words and as lines of the configuration."""
    if surrogate is not None:
        return f"the shipped surrogate {surrogate.name}", surrogate_section(surrogate.name)
    if reduced is not None:
        return f"a design of the reduced model {reduced.name}", reduced_design_section(reduced.name)
    return "a design of full runs", full_design_section()


def _name(out: Path) -> str:
    """Returns a run's name from a file's name; characters that are not allowed become hyphens."""
    return re.sub(r"^[^A-Za-z0-9]+", "", re.sub(r"[^A-Za-z0-9._-]", "-", out.stem)) or "run"
