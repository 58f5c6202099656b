"""How many full runs fail at random parameters, and how long one takes.

N points of each of two boxes, independent and seeded: the article's (E 10 kPa..500 MPa, k 1e-16..1e-10 m^2 in
both layers, log-uniform, as in its text; p_init as default) and the default prior box. Each is run with the
`reaction` on the default mesh over the whole healthy-skin protocol (benchmarks/healthy_skin.py). Counts
finished and failed runs, lists every failure with its parameters, and checks that all forces are finite.

    python benchmarks/robustness.py                  # on the default mesh, some hours
    python benchmarks/robustness.py --refinement 0   # on 80 bricks

Finished runs are rows of benchmarks/results/robustness.csv, which a later start does not repeat; more points
keep those already run. Draws docs/figures/robustness-80-bricks.{png,svg} or -448-bricks.
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
    """The article's text's box, and the default."""
    default = default_space()
    wide = {"E": (10e3, 500e6), "k": (1e-16, 1e-10)}
    article = [
        replace(p, lower=wide[p.name[0]][0], upper=wide[p.name[0]][1]) if p.name[0] in wide else p
        for p in default.parameters
    ]
    return {"article": ParameterSpace(tuple(article)), "default": default}


def points(space: ParameterSpace, n: int, seed: int) -> list[dict[str, float]]:
    """The first n of the seed's points."""
    unit = np.random.default_rng(seed).random((n, space.dim))
    return [dict(zip(space.names, map(float, row), strict=True)) for row in space.from_unit(unit)]


def perform(spec: ModelSpec, item: Item) -> Item:
    """One run as a row; what it raises, which it never should, is a failure too."""
    motion = healthy_skin.HEALTHY_SKIN
    motion = healthy_skin.first_cycle(motion) if item["protocol"] == "first cycle" else motion
    theta = {name: item[name] for name in NAMES}
    _compile(spec)
    started = time.process_time()
    try:
        found = simulate(spec, motion, theta)
    except Exception as error:  # one run must not end the count
        return item | _no_run("raised", f"{type(error).__name__}: {error}", time.process_time() - started)
    return item | {
        "status": found.status,
        "finite": bool(np.isfinite(found.force_n).all()),
        "peak_n": found.stats["peak_force_n"],
        "end_s": float(found.time_s[-1]),
        "steps": int(found.stats["steps"]),
        "factorisations": int(found.stats["factorisations"]),
        "falls": int(found.stats["falls"]),
        "cpu_s": time.process_time() - started,
        "code": rows.CODE,
        "message": found.message,
    }


@cache
def _compile(spec: ModelSpec) -> None:
    """A short run, once a process, so that no time is that of compiling and of building the mesh's space."""
    compiling = PadMotion(np.array([0.0, 1.0]), np.array([0.0, 1e-4]))
    simulate(replace(spec, tolerance=1.0), compiling, healthy_skin.POINTS["C"])


def _no_run(status: str, message: str, cpu_s: float) -> Item:
    return {
        "status": status, "finite": False, "peak_n": np.nan, "end_s": np.nan, "steps": 0, "factorisations": 0,
        "falls": 0, "cpu_s": cpu_s, "code": rows.CODE, "message": message,
    }  # fmt: skip


def run_all(spec: ModelSpec, items: Sequence[Item], table: rows.Rows, workers: int) -> list[rows.Row]:
    """Rows of all items, those that are there already among them."""
    there = {table.key_of(row): row for row in table.read()}
    todo = [item for item in items if table.key_of(item) not in there]
    rows.say(f"{len(items) - len(todo)} of {len(items)} runs are there already")
    for done, (i, result) in enumerate(run_parallel(partial(perform, spec), todo, workers), start=1):
        row = todo[i] | _no_run("lost", result.reason, np.nan) if isinstance(result, Lost) else result
        there[table.key_of(row)] = table.append(**row)
        if row["status"] != "ok" or done % 20 == 0 or done == len(todo):
            rows.say(f"{done} of {len(todo)}: {row['box']} {row['index']} {row['status']} {row['message']}")
    return [there[table.key_of(item)] for item in items]


def summary(found: dict[str, list[rows.Row]]) -> str:
    header = ["box", "runs", "finished", "failed", "with NaN or infinite force", "finished after falls"]
    header += ["CPU s a run: median", "95 %", "largest"]
    lines = []
    for box, its in found.items():
        ok = sum(r["status"] == "ok" for r in its)
        seconds = np.array([float(r["cpu_s"]) for r in its])
        spread = [np.nanmedian(seconds), np.nanquantile(seconds, 0.95), np.nanmax(seconds)]
        bad = sum(r["finite"] != "True" for r in its)
        fell = sum(r["status"] == "ok" and int(r["falls"]) > 0 for r in its)
        lines.append(
            [box, *map(str, (len(its), ok, len(its) - ok, bad, fell)), *(f"{s:.2f}" for s in spread)]
        )
    return rows.markdown(header, lines)


