"""Measures how far off a mesh is for the displacements of 25 markers, and whether a coarse mesh shows it.

    python benchmarks/markers_mesh.py        # some three minutes of one core

The program prints a table, and writes it between its markers of docs/markers.md. Its rows compare meshes of
the full model on the test of benchmarks/markers.py.
"""

from __future__ import annotations

import numpy as np
import rows
from markers import IMAGES_S, MOTION, PAGE, SKINS, Case, full_run

from bayeskin.types import Array


def gain(skin: str, coarse: int, fine: int) -> Array:
    """Returns by how much displacements (t - 1, p, 2) [m] change from one refinement to another."""
    return full_run(Case(skin, refinement=fine))[1] - full_run(Case(skin, refinement=coarse))[1]


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def compared(name: str, change_m: Array, shape_m: Array) -> list[str]:
    """Returns a table row: the size of a change at the largest opening, and what a shape says of it."""
    pads_m = 0.5 * MOTION.at(IMAGES_S[1:])
    widest = int(np.argmax(pads_m))
    factor = float(np.sum(change_m * shape_m) / np.sum(shape_m**2))
    left = rms(change_m - factor * shape_m) / rms(change_m)
    share, largest = rms(change_m[widest]) / pads_m[widest], np.abs(change_m[widest]).max() / pads_m[widest]
    return [name, f"{100 * share:.2f}", f"{100 * largest:.2f}", f"{factor:.3f}", f"{100 * left:.0f}"]


def main() -> None:
    shape_m = gain("usual", 0, 1)
    table = [
        compared("448 to 1,540 bricks, usual skin", gain("usual", 1, 2), shape_m),
        *(compared(f"80 to 448 bricks, {skin} skin", gain(skin, 0, 1), shape_m) for skin in SKINS),
    ]
    header = ["change of mesh", "RMS [%]", "largest [%]", "factor", "not described [%]"]
    text = rows.markdown(header, table)
    print(text)
    rows.into_docs(PAGE, "markers mesh", text)


if __name__ == "__main__":
    main()
