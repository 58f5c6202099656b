"""What the benchmarks of the full model run: a protocol, points of the parameters, meshes.

The protocol is that of the article's healthy-skin recording in idealised corners (times to 0.1 s, heights to
0.01 mm): four extensions of 9.45 mm at 1 mm/s, of which the third is released to 1.76 mm only.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from unittest import mock

import numpy as np

from bayeskin import storage
from bayeskin.model import mesh as mesh_module
from bayeskin.model.simulate import ModelSpec, _mesh, problem_of
from bayeskin.recordings import idealised_motion, segment
from bayeskin.types import Array, PadMotion, Recording

HEALTHY_SKIN = PadMotion(
    np.array([0, 9.6, 19, 79, 88.5, 97.9, 147.9, 157.4, 166.8, 206.8, 214.5, 222.2, 258, 267.4, 347.4]),
    1e-3 * np.array([0, 0, 9.45, 9.45, 0.02, 9.45, 9.45, 0.02, 9.45, 9.45, 1.76, 9.45, 9.45, 0, 0]),
)
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
EDGES_M = (1e-3 * np.array([18, 26, 27, 35]), 1e-3 * np.array([4, 5, 12]), 1e-3 * np.array([10]))
TOWARD_EDGE = 0.25  # where a cell beside an edge of the pads is divided: a quarter of its width from it


def first_cycle(motion: PadMotion) -> PadMotion:
    """Rest, first loading, hold and unloading: the first five corners."""
    return PadMotion(motion.time_s[:5], motion.displacement_m[:5])


def demo_motion() -> PadMotion:
    """The idealised protocol of the shipped demo, as `bayeskin run` takes it."""
    recording = storage.load(Path(__file__).parents[1] / "data" / "demo.h5", Recording)
    return idealised_motion(recording, segment(recording))


def supplement_mesh(name: str) -> Path | None:
    """Path of one of the article's meshes, or None where the supplement is not there."""
    root = os.environ.get("BAYESKIN_SUPPLEMENT")
    return Path(root) / "data" / name if root else None


@contextmanager
def spec_on(mesh: str, tolerance: float) -> Iterator[ModelSpec]:
    """The `reaction` on a mesh: "bricks-2", "bricks-1-edges-2", or a gmsh file of the supplement.

    "edges-n" divides the cells beside the pads' edges n times toward them, before the refinement.
    """
    bricks = re.fullmatch(r"bricks-(\d+)(?:-edges-(\d+))?", mesh)
    if not bricks:
        path = supplement_mesh(mesh)
        if path is None:
            raise SystemExit(f"{mesh}: BAYESKIN_SUPPLEMENT is not set")
        yield ModelSpec(mesh=str(path), tolerance=tolerance)
        return
    refinement, levels = int(bricks[1]), int(bricks[2] or 0)
    with mock.patch.object(mesh_module, "_COARSE_LINES_M", brick_lines(levels)):
        _forget_meshes()
        try:
            yield ModelSpec(refinement=refinement, tolerance=tolerance)
        finally:
            _forget_meshes()


def brick_lines(levels: int) -> tuple[Array, ...]:
    """Lines of the coarsest bricks with `levels` more on either side of each edge of the pads [m]."""
    lines = mesh_module._COARSE_LINES_M
    for _ in range(levels):
        lines = tuple(_divided(axis, edges) for axis, edges in zip(lines, EDGES_M, strict=True))
    return lines


def _divided(lines: Array, edges: Array) -> Array:
    new = []
    for a, b in pairwise(lines):
        new += [a + TOWARD_EDGE * (b - a)] if np.isclose(edges, a).any() else []
        new += [b - TOWARD_EDGE * (b - a)] if np.isclose(edges, b).any() else []
    return np.sort(np.concatenate([lines, new]))


def _forget_meshes() -> None:
    _mesh.cache_clear()
    problem_of.cache_clear()
