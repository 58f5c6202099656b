"""Folders in which this process and those that it starts open no file for a while."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

_VARIABLE = "BAYESKIN_OFF_LIMITS"  # what a process that is started inherits
_FOLDERS: list[str] = []  # at the moment


@contextmanager
def off_limits(folder: Path) -> Iterator[None]:
    """While it lasts, no file in a folder can be opened, nor its names be listed: that is a PermissionError.

    It holds in this process, in those that it forks, and in workers that call `keep_out`.
    """
    _set_hook()
    closed = os.path.realpath(folder)
    _FOLDERS.append(closed)
    before = os.environ.get(_VARIABLE)
    os.environ[_VARIABLE] = json.dumps(_FOLDERS)
    try:
        yield
    finally:
        _FOLDERS.remove(closed)
        if before is None:
            del os.environ[_VARIABLE]
        else:
            os.environ[_VARIABLE] = before


def keep_out() -> None:
    """Makes a process that was started meanwhile open none either, for the rest of its life."""
    if folders := os.environ.get(_VARIABLE):
        _set_hook()
        _FOLDERS.extend(json.loads(folders))


@cache
def _set_hook() -> None:
    sys.addaudithook(_refuse)  # for good: Python takes none back


def _refuse(event: str, arguments: tuple[Any, ...]) -> None:
    if _FOLDERS and event in ("open", "os.listdir", "os.scandir"):
        name = arguments[0]
        if isinstance(name, str | bytes | os.PathLike):
            path = os.path.realpath(os.fsdecode(name))
            if any(path == one or path.startswith(one + os.sep) for one in _FOLDERS):
                raise PermissionError(f"{path} is off limits")
