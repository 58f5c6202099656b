"""What running a design costs beside its runs: one and two local processes, Dask with one and two workers.

The same full runs (default bricks, first cycle of the healthy-skin protocol, first points of a design of the
default box), timed by the clock:

    alone            one after the other in this process, no runner
    local 1, 2       `bayeskin.runner` with processes of its own, started anew for each design
    Dask 1, 2        the runner over a LocalCluster of this machine, one thread a worker (extra `cluster`)

Every way runs the points once before it is timed, so that no compilation is. Prints medians over the repeats,
what a run costs beyond the serial one, and the efficiency: serial time over workers times time. Nothing is
stored. Needs as many idle cores as workers.

    OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 python benchmarks/scaling.py
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path

import healthy_skin
import numpy as np
import rows

from bayeskin.design import Wave, default_space, first_wave
from bayeskin.errors import InputError
from bayeskin.execution import cluster
from bayeskin.execution.local import Map, local
from bayeskin.finite_element import ModelSpec, simulate
from bayeskin.runner import run_design

SEED = 5
SPEC = ModelSpec()
MOTION = healthy_skin.first_cycle(healthy_skin.HEALTHY_SKIN)
EDGES_S = np.arange(9.5, 88.1, 0.5)
RUN = partial(simulate, SPEC, MOTION)


@contextmanager
def dask(workers: int) -> Iterator[Map]:
    """Over a cluster on this machine. Raises InputError without Dask."""
    distributed = cluster.extra("distributed")
    with (
        distributed.LocalCluster(
            n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=None, host="127.0.0.1"
        ) as here,
        cluster.on_scheduler(here.scheduler_address) as over,
    ):
        yield over


def alone(wave: Wave) -> None:
    """Every run here."""
    for point in wave.theta:
        RUN(dict(zip(wave.space.names, map(float, point), strict=True)))


def designed(wave: Wave, run_all: Map) -> None:
    """Every run by the runner, into a new file."""
    with tempfile.TemporaryDirectory() as folder:
        design = run_design(Path(folder) / "design.h5", wave, EDGES_S, RUN, SPEC.hash, run_all)
    if not design.ok.all():
        raise SystemExit(f"a run failed: {next(text for text in design.messages if text)}")


def timed(wave: Wave, way: str, workers: int, repeats: int) -> list[float]:
    """Seconds of each repeat, one before them not counted."""
    maps = {"local": lambda: nullcontext(local(workers)), "Dask": lambda: dask(workers)}
    found = []
    with maps[way]() if way in maps else nullcontext(None) as run_all:
        for repeat in range(repeats + 1):
            started = time.perf_counter()
            alone(wave) if run_all is None else designed(wave, run_all)
            found.append(time.perf_counter() - started)
            rows.say(f"{way} {workers}, repeat {repeat}: {found[-1]:.2f} s")
    return found[1:]


def main(arguments: Sequence[str] | None = None) -> int:
    """Times all ways and prints the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=32)
    parser.add_argument("--repeats", type=int, default=3)
    asked = parser.parse_args(arguments)
    wave = first_wave(default_space(), asked.runs, 0, SEED)
    lines, serial = [], 0.0
    for way, workers in (("alone", 1), ("local", 1), ("local", 2), ("Dask", 1), ("Dask", 2)):
        try:
            seconds = float(np.median(timed(wave, way, workers, asked.repeats)))
        except InputError as error:
            rows.say(str(error))
            continue
        serial = serial or seconds
        beyond = (workers * seconds - serial) / asked.runs
        share = serial / (workers * seconds)
        lines.append(
            [way, str(workers), f"{seconds:.2f}", f"{1e3 * beyond:+.0f}", f"{100 * share:.0f}",
             f"{serial / seconds:.2f}"]
        )  # fmt: skip
    header = ["way", "workers", "seconds", "worker ms beyond serial, a run", "efficiency [%]", "speed-up"]
    print(f"{asked.runs} runs, median of {asked.repeats}\n\n{rows.markdown(header, lines)}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
