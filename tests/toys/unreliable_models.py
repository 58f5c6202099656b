"""Toy models that fail, die or dawdle in worker processes, and a small program that gets killed."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from toys.closed_form_model import EDGES_S, SPACE, toy_simulate

from bayeskin import storage
from bayeskin.design import Wave
from bayeskin.execution.local import local
from bayeskin.runner import run_design
from bayeskin.store import Store
from bayeskin.types import Design, Simulation

COARSE_S = EDGES_S[::10]
WAVE = Wave(  # random, not Sobol': each worker imports this file, and SciPy's qmc takes a second
    SPACE,
    SPACE.from_unit(np.random.default_rng(3).uniform(size=(11, 5))),
    np.arange(11) >= 8,
    number=0,
    seed=3,
    record={"rule": "random"},
)


def slow(theta: Mapping[str, float], seconds: float) -> Simulation:
    """The toy after a pause that differs from point to point, so that runs finish out of order."""
    time.sleep(seconds * (0.5 + (np.log(theta["E_c"]) * 7.0) % 1.0))
    return toy_simulate(theta)


def counted(theta: Mapping[str, float], folder: str) -> Simulation:
    """The toy, leaving one file a call."""
    descriptor = os.open(f"{folder}/{theta['E_c']!r}.{os.getpid()}.{time.monotonic_ns()}", os.O_CREAT)
    os.close(descriptor)
    return toy_simulate(theta)


def failing(theta: Mapping[str, float]) -> Simulation:
    """Fails in three ways over the box: by status, by exception, by a force that is not finite."""
    run = toy_simulate(theta)
    if theta["E_c"] < 3e4:
        return replace(run, status="failed", message="Newton stalled: use smaller steps")
    if theta["E_c"] > 7e5:
        raise ZeroDivisionError("singular tangent")
    if theta["E_s"] < 5e3:
        return replace(run, force_n=np.full_like(run.force_n, np.nan))
    return run


def deadly(theta: Mapping[str, float], folder: str, deaths: int) -> Simulation:
    """Kills its own process, as a segmentation fault would, on `deaths` calls a point with a stiff cutis."""
    if theta["E_c"] > 3e5 and len(list(Path(folder).glob(f"{theta['E_c']!r}.*"))) < deaths:
        (Path(folder) / f"{theta['E_c']!r}.{os.getpid()}").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return toy_simulate(theta)


def deadly_first(item: int) -> int:
    """Kills its own process on item 0."""
    if item == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    return item


def stuck(theta: Mapping[str, float], folder: str) -> Simulation:
    """Says which process it is in, then takes for ever."""
    (Path(folder) / f"{os.getpid()}.pid").touch()
    time.sleep(600.0)
    return toy_simulate(theta)


def threads(theta: Mapping[str, float]) -> Simulation:
    """Fails with the thread settings of its process."""
    settings = ",".join(os.environ.get(f"{name}_NUM_THREADS", "-") for name in ("OMP", "MKL", "NUMBA"))
    return replace(toy_simulate(theta), status="failed", message=settings)


def main(path: str, workers: int, seconds: float) -> Design:
    """Runs a wave in a store beside a file, and saves it there; may be killed and started again."""
    with Store(Path(path).with_suffix(".store"), "toy") as store:
        design = run_design(store, WAVE, COARSE_S, partial(slow, seconds=seconds), "toy", local(workers))
    storage.save(path, design)
    return design


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]))
