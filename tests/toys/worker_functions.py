"""Functions for worker processes in tests: they identify themselves, wait for each other, or end."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import numpy as np

from bayeskin.store import Store

ADDED = 50


def met(folder: str) -> int:
    """Returns the process's id when two processes are in the folder."""
    (Path(folder) / f"{os.getpid()}.pid").touch()
    patience = time.monotonic() + 60.0
    while len(list(Path(folder).glob("*.pid"))) < 2 and time.monotonic() < patience:
        time.sleep(0.02)
    return os.getpid()


def slept(item: tuple[str, float]) -> tuple[str, int]:
    """Writes its process's id to a file, sleeps for some seconds, returns the file and the id."""
    file, seconds = item
    unfinished = Path(f"{file}.partial")
    unfinished.write_text(str(os.getpid()))
    unfinished.rename(file)
    time.sleep(seconds)
    return file, os.getpid()


def dead_once(file: str) -> int:
    """Kills its process where a file is not there yet, which it then is; else returns the process's id."""
    if file and not Path(file).exists():
        Path(file).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return os.getpid()


kept: list[int] = []


def counted(item: int) -> tuple[int, ...]:
    """All items that this process has had."""
    kept.append(item)
    return tuple(kept)


def added(path: str) -> int:
    """Adds results to a store while another process does the same, and returns this process's id."""
    with Store(Path(path), "shared") as store:
        met(str(Path(path).parent))
        for n in range(ADDED):
            store.add([os.getpid(), n], {"force_n": np.full(3000, n)})
    return os.getpid()


def opens(path: str) -> bool:
    """Returns whether this process may read a file."""
    try:
        return bool(Path(path).read_text())
    except PermissionError:
        return False


def hooke(theta: dict[str, float], time_s: np.ndarray, displacement_m: np.ndarray) -> np.ndarray:
    """The force of a spring."""
    return theta["stiffness"] * displacement_m
