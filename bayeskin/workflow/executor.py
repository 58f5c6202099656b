"""Chooses the executor of a configuration's full runs: local processes, a Dask cluster, or SLURM jobs."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

from bayeskin.execution.cluster import on_scheduler, on_slurm
from bayeskin.execution.local import Map, here, local
from bayeskin.workflow.engine import Run

WORKERS = 2  # worker processes of a command that has no such setting


def with_scheduler(run: Run, scheduler: str) -> Run:
    """Returns the same run, except that a Dask scheduler at the given address makes the full runs."""
    design = run.config.design.model_copy(update={"scheduler": scheduler})
    return replace(run, config=run.config.model_copy(update={"design": design}))


@contextmanager
def executor(run: Run) -> Iterator[Map]:
    """Yields the executor that the configuration asks for: a function that applies a function to many items.

    In a worker process of another executor, which may start no processes, it is this process itself. Raises
    InputError where a cluster is not available.
    """
    design, slurm = run.config.design, run.config.slurm
    if multiprocessing.current_process().daemon:
        yield here
    elif design.scheduler is not None:
        with on_scheduler(design.scheduler) as run_all:
            yield run_all
    elif slurm is not None:
        settings = slurm.model_dump(exclude={"jobs"}, exclude_none=True)
        with on_slurm(slurm.jobs, settings) as run_all:
            yield run_all
    else:
        yield local(design.workers)
