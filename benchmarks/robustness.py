"""Counts how many full runs fail at random parameters, and measures how long a run takes.

N independent points are drawn from each of two boxes, with a fixed seed. The first is the box of the
article's text (E 10 kPa to 500 MPa, k 1e-16 to 1e-10 m^2 in both layers, log-uniform; p_init as in the
default box). The second is the default prior box. Each point is run with the `reaction` on the default mesh
over the whole healthy-skin protocol (benchmarks/healthy_skin.py). The program counts finished and failed
runs, lists every failure with its parameters, and checks that all forces are finite.

    python benchmarks/robustness.py                  # on the default mesh; takes some hours
    python benchmarks/robustness.py --refinement 0   # on 80 bricks

Finished runs are rows of benchmarks/results/robustness.csv, and a later start does not repeat them. A start
with more points keeps the finished ones. The program draws docs/figures/robustness-80-bricks.{png,svg} or
-448-bricks.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import healthy_skin
import numpy as np
import rows
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from bayeskin.design import default_space
from bayeskin.execution.local import Lost, run_parallel
from bayeskin.finite_element import simulate
from bayeskin.finite_element.simulate import ModelSpec
from bayeskin.report import save_figure
from bayeskin.report.style import (
    ACCENT,
    INK,
    PAGE_IN,
    new_figure,
    panel_title,
    plain_log,
    state_finding,
    styled,
)
from bayeskin.types import PadMotion, ParameterSpace

SEED = 20
FIGURES = Path(__file__).parents[1] / "docs" / "figures"
NAMES = default_space().names
ROWS = rows.Rows(
    rows.RESULTS / "robustness.csv",
    ("protocol", "box", "seed", "index", "model_hash"),
    (
        *NAMES,
        "status",
        "finite",
        "peak_n",
        "end_s",
        "steps",
        "factorisations",
        "falls",
        "cpu_s",
        "code",
        "message",
    ),
)
Item = dict[str, Any]


def boxes() -> dict[str, ParameterSpace]:
    """Returns the box of the article's text, and the default box."""
    default = default_space()
    article_bounds = {"E": (10e3, 500e6), "k": (1e-16, 1e-10)}
    article = [
        replace(p, lower=article_bounds[p.name[0]][0], upper=article_bounds[p.name[0]][1])
        if p.name[0] in article_bounds
        else p
        for p in default.parameters
    ]
    return {"article": ParameterSpace(tuple(article)), "default": default}


def points(space: ParameterSpace, n: int, seed: int) -> list[dict[str, float]]:
    """Returns the first n points of a box for this seed."""
    unit = np.random.default_rng(seed).random((n, space.dim))
    return [dict(zip(space.names, map(float, row), strict=True)) for row in space.from_unit(unit)]


def perform(spec: ModelSpec, item: Item) -> Item:
    """Returns one run as a row.

    An exception counts as a failure too, although the model should never raise one.
    """
    theta = {name: item[name] for name in NAMES}
    _compile(spec)
    started = time.process_time()
    try:
        simulation = simulate(spec, healthy_skin.HEALTHY_SKIN, theta)
    except Exception as error:  # one failing run must not end the count
        return item | _no_run("raised", f"{type(error).__name__}: {error}", time.process_time() - started)
    return item | {
        "status": simulation.status,
        "finite": bool(np.isfinite(simulation.force_n).all()),
        "peak_n": simulation.stats["peak_force_n"],
        "end_s": float(simulation.time_s[-1]),
        "steps": int(simulation.stats["steps"]),
        "factorisations": int(simulation.stats["factorisations"]),
        "falls": int(simulation.stats["falls"]),
        "cpu_s": time.process_time() - started,
        "code": rows.CODE,
        "message": simulation.message,
    }


@cache
def _compile(spec: ModelSpec) -> None:
    """Makes a short run once in each process, so that compilation and mesh setup are not timed."""
    compiling = PadMotion(np.array([0.0, 1.0]), np.array([0.0, 1e-4]))
    simulate(replace(spec, tolerance=1.0), compiling, healthy_skin.POINTS["C"])


def _no_run(status: str, message: str, cpu_s: float) -> Item:
    """Returns the result columns of a run that gave no force."""
    return {
        "status": status, "finite": False, "peak_n": np.nan, "end_s": np.nan, "steps": 0, "factorisations": 0,
        "falls": 0, "cpu_s": cpu_s, "code": rows.CODE, "message": message,
    }  # fmt: skip


def run_all(spec: ModelSpec, items: Sequence[Item], workers: int) -> list[rows.Row]:
    """Returns the rows of all items, including those that were finished before."""
    table_rows = {ROWS.key_of(row): row for row in ROWS.read()}
    remaining = [item for item in items if ROWS.key_of(item) not in table_rows]
    rows.say(f"{len(items) - len(remaining)} of {len(items)} runs are finished already")
    for done, (i, result) in enumerate(run_parallel(partial(perform, spec), remaining, workers), start=1):
        row = remaining[i] | _no_run("lost", result.reason, np.nan) if isinstance(result, Lost) else result
        table_rows[ROWS.key_of(row)] = ROWS.append(**row)
        if row["status"] != "ok" or done % 20 == 0 or done == len(remaining):
            rows.say(
                f"{done} of {len(remaining)}: {row['box']} {row['index']} {row['status']} {row['message']}"
            )
    return [table_rows[ROWS.key_of(item)] for item in items]


