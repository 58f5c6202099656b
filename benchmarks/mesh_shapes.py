"""What refining the default bricks does to a force history's shape, over the prior.

Skins of the default prior box whose subcutis is at most twice as stiff as the cutis (a scrambled Sobol'
sequence), run with the `reaction` on 448 and on 1,540 bricks over the whole healthy-skin protocol. The
difference of the two histories, in means over 0.5 s, is taken apart by least squares into the shapes of
`bayeskin.inference.model_error`: a factor on the force, a bend of it with displacement, answers that relax.
Prints the RMS of each over the skins, factor and bend in percent of the force, the rest of the peak.

    OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 python benchmarks/mesh_shapes.py

Finished skins are rows of benchmarks/results/mesh_shapes.csv, which a later start does not repeat. Writes the
table between the markers of docs/discretisation.md.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

import healthy_skin
import numpy as np
import rows

from bayeskin.design import default_space, sobol_points
from bayeskin.execution.local import Lost, run_parallel
from bayeskin.finite_element import simulate
from bayeskin.finite_element.simulate import ModelSpec
from bayeskin.inference.model_error import RELAXATION_S, errors, shapes
from bayeskin.mismatch.fit import STIFFEST_BELOW
from bayeskin.types import Array

SEED = 21
BIN_S = 0.5
DOCS = Path(__file__).parents[1] / "docs"
NAMES = default_space().names
ANSWERS = tuple(f"relaxing in {tau:g} s" for tau in RELAXATION_S)
PARTS = ("factor", "bend", *ANSWERS)
LEFT = ("all", "left by the factor", "left by factor and bend", "left by all shapes")
ROWS = rows.Rows(
    rows.RESULTS / "mesh_shapes.csv", ("seed", "index", "model_hash"), (*NAMES, *PARTS, *LEFT, "code")
)


def skins(count: int) -> Array:
    """Parameters (count, 5), more of them when more are asked for."""
    theta = sobol_points(default_space(), 4 * count + 64, SEED)
    return theta[theta[:, 1] <= STIFFEST_BELOW * theta[:, 0]][:count]


def refined(theta: dict[str, float]) -> dict[str, float] | str:
    """Of one skin: the parts of the difference and what they leave, over the peak; or why a run failed."""
    motion = healthy_skin.HEALTHY_SKIN
    edges_s = np.arange(0.0, motion.time_s[-1], BIN_S)
    runs = [simulate(ModelSpec(refinement=r), motion, theta) for r in (1, 2)]
    for run in runs:
        if run.status != "ok":
            return run.message
    here, finer = (run.bin_means(edges_s) for run in runs)
    peak = float(np.abs(finer).max())
    columns = errors(here[None], *shapes(motion, edges_s))[0]
    left = [_rms(finer - here) / peak]
    for count in (1, 2, len(columns)):
        found, *_ = np.linalg.lstsq(columns[:count].T, finer - here, rcond=None)
        left.append(_rms(finer - here - found @ columns[:count]) / peak)
    return dict(zip((*PARTS, *LEFT), (*found, *left), strict=True))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def table(found: list[rows.Row]) -> str:
    lines = []
    for name in (*PARTS, *LEFT):
        values = 100.0 * np.array([float(row[name]) for row in found])
        lines.append(
            [name, f"{np.sqrt(np.mean(values**2)):.3f}", f"{values.min():.3f}", f"{values.max():.3f}"]
        )
    return rows.markdown([f"{len(found)} skins", "RMS [%]", "least", "most"], lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--skins", type=int, default=16)
    parser.add_argument("--docs", type=Path, default=DOCS, help="folder of discretisation.md")
    asked = parser.parse_args()
    inputs = [{"seed": SEED, "index": i, "model_hash": ModelSpec().hash} for i in range(asked.skins)]
    cases = [dict(zip(NAMES, map(float, theta), strict=True)) for theta in skins(asked.skins)]
    missing = [i for i, key in enumerate(inputs) if ROWS.find(**key) is None]
    for place, found in run_parallel(partial(refined), [cases[i] for i in missing], 2):
        i = missing[place]
        if isinstance(found, Lost | str):
            rows.say(f"skin {i}: {found if isinstance(found, str) else found.reason}")
            continue
        ROWS.append(**inputs[i], **cases[i], **found, code=rows.CODE)
        rows.say(f"skin {i}: {100 * found[LEFT[0]]:.2f} % of the peak, {100 * found[LEFT[-1]]:.3f} % left")
    block = table([row for key in inputs if (row := ROWS.find(**key))])
    print(block)
    rows.into_docs(asked.docs / "discretisation.md", "shapes", block)


if __name__ == "__main__":
    main()
