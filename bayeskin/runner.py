"""Runs a design through the full model, on this machine or a cluster, into one HDF5 file.

While a wave runs, each finished run goes into a journal beside the file (`bayeskin.journal`). When all runs
are there, a new file with all rows is written and replaces the old one, and the journal is removed. The file
is thus complete at every moment, and a process that is killed at any moment loses only the runs in progress.
The rows have the order of the points, in whatever order the runs finished.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from bayeskin.design import Wave
from bayeskin.design_files import (
    check_same,
    extended,
    identity_of,
    load_design,
    load_waves,
    remove_stale,
    rows_ok,
    save_design,
)
from bayeskin.errors import InputError, Unavailable
from bayeskin.execution.local import Lost, Map, local
from bayeskin.journal import Journal, Run
from bayeskin.types import Array, Design, Simulation

Simulate = Callable[[Mapping[str, float]], Simulation]
Progress = Callable[[int, int, int], None]


class _Outcome(NamedTuple):
    """The result that a worker sends back; `force_n` is None where the run failed.

    unavailable : `where`, `found` and `expected` of an `Unavailable` error, where something that the run
        needs was not available
    """

    force_n: Array | None
    message: str
    seconds: float
    model_hash: str
    unavailable: tuple[str, str, str] | None = None


def run_design(
    path: Path | str,
    wave: Wave,
    edges_s: ArrayLike,
    simulate: Simulate,
    model_hash: str,
    run_all: Map | None = None,
    progress: Progress | None = None,
) -> Design:
    """Runs the points of `wave` that are in no file yet, and returns the design with all its waves.

    edges_s : the edges (m+1,) of the bins whose mean force is stored
    simulate : maps ``{name: value}`` to a Simulation; it must be picklable, and its results carry
        `model_hash`
    run_all : maps a function over the points (`execution.local.local`, by default with two processes, or a
        cluster); the file is the same for each of them
    progress : called as progress(done, total, failed) with the counts of this wave's points

    A point is identified by its bytes, so a repeated point is not run again. A run that fails, raises an
    error, or kills its worker `ATTEMPTS` times becomes a row with ``ok`` False and a message. A call after an
    interruption of any kind continues the wave. Ctrl-C ends the workers, keeps the finished runs and raises
    KeyboardInterrupt.

    Raises InputError, with nothing written, when the file holds another parameter space, model or bins, when
    a point lies outside the box, when another process runs the same file, or when `simulate` belongs to
    another model. Raises Unavailable when something that the runs need is not available, such as a server.
    This says nothing about the points, so none of these runs is stored.
    """
    path, edges = Path(path), np.asarray(edges_s, dtype=float)
    points = _distinct(wave)
    identity, bins = identity_of(wave.space, edges, model_hash), len(edges) - 1
    with Journal(path.with_name(f"{path.name}.journal"), identity, bins) as journal:
        remove_stale(path)
        before = load_design(path) if path.exists() else None
        if before is not None:
            check_same(path, before, wave.space, edges, model_hash)
        known = rows_ok(before) | {key: run.ok for key, run in journal.runs.items()}
        todo = [row for key, row in points.items() if key not in known]
        report = _progress_reporter(progress, len(points), [known[key] for key in points if key in known])
        report(None)
        task = partial(_bin_means_of, simulate, wave.space.names, edges)
        with closing((run_all or local(2))(task, todo)) as results:
            for index, outcome in results:
                if todo[index].tobytes() in journal.runs:  # a cluster may have run the point twice
                    continue
                run = _as_run(path, todo[index], outcome, bins, model_hash)
                journal.append(run)
                report(run)
        stored = set(rows_ok(before))
        fresh = [journal.runs[key] for key in points if key not in stored]
        design = extended(before, wave, edges, model_hash, fresh)
        if fresh:
            save_design(path, design, [*(load_waves(path) if before else ()), dict(wave.record)])
        journal.forget(stored | set(points))
    return design


def add_points(
    path: Path | str,
    theta: ArrayLike,
    simulate: Simulate,
    reason: str,
    run_all: Map | None = None,
    progress: Progress | None = None,
) -> Design:
    """Adds training points (n, d) that no rule has drawn, such as a MAP estimate, as the next wave.

    `reason` goes into the wave's record. The call resumes after an interruption as `run_design` does. Raises
    InputError as `run_design` and `load_design` do.
    """
    design = load_design(path)
    theta = np.atleast_2d(np.asarray(theta, dtype=float))
    number = int(design.wave.max()) + 1
    record = {"wave": number, "seed": design.seed, "training": len(theta), "held_out": 0, "rule": reason}
    wave = Wave(design.space, theta, np.zeros(len(theta), bool), number, design.seed, record)
    return run_design(path, wave, design.edges_s, simulate, design.model_hash, run_all, progress)


def _bin_means_of(simulate: Simulate, names: tuple[str, ...], edges: Array, theta: Array) -> _Outcome:
    """Returns the bin means [N] (m,) of one run, or the reason why it has none.

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
        unavailable = (error.where, error.found, error.expected)
    except Exception as error:
        message = f"{type(error).__name__}: {error}"
    return _Outcome(force_n, message, time.perf_counter() - start, model_hash, unavailable)


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


def _as_run(path: Path, theta: Array, outcome: _Outcome | Lost, bins: int, model_hash: str) -> Run:
    """Returns the outcome of a worker as a run. Raises Unavailable, and InputError for another model."""
    if isinstance(outcome, Lost):
        return Run(theta, np.full(bins, np.nan), False, outcome.reason, math.nan)
    if outcome.unavailable is not None:
        raise Unavailable(*outcome.unavailable)
    if outcome.model_hash not in ("", model_hash):
        raise InputError(path, f"a run of model {outcome.model_hash}", f"runs of model {model_hash}")
    ok = outcome.force_n is not None
    force_n = outcome.force_n if outcome.force_n is not None else np.full(bins, np.nan)
    return Run(theta, force_n, ok, outcome.message, outcome.seconds)


def _progress_reporter(
    progress: Progress | None, total: int, known: list[bool]
) -> Callable[[Run | None], None]:
    """Returns a function that turns finished runs into calls of `progress`.

    `known` says for each earlier run whether it is ok.
    """
    states = list(known)

    def report(run: Run | None) -> None:
        """Counts a finished run (None: no new run) and reports the progress."""
        if run is not None:
            states.append(run.ok)
        if progress is not None:
            progress(len(states), total, states.count(False))

    return report


def _distinct(wave: Wave) -> dict[bytes, Array]:
    """Returns the wave's points by their bytes, in order, each point once.

    Raises InputError for arrays of the wrong shape and for a point outside the prior box.
    """
    theta = wave.theta
    if theta.ndim != 2 or theta.shape[1] != wave.space.dim or len(theta) != len(wave.held_out):
        raise InputError("points of a design", f"shape {theta.shape}", f"shape (n, {wave.space.dim})")
    outside = np.flatnonzero(~wave.space.contains(theta))
    if len(outside):
        row = outside[0]
        raise InputError(
            f"points of a design: row {row}", theta[row].tolist(), "a point inside the prior box"
        )
    return {row.tobytes(): row for row in theta}
