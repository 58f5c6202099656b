"""Forbids this process, and the processes that it starts, to open files in given folders for a while.

While recordings with concealed effects are diagnosed, the folder with the answers is closed in this way, so
that a diagnosis cannot read them. The guard is an audit hook of Python.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

_VARIABLE = "BAYESKIN_OFF_LIMITS"  # the closed folders as JSON, for processes that are started
_FOLDERS: list[str] = []  # the folders that are closed at present


@contextmanager
def guarded(folder: Path) -> Iterator[None]:
    """Forbids access to a folder while the context lasts.

    Opening a file in the folder, or listing its names, raises PermissionError. The ban holds in this process,
    in processes that it forks, and in worker processes that call `apply_inherited_guards`.
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


def apply_inherited_guards() -> None:
    """Applies the bans of the parent process in a worker process, for the rest of the worker's life.

    The worker reads the closed folders from an environment variable that it inherits from its parent.
    """
    if folders := os.environ.get(_VARIABLE):
        _set_hook()
        _FOLDERS.extend(json.loads(folders))


@cache
def _set_hook() -> None:
    """Installs the audit hook once per process."""
    sys.addaudithook(_refuse)  # Python cannot remove an audit hook, so it stays for the life of the process


def _refuse(event: str, arguments: tuple[Any, ...]) -> None:
    """Raises PermissionError where an audit event opens or lists something in a closed folder."""
    if _FOLDERS and event in ("open", "os.listdir", "os.scandir"):
        name = arguments[0]
        if isinstance(name, str | bytes | os.PathLike):
            path = os.path.realpath(os.fsdecode(name))
            if any(path == folder or path.startswith(folder + os.sep) for folder in _FOLDERS):
                raise PermissionError(f"{path} is off limits")
