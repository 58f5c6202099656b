"""Runs a design through the full model, on this machine or a cluster, into one HDF5 file.

While a wave runs, each finished run goes into a journal beside the file (`bayeskin.journal`). When all runs
are there, a new file with all rows is written and replaces the old one, and the journal is removed. The file
is thus complete at every moment, and a process that is killed at any moment loses only the runs in progress.
The rows have the order of the points, in whatever order the runs finished.
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Callable, Mapping
from contextlib import closing
from functools import partial
from glob import escape
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from bayeskin import storage
from bayeskin.design import Wave
from bayeskin.errors import InputError, Unavailable
from bayeskin.execution.local import Lost, Map, local
from bayeskin.journal import Journal, Run
from bayeskin.types import Array, Design, ParameterSpace, Simulation

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
    identity, bins = _identity(wave.space, edges, model_hash), len(edges) - 1
    with Journal(path.with_name(f"{path.name}.journal"), identity, bins) as journal:
        _remove_stale(path)
        before = load_design(path) if path.exists() else None
        if before is not None:
            _check_same(path, before, wave.space, edges, model_hash)
        known = _rows_ok(before) | {key: run.ok for key, run in journal.runs.items()}
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
        stored = set(_rows_ok(before))
        fresh = [journal.runs[key] for key in points if key not in stored]
        design = _extended(before, wave, edges, model_hash, fresh)
        if fresh:
            _write(path, design, [*(load_waves(path) if before else ()), dict(wave.record)])
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


def load_design(path: Path | str) -> Design:
    """Returns the finished waves of a design file.

    Raises InputError where there is no such file, or where its arrays do not fit each other.
    """
    design = storage.load(path, Design)
    rows, bins = len(np.atleast_1d(design.ok)), design.edges_s.size - 1
    shapes = {
        "edges_s": (bins + 1,), "theta": (rows, design.space.dim), "force_n": (rows, bins), "wave": (rows,),
        "held_out": (rows,), "ok": (rows,), "seconds": (rows,),
    }  # fmt: skip
    for name, shape in shapes.items():
        if getattr(design, name).shape != shape:
            raise InputError(f"{path}: {name}", f"shape {getattr(design, name).shape}", f"shape {shape}")
    if len(design.messages) != rows:
        raise InputError(f"{path}: messages", f"{len(design.messages)} messages", f"{rows}, one for each row")
    if not (np.isfinite(design.theta).all() and np.isfinite(design.force_n[design.ok]).all()):
        raise InputError(path, "values that are not finite", "finite values, except in runs that failed")
    return design


def load_waves(path: Path | str) -> tuple[dict[str, Any], ...]:
    """Returns how the points of each wave were chosen, oldest wave first.

    Raises InputError as `load_design`.
    """
    load_design(path)
    with storage.reading(Path(path), "a bayeskin Design file") as handle:
        return tuple(map(dict, json.loads(handle.attrs.get("waves", "[]"))))


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


def _rows_ok(design: Design | None) -> dict[bytes, bool]:
    """Returns whether the run of each stored point is ok, by the bytes of theta."""
    if design is None:
        return {}
    return {row.tobytes(): bool(ok) for row, ok in zip(design.theta, design.ok, strict=True)}


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


def _identity(space: ParameterSpace, edges: Array, model_hash: str) -> str:
    """Returns the hash of all that results depend on besides theta.

    The wording of a parameter's description is not part of it.
    """
    parts = [_box(space), edges.tobytes().hex(), model_hash]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def _box(space: ParameterSpace) -> list[list[Any]]:
    """Returns the parameters with their units, bounds and priors as plain values."""
    return [[p.name, p.unit, float(p.lower), float(p.upper), p.prior, p.offset] for p in space.parameters]


def _check_same(path: Path, design: Design, space: ParameterSpace, edges: Array, model_hash: str) -> None:
    """Raises InputError unless runs of this model, space and bins can extend the file's design."""
    if design.model_hash != model_hash:
        raise InputError(path, f"a design of model {design.model_hash}", f"a design of model {model_hash}")
    if _box(design.space) != _box(space):
        raise InputError(path, f"parameters {_box(design.space)}", f"parameters {_box(space)}")
    if not np.array_equal(design.edges_s, edges):
        bins, expected_bins = len(design.edges_s) - 1, len(edges) - 1
        raise InputError(
            path, f"{bins} time bins to {design.edges_s[-1]:g} s", f"{expected_bins} bins to {edges[-1]:g} s"
        )


def _extended(before: Design | None, wave: Wave, edges: Array, model_hash: str, fresh: list[Run]) -> Design:
    """Returns the design with the `fresh` runs of `wave` as its last rows."""
    held_out = dict(zip((t.tobytes() for t in wave.theta[::-1]), wave.held_out[::-1], strict=True))
    new = Design(
        space=wave.space,
        edges_s=edges,
        theta=np.array([run.theta for run in fresh]).reshape(-1, wave.space.dim),
        force_n=np.array([run.force_n for run in fresh]).reshape(-1, len(edges) - 1),
        wave=np.full(len(fresh), wave.number, dtype=np.int64),
        held_out=np.array([held_out[run.theta.tobytes()] for run in fresh], dtype=bool),
        ok=np.array([run.ok for run in fresh], dtype=bool),
        messages=tuple(run.message for run in fresh),
        seconds=np.array([run.seconds for run in fresh], dtype=float),
        seed=wave.seed,
        model_hash=model_hash,
    )
    if before is None:
        return new
    rows = ("theta", "force_n", "wave", "held_out", "ok", "seconds")
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(before, name), getattr(new, name)]) for name in rows
    }
    joined["messages"] = before.messages + new.messages
    return Design(
        space=before.space, edges_s=before.edges_s, seed=before.seed, model_hash=model_hash, **joined
    )


def _write(path: Path, design: Design, waves: list[dict[str, Any]]) -> None:
    """Replaces the file, in one step, by a file with all rows and the records of the waves."""
    storage.save(path, design, {"waves": json.dumps(waves)})


def _remove_stale(path: Path) -> None:
    """Removes partial files that a killed process may have left; only the journal's holder may do this."""
    for stale in path.parent.glob(f".{escape(path.name)}.*.partial"):
        stale.unlink(missing_ok=True)
    path.with_name(f".{path.name}.journal.partial").unlink(missing_ok=True)
