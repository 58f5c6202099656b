"""Compares the default bricks with finer ones for other devices and other skin than the article's.

Each geometry is run at two skins over one shortened cycle of loading, a hold of some ten seconds, and
unloading. In proportion to the gauge the displacement is as large as in the healthy-skin recording. The
reference is refinement 2.

    OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 python benchmarks/discretisation_geometries.py

The program takes some ten minutes of one core. It writes the table between the markers of
docs/discretisation.md.
"""

from __future__ import annotations

from pathlib import Path

import healthy_skin
import numpy as np
import rows
from discretisation_tables import Error, error

from bayeskin.finite_element import ModelSpec, simulate
from bayeskin.finite_element.simulate import problem_of
from bayeskin.geometry import Geometry, Guard
from bayeskin.types import PadMotion, Simulation

REFERENCE = 2
SKINS = ("A", "C")
CORNERS_S = (0.0, 9.4, 20.0, 29.4)
EXTENSION = 9.45e-3 / Geometry().gauge_m  # stretch of the gauge in the healthy-skin recording
PAGE = Path(__file__).parents[1] / "docs" / "discretisation.md"
GEOMETRIES = {
    "the article's": Geometry(),
    "the article's device, force on pad and guard": Geometry(force_on="pad and guard"),
    "the article's device; cutis 3.5, subcutis 20, arm 35": Geometry(
        cutis_m=3.5e-3, subcutis_m=20e-3, arm_radius_m=35e-3
    ),
    "gauge 20, pads 10 x 20, no guard": Geometry(
        gauge_m=20e-3, pad_length_m=10e-3, pad_width_m=20e-3, guard=None
    ),
    "gauge 12, pads 4 x 6, no guard; cutis 1.2, subcutis 3, flat": Geometry(
        gauge_m=12e-3, pad_length_m=4e-3, pad_width_m=6e-3, guard=None,
        cutis_m=1.2e-3, subcutis_m=3e-3, arm_radius_m=None,
    ),
    "gauge 20, pads 6 x 20, guard 0.3 behind, 4 wide; cutis 1.2": Geometry(
        gauge_m=20e-3, pad_length_m=6e-3, pad_width_m=20e-3, guard=Guard(0.3e-3, 4e-3), cutis_m=1.2e-3
    ),
    "gauge 5, pads 20 x 20, no guard": Geometry(
        gauge_m=5e-3, pad_length_m=20e-3, pad_width_m=20e-3, guard=None
    ),
}  # fmt: skip


def run(geometry: Geometry, refinement: int, skin: str) -> Simulation:
    """Returns the reaction over one cycle."""
    far_m = EXTENSION * geometry.gauge_m
    motion = PadMotion(np.array(CORNERS_S), np.array([0.0, far_m, far_m, 0.0]))
    return simulate(ModelSpec(refinement=refinement, geometry=geometry), motion, healthy_skin.POINTS[skin])


def line(name: str, geometry: Geometry) -> list[str]:
    """Returns one row of the table: number of bricks, and the errors of refinements 1 and 0 at each skin."""
    rows.say(name)
    references = [run(geometry, REFERENCE, skin) for skin in SKINS]
    cells = []
    for refinement in (1, 0):
        cells.append(str(problem_of("bricks", refinement, geometry).mesh.geometry.nelements))
        runs = [run(geometry, refinement, skin) for skin in SKINS]
        cells += [_error_text(error(*pair)) for pair in zip(runs, references, strict=True)]
    return [name, *cells]


def _error_text(error: Error) -> str:
    """Returns an error as text: RMS, RMS after the best factor, and that factor."""
    return f"{100 * error.rms:.2f}, {100 * error.rms_scaled:.2f} (x {error.scale:.4f})"


def main() -> None:
    header = ["device [mm]"]
    for kind in ("default", "coarsest"):
        header += [f"{kind} bricks", *(f"{skin}: RMS error, after best factor [% of peak]" for skin in SKINS)]
    block = rows.markdown(header, [line(*device) for device in GEOMETRIES.items()])
    print(block)
    rows.into_docs(PAGE, "geometries", block)


if __name__ == "__main__":
    main()
