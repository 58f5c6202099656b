"""Runs a design through a model, on this machine or a cluster, and keeps the finished runs in a store.

Each finished run is on disk before the next one is kept (`bayeskin.store`), so a process that is killed at
any moment loses only the runs in progress. The rows have the order of the points, in whatever order the runs
finished.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from bayeskin.design import Wave
from bayeskin.errors import InputError, Unavailable
from bayeskin.execution.local import Lost, Map, local
from bayeskin.hashing import sha256_of
from bayeskin.store import Store
from bayeskin.types import Array, Design, Simulation

Simulate = Callable[[Mapping[str, float]], Simulation]
Progress = Callable[[int, int, int], None]


@dataclass(frozen=True)
class FinishedRun:
    """The result of one run of a design.

    force_n : the bin means [N] (m,), or NaN where the run failed
    ok : whether the run succeeded
    message : why it failed, or a remark
    seconds : its duration
    """

    force_n: Array
    ok: bool
    message: str
    seconds: float


class _Outcome(NamedTuple):
    """The result that a worker sends back.

    model_hash : hash of the model that made the run, or an empty text where none was made
    unavailable : `where`, `found` and `expected` of an `Unavailable` error, where something that the run
        needs was not available
    """

    run: FinishedRun
    model_hash: str
    unavailable: tuple[str, str, str] | None = None


def run_design(
    store: Store,
    wave: Wave,
    edges_s: ArrayLike,
    simulate: Simulate,
    model_hash: str,
    run_all: Map | None = None,
    progress: Progress | None = None,
) -> Design:
    """Runs the points of `wave` that are not in the store yet, and returns all of them as a design.

    store : an open store, for runs of one motion only
    edges_s : the edges (m+1,) of the bins whose mean force is kept
    simulate : maps ``{name: value}`` to a Simulation; it must be picklable, and its results carry
        `model_hash`
    run_all : maps a function over the points (`execution.local.local`, by default with two processes, or a
        cluster); the design is the same for each of them
    progress : called as progress(done, total, failed) with the counts of this wave's points

    A run is found again by its parameters, bins and model, so a repeated point is not run again. A run that
    fails, raises an error, or kills its worker `ATTEMPTS` times becomes a row with ``ok`` False and a
    message. A call after an interruption of any kind continues the wave. Ctrl-C ends the workers, keeps the
    finished runs and raises KeyboardInterrupt.

    Raises InputError when a point lies outside the box, and when `simulate` belongs to another model. Raises
    Unavailable when something that the runs need is not available, such as a server. This says nothing about
    the points, so none of these runs is kept.
    """
    edges, points = np.asarray(edges_s, dtype=float), _distinct(wave)
    common = sha256_of([wave.space.names, edges, model_hash])
    done = {
        key: store.read([common, point], FinishedRun)
        for key, point in points.items()
        if [common, point] in store
    }

    def report() -> None:
        """Reports the progress."""
        if progress is not None:
            progress(len(done), len(points), sum(not run.ok for run in done.values()))

    report()
    todo = [point for key, point in points.items() if key not in done]
    task = partial(_bin_means_of, simulate, wave.space.names, edges)
    with closing((run_all or local(2))(task, todo)) as outcomes:
        for index, outcome in outcomes:
            point = todo[index]
            if point.tobytes() in done:  # a cluster may have run the point twice
                continue
            done[point.tobytes()] = _checked_run(store, outcome, len(edges) - 1, model_hash)
            store.add([common, point], done[point.tobytes()])
            report()
    return _design(wave, edges, model_hash, [done[point.tobytes()] for point in wave.theta])


def _bin_means_of(simulate: Simulate, names: tuple[str, ...], edges: Array, theta: Array) -> _Outcome:
    """Returns the outcome of one run, with the bin means [N] (m,) or the reason why it has none.

    This function runs in a worker. It raises no error.
    """
    start = time.perf_counter()
    force_n, message, model_hash, unavailable = None, "", "", None
    try:
        run = simulate(dict(zip(names, theta.tolist(), strict=True)))
        model_hash, message = run.model_hash, run.message
        if run.status == "ok":
            force_n, message = _checked_means(run, edges)
        elif not message:
            message = "the run failed without a message"
    except Unavailable as error:
        unavailable = (error.where, error.problem, error.remedy)
    except Exception as error:
        message = f"{type(error).__name__}: {error}"
    seconds = time.perf_counter() - start
    if force_n is None:
        return _Outcome(_failed(len(edges) - 1, message, seconds), model_hash, unavailable)
    return _Outcome(FinishedRun(force_n, True, message, seconds), model_hash)


def _failed(bins: int, message: str, seconds: float) -> FinishedRun:
    """Returns a run that failed."""
    return FinishedRun(np.full(bins, np.nan), False, message, seconds)


def _checked_means(run: Simulation, edges: Array) -> tuple[Array | None, str]:
    """Returns the bin means [N] (m,) and a message; no means where the run is too short or not finite."""
    slack = 1e-9 * (edges[-1] - edges[0])
    if run.time_s[0] > edges[0] + slack or run.time_s[-1] < edges[-1] - slack:
        covered = f"{run.time_s[0]:g}..{run.time_s[-1]:g} s"
        return (
            None,
            f"the run covers {covered}, the bins {edges[0]:g}..{edges[-1]:g} s: use the motion of the bins",
        )
    if not np.isfinite(run.force_n).all():
        return None, "the force is not finite: tighten the tolerances or narrow the prior box"
    return run.bin_means(edges), run.message


def _checked_run(store: Store, outcome: _Outcome | Lost, bins: int, model_hash: str) -> FinishedRun:
    """Returns the run of a worker's outcome. Raises Unavailable, and InputError for another model."""
    if isinstance(outcome, Lost):
        return _failed(bins, outcome.reason, math.nan)
    if outcome.unavailable is not None:
        raise Unavailable(*outcome.unavailable)
    if outcome.model_hash not in ("", model_hash):
        raise InputError(
            store.path,
            f"a run comes from the model {outcome.model_hash}",
            f"all its runs must come from the model {model_hash}",
        )
    return outcome.run


def _distinct(wave: Wave) -> dict[bytes, Array]:
    """Returns the wave's points by their bytes, in order, each point once.

    Raises InputError for arrays of the wrong shape and for a point outside the prior box.
    """
    theta = wave.theta
    if theta.ndim != 2 or theta.shape[1] != wave.space.dim or len(theta) != len(wave.held_out):
        raise InputError(
            "points of a design", f"the shape is {theta.shape}", f"it must be (n, {wave.space.dim})"
        )
    outside = np.flatnonzero(~wave.space.contains(theta))
    if len(outside):
        row = outside[0]
        raise InputError(
            f"points of a design: row {row}",
            f"the point is {theta[row].tolist()}",
            "it must lie inside the box of the priors",
        )
    return {row.tobytes(): row for row in theta}


def _design(wave: Wave, edges: Array, model_hash: str, runs: list[FinishedRun]) -> Design:
    """Returns the points of a wave with their runs."""
    return Design(
        space=wave.space,
        edges_s=edges,
        theta=wave.theta,
        force_n=np.array([run.force_n for run in runs]).reshape(-1, len(edges) - 1),
        wave=np.full(len(runs), wave.number, dtype=np.int64),
        held_out=wave.held_out,
        ok=np.array([run.ok for run in runs], dtype=bool),
        messages=tuple(run.message for run in runs),
        seconds=np.array([run.seconds for run in runs], dtype=float),
        seed=wave.seed,
        model_hash=model_hash,
    )
