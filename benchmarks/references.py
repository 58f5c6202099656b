"""Compares the models with other programs over the whole recording: differences of the force, and CPU time.

- The `reaction` is compared with an independent solver at three points
  (`reference/reaction_independent_A.csv`, B, C). The models are the full model on the solver's own mesh and
  on the default mesh, and the shipped reduced model.
- The `article` observation is compared with the article's released script (`reference/article_forward.csv`).

    python benchmarks/references.py

The environment variable BAYESKIN_SUPPLEMENT must name the supplement's folder. The program takes some nine
minutes.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import numpy as np

from bayeskin.finite_element import ModelSpec, simulate
from bayeskin.reduced.files import load_reduced
from bayeskin.reduced.simulate import simulate_reduced
from bayeskin.shipped import shipped
from bayeskin.types import Array, PadMotion, Simulation
from bayeskin.workflow.reducing import SHIPPED

POINTS = {
    "A": {"E_c": 60e3, "E_s": 20e3, "k_c": 1e-14, "k_s": 5e-13, "p_init": 700.0},
    "B": {"E_c": 200e3, "E_s": 5e3, "k_c": 1e-13, "k_s": 5e-12, "p_init": 700.0},
    "C": {"E_c": 684250.48, "E_s": 47789.13, "k_c": 9.428584e-15, "k_s": 5.0299945e-13, "p_init": 700.0},
}
CORNER_M_S = 1e-4  # a larger change of the pads' speed is a corner of the protocol


def main() -> int:
    """Prints one line for each comparison; returns exit code 2 where the supplement is missing."""
    folder = os.environ.get("BAYESKIN_SUPPLEMENT")
    if not folder:
        print(
            "BAYESKIN_SUPPLEMENT is not set; set it to the folder of the article's supplement",
            file=sys.stderr,
        )
        return 2
    mesh, reference = str(Path(folder) / "data" / "Mesh_SKIN.msh"), Path(folder) / "reference"
    reduced = partial(simulate_reduced, load_reduced(shipped(SHIPPED)))
    for case, theta in POINTS.items():
        time_s, pad_m, force_n = _read(reference / f"reaction_independent_{case}.csv")
        speed = np.diff(pad_m) / np.diff(time_s)
        corners = 1 + np.flatnonzero(np.abs(np.diff(speed)) > CORNER_M_S)
        kept = np.concatenate([[0], corners, [len(time_s) - 1]])
        motion = PadMotion(time_s[kept], 2.0 * pad_m[kept])
        for name, model in {
            "solver's mesh": partial(simulate, ModelSpec(mesh=mesh)),
            "default mesh": partial(simulate, ModelSpec()),
            "reduced": reduced,
        }.items():
            _compare(f"reaction {case}, {name}", model, motion, theta, time_s, force_n)
    time_s, pad_m, force_n = _read(reference / "article_forward.csv")
    motion = PadMotion(time_s, 2.0 * pad_m)
    _compare("article", partial(simulate, ModelSpec("article", mesh)), motion, POINTS["C"], time_s, force_n)
    return 0


def _read(path: Path) -> tuple[Array, Array, Array]:
    """Returns time [s], displacement of a pad [m] and force [N], from the start at rest."""
    table = np.loadtxt(path, delimiter=",", skiprows=1)[:, :3]
    time_s, pad_m, force_n = table.T if table[0, 0] == 0.0 else np.vstack([np.zeros(3), table]).T
    return time_s, pad_m, force_n


def _compare(
    label: str,
    model: Callable[[PadMotion, Mapping[str, float]], Simulation],
    motion: PadMotion,
    theta: Mapping[str, float],
    time_s: Array,
    force_n: Array,
) -> None:
    """Runs a model, and prints its difference from a reference force and its CPU time."""
    started = time.process_time()
    run = model(motion, theta)
    cpu_s = time.process_time() - started
    if run.status != "ok":
        raise SystemExit(f"{label}: {run.message}")
    difference_n = run.at(time_s) - force_n
    rmse_n, largest_n, peak_n = (
        np.sqrt(np.mean(difference_n**2)),
        np.abs(difference_n).max(),
        np.abs(force_n).max(),
    )
    print(
        f"{label:>26}: RMSE {1e3 * rmse_n:.4f} mN ({100 * rmse_n / peak_n:.3f} % of the peak), at most "
        f"{1e3 * largest_n:.4f} mN, {len(run.time_s) - 1} steps, {cpu_s:.1f} CPU s",
        flush=True,
    )


if __name__ == "__main__":
    sys.exit(main())
