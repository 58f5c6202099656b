"""Reads a design's file, checks that further runs fit it, and replaces it by a file with more rows."""

from __future__ import annotations

import hashlib
import json
from glob import escape
from pathlib import Path
from typing import Any

import numpy as np

from bayeskin import storage
from bayeskin.design import Wave
from bayeskin.errors import InputError
from bayeskin.journal import Run
from bayeskin.types import Array, Design, ParameterSpace


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


def rows_ok(design: Design | None) -> dict[bytes, bool]:
    """Returns whether the run of each stored point is ok, by the bytes of theta."""
    if design is None:
        return {}
    return {row.tobytes(): bool(ok) for row, ok in zip(design.theta, design.ok, strict=True)}


def identity_of(space: ParameterSpace, edges: Array, model_hash: str) -> str:
    """Returns the hash of all that results depend on besides theta.

    The wording of a parameter's description is not part of it.
    """
    parts = [_box(space), edges.tobytes().hex(), model_hash]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def _box(space: ParameterSpace) -> list[list[Any]]:
    """Returns the parameters with their units, bounds and priors as plain values."""
    return [[p.name, p.unit, float(p.lower), float(p.upper), p.prior, p.offset] for p in space.parameters]


def check_same(path: Path, design: Design, space: ParameterSpace, edges: Array, model_hash: str) -> None:
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


def extended(before: Design | None, wave: Wave, edges: Array, model_hash: str, fresh: list[Run]) -> Design:
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


def save_design(path: Path, design: Design, waves: list[dict[str, Any]]) -> None:
    """Replaces the file, in one step, by a file with all rows and the records of the waves."""
    storage.save(path, design, {"waves": json.dumps(waves)})


def remove_stale(path: Path) -> None:
    """Removes partial files that a killed process may have left; only the journal's holder may do this."""
    for stale in path.parent.glob(f".{escape(path.name)}.*.partial"):
        stale.unlink(missing_ok=True)
    path.with_name(f".{path.name}.journal.partial").unlink(missing_ok=True)
