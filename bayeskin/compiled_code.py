"""Chooses the folder in which numba keeps compiled code, where its usual folders cannot be written.

Numba keeps compiled code beside the sources, or else in the user's home. Where it can write to neither, as in
a container with a read-only package and no home, it refuses to compile. Compiled code then goes to a folder
for temporary files that belongs to this user.
"""

from __future__ import annotations

import os
import stat
import sys
import tempfile
from pathlib import Path

VARIABLE = "NUMBA_CACHE_DIR"  # numba, and all processes that this one starts, take the folder from here


def keep_compiled_code(package: Path, home: Path, temporary: Path) -> Path | None:
    """Returns the temporary folder that numba will use, or None where a usual folder can be written.

    package : folder of the sources; home : the user's home; temporary : the system's folder for such files
    """
    if os.environ.get(VARIABLE) or _is_writable(package / "__pycache__") or _is_writable(home / ".cache"):
        return None
    folder = _own_folder(temporary)
    os.environ[VARIABLE] = str(folder)
    if "numba" in sys.modules:  # it has read the variable already
        sys.modules["numba"].config.CACHE_DIR = str(folder)
    return folder


def folder_of_compiled_code(package: Path, home: Path) -> Path:
    """Returns the folder below which numba keeps the compiled code of a package."""
    if named := os.environ.get(VARIABLE):
        return Path(named)
    return package if _is_writable(package / "__pycache__") else home / ".cache" / "numba"


def _is_writable(folder: Path) -> bool:
    """Returns whether a file can be written to a folder, which is made where it does not exist."""
    if not folder.is_absolute():  # the home is not known
        return False
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _own_folder(temporary: Path) -> Path:
    """Returns a folder that only this user can read and write, the same for all processes of the user.

    Compiled code is executed. A folder that somebody else has made is therefore not used.
    """
    folder = temporary / f"bayeskin-compiled-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
        is_own = stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid()
        if is_own and not status.st_mode & 0o077:
            return folder
    except OSError:
        pass
    return Path(tempfile.mkdtemp(prefix="bayeskin-compiled-", dir=temporary))
