"""Reads the file of a study: its table, and the settings that the runs of all its recordings share."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bayeskin.config.configuration import Config
from bayeskin.config.device import load_device_file
from bayeskin.config.files import config_of
from bayeskin.config.sections import read_toml
from bayeskin.errors import InputError

EXPECTED = "a TOML file with the key `table`, and sections of a configuration"
_ALONE: dict[str, Any] = {"workers": 1}  # a recording is inferred by one process


@dataclass(frozen=True)
class StudyFile:
    """A study as its file states it.

    table : path of the table
    settings : the keys and sections of a configuration that the runs of all recordings share
    config : these settings as a configuration, whose recording is a placeholder
    """

    path: Path
    table: Path
    settings: Mapping[str, Any]
    config: Config

    @property
    def folder(self) -> Path:
        """Returns the folder of the study's outputs, which lies beside its file."""
        return self.path.resolve().parent / self.config.name

    def config_of(
        self, name: str, folder: Path, recording: Path, device: Path | None = None, **sections: Any
    ) -> Config:
        """Returns the configuration of a recording's run, which will lie in `folder`.

        The files that the settings name lie beside the study's file, and are named from the folder.

        device : file with the sections [device] and [tissue] of this recording
        sections : further sections, whose keys replace those of the settings

        Raises InputError for settings that are wrong, and for a device where the study's file states one.
        """
        settings = self._moved(folder) | {"name": name}
        if device is not None:
            if stated := {"device", "tissue"} & settings.keys():
                problem = f"{device} is named here, and {self.path} has the section [{min(stated)}]"
                raise InputError(
                    f"{self.table}, column 'device'", problem, "leave out the column or the section"
                )
            settings |= {key: section.model_dump() for key, section in load_device_file(device)}
        for key, own in {"recording": {"file": self._from(folder, recording)}, **sections}.items():
            settings[key] = {**settings.get(key, {}), **own}
        settings["design"] = {**_without(settings.get("design", {}), "scheduler"), **_ALONE}
        return config_of(_without(settings, "slurm"), self.path)

    def _moved(self, folder: Path) -> dict[str, Any]:
        """Returns the settings, in which files beside the study's file are named from a folder."""
        moved = dict(self.settings)
        for section, key in (("model", "mesh"), ("model", "forward"), ("surrogate", "file")):
            file, colon, function = str(moved.get(section, {}).get(key, "")).partition(":")
            beside = self.path.resolve().parent / file
            if file and beside.is_file():
                moved[section] = {**moved[section], key: self._from(folder, beside) + colon + function}
        return moved

    @staticmethod
    def _from(folder: Path, file: Path) -> str:
        return os.path.relpath(file.resolve(), folder.resolve())


def load_study(path: Path | str) -> StudyFile:
    """Reads and checks the file of a study; ``name`` defaults to the file's name without its suffix.

    Raises InputError for a file that is absent or is not TOML, for a file without a table, for recordings in
    it, and for settings that `load_config` refuses.
    """
    path = Path(path)
    settings = {"name": path.stem, **read_toml(path, EXPECTED)}
    table = settings.pop("table", None)
    if not isinstance(table, str):
        problem = "there is no table" if table is None else f"{table!r:.80} is not the name of a file"
        raise InputError(f"{path}: table", problem, "give the name of a CSV file with the study's recordings")
    named = settings.get("recording", {})
    if "recordings" in settings or (isinstance(named, dict) and "file" in named):
        raise InputError(
            f"{path}: recording",
            "a recording is given",
            "leave it out, because the table names the recordings",
        )
    if not isinstance(named, dict):
        raise InputError(
            f"{path}: recording",
            f"{named!r:.80} is not a section",
            "write a section [recording], or leave it out",
        )
    if "markers" in named:
        raise InputError(
            f"{path}: recording.markers",
            "a study infers from the force alone",
            "leave out this key, or run the recording by itself",
        )
    config = config_of({**settings, "recording": {**named, "file": table}}, path)
    return StudyFile(path, path.parent / table, settings, config)


def _without(section: Mapping[str, Any], key: str) -> dict[str, Any]:
    return {name: value for name, value in section.items() if name != key}
