"""Imports a recording: reads a table and writes it as an HDF5 file of bayeskin."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from bayeskin import storage
from bayeskin.json_files import plain
from bayeskin.recordings import describe, describe_json, phase_noise, read_recording, segment
from bayeskin.workflow.output_paths import check_ending


def import_recording(file: Path, out: Path, sheet: str | None = None) -> dict[str, Any]:
    """Reads `file`, writes it to `out` as an HDF5 file of bayeskin, and returns the command's answer.

    Raises InputError, with nothing written, for a file that is no recording of a test.
    """
    check_ending(out, ".h5")
    recording = read_recording(file, sheet=sheet)
    phases = segment(recording)
    noise = phase_noise(recording, phases)
    storage.save(out, recording)
    text = f"{describe(recording, phases, noise)}\n\nwritten to {out}"
    return plain({"ok": True, "out": out, **describe_json(recording, phases, noise), "text": text})
