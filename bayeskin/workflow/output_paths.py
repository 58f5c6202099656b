"""Checks where a command is to write, before the command computes anything."""

from __future__ import annotations

from pathlib import Path

from bayeskin.errors import InputError


def check_ending(out: Path, *endings: str) -> None:
    """Raises InputError for a file with another ending than the allowed ones."""
    if out.suffix not in endings:
        raise InputError(
            f"-o {out}", f"the ending {out.suffix!r} is not possible", f"use {' or '.join(endings)}"
        )


def check_folder(option: str, folder: Path | None) -> None:
    """Raises InputError, which names the option, where a folder cannot be made."""
    above = [path for path in (folder, *folder.parents) if path.exists()] if folder else []
    if above and not above[0].is_dir():
        raise InputError(f"{option} {folder}", f"{above[0]} is a file", "it must be a folder")
