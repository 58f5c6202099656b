"""Packs the folder of a recording into a zip archive, piece by piece, without a copy on the disk."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

_PIECE = 1 << 20
_STORED = (".h5", ".nc", ".png", ".xlsx", ".zip")  # compressed already


class _Pipe:
    """Keeps what an archive writes until it is passed on."""

    def __init__(self) -> None:
        self._pieces: list[bytes] = []

    def write(self, data: bytes) -> int:
        """Keeps bytes."""
        self._pieces.append(bytes(data))
        return len(data)

    def flush(self) -> None:
        """Does nothing, since nothing waits."""

    def taken(self) -> bytes:
        """Returns the bytes since the last call."""
        data = b"".join(self._pieces)
        self._pieces.clear()
        return data


def packed(folder: Path) -> Iterator[bytes]:
    """Yields a zip archive with all files of a folder.

    Hidden files, links, and what a link leads to are left out, so nothing from outside the folder is packed.
    A file that vanishes meanwhile is left out.
    """
    pipe = _Pipe()
    with zipfile.ZipFile(pipe, "w", zipfile.ZIP_DEFLATED) as archive:  # type: ignore[call-overload]
        for file in _files(folder):
            with suppress(FileNotFoundError):
                yield from _added(archive, pipe, file, f"{folder.name}/{file.relative_to(folder)}")
    yield pipe.taken()


def _files(folder: Path) -> Iterator[Path]:
    """Yields the files below a folder that are packed."""
    for path in sorted(folder.iterdir()):
        if path.name.startswith(".") or path.is_symlink():
            continue
        if path.is_dir():
            yield from _files(path)
        elif path.is_file():
            yield path


def _added(archive: zipfile.ZipFile, pipe: _Pipe, file: Path, name: str) -> Iterator[bytes]:
    """Yields the bytes of an archive while a file is added to it."""
    with open(file, "rb") as source:
        info = zipfile.ZipInfo.from_file(file, name, strict_timestamps=False)
        info.compress_type = zipfile.ZIP_STORED if file.suffix in _STORED else zipfile.ZIP_DEFLATED
        with archive.open(info, "w", force_zip64=True) as entry:
            while piece := source.read(_PIECE):
                entry.write(piece)
                yield pipe.taken()
    yield pipe.taken()
