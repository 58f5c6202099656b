"""Runs the map of `bayeskin.execution.local` on other machines: on a Dask cluster, or in SLURM jobs.

It needs the extra `bayeskin[cluster]`. When a worker dies, its item is run again on another worker. The
scheduler also counts the failure against all other items in that worker's queue, although they are not the
cause. It gives up an item after as many failures as it allows (`allowed-failures`). Items that it has given
up are run once more, one by one after all others, so that only the item that is the cause is lost. Workers
should have one thread each (``dask worker --nthreads 1``), since the full model uses one core.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from bayeskin.errors import InputError
from bayeskin.execution.local import Lost, Map

CONNECT_S = 10
HIDDEN = {"dashboard": False}  # jobs must reach the scheduler, but nobody needs the pages of its dashboard


@contextmanager
def on_scheduler(address: str) -> Iterator[Map]:
    """Yields a map over the workers of the Dask scheduler at an address, such as tcp://10.0.0.1:8786.

    Raises InputError where no scheduler answers.
    """
    distributed = extra("distributed")
    if not re.fullmatch(r"(\w+://)?[^\s/]+:\d+", address):  # Dask's client would wait and then fail
        raise InputError(
            f"scheduler {address}",
            "it has no host and port",
            "give the address of a Dask scheduler, such as tcp://10.0.0.1:8786",
        )
    try:
        client = distributed.Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        problem = f"it does not answer ({type(error).__name__})"
        raise InputError(
            f"scheduler {address}", problem, "give the address of a Dask scheduler that runs"
        ) from None
    with client:
        yield _map_over(client)


@contextmanager
def on_slurm(jobs: int, settings: Mapping[str, Any]) -> Iterator[Map]:
    """Yields a map over `jobs` SLURM jobs, each of which is a worker with one thread.

    settings : arguments of dask_jobqueue.SLURMCluster
    Raises InputError for settings that SLURMCluster does not accept.
    """
    distributed, queue = extra("distributed"), extra("dask_jobqueue")
    try:
        cluster = queue.SLURMCluster(cores=1, processes=1, scheduler_options=HIDDEN, **settings)
    except (TypeError, ValueError) as error:
        raise InputError(
            "slurm",
            f"dask_jobqueue.SLURMCluster refuses these settings ({error})",
            "its documentation lists the settings",
        ) from None
    with cluster, distributed.Client(cluster, set_as_default=False) as client:
        cluster.scale(jobs=jobs)
        yield _map_over(client)


def _map_over(client: Any) -> Map:
    distributed = extra("distributed")

    def over(function: Callable[[Any], Any], items: Sequence[Any]) -> Generator[tuple[int, Any], None, None]:
        futures = {client.submit(function, item, pure=False): index for index, item in enumerate(items)}
        given_up: list[int] = []
        try:
            for future in distributed.as_completed(list(futures), loop=client.loop):
                result = _result(future, distributed)
                if isinstance(result, Lost):
                    given_up.append(futures[future])
                else:
                    yield futures[future], result
        finally:
            client.cancel(list(futures))
        for index in given_up:
            alone = client.submit(function, items[index], pure=False)
            try:
                yield index, _result(alone, distributed)
            finally:
                client.cancel([alone])

    return over


def _result(future: Any, distributed: Any) -> Any:
    try:
        return future.result()
    except distributed.KilledWorker as killed:
        return Lost(f"the worker process ended in each attempt; last: {killed.last_worker}")


def extra(name: str) -> Any:
    """Returns an optional package. Raises InputError where it is not installed."""
    import importlib

    try:
        return importlib.import_module(name)
    except ImportError:
        raise InputError(
            "cluster", f"the package {name} is not installed", "install it with `pip install '.[cluster]'`"
        ) from None
