"""Repeats the local sensitivities of the article's appendix, for the article's force and for the reaction.

The article's metric is the mean over 18 s to 50 s of the force relative to the force at the calibrated point.
theta_i is the slope of this metric by a relative change of parameter i, and S_i = theta_i^2 / sum theta^2.
The program prints side by side:

- the article's table, recomputed from its own force histories (`data/Sobol_indice.xlsx`) with changes of
  +-10 %;
- our `article` observation on the article's mesh and time steps with changes of +-10 % (nine runs to 50 s,
  which take some minutes);
- our `reaction`, by the derivatives that are computed along one run.

    python benchmarks/local_sobol.py

The environment variable BAYESKIN_SUPPLEMENT must name the supplement's folder.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import openpyxl

from bayeskin.finite_element import ModelSpec, simulate
from bayeskin.finite_element.gradients import logarithms
from bayeskin.types import Array, PadMotion

NAMES = ("E_c", "E_s", "k_c", "k_s")
SHEETS = {"E_c": "E1", "E_s": "E2", "k_c": "k1", "k_s": "k2"}
POINT = {"E_c": 684250.48, "E_s": 47789.13, "k_c": 9.428584e-15, "k_s": 5.0299945e-13, "p_init": 700.0}
WINDOW_S = (18.0, 50.0)
CHANGE = 0.1


def main() -> int:
    """Prints the table; returns exit code 2 where the supplement is missing."""
    folder = os.environ.get("BAYESKIN_SUPPLEMENT")
    if not folder:
        print(
            "BAYESKIN_SUPPLEMENT is not set; set it to the folder of the article's supplement",
            file=sys.stderr,
        )
        return 2
    supplement = Path(folder)
    mesh = str(supplement / "data" / "Mesh_SKIN.msh")
    motion = _motion(supplement)
    columns = {
        "article's files": _slopes_of_files(supplement),
        "article, bayeskin": _slopes_of_article(mesh, motion),
        "reaction, article's mesh": _slopes_of_reaction(ModelSpec(mesh=mesh), motion),
        "reaction, bricks": _slopes_of_reaction(ModelSpec(), motion),
    }
    print(f"{'':>6}" + "".join(f"{name:>34}" for name in columns))
    for i, name in enumerate(NAMES):
        cells = (f"theta {slopes[i]:+.4f}  S {share:.3f}" for slopes, share in _shares(columns, i))
        print(f"{name:>6}" + "".join(f"{cell:>34}" for cell in cells))
    return 0


def _shares(columns: dict[str, Array], i: int) -> list[tuple[Array, float]]:
    """Returns for each column its slopes (4,) and the share S_i of parameter i."""
    return [(slopes, float(slopes[i] ** 2 / np.sum(slopes**2))) for slopes in columns.values()]


def _motion(supplement: Path) -> PadMotion:
    """Returns the pads' motion of the article's script up to the end of the window."""
    table = np.loadtxt(supplement / "reference" / "article_forward.csv", delimiter=",", skiprows=1)
    time_s, pad_m = np.concatenate([[[0.0, 0.0]], table[table[:, 0] <= WINDOW_S[1], :2]]).T
    return PadMotion(time_s, 2.0 * pad_m)


def _slopes_of_files(supplement: Path) -> Array:
    """Returns the slopes (4,) from the article's own force histories."""
    book = openpyxl.load_workbook(supplement / "data" / "Sobol_indice.xlsx", data_only=True, read_only=True)

    def force(sheet: str) -> tuple[Array, Array]:
        rows = [row[:2] for row in book[sheet].iter_rows(min_row=2, values_only=True) if row[0] is not None]
        time_s, force_n = np.array(rows, dtype=float).T
        return time_s, force_n

    time_s, reference = force("reference")
    in_window = (time_s >= WINDOW_S[0]) & (time_s <= WINDOW_S[1])

    def slope(sheet: str) -> float:
        up, down = (np.mean(force(sheet + sign)[1][in_window] / reference[in_window]) for sign in "pm")
        return float((up - down) / (2 * CHANGE))

    return np.array([slope(SHEETS[name]) for name in NAMES])


def _slopes_of_article(mesh: str, motion: PadMotion) -> Array:
    """Returns the slopes (4,) by central differences of our `article` observation."""
    spec = ModelSpec("article", mesh)

    def force(theta: dict[str, float]) -> Array:
        print(", ".join(f"{k} {v:.4g}" for k, v in theta.items()), file=sys.stderr)
        run = simulate(spec, motion, theta)
        if run.status != "ok":
            raise SystemExit(run.message)
        return run.force_n[(run.time_s >= WINDOW_S[0]) & (run.time_s <= WINDOW_S[1])]

    reference = force(POINT)

    def slope(name: str) -> float:
        up, down = (
            np.mean(force({**POINT, name: POINT[name] * (1 + sign * CHANGE)}) / reference) for sign in (1, -1)
        )
        return float((up - down) / (2 * CHANGE))

    return np.array([slope(name) for name in NAMES])


def _slopes_of_reaction(spec: ModelSpec, motion: PadMotion) -> Array:
    """Returns the slopes (4,) by the derivatives along one run of the `reaction`."""
    corners = np.flatnonzero(np.abs(np.diff(np.diff(motion.displacement_m) / np.diff(motion.time_s))) > 1e-4)
    kept = np.concatenate([[0], 1 + corners, [len(motion.time_s) - 1]])
    run = simulate(
        spec, PadMotion(motion.time_s[kept], motion.displacement_m[kept]), POINT, gradients=logarithms(POINT)
    )
    edges = np.linspace(*WINDOW_S, 65)
    force, gradient = run.bin_means(edges), run.gradient_bin_means(edges)
    return np.asarray(np.mean(gradient / force[:, None], axis=0))


if __name__ == "__main__":
    sys.exit(main())
