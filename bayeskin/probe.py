"""Checks that a file of the user can be read to its end, and that libhdf5 survives reading it.

Reading a pipe may never end, and reading a device never does. Damaged bytes can make libhdf5 loop for ever,
use all memory, or end the process. A file from elsewhere is therefore first read once, as a whole, in a
separate process with a limit on time and memory. Only then does this process read it. The files of a run's
folder are not checked, because they are written completely or not at all.
"""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from functools import lru_cache
from pathlib import Path

from bayeskin.errors import InputError, reason_of

# A busy machine takes seconds to start Python. It reads 100 times as fast as assumed here.
STARTS_S, BYTES_A_S = 60.0, 2e6
MEMORY_BYTES = 4 * 2**30
MOST_BYTES = 2 * 2**30  # the largest file that is read as a whole

READ_ALL = """
import resource, sys
resource.setrlimit(resource.RLIMIT_AS, (int(sys.argv[2]),) * 2)
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
import h5py
def read(name, node):
    dict(node.attrs)
    if isinstance(node, h5py.Dataset):
        node[()]
try:
    with h5py.File(sys.argv[1], "r") as handle:
        dict(handle.attrs)
        handle.visititems(read)
except BaseException as error:
    sys.exit(f"{type(error).__name__}: {error}")
"""


def refuse_endless(path: Path, expected: str, most_bytes: int = MOST_BYTES) -> None:
    """Raises InputError unless `path` is a regular file of at most `most_bytes`."""
    try:
        status = os.stat(path)
    except FileNotFoundError:
        raise InputError(path, "there is no such file", f"bayeskin needs {expected}") from None
    except (OSError, ValueError) as error:
        raise InputError(
            path, f"it cannot be read ({reason_of(error)})", f"bayeskin needs {expected}"
        ) from None
    if not stat.S_ISREG(status.st_mode):
        folder = stat.S_ISDIR(status.st_mode)
        problem = "it is a folder" if folder else "it is a pipe or a device instead of a file"
        raise InputError(path, problem, f"bayeskin needs {expected}")
    if status.st_size > most_bytes:
        raise InputError(
            path,
            f"it has {status.st_size} bytes",
            f"bayeskin needs {expected}, of at most {most_bytes} bytes",
        )


def bytes_of(path: Path, expected: str, most_bytes: int = MOST_BYTES) -> bytes:
    """Returns the bytes of a file. Raises InputError as `refuse_endless`, and where reading fails."""
    refuse_endless(path, expected, most_bytes)
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(
            path, f"it cannot be read ({reason_of(error)})", f"bayeskin needs {expected}"
        ) from None


def refuse_damaged(path: Path, expected: str) -> None:
    """Raises InputError unless an HDF5 file can be read completely, in reasonable time and memory."""
    refuse_endless(path, expected)
    status = os.stat(path)
    fault = _fault_of(str(path), status.st_size, status.st_mtime_ns, status.st_ino)
    if fault is not None:
        raise InputError(path, fault, f"bayeskin needs {expected}")


@lru_cache(maxsize=64)
def _fault_of(path: str, size: int, *_version: int) -> str | None:
    """Returns the reason why a separate process cannot read an HDF5 file, and None where it can.

    `_version` only serves the cache: a file that has changed is read again.
    """
    command = [sys.executable, "-c", READ_ALL, path, str(MEMORY_BYTES)]
    try:
        reader = subprocess.run(
            command, capture_output=True, text=True, timeout=STARTS_S + size / BYTES_A_S, check=False
        )
    except subprocess.TimeoutExpired:
        return "it cannot be read as HDF5 (reading it does not end)"
    if reader.returncode == 0:
        return None
    why = " ".join(reader.stderr.split())[-120:] if reader.returncode == 1 else "reading it ends the process"
    return f"it cannot be read as HDF5 ({why})"