def failures(found: dict[str, list[rows.Row]]) -> str:
    its = [r for rs in found.values() for r in rs if r["status"] != "ok" or r["finite"] != "True"]
    if not its:
        return "No run failed."
    cells = [
        [r["box"], r["index"], *(f"{float(r[n]):.3g}" for n in NAMES), r["end_s"], r["status"], r["message"]]
        for r in its
    ]
    return rows.markdown(["box", "index", *NAMES, "time [s]", "status", "message"], cells)


@styled
def figure_robustness(found: dict[str, list[rows.Row]], mesh: str) -> Figure:
    """Where runs failed, by the two ratios that govern them, and the CPU time of all."""
    figure = new_figure(PAGE_IN, 2.9)
    axes = figure.subplots(1, len(found) + 1)
    for letter, ax, (box, its) in zip("abc", axes, found.items(), strict=False):
        _draw_box(ax, its)
        panel_title(ax, letter, f"{box} box, {len(its)} runs")
    for (box, its), colour in zip(found.items(), (INK, "#0072B2"), strict=False):
        seconds = np.sort([float(r["cpu_s"]) for r in its])
        axes[-1].step(
            seconds, 100 * np.arange(1, len(its) + 1) / len(its), color=colour, where="post", label=box
        )
    axes[-1].set(
        xscale="log", xlabel="CPU time of a run [s]", ylabel="runs that took no longer [%]", ylim=(0, 102)
    )
    plain_log(axes[-1].xaxis)
    axes[-1].legend(loc="lower right")
    panel_title(axes[-1], "c", "cost")
    failed = sum(r["status"] != "ok" for its in found.values() for r in its)
    total = sum(map(len, found.values()))
    state_finding(
        figure, f"{total - failed} of {total} runs at random parameters finish",
        f"Each point is a full run over the healthy-skin protocol on {mesh}; crosses failed. "
        "Slow drainage is on the left.",
    )  # fmt: skip
    return figure


def _draw_box(ax: Axes, its: Sequence[rows.Row]) -> None:
    values = {name: np.array([float(r[name]) for r in its]) for name in NAMES}
    x, y = values["k_s"] * values["E_s"], values["E_s"] / values["E_c"]
    ok = np.array([r["status"] == "ok" for r in its])
    ax.scatter(x[ok], y[ok], s=4, color="#0072B2", lw=0)
    ax.scatter(x[~ok], y[~ok], s=16, marker="x", color=ACCENT, lw=0.9)
    ax.set(xscale="log", yscale="log", xlabel="$k_s E_s$ [N]", ylabel="$E_s / E_c$")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_minor_formatter(NullFormatter())


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--n", type=int, default=500, help="points of each box (default 500)")
    parser.add_argument("--refinement", type=int, choices=(0, 1), default=1, help="of the bricks")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--first-cycle", action="store_true", help="the first cycle of the protocol only")
    parser.add_argument("--results", type=Path, default=rows.RESULTS)
    parser.add_argument("--figures", type=Path, default=FIGURES)
    return parser.parse_args()


def main() -> None:
    asked = arguments()
    spec, mesh = ModelSpec(refinement=asked.refinement), ("80 bricks", "448 bricks")[asked.refinement]
    table = replace(ROWS, path=asked.results / ROWS.path.name)
    same = {
        "protocol": "first cycle" if asked.first_cycle else "whole",
        "seed": asked.seed,
        "model_hash": spec.hash,
    }
    drawn = {box: points(space, asked.n, asked.seed) for box, space in boxes().items()}
    items = [
        {**same, "box": box, "index": index, **theta}
        for index, both in enumerate(zip(*drawn.values(), strict=True))  # a partial count has some of each
        for box, theta in zip(drawn, both, strict=True)
    ]
    done = run_all(spec, items, table, asked.workers)
    rows.warn_of_mixed_code(done)
    found = {box: [r for r in done if r["box"] == box] for box in boxes()}
    print(f"seed {asked.seed}\n\n{summary(found)}\n\n{failures(found)}")
    stem = f"robustness-{mesh.replace(' ', '-')}"
    save_figure(figure_robustness(found, mesh), asked.figures / stem, "benchmarks/robustness.py")


if __name__ == "__main__":
    main()
