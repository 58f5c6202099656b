"""Measures how a refinement of the default bricks changes the shape of a force history, over the prior.

The skins are drawn from the default prior box by a scrambled Sobol' sequence. Only skins whose subcutis is at
most twice as stiff as the cutis are used. Each is run with the `reaction` on 448 and on 1,540 bricks over the
whole healthy-skin protocol. The difference of the two histories, in means over 0.5 s, is decomposed by least
squares into the shapes of `bayeskin.inference.model_error`: a factor on the force, a bend of the force with
displacement, and responses that relax. The program prints the RMS of each over the skins, factor and bend in
percent of the force, all others in percent of the peak.

    OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 python benchmarks/mesh_shapes.py

Finished skins are rows of benchmarks/results/mesh_shapes.csv, and a later start does not repeat them. The
program writes the table between the markers of docs/discretisation.md.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import healthy_skin
import numpy as np
import rows

from bayeskin.design import default_space, sobol_points
from bayeskin.execution.local import Lost, run_parallel
from bayeskin.finite_element import simulate
from bayeskin.finite_element.simulate import ModelSpec
from bayeskin.inference.model_error import ErrorSizes, errors, shapes
from bayeskin.types import STIFFEST_BELOW, Array

SEED = 21
BIN_S = 0.5
PAGE = Path(__file__).parents[1] / "docs" / "discretisation.md"
NAMES = default_space().names
ANSWERS = tuple(f"relaxing in {tau:g} s" for tau in ErrorSizes().relaxation_s)
PARTS = ("factor", "bend", *ANSWERS)
LEFT = ("all", "left by the factor", "left by factor and bend", "left by all shapes")
ROWS = rows.Rows(
    rows.RESULTS / "mesh_shapes.csv", ("seed", "index", "model_hash"), (*NAMES, *PARTS, *LEFT, "code")
)


def skins(count: int) -> Array:
    """Returns parameters (count, 5) of skins; a larger count adds skins and keeps the first ones."""
    theta = sobol_points(default_space(), 4 * count + 64, SEED)
    return theta[theta[:, 1] <= STIFFEST_BELOW * theta[:, 0]][:count]


def refined(theta: dict[str, float]) -> dict[str, float] | str:
    """Returns for one skin the coefficients of the shapes, and the RMS over the peak that they leave.

    Returns the error message where a run fails.
    """
    motion = healthy_skin.HEALTHY_SKIN
    edges_s = np.arange(0.0, motion.time_s[-1], BIN_S)
    runs = [simulate(ModelSpec(refinement=r), motion, theta) for r in (1, 2)]
    for run in runs:
        if run.status != "ok":
            return run.message
    default, finer = (run.bin_means(edges_s) for run in runs)
    peak = float(np.abs(finer).max())
    columns = errors(default[None], *shapes(motion, edges_s, ErrorSizes().relaxation_s))[0]
    remaining_rms = [_rms(finer - default) / peak]
    for count in (1, 2, len(columns)):
        coefficients, *_ = np.linalg.lstsq(columns[:count].T, finer - default, rcond=None)
        remaining_rms.append(_rms(finer - default - coefficients @ columns[:count]) / peak)
    return dict(zip((*PARTS, *LEFT), (*coefficients, *remaining_rms), strict=True))


def _rms(values: Array) -> float:
    """Returns the root mean square of some values."""
    return float(np.sqrt(np.mean(values**2)))


def table(skins: list[rows.Row]) -> str:
    """Returns the RMS, smallest and largest value of each quantity over the skins as a table."""
    lines = []
    for name in (*PARTS, *LEFT):
        values = 100.0 * np.array([float(row[name]) for row in skins])
        lines.append(
            [name, f"{np.sqrt(np.mean(values**2)):.3f}", f"{values.min():.3f}", f"{values.max():.3f}"]
        )
    return rows.markdown([f"{len(skins)} skins", "RMS [%]", "smallest", "largest"], lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--skins", type=int, default=16)
    options = parser.parse_args()
    inputs = [{"seed": SEED, "index": i, "model_hash": ModelSpec().hash} for i in range(options.skins)]
    cases = [dict(zip(NAMES, map(float, theta), strict=True)) for theta in skins(options.skins)]
    missing = [i for i, key in enumerate(inputs) if ROWS.find(**key) is None]
    for position, outcome in run_parallel(refined, [cases[i] for i in missing], 2):
        i = missing[position]
        if isinstance(outcome, Lost | str):
            rows.say(f"skin {i}: {outcome if isinstance(outcome, str) else outcome.reason}")
            continue
        ROWS.append(**inputs[i], **cases[i], **outcome, code=rows.CODE)
        rows.say(
            f"skin {i}: {100 * outcome[LEFT[0]]:.2f} % of the peak, {100 * outcome[LEFT[-1]]:.3f} % left"
        )
    block = table([row for key in inputs if (row := ROWS.find(**key))])
    print(block)
    rows.into_docs(PAGE, "shapes", block)


if __name__ == "__main__":
    main()
