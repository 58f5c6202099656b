"""Who makes a configuration's full runs: processes of this machine, a Dask cluster, or SLURM's jobs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

from bayeskin.execution.cluster import on_scheduler, on_slurm
from bayeskin.execution.local import Map, local
from bayeskin.workflow.engine import Run


def made_by(run: Run, scheduler: str) -> Run:
    """The run with a Dask scheduler at an address to make its full runs."""
    design = run.config.design.model_copy(update={"scheduler": scheduler})
    return replace(run, config=run.config.model_copy(update={"design": design}))


@contextmanager
def crew(run: Run) -> Iterator[Map]:
    """The map that the configuration asks for. Raises InputError where a cluster cannot be had."""
    design, slurm = run.config.design, run.config.slurm
    if design.scheduler is not None:
        with on_scheduler(design.scheduler) as over:
            yield over
    elif slurm is not None:
        settings = slurm.model_dump(exclude={"jobs"}, exclude_none=True)
        with on_slurm(slurm.jobs, settings) as over:
            yield over
    else:
        yield local(design.workers)
