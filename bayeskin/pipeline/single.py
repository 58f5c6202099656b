"""Commands that need no run's folder: import a recording, run the full model once."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from bayeskin import storage
from bayeskin.errors import InputError
from bayeskin.pipeline.folder import plain
from bayeskin.pipeline.recording import describe, in_words
from bayeskin.recordings.noise import phase_noise
from bayeskin.recordings.read import read_recording
from bayeskin.recordings.segment import segment


def import_recording(file: Path, out: Path, sheet: str | None = None) -> dict[str, Any]:
    """Reads `file`, writes it to `out` in bayeskin's HDF5, and says what is in it.

    Raises InputError, with nothing written, when it is no recording of a test.
    """
    if out.suffix != ".h5":
        raise InputError(f"-o {out}", f"ending {out.suffix!r}", "ending '.h5'")
    recording = read_recording(file, sheet=sheet)
    description = describe(recording, phase_noise(recording, segment(recording)))
    storage.save(out, recording)
    text = f"{in_words(description)}\nwritten to {out}"
    return plain({"ok": True, "out": out, **description, "text": text})
