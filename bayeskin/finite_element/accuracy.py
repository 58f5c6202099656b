"""Discretisation error: how far a run is from the limit of fine meshes and short steps.

In time, the root of the sum of squares of the steps' own estimates: two to five times the largest error that
the study found. In space, what the study found on the same mesh. The study: docs/discretisation.md.
"""

from __future__ import annotations

import json
from functools import lru_cache
from importlib import resources
from typing import NamedTuple

FILE = "discretisation.json"  # beside this file; written by benchmarks/discretisation_study.py


class MeshError(NamedTuple):
    """Error of the reaction's history over the first cycle, relative to its peak: RMS and largest, the worst
    of the study's points."""

    rms: float
    largest: float


def mesh_error(mesh_hash: str) -> MeshError | None:
    """Returns the study's result for the mesh with this hash; None for a mesh that was not in it."""
    found = _studied().get(mesh_hash)
    return None if found is None else MeshError(found["rms"], found["largest"])


@lru_cache(maxsize=1)
def _studied() -> dict[str, dict[str, float]]:
    return dict(json.loads(resources.files("bayeskin.finite_element").joinpath(FILE).read_text()))
