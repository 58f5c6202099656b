"""The folder with all recordings of the page: one folder for each, listed from the disk."""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import count
from pathlib import Path

from bayeskin.errors import InputError, reason_of

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,79}")
_LONGEST = 60
_PRIVATE = 0o700  # other users of the machine may not look into the folders


@dataclass(frozen=True)
class RecordingFolder:
    """The folder of one recording, which contains all that belongs to it."""

    path: Path

    @property
    def name(self) -> str:
        """Returns the name of the recording."""
        return self.path.name

    @property
    def original(self) -> Path | None:
        """Returns the file that was dropped, or None where there is none."""
        folder = self.path / "original"
        files = [file for file in folder.iterdir() if file.is_file()] if folder.is_dir() else []
        return files[0] if files else None

    @property
    def dropped_s(self) -> float:
        """Returns when its file was dropped, in seconds since 1970."""
        return (self.path / "original").stat().st_mtime

    @property
    def stored(self) -> Path:
        """Returns the recording as `bayeskin import` writes it."""
        return self.path / f"{self.name}.h5"

    @property
    def reading(self) -> Path:
        """Returns the file that says how the recording was read."""
        return self.path / "reading.json"

    @property
    def device(self) -> Path:
        """Returns the file of the device; there is none for the article's device."""
        return self.path / "device.toml"

    @property
    def config(self) -> Path:
        """Returns the configuration of the run."""
        return self.path / f"{self.name}.toml"

    @property
    def run(self) -> Path:
        """Returns the folder of the run's outputs."""
        return self.path / self.name

    @property
    def report(self) -> Path:
        """Returns the report of the run."""
        return self.run / "report.html"

    @property
    def report_is_old(self) -> bool:
        """Returns whether the recording or its device was changed after the report was written."""
        inputs = [file.stat().st_mtime for file in (self.stored, self.device) if file.is_file()]
        return self.report.is_file() and self.report.stat().st_mtime < max(inputs, default=0.0)

    @property
    def job(self) -> Path:
        """Returns the folder of the last job."""
        return self.path / "job"


@dataclass(frozen=True)
class Recordings:
    """All recordings of the page, in one folder."""

    root: Path

    def all(self) -> list[RecordingFolder]:
        """Returns the folders of all recordings, the newest first."""
        folders = [RecordingFolder(path) for path in self.root.iterdir() if _is_recording(path)]
        return sorted(folders, key=lambda folder: folder.dropped_s, reverse=True)

    def named(self, name: str) -> RecordingFolder | None:
        """Returns the folder of a recording, or None for any name that no recording has."""
        path = self.root / name
        return RecordingFolder(path) if path.name == name and _is_recording(path) else None

    def new(self, file_name: str) -> RecordingFolder:
        """Makes the folder of a new recording, whose name is made from the name of its file.

        Characters that are not allowed become hyphens. A name that exists gets a number.
        """
        stem = re.sub(r"[^A-Za-z0-9._-]+", "-", Path(file_name).stem).strip("-._")[:_LONGEST] or "recording"
        for number in count(1):
            path = self.root / (stem if number == 1 else f"{stem}-{number}")
            try:
                path.mkdir(mode=_PRIVATE)
            except FileExistsError:
                continue
            return RecordingFolder(path)
        raise AssertionError("unreachable")


def open_recordings(root: Path) -> Recordings:
    """Returns the recordings in a folder, which is made if it does not exist.

    Raises InputError where the folder cannot be made.
    """
    try:
        root.mkdir(mode=_PRIVATE, parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            root, f"the folder cannot be made ({reason_of(error)})", "name another folder"
        ) from None
    return Recordings(root.resolve())


def _is_recording(path: Path) -> bool:
    return bool(_NAME.fullmatch(path.name)) and not path.is_symlink() and (path / "original").is_dir()
