"""One function over many items in local processes, any of which may die without taking the rest along."""

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

from bayeskin.access_guard import keep_out
from bayeskin.errors import InputError

ATTEMPTS = 3  # an item that has cost so many workers is given up
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
    """`run_parallel` over so many processes of this machine."""
    return lambda function, items: run_parallel(function, items, workers)


@dataclass(frozen=True)
class Lost:
    """Stands for the result of an item whose worker process died `ATTEMPTS` times."""

    reason: str


@dataclass
class _Worker:
    process: Any
    pipe: Connection
    ready: bool = False
    item: int | None = None


@contextmanager
def standing(function: Callable[[Any], Any], workers: int) -> Iterator[Callable[[Sequence[Any]], Results]]:
    """Yields what `run_parallel` does for one function, with workers that stay from one call to the next.

    What the function keeps in its process, it keeps for later items.
    """
    crew: list[_Worker] = []
    try:
        yield lambda items: _run(function, items, workers, crew)
    finally:
        for worker in crew:
            _end(worker)


def run_parallel(function: Callable[[Any], Any], items: Sequence[Any], workers: int) -> Results:
    """Yields ``(index, function(items[index]))`` as results come; `Lost` for an item that kills its worker.

    `function` must be importable by a fresh interpreter (picklable) and raise nothing; it runs with
    one thread for linear algebra. A dead worker is replaced and its item run again, `ATTEMPTS` times
    in all. Closing the iterator ends the workers, as does the death of this process.
    Raises InputError when workers die before they are ready.
    """
    with standing(function, workers) as run_all:
        yield from run_all(items)


def _run(function: Callable[[Any], Any], items: Sequence[Any], workers: int, crew: list[_Worker]) -> Results:
    todo, attempts, false_starts = deque(range(len(items))), Counter[int](), 0
    _hand_out(crew, items, todo, attempts)
    try:
        while todo or any(worker.item is not None for worker in crew):
            busy = sum(worker.item is not None for worker in crew)
            while len(crew) < min(workers, busy + len(todo)):
                crew.append(_start(function))
            for pipe in wait([worker.pipe for worker in crew]):
                worker = next(w for w in crew if w.pipe is pipe)
                done, result = worker.item, None
                try:
                    result = worker.pipe.recv()
                    false_starts, worker.ready, worker.item = 0, True, None
                except (EOFError, OSError):
                    crew.remove(worker)
                    reason = _bury(worker)
                    if not worker.ready:
                        false_starts += 1
                        _check_start(false_starts, reason)
                    elif done is not None and attempts[done] < ATTEMPTS:
                        todo.appendleft(done)
                        done = None
                    else:
                        result = Lost(f"the worker process ended {ATTEMPTS} times; last: {reason}")
                _hand_out(crew, items, todo, attempts)
                if done is not None:
                    yield done, result
    finally:
        for worker in [worker for worker in crew if worker.item is not None]:  # what it does is not wanted
            crew.remove(worker)
            _end(worker)


def _hand_out(crew: list[_Worker], items: Sequence[Any], todo: deque[int], attempts: Counter[int]) -> None:
    """Gives each idle worker an item, as long as there are any."""
    for worker in crew:
        if todo and worker.ready and worker.item is None:
            worker.item = todo.popleft()
            attempts[worker.item] += 1
            with suppress(OSError):  # it has just died: the end of its pipe will say so
                worker.pipe.send(items[worker.item])


def _check_start(false_starts: int, reason: str) -> None:
    if false_starts >= ATTEMPTS:
        raise InputError(
            "worker processes",
            f"{false_starts} in a row that end before they start ({reason})",
            "a model that a fresh interpreter can import, and in a script the guard "
            "`if __name__ == '__main__':`",
        )


def _start(function: Callable[[Any], Any]) -> _Worker:
    """Starts a worker by spawn: a fork would copy the parent's threads' locks and its libraries' state."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(theirs, function), daemon=True)
    with _environment(ONE_THREAD):  # read by the libraries when the child loads them
        process.start()
    theirs.close()  # or the end of the child would not close the pipe
    return _Worker(process, ours)


def _end(worker: _Worker) -> None:
    worker.process.terminate()
    worker.process.join(timeout=5.0)
    if worker.process.exitcode is None:
        worker.process.kill()
        worker.process.join()
    worker.pipe.close()


def _bury(worker: _Worker) -> str:
    """Reaps a worker whose pipe has closed; returns how it ended, in words."""
    worker.process.join(timeout=5.0)  # first let it end by itself, or the cause would be our own signal
    _end(worker)
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
    """The life of a worker: ready, then one item after another until the parent closes the pipe."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all; the parent decides
    threading.Thread(target=_end_with_parent, daemon=True).start()
    keep_out()
    pipe.send(None)
    with suppress(EOFError, OSError):  # the parent is gone
        while True:
            pipe.send(function(pipe.recv()))


def _end_with_parent() -> None:
    """A parent killed outright cannot end its workers; they must not go on beside those of a new start."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
