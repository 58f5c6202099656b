"""Reads the file of a design."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bayeskin import storage
from bayeskin.errors import InputError
from bayeskin.types import Design


def load_design(path: Path | str) -> Design:
    """Returns the design of a file.

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
            raise InputError(
                f"{path}: {name}", f"its shape is {getattr(design, name).shape}", f"it must be {shape}"
            )
    if len(design.messages) != rows:
        raise InputError(
            f"{path}: messages",
            f"the number of messages is {len(design.messages)}",
            f"it must be {rows}, one for each row",
        )
    if not (np.isfinite(design.theta).all() and np.isfinite(design.force_n[design.ok]).all()):
        raise InputError(path, "some values are not finite", "only the forces of failed runs can be so")
    return design
