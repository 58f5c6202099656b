"""Whether a file that somebody brought can be read to its end, and whether libhdf5 survives it.

A pipe may never end, a device never does. Damaged bytes can make libhdf5 loop for ever, ask for all memory
or end the process. A foreign file is therefore read once, whole, in a process of its own with a limit on time
and memory; only then here. Files of a run's folder are not: they are written whole or not at all.
"""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from functools import lru_cache
from pathlib import Path

from bayeskin.errors import InputError

STARTS_S, BYTES_A_S = (
    60.0,
    2e6,
)  # a busy machine takes seconds to start Python, and reads 100 times as quickly
MEMORY_BYTES = 4 * 2**30
MOST_BYTES = 2 * 2**30  # of a file that is read as a whole

_READ_ALL = """
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
        found = os.stat(path)
    except FileNotFoundError:
        raise InputError(path, "no such file", expected) from None
    except (OSError, ValueError) as error:
        raise InputError(path, f"an unreadable file ({error})", expected) from None
    if not stat.S_ISREG(found.st_mode):
        what = "a folder" if stat.S_ISDIR(found.st_mode) else "a pipe or a device, no file"
        raise InputError(path, what, expected)
    if found.st_size > most_bytes:
        raise InputError(path, f"{found.st_size} bytes", f"{expected}, of at most {most_bytes} bytes")


def bytes_of(path: Path, expected: str, most_bytes: int = MOST_BYTES) -> bytes:
    """A file's bytes. Raises InputError as `refuse_endless`, and for one that cannot be read."""
    refuse_endless(path, expected, most_bytes)
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(path, f"an unreadable file ({error.strerror})", expected) from None


def refuse_damaged(path: Path, expected: str) -> None:
    """Raises InputError unless all of an HDF5 file can be read, in reasonable time and memory."""
    refuse_endless(path, expected)
    found = os.stat(path)
    fault = _fault_of(str(path), found.st_size, found.st_mtime_ns, found.st_ino)
    if fault is not None:
        raise InputError(path, fault, expected)


@lru_cache(maxsize=64)
def _fault_of(path: str, size: int, *_version: int) -> str | None:
    command = [sys.executable, "-c", _READ_ALL, path, str(MEMORY_BYTES)]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=STARTS_S + size / BYTES_A_S, check=False
        )
    except subprocess.TimeoutExpired:
        return "not readable as HDF5 (reading it does not end)"
    if done.returncode == 0:
        return None
    said = " ".join(done.stderr.split())[-120:] if done.returncode == 1 else "it ends the reading process"
    return f"not readable as HDF5 ({said})"
