"""What the benchmarks of the full model run: a protocol, points of the parameters, meshes.

The protocol is that of the article's healthy-skin recording in idealised corners (times to 0.1 s, heights to
0.01 mm): four extensions of 9.45 mm at 1 mm/s, of which the third is released to 1.76 mm only.
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
from bayeskin.finite_element.simulate import ModelSpec, _mesh, problem_of
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
    """Rest, first loading, hold and unloading: the first five corners."""
    return PadMotion(motion.time_s[:5], motion.displacement_m[:5])


def supplement_mesh(name: str) -> Path | None:
    """Path of one of the article's meshes, or None where the supplement is not there."""
    root = os.environ.get("BAYESKIN_SUPPLEMENT")
    return Path(root) / "data" / name if root else None


@contextmanager
def spec_on(mesh: str, tolerance: float) -> Iterator[ModelSpec]:
    """The `reaction` on a mesh: "bricks-2", "bricks-1-halved" (every edge of every brick), or a gmsh file of
    the supplement."""
    bricks = re.fullmatch(r"bricks-(\d+)(-halved)?", mesh)
    if not bricks:
        path = supplement_mesh(mesh)
        if path is None:
            raise SystemExit(f"{mesh}: BAYESKIN_SUPPLEMENT is not set")
        yield ModelSpec(mesh=str(path), tolerance=tolerance)
        return
    spec = ModelSpec(refinement=int(bricks[1]), tolerance=tolerance)
    if not bricks[2]:
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
    """Lines of the bricks with one more in the middle of every cell [m]."""
    lines = brick_lines(refinement, geometry, like)
    return tuple(np.sort(np.concatenate([axis, 0.5 * (axis[1:] + axis[:-1])])) for axis in lines)


def _forget_meshes() -> None:
    _mesh.cache_clear()
    problem_of.cache_clear()
