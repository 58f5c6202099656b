"""Applies one function to many items in local processes. A process that dies does not stop the others."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any

from bayeskin.access_guard import apply_inherited_guards
from bayeskin.errors import InputError

ATTEMPTS = 3  # an item that has ended this many workers is given up
ONE_THREAD = {
    name: "1"
    for name in (
        "OMP_NUM_THREADS",
        "MKL_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "BLIS_NUM_THREADS",
        "VECLIB_MAXIMUM_THREADS",
        "NUMBA_NUM_THREADS",
    )
}


Results = Generator[tuple[int, Any], None, None]
Map = Callable[[Callable[[Any], Any], Sequence[Any]], Results]


def local(workers: int) -> Map:
    """Returns a map that runs `run_parallel` with this number of processes on this machine."""
    return lambda function, items: run_parallel(function, items, workers)


def here(function: Callable[[Any], Any], items: Sequence[Any]) -> Results:
    """Yields the same as `run_parallel`, from this process itself; a worker process may start no others."""
    for index, item in enumerate(items):
        yield index, function(item)


@dataclass(frozen=True)
class Lost:
    """Takes the place of the result of an item whose worker process died `ATTEMPTS` times."""

    reason: str


@dataclass
class _Worker:
    process: Any
    pipe: Connection
    ready: bool = False
    item: int | None = None


@contextmanager
def standing(function: Callable[[Any], Any], workers: int) -> Iterator[Callable[[Sequence[Any]], Results]]:
    """Yields a function that does the same as `run_parallel`, but whose workers stay for later calls.

    Data that `function` keeps in its process are available for later items too.
    """
    crew: list[_Worker] = []
    try:
        yield lambda items: _run(function, items, workers, crew)
    finally:
        for worker in crew:
            _stop(worker)


def run_parallel(function: Callable[[Any], Any], items: Sequence[Any], workers: int) -> Results:
    """Yields ``(index, function(items[index]))`` in the order in which results arrive.

    A dead worker is replaced and its item is run again, `ATTEMPTS` times in total. The result of an item that
    always kills its worker is `Lost`. A fresh interpreter must be able to import `function` (it is pickled),
    and `function` must not raise exceptions. It runs with one thread for linear algebra. The workers end when
    the iterator is closed or when this process dies.
    Raises InputError when workers die before they are ready.
    """
    with standing(function, workers) as run_all:
        yield from run_all(items)


def _run(function: Callable[[Any], Any], items: Sequence[Any], workers: int, crew: list[_Worker]) -> Results:
    todo, attempts, false_starts = deque(range(len(items))), Counter[int](), 0
    _give_items(crew, items, todo, attempts)
    try:
        while todo or any(worker.item is not None for worker in crew):
            busy = sum(worker.item is not None for worker in crew)
            while len(crew) < min(workers, busy + len(todo)):
                crew.append(_start(function))
            for pipe in wait([worker.pipe for worker in crew]):
                worker = next(w for w in crew if w.pipe is pipe)
                index, result = worker.item, None
                try:
                    result = worker.pipe.recv()
                    false_starts, worker.ready, worker.item = 0, True, None
                except (EOFError, OSError):
                    crew.remove(worker)
                    reason = _ending_of(worker)
                    if not worker.ready:
                        false_starts += 1
                        _check_start(false_starts, reason)
                    elif index is not None and attempts[index] < ATTEMPTS:
                        todo.appendleft(index)
                        index = None
                    else:
                        result = Lost(f"the worker process ended {ATTEMPTS} times; last: {reason}")
                _give_items(crew, items, todo, attempts)
                if index is not None:
                    yield index, result
    finally:
        for worker in [worker for worker in crew if worker.item is not None]:  # nobody waits for its result
            crew.remove(worker)
            _stop(worker)


def _give_items(crew: list[_Worker], items: Sequence[Any], todo: deque[int], attempts: Counter[int]) -> None:
    """Gives an item to each idle worker, as long as items are left."""
    for worker in crew:
        if todo and worker.ready and worker.item is None:
            worker.item = todo.popleft()
            attempts[worker.item] += 1
            with suppress(OSError):  # the worker has just died; the loop notices the closed pipe
                worker.pipe.send(items[worker.item])


def _check_start(false_starts: int, reason: str) -> None:
    if false_starts >= ATTEMPTS:
        raise InputError(
            "worker processes",
            f"{false_starts} in a row ended before they started ({reason})",
            "a fresh interpreter must be able to import the model, and a script needs the guard "
            "`if __name__ == '__main__':`",
        )


def _start(function: Callable[[Any], Any]) -> _Worker:
    """Starts a worker by spawn, since a fork would copy locks of threads and the state of libraries."""
    context = multiprocessing.get_context("spawn")
    parent_end, child_end = context.Pipe()
    process = context.Process(target=_work, args=(child_end, function), daemon=True)
    with _environment(ONE_THREAD):  # the libraries read these values when the child loads them
        process.start()
    child_end.close()  # otherwise the pipe would stay open after the child ends
    return _Worker(process, parent_end)


def _stop(worker: _Worker) -> None:
    worker.process.terminate()
    worker.process.join(timeout=5.0)
    if worker.process.exitcode is None:
        worker.process.kill()
        worker.process.join()
    worker.pipe.close()


def _ending_of(worker: _Worker) -> str:
    """Removes a worker whose pipe has closed and returns a message that says how it ended."""
    worker.process.join(timeout=5.0)  # else our own signal would hide the cause
    _stop(worker)
    exitcode = worker.process.exitcode
    if exitcode == -signal.SIGKILL:
        return "killed by signal 9, as the system does when memory runs out"
    return f"killed by signal {-exitcode}" if exitcode < 0 else f"exit code {exitcode}"


@contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _work(pipe: Connection, function: Callable[[Any], Any]) -> None:
    """Runs in the worker: reports that it is ready, then processes items until the parent closes the pipe."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes, but the parent decides
    threading.Thread(target=_end_with_parent, daemon=True).start()
    apply_inherited_guards()
    pipe.send(None)
    with suppress(EOFError, OSError):  # the parent has ended
        while True:
            pipe.send(function(pipe.recv()))


def _end_with_parent() -> None:
    """Ends this worker when its parent ends.

    A parent that is killed cannot end its workers. They must not run on beside the workers of a new start.
    """
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
