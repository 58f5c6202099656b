"""Provides a protocol, parameter points and meshes for the benchmarks of the full model.

The protocol is that of the article's healthy-skin recording in idealised corners, with times rounded to 0.1 s
and heights to 0.01 mm. It has four extensions of 9.45 mm at 1 mm/s. The third of them is released to 1.76 mm
only.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import numpy as np

from bayeskin.finite_element import mesh as mesh_module
from bayeskin.finite_element.bricks import brick_lines
from bayeskin.finite_element.simulate import ModelSpec, mesh_of, problem_of
from bayeskin.geometry import Geometry
from bayeskin.proof.protocol import MOTION
from bayeskin.types import Array, PadMotion

HEALTHY_SKIN = MOTION
P_INIT_PA = 700.0
POINTS = {
    name: dict(zip(("E_c", "E_s", "k_c", "k_s", "p_init"), (*values, P_INIT_PA), strict=True))
    for name, values in {
        "A": (60e3, 20e3, 1e-14, 5e-13),
        "C": (684e3, 47.8e3, 9.4e-15, 5e-13),  # near the article's calibrated point
        "soft": (20e3, 5e3, 1e-12, 1e-11),
    }.items()
}
GMSH_MESHES = ("Mesh_SKIN.msh", "Symmetric_skin_XY_RF.msh")


def first_cycle(motion: PadMotion) -> PadMotion:
    """Returns the first five corners of a protocol: rest, first loading, hold and unloading."""
    return PadMotion(motion.time_s[:5], motion.displacement_m[:5])


def supplement_mesh(name: str) -> Path | None:
    """Returns the path of one of the article's meshes, or None if BAYESKIN_SUPPLEMENT is not set."""
    supplement = os.environ.get("BAYESKIN_SUPPLEMENT")
    return Path(supplement) / "data" / name if supplement else None


@contextmanager
def spec_on(mesh: str, tolerance: float) -> Iterator[ModelSpec]:
    """Yields the specification of the `reaction` on a mesh.

    mesh : "bricks-2", "bricks-1-halved" (every edge of every brick is halved), or a gmsh file of the
    supplement
    """
    match = re.fullmatch(r"bricks-(\d+)(-halved)?", mesh)
    if not match:
        path = supplement_mesh(mesh)
        if path is None:
            raise SystemExit(f"{mesh}: BAYESKIN_SUPPLEMENT is not set")
        yield ModelSpec(mesh=str(path), tolerance=tolerance)
        return
    spec = ModelSpec(refinement=int(match[1]), tolerance=tolerance)
    if not match[2]:
        yield spec
        return
    with mock.patch.object(mesh_module, "brick_lines", halved_lines):
        _forget_meshes()
        try:
            yield spec
        finally:
            _forget_meshes()


def halved_lines(
    refinement: int, geometry: Geometry = Geometry(), like: Geometry | None = None
) -> tuple[Array, ...]:
    """Returns the lines of the bricks with an additional line in the middle of every cell [m]."""
    lines = brick_lines(refinement, geometry, like)
    return tuple(np.sort(np.concatenate([axis, 0.5 * (axis[1:] + axis[:-1])])) for axis in lines)


def _forget_meshes() -> None:
    """Clears the caches of meshes and problems, which do not know that the lines were replaced."""
    mesh_of.cache_clear()
    problem_of.cache_clear()
