"""Measures the overhead of running a design by local processes and by Dask, with one and two workers.

The same full runs are timed by the clock in several ways (default bricks, first cycle of the healthy-skin
protocol, first points of a design of the default box):

    alone            one run after the other in this process, without the runner
    local 1, 2       `bayeskin.runner` with processes of its own, started again for each design
    Dask 1, 2        the runner with a LocalCluster of this machine, one thread a worker (extra `cluster`)

Every way runs the points once before it is timed, so that no compilation is timed. The program prints medians
over the repeats, the additional time of a run over a serial one, and the efficiency, which is the serial time
over the product of workers and time. Nothing is stored. The machine needs as many idle cores as there are
workers.

    OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 python benchmarks/scaling.py
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
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
from bayeskin.store import Store

SEED = 5
SPEC = ModelSpec()
MOTION = healthy_skin.first_cycle(healthy_skin.HEALTHY_SKIN)
EDGES_S = np.arange(9.5, 88.1, 0.5)
RUN = partial(simulate, SPEC, MOTION)


@contextmanager
def dask(workers: int) -> Iterator[Map]:
    """Yields a map over a Dask cluster on this machine; raises InputError where Dask is not installed."""
    distributed = cluster.extra("distributed")
    with (
        distributed.LocalCluster(
            n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=None, host="127.0.0.1"
        ) as local_cluster,
        cluster.on_scheduler(local_cluster.scheduler_address) as run_all,
    ):
        yield run_all


def alone(wave: Wave) -> None:
    """Makes every run in this process."""
    for point in wave.theta:
        RUN(dict(zip(wave.space.names, map(float, point), strict=True)))


def designed(wave: Wave, run_all: Map) -> None:
    """Makes every run by the runner, into a new file."""
    with tempfile.TemporaryDirectory() as folder, Store(Path(folder) / "runs.store", SPEC.hash) as store:
        design = run_design(store, wave, EDGES_S, RUN, SPEC.hash, run_all)
    if not design.ok.all():
        raise SystemExit(f"a run failed: {next(text for text in design.messages if text)}")


def timed(wave: Wave, way: str, workers: int, repeats: int) -> list[float]:
    """Returns the seconds of each repeat; one more repeat before them is not counted."""
    maps: dict[str, Callable[[], AbstractContextManager[Map | None]]] = {
        "alone": nullcontext, "local": lambda: nullcontext(local(workers)), "Dask": lambda: dask(workers)
    }  # fmt: skip
    seconds = []
    with maps[way]() as run_all:
        for repeat in range(repeats + 1):
            started = time.perf_counter()
            alone(wave) if run_all is None else designed(wave, run_all)
            seconds.append(time.perf_counter() - started)
            rows.say(f"{way} {workers}, repeat {repeat}: {seconds[-1]:.2f} s")
    return seconds[1:]


def main(arguments: Sequence[str] | None = None) -> int:
    """Times all ways and prints the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=32)
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args(arguments)
    wave = first_wave(default_space(), options.runs, 0, SEED)
    lines, serial = [], 0.0
    for way, workers in (("alone", 1), ("local", 1), ("local", 2), ("Dask", 1), ("Dask", 2)):
        try:
            seconds = float(np.median(timed(wave, way, workers, options.repeats)))
        except InputError as error:
            rows.say(str(error))
            continue
        serial = serial or seconds
        overhead_s = (workers * seconds - serial) / options.runs
        efficiency = serial / (workers * seconds)
        lines.append(
            [way, str(workers), f"{seconds:.2f}", f"{1e3 * overhead_s:+.0f}", f"{100 * efficiency:.0f}",
             f"{serial / seconds:.2f}"]
        )  # fmt: skip
    header = ["way", "workers", "seconds", "overhead of a run [worker ms]", "efficiency [%]", "speed-up"]
    print(f"{options.runs} runs, median of {options.repeats}\n\n{rows.markdown(header, lines)}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
