"""Measures what one full run costs, stage by stage, and compares it with its factorisations and solves alone.

The run is the `reaction` at point C over the whole healthy-skin protocol (benchmarks/healthy_skin.py) with
the default tolerance, on the default bricks. Where the environment variable BAYESKIN_SUPPLEMENT names the
folder above the supplement's `data/`, the article's mesh is measured too. Each run has a fresh process with
one thread. A short run before it compiles the code. The CPU seconds are counted by stage:

    evaluation       fields at the quadrature points from the unknowns
    law              stress, fluid content and flux at these points, and their derivatives
    residual         assembly of the residual
    tangent          assembly of the tangent stiffness
    analysis         the first factorisation, with the ordering
    factorisation    all other factorisations
    solve            back-substitution
    rest             everything else (Python, NumPy)

A second run with the force's derivatives by the parameters shows what these cost in addition.

The floor is the time of one factorisation and one solve, each multiplied by how many the run needed. Both
times are medians, measured alone on the last tangent of the run. The article's script takes about 3,600 CPU s
for its 694 steps on one core. This number was given to the project; the script is not run here.

    python benchmarks/forward_benchmark.py

Finished runs are rows of benchmarks/results/forward.csv. A later start does not repeat them, unless the
source of the model has changed. The program prints medians and draws docs/figures/forward.{png,svg}.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import healthy_skin
import numpy as np
import rows
import scipy.sparse as sp

from bayeskin.execution.local import Lost, run_parallel
from bayeskin.finite_element import assembly, linear, newton, poroelastic, simulate
from bayeskin.finite_element.gradients import ForceGradients, logarithms
from bayeskin.finite_element.linear import SOLVER_NAME, Factorisations
from bayeskin.finite_element.simulate import ModelSpec, problem_of
from bayeskin.types import Array, PadMotion

ARTICLE_CPU_S = 3600.0  # not measured here, for 694 steps; see above
STAGES = ("evaluation", "law", "residual", "tangent", "analysis", "factorisation", "solve", "rest")
FACTORISATIONS_ALONE, SOLVES_ALONE = 5, 30
MESHES, PROTOCOL = ("bricks-1", "Mesh_SKIN.msh"), "whole"
FIGURES = Path(__file__).parents[1] / "docs" / "figures"
ROWS = rows.Rows(
    rows.RESULTS / "forward.csv",
    ("protocol", "mesh", "tolerance", "repeat", "model_hash", "code"),
    (
        "status", "linear_solver", "cells", "dofs", "steps", "iterations", "cpu_s",
        *(f"{stage}_s" for stage in STAGES), *(f"{stage}_count" for stage in STAGES[:-1]),
        "one_factorisation_s", "one_solve_s", "floor_s", "factor_bytes", "matrix_entries",
        "peak_memory_bytes", "gradients_s",
    ),
)  # fmt: skip


@dataclass
class Clock:
    """Counts CPU seconds and calls by stage."""

    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(STAGES, 0.0))
    counts: dict[str, int] = field(default_factory=lambda: dict.fromkeys(STAGES, 0))

    def timed(self, stage: str, action: Callable[..., Any]) -> Callable[..., Any]:
        """Returns the action so that each call adds its time and its number to a stage."""

        def wrapper(*args: Any) -> Any:
            started = time.process_time()
            try:
                return action(*args)
            finally:
                self.seconds[stage] += time.process_time() - started
                self.counts[stage] += 1

        return wrapper


class TimedFactorisations:
    """Wraps factorisations so that a clock counts their stages; keeps the last matrix."""

    def __init__(self, inner: Factorisations, clock: Clock) -> None:
        self.inner = inner
        self.next, self.later = (
            clock.timed(stage, inner.factorise) for stage in ("analysis", "factorisation")
        )
        self.solve, self.release = clock.timed("solve", inner.solve), inner.release

    @property
    def room(self) -> int:
        return self.inner.room

    def factorise(self, number: int, matrix: sp.csr_matrix, scale: Array) -> None:
        self.next(number, matrix, scale)
        self.next, self.last = self.later, (matrix, scale)


@contextmanager
def on_the_clock(clock: Clock) -> Iterator[list[TimedFactorisations]]:
    """Replaces the model's stages by timed ones; yields a list that will hold its factorisations."""
    timed_factorisations: list[TimedFactorisations] = []

    def factorisations(symmetric: bool) -> TimedFactorisations:
        timed_factorisations.append(TimedFactorisations(linear.factorisations(symmetric), clock))
        return timed_factorisations[-1]

    stages = (
        (assembly, "evaluate", "evaluation"), (assembly, "residual", "residual"),
        (assembly, "tangent", "tangent"), (poroelastic, "respond", "law"), (poroelastic, "linearise", "law"),
    )  # fmt: skip
    with ExitStack() as patches:
        patches.enter_context(mock.patch.object(newton, "factorisations", factorisations))
        for module, name, stage in stages:
            action = clock.timed(stage, getattr(module, name))
            patches.enter_context(mock.patch.object(module, name, action))
        yield timed_factorisations


