"""Estimates the discretisation error: how far a run is from the limit of fine meshes and short time steps.

The error in time is the root of the sum of squares of the errors that the time steps estimate themselves. It
is two to five times the largest error that the discretisation study measured. The error in space is the error
that the study measured on the same mesh. docs/discretisation.md describes the study.
"""

from __future__ import annotations

import json
from functools import lru_cache
from importlib import resources
from typing import NamedTuple

FILE = "discretisation.json"  # benchmarks/discretisation_study.py writes it into this folder


class MeshError(NamedTuple):
    """Error of the reaction force over the first cycle, relative to the peak force.

    rms, largest : root mean square and largest error, each at the worst of the study's parameter points
    """

    rms: float
    largest: float


def mesh_error(mesh_hash: str) -> MeshError | None:
    """Returns the study's error for the mesh with this hash, or None if the mesh was not in the study."""
    error = _studied_meshes().get(mesh_hash)
    return None if error is None else MeshError(error["rms"], error["largest"])


@lru_cache(maxsize=1)
def _studied_meshes() -> dict[str, dict[str, float]]:
    """Returns the errors of the studied meshes by the hash of the mesh."""
    return dict(json.loads(resources.files("bayeskin.finite_element").joinpath(FILE).read_text()))
