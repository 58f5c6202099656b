"""Receives a dropped file: completely or not at all, and no larger than is allowed."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import AsyncIterator
from pathlib import Path

from starlette.concurrency import run_in_threadpool

from bayeskin.app.reading import Choice, can_be_corrected, read_as
from bayeskin.app.recordings import RecordingFolder, Recordings
from bayeskin.errors import CannotWrite, InputError

MOST_BYTES = 500_000_000
_ENDING = re.compile(r"\.[a-z0-9-]{1,8}")
_PARTIAL = ".dropped.partial"


async def receive(recordings: Recordings, file_name: str, body: AsyncIterator[bytes]) -> RecordingFolder:
    """Keeps a dropped file as a new recording, and reads it as it explains itself.

    Raises InputError for a file that is too large, cannot be written, or is not readable whatever a person
    states about it. Nothing of it is kept then.
    """
    ending = Path(file_name).suffix.lower()
    if not _ENDING.fullmatch(ending):
        problem = f"{ending!r} is no ending of a table or a workbook"
        raise InputError(file_name[:80], problem, "rename the file, or export it in another format")
    folder = recordings.new(file_name)
    try:
        await _write(folder.path / _PARTIAL, file_name, body)
        await run_in_threadpool(_keep, folder, ending)
    except BaseException:
        shutil.rmtree(folder.path)
        raise
    return folder


async def _write(partial: Path, file_name: str, body: AsyncIterator[bytes]) -> None:
    """Writes the bytes of a file. Raises InputError where they are too many or cannot be written."""
    size = 0
    try:
        with open(partial, "xb") as handle:
            async for part in body:
                size += len(part)
                if size > MOST_BYTES:
                    problem = f"the file has more than {MOST_BYTES // 10**6} MB"
                    raise InputError(file_name[:80], problem, "drop the file of a single recording")
                handle.write(part)
    except OSError as error:
        raise CannotWrite(file_name[:80], error) from None


def _keep(folder: RecordingFolder, ending: str) -> None:
    """Keeps the received bytes as the original of a recording, and reads them.

    Raises InputError where no choice of columns, units or table could make a recording of them.
    """
    (folder.path / "original").mkdir()
    os.replace(folder.path / _PARTIAL, folder.path / "original" / f"{folder.name}{ending}")
    reading = read_as(folder, Choice())
    if reading.error and not can_be_corrected(folder):
        raise reading.error