def measure(item: tuple[str, int]) -> dict[str, Any]:
    """Returns one row for (mesh, repeat); runs in a process of its own."""
    mesh, repeat = item
    motion, theta = healthy_skin.HEALTHY_SKIN, healthy_skin.POINTS["C"]
    with healthy_skin.spec_on(mesh, ModelSpec().tolerance) as spec:
        compiling = PadMotion(np.array([0.0, 1.0]), np.array([0.0, 1e-4]))
        simulate(ModelSpec(tolerance=1.0), compiling, theta, gradients=logarithms(theta))
        # A process builds the problem once for all of its runs, so this is not timed.
        problem = problem_of(spec.mesh, spec.refinement)
        clock = Clock()
        with on_the_clock(clock) as timed_factorisations:
            started = time.process_time()
            run = simulate(spec, motion, theta, rows.progress(mesh))
            cpu_s = time.process_time() - started
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        derivatives_s = gradients_s(spec, motion, theta)
    clock.seconds["rest"] = cpu_s - sum(clock.seconds.values())
    matrix, scale = timed_factorisations[0].last
    factorisation_s, solve_s, factor_bytes = alone(matrix, scale)
    factorisations = clock.counts["factorisation"] + clock.counts["analysis"]
    return {
        "protocol": PROTOCOL, "mesh": mesh, "repeat": repeat, "tolerance": spec.tolerance,
        "model_hash": run.model_hash, "code": rows.CODE, "status": run.status,
        "linear_solver": SOLVER_NAME, "cells": problem.mesh.geometry.nelements, "dofs": problem.space.dofs,
        "steps": int(run.stats["steps"]), "iterations": int(run.stats["iterations"]), "cpu_s": cpu_s,
        **{f"{stage}_s": seconds for stage, seconds in clock.seconds.items()},
        **{f"{stage}_count": count for stage, count in clock.counts.items()},
        "one_factorisation_s": factorisation_s, "one_solve_s": solve_s,
        "floor_s": factorisations * factorisation_s + clock.counts["solve"] * solve_s,
        "factor_bytes": factor_bytes, "matrix_entries": matrix.nnz, "peak_memory_bytes": memory,
        "gradients_s": derivatives_s,
    }  # fmt: skip


def gradients_s(spec: ModelSpec, motion: PadMotion, theta: dict[str, float]) -> float:
    """Returns the CPU seconds that the force's derivatives take along a run."""
    clock = Clock()
    clock.seconds["gradients"], clock.counts["gradients"] = 0.0, 0
    follow = clock.timed("gradients", ForceGradients.follow)
    with mock.patch.object(ForceGradients, "follow", follow):
        simulate(spec, motion, theta, gradients=logarithms(theta))
    return clock.seconds["gradients"]


def alone(matrix: sp.csr_matrix, scale: Array) -> tuple[float, float, int]:
    """Returns the CPU seconds of one factorisation and of one solve, and the factors' size in bytes."""
    factors, right = linear.factorisations(True), np.random.default_rng(0).normal(size=matrix.shape[0])
    factors.factorise(0, matrix, scale)  # not timed, because it also analyses the pattern
    factorisation_s = _median_s(lambda: factors.factorise(0, matrix, scale), FACTORISATIONS_ALONE)
    solve_s = _median_s(lambda: factors.solve(0, right), SOLVES_ALONE)
    size = factors.bytes_each
    factors.release()
    return factorisation_s, solve_s, size


def _median_s(action: Callable[[], Any], times: int) -> float:
    """Returns the median CPU seconds of some calls."""
    seconds = []
    for _ in range(times):
        started = time.process_time()
        action()
        seconds.append(time.process_time() - started)
    return float(np.median(seconds))


