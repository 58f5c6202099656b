"""Designs over a real Dask cluster on this machine, whose workers are killed in mid-run."""

from __future__ import annotations

import os
import signal
import threading
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from toys import unreliable_models
from toys.design_runs import SHORT, assert_same_rows, run

from bayeskin.errors import InputError
from bayeskin.execution.cluster import on_scheduler, on_slurm
from bayeskin.execution.local import Lost
from bayeskin.types import Design

distributed = pytest.importorskip("distributed")
dask = pytest.importorskip("dask")


@pytest.fixture(scope="module")
def cluster():
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, host="127.0.0.1"
    ) as cluster:
        yield cluster


@pytest.fixture(scope="module")
def expected(tmp_path_factory) -> Design:
    return run(tmp_path_factory.mktemp("here") / "a.store", SHORT)


def test_the_design_is_the_same_whoever_made_the_runs(cluster, tmp_path: Path, expected: Design) -> None:
    with on_scheduler(cluster.scheduler_address) as over:
        design = run(tmp_path / "a.store", SHORT, run_all=over)
    assert_same_rows(design, expected)
    again = run(tmp_path / "a.store", SHORT, unreliable_models.failing)
    assert_same_rows(again, expected)


def test_a_worker_killed_in_mid_run_costs_its_own_point_which_is_run_again(
    cluster, tmp_path: Path, expected: Design
) -> None:
    """One of the workers is killed from outside while all are busy."""
    killed = []

    def kill() -> None:
        time.sleep(1.0)
        killed.append(next(iter(cluster.workers.values())).pid)
        os.kill(killed[0], signal.SIGKILL)

    simulate = partial(unreliable_models.slow, seconds=1.0)
    thread = threading.Thread(target=kill)
    thread.start()
    with on_scheduler(cluster.scheduler_address) as over:
        design = run(tmp_path / "a.store", SHORT, simulate, over)
    thread.join()
    assert killed
    assert_same_rows(design, expected)


@pytest.mark.slow
def test_a_point_that_kills_every_worker_is_a_failed_row(cluster, tmp_path: Path) -> None:
    simulate = partial(unreliable_models.deadly, folder=str(tmp_path), deaths=99)
    with on_scheduler(cluster.scheduler_address) as over:
        design = run(tmp_path / "out" / "a.store", SHORT, simulate, over)
    stiff = SHORT.theta[:, 0] > 3e5
    np.testing.assert_array_equal(design.ok, ~stiff)
    assert all("ended" in design.messages[row] for row in np.flatnonzero(stiff))


def test_what_stands_in_the_queue_of_a_worker_that_dies_is_not_lost_with_it() -> None:
    """One worker that is handed all items at once: the scheduler gives the innocent up with the deadly."""
    hasty = {"worker-saturation": float("inf"), "allowed-failures": 0}
    with (
        dask.config.set({f"distributed.scheduler.{name}": value for name, value in hasty.items()}),
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, dashboard_address=None, host="127.0.0.1"
        ) as cluster,
        on_scheduler(cluster.scheduler_address) as over,
    ):
        results = dict(over(unreliable_models.deadly_first, range(3)))
    assert isinstance(results[0], Lost)
    assert (results[1], results[2]) == (1, 2)


def test_a_run_that_comes_back_twice_is_one_row(tmp_path: Path, expected: Design) -> None:
    def twice(function, items):
        for index, item in enumerate(items):
            yield index, function(item)
            yield index, function(item)

    design = run(tmp_path / "a.store", SHORT, run_all=twice)
    assert_same_rows(design, expected)
    assert_same_rows(run(tmp_path / "a.store", SHORT, unreliable_models.failing), expected)


def test_an_address_where_nobody_answers_is_told_in_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bayeskin.execution.cluster.CONNECT_S", 1)
    with pytest.raises(InputError, match="9: it does not answer"), on_scheduler("tcp://127.0.0.1:9"):
        pass
    with pytest.raises(InputError, match="the address of a Dask scheduler"), on_scheduler("nowhere://x"):
        pass
    with pytest.raises(InputError, match="foo: it has no host and port"), on_scheduler("foo"):
        pass


def test_slurm_is_asked_for_single_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """The job script that would be submitted; there is no SLURM here to run it."""
    queue = pytest.importorskip("dask_jobqueue")
    scripts, submitted = [], []

    class Recorded(queue.SLURMCluster):
        def scale(self, jobs):
            scripts.append(self.job_script())
            submitted.append(jobs)

    monkeypatch.setattr(queue, "SLURMCluster", Recorded)
    with on_slurm(3, {"queue": "long", "memory": "2GB", "walltime": "01:00:00"}):
        pass
    assert submitted[0] == 3
    assert "#SBATCH -p long" in scripts[0]
    assert "--nthreads 1" in scripts[0]
    with pytest.raises(InputError, match="slurm"), on_slurm(1, {"memory": "2GB", "colour": "blue"}):
        pass