def summary(by_box: dict[str, list[rows.Row]]) -> str:
    """Returns a table of finished and failed runs and of CPU times, by box."""
    header = ["box", "runs", "finished", "failed", "with NaN or infinite force", "finished after folding"]
    header += ["CPU s a run: median", "95 %", "largest"]
    lines = []
    for box, runs in by_box.items():
        finished = sum(r["status"] == "ok" for r in runs)
        seconds = np.array([float(r["cpu_s"]) for r in runs])
        spread = [np.nanmedian(seconds), np.nanquantile(seconds, 0.95), np.nanmax(seconds)]
        not_finite = sum(r["finite"] != "True" for r in runs)
        after_falls = sum(r["status"] == "ok" and int(r["falls"]) > 0 for r in runs)
        lines.append(
            [
                box,
                *map(str, (len(runs), finished, len(runs) - finished, not_finite, after_falls)),
                *(f"{s:.2f}" for s in spread),
            ]
        )
    return rows.markdown(header, lines)


def failures(by_box: dict[str, list[rows.Row]]) -> str:
    """Returns a table of the failed runs with their parameters."""
    failed = [r for runs in by_box.values() for r in runs if r["status"] != "ok" or r["finite"] != "True"]
    if not failed:
        return "No run failed."
    cells = [
        [r["box"], r["index"], *(f"{float(r[n]):.3g}" for n in NAMES), r["end_s"], r["status"], r["message"]]
        for r in failed
    ]
    return rows.markdown(["box", "index", *NAMES, "time [s]", "status", "message"], cells)


@styled
def figure_robustness(by_box: dict[str, list[rows.Row]], mesh: str) -> Figure:
    """Returns the figure: the failed runs by the two ratios that govern them, and the CPU times."""
    figure = new_figure(PAGE_IN, 2.9)
    axes = figure.subplots(1, len(by_box) + 1)
    for letter, ax, (box, runs) in zip("abc", axes, by_box.items(), strict=False):
        _draw_box(ax, runs)
        panel_title(ax, letter, f"{box} box, {len(runs)} runs")
    for (box, runs), colour in zip(by_box.items(), (INK, "#0072B2"), strict=False):
        seconds = np.sort([float(r["cpu_s"]) for r in runs])
        axes[-1].step(
            seconds, 100 * np.arange(1, len(runs) + 1) / len(runs), color=colour, where="post", label=box
        )
    axes[-1].set(
        xscale="log", xlabel="CPU time of a run [s]", ylabel="runs that took no longer [%]", ylim=(0, 102)
    )
    plain_log(axes[-1].xaxis)
    axes[-1].legend(loc="lower right")
    panel_title(axes[-1], "c", "cost")
    failed = sum(r["status"] != "ok" for runs in by_box.values() for r in runs)
    total = sum(map(len, by_box.values()))
    state_finding(
        figure, f"{total - failed} of {total} runs at random parameters finish",
        f"Each point is a full run over the healthy-skin protocol on {mesh}; crosses failed. "
        "Slow drainage is on the left.",
    )  # fmt: skip
    return figure


def _draw_box(ax: Axes, its: Sequence[rows.Row]) -> None:
    """Draws the runs of one box over k_s E_s and E_s / E_c."""
    values = {name: np.array([float(r[name]) for r in its]) for name in NAMES}
    x, y = values["k_s"] * values["E_s"], values["E_s"] / values["E_c"]
    finished = np.array([r["status"] == "ok" for r in its])
    ax.scatter(x[finished], y[finished], s=4, color="#0072B2", lw=0)
    ax.scatter(x[~finished], y[~finished], s=16, marker="x", color=ACCENT, lw=0.9)
    ax.set(xscale="log", yscale="log", xlabel="$k_s E_s$ [N]", ylabel="$E_s / E_c$")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_minor_formatter(NullFormatter())


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--n", type=int, default=500, help="number of points in each box (default 500)")
    parser.add_argument("--refinement", type=int, choices=(0, 1), default=1, help="refinement of the bricks")
    parser.add_argument("--workers", type=int, default=2)
    return parser.parse_args()


def main() -> None:
    args = arguments()
    spec, mesh = ModelSpec(refinement=args.refinement), ("80 bricks", "448 bricks")[args.refinement]
    shared = {"protocol": "whole", "seed": SEED, "model_hash": spec.hash}
    points_of = {box: points(space, args.n, SEED) for box, space in boxes().items()}
    # The boxes alternate, so that a count that was stopped has points of both.
    items = [
        {**shared, "box": box, "index": index, **theta}
        for index, pair in enumerate(zip(*points_of.values(), strict=True))
        for box, theta in zip(points_of, pair, strict=True)
    ]
    finished = run_all(spec, items, args.workers)
    rows.warn_of_mixed_code(finished)
    rows_by_box = {box: [r for r in finished if r["box"] == box] for box in boxes()}
    print(f"seed {SEED}\n\n{summary(rows_by_box)}\n\n{failures(rows_by_box)}")
    stem = f"robustness-{mesh.replace(' ', '-')}"
    save_figure(figure_robustness(rows_by_box, mesh), FIGURES / stem, "benchmarks/robustness.py")


if __name__ == "__main__":
    main()