def medians(measured: Sequence[rows.Row]) -> dict[str, dict[str, float]]:
    """Returns the medians over repeats of every number, by mesh."""
    numbers = [name for name in ROWS.values if name not in ("status", "linear_solver")]
    return {
        mesh: {n: float(np.median([float(r[n]) for r in measured if r["mesh"] == mesh])) for n in numbers}
        for mesh in dict.fromkeys(r["mesh"] for r in measured)
    }


def table(by_mesh: dict[str, dict[str, float]]) -> str:
    """Returns the medians as a table with one column for each mesh."""
    lines = [["CPU s", *(f"{m['cpu_s']:.2f}" for m in by_mesh.values())]]
    ratios = [f"{ARTICLE_CPU_S / m['cpu_s']:.0f}" for m in by_mesh.values()]
    lines.append([f"ratio of the article's {ARTICLE_CPU_S:.0f} CPU s to these", *ratios])
    lines.append(["cells, unknowns", *(f"{m['cells']:.0f}, {m['dofs']:.0f}" for m in by_mesh.values())])
    lines.append(
        ["steps, iterations", *(f"{m['steps']:.0f}, {m['iterations']:.0f}" for m in by_mesh.values())]
    )
    for stage in STAGES:
        calls = [f" ({m[f'{stage}_count']:.0f} calls)" if stage != "rest" else "" for m in by_mesh.values()]
        lines.append(
            [
                f"{stage} [s]",
                *(f"{m[f'{stage}_s']:.2f}{n}" for m, n in zip(by_mesh.values(), calls, strict=True)),
            ]
        )
    alone_ms = [(1e3 * m["one_factorisation_s"], 1e3 * m["one_solve_s"]) for m in by_mesh.values()]
    lines.append(["one factorisation, one solve, alone [ms]", *(f"{a:.0f}, {b:.1f}" for a, b in alone_ms)])
    lines.append(
        ["floor: these times the number of calls [s]", *(f"{m['floor_s']:.2f}" for m in by_mesh.values())]
    )
    lines.append(
        [
            "ratio of the run's CPU s to the floor",
            *(f"{m['cpu_s'] / m['floor_s']:.2f}" for m in by_mesh.values()),
        ]
    )
    lines.append(["derivatives [CPU s]", *(f"{m['gradients_s']:.2f}" for m in by_mesh.values())])
    shares = [f"{m['gradients_s'] / m['cpu_s']:.2f}" for m in by_mesh.values()]
    lines.append(["ratio of derivatives to the run", *shares])
    lines.append(["factors [MB]", *(f"{m['factor_bytes'] / 1e6:.1f}" for m in by_mesh.values())])
    rate = [2 * m["factor_bytes"] / m["one_solve_s"] / 1e9 for m in by_mesh.values()]
    lines.append(["rate of reading the factors twice per solve [GB/s]", *(f"{r:.1f}" for r in rate)])
    memory = [m["peak_memory_bytes"] / 2**20 for m in by_mesh.values()]
    lines.append(["peak memory of the process [MiB]", *(f"{b:.0f}" for b in memory)])
    return rows.markdown(["", *by_mesh], lines)


def main() -> None:
    # Not imported above, so that plotting does not count in the memory of the measured processes.
    from forward_figure import figure_forward

    from bayeskin.report import save_figure

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    supplement = healthy_skin.supplement_mesh("") is not None
    table_rows = []
    for mesh in [m for m in MESHES if supplement or m not in healthy_skin.GMSH_MESHES]:
        with healthy_skin.spec_on(mesh, ModelSpec().tolerance) as spec:
            same = {"tolerance": spec.tolerance, "model_hash": spec.hash, "code": rows.CODE}
        for repeat in range(options.repeats):
            row = ROWS.find(protocol=PROTOCOL, mesh=mesh, repeat=repeat, **same)
            if row is None:
                rows.say(f"{mesh}, repeat {repeat}")
                _, measured = next(run_parallel(measure, [(mesh, repeat)], 1))
                if isinstance(measured, Lost):
                    raise SystemExit(f"{mesh}: {measured.reason}")
                row = ROWS.append(**measured)
            table_rows.append(row)
    by_mesh = medians(table_rows)
    print(table(by_mesh))
    save_figure(figure_forward(by_mesh, STAGES), FIGURES / "forward", "benchmarks/forward_benchmark.py")


if __name__ == "__main__":
    main()
