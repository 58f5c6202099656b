"""Measures the error of the `reaction` against cells and time steps, and chooses mesh and tolerance.

The study uses three points of the prior box (A, C and soft: benchmarks/healthy_skin.py). An error is the
difference between two force histories every 0.1 s. Its RMS and its largest value are given relative to the
peak of the reference.

- Time: bricks-1 is run with several tolerances. The reference has a tolerance of 1e-6, a nonlinear solver
  1000 times tighter, at least 40 steps in each phase, and steps as short as needed. The tolerance is chosen
  on two cycles of 9.4 mm (named `demo`) and tested on the healthy-skin protocol.
- Space: bricks-1, bricks-2 and the article's mesh are run over the whole healthy-skin protocol. Finer meshes
  are run over its first cycle: the reference, bricks-3, and bricks-1 with every edge of every brick halved,
  among others. Still finer meshes are run over the first loading alone, which shows how far the reference
  itself is from convergence. The article's meshes are in the supplement. The environment variable
  BAYESKIN_SUPPLEMENT names the folder above its `data/`; where it is not set, these meshes are left out.
- The runs in space also record at each step the normal stress sigma_xx - p, integrated over the pad's top
  face and not doubled. It is the total-Lagrangian analogue of the article's force, and stands beside the
  reaction.

    OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 python benchmarks/discretisation_study.py

A study that was stopped continues where it ended: finished runs are rows of
benchmarks/results/discretisation.csv, and their histories are stored beside it. The study writes the tables
between the markers of docs/discretisation.md, and draws docs/figures/discretisation.{png,svg}. It also writes
the meshes' errors into bayeskin/finite_element/discretisation.json, from which `bayeskin simulate` reports
them.
"""

from __future__ import annotations

import json
import time
from contextlib import ExitStack
from dataclasses import replace
from itertools import product
from pathlib import Path
from unittest import mock

import healthy_skin
import numpy as np
import rows
import skfem
from discretisation_figure import figure_discretisation
from discretisation_tables import (
    LOADING,
    SPACE_REFERENCE,
    SPACE_TOLERANCE,
    Error,
    Result,
    Run,
    error,
    mesh_errors,
    peak_table,
    space_errors,
    space_table,
    time_table,
    verdict,
    whole_table,
)

from bayeskin import storage
from bayeskin.errors import InputError
from bayeskin.finite_element import accuracy, lagrangian, simulate, stepping
from bayeskin.finite_element.problem import Problem, material
from bayeskin.finite_element.simulate import ModelSpec, problem_of
from bayeskin.report import save_figure
from bayeskin.types import Array, PadMotion, Simulation

TOLERANCES = (3e-2, 1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5)
TIME_REFERENCE, TIME_CHECK = 1e-6, 1e-5
TIME_TARGET, MESH_TARGET = 5e-4, 0.005  # required RMS errors over the peak
POINTS, CYCLE = list(healthy_skin.POINTS), "healthy, first cycle"
SETTINGS = {
    "as run": {},
    "reference": {
        (lagrangian, "SOLVER_TOLERANCE"): 1e-7,
        (stepping, "STEPPING"): stepping.StepSettings(shortest=1e-6, steps_per_phase=40),
    },
}
WHOLE_MESHES = ("bricks-1", "bricks-2", "Mesh_SKIN.msh")
CYCLE_MESHES = ("bricks-1-halved", "Symmetric_skin_XY_RF.msh")
LOADING_MESHES = ("bricks-4",)
DOCS = Path(__file__).parents[1] / "docs"
ROWS = rows.Rows(
    rows.RESULTS / "discretisation.csv",
    ("protocol", "point", "mesh", "tolerance", "settings", "model_hash"),
    (
        "status",
        "cells",
        "dofs",
        "steps",
        "factorisations",
        "iterations",
        "cpu_s",
        "peak_n",
        "code",
        "message",
    ),
)


def two_cycles() -> PadMotion:
    """Returns a protocol of two cycles of 9.4 mm at 1 mm/s, which was that of the demo until it changed."""
    corners_s = [0.0, 5.0, 14.4, 45.0, 54.4, 65.0, 74.4, 105.0, 114.4, 130.0]
    heights_mm = [0.0, 0.0, 9.4, 9.4, 0.0, 0.0, 9.4, 9.4, 0.0, 0.0]
    return PadMotion(np.array(corners_s), 1e-3 * np.array(heights_mm))


def motions() -> dict[str, PadMotion]:
    """Returns all protocols of the study by their names."""
    healthy = healthy_skin.HEALTHY_SKIN
    return {
        "demo": two_cycles(),
        "healthy": healthy,
        CYCLE: healthy_skin.first_cycle(healthy),
        LOADING: PadMotion(np.array([0.0, 9.4]), np.array([0.0, 9.45e-3])),
    }


def perform(run: Run) -> Result:
    """Returns the result of a run; simulates the run where the table or its histories lack it."""
    try:
        with healthy_skin.spec_on(run.mesh, run.tolerance) as spec:
            inputs = vars(run) | {"model_hash": spec.hash}
            stem = ROWS.path.with_suffix("") / rows.digest(inputs)
            row = ROWS.find(**inputs)
            if row is None or (row["status"] == "ok" and not stem.with_suffix(".stress.h5").is_file()):
                row = _simulate(run, spec, stem)
    except InputError as error:  # the mesh does not exist or cannot be read
        return Result(run, {"status": "not run", "message": str(error)})
    if row["status"] != "ok":
        return Result(run, row)
    histories = [storage.load(stem.with_suffix(end), Simulation) for end in (".force.h5", ".stress.h5")]
    return Result(run, row, *histories)


def _simulate(run: Run, spec: ModelSpec, stem: Path) -> rows.Row:
    """Simulates a run, saves its histories beside the table, and appends its row."""
    rows.say(f"{run.protocol}, point {run.point}, {run.mesh}, tolerance {run.tolerance:g}, {run.settings}")
    theta, problem = healthy_skin.POINTS[run.point], problem_of(spec.mesh, spec.refinement)
    face = FaceStress(problem, theta)
    stress: list[float] = []
    with ExitStack() as patches:
        for (module, name), value in SETTINGS[run.settings].items():
            patches.enter_context(mock.patch.object(module, name, value))
        started = time.process_time()
        simulation = simulate(
            spec, motions()[run.protocol], theta, rows.progress(run.mesh),
            lambda _time, x, _force: stress.append(face.force_n(x)),
        )  # fmt: skip
        seconds = time.process_time() - started
    storage.save(stem.with_suffix(".force.h5"), simulation)
    storage.save(stem.with_suffix(".stress.h5"), replace(simulation, force_n=np.array(stress)))
    return ROWS.append(
        **vars(run),
        model_hash=spec.hash,
        status=simulation.status,
        cells=problem.mesh.geometry.nelements,
        dofs=problem.space.dofs,
        steps=int(simulation.stats["steps"]),
        factorisations=int(simulation.stats["factorisations"]),
        iterations=int(simulation.stats["iterations"]),
        cpu_s=round(seconds, 2),
        peak_n=simulation.stats["peak_force_n"],
        code=rows.CODE,
        message=simulation.message,
    )


class FaceStress:
    """Integrates sigma_xx - p over the pad's top face [N].

    The face is clamped, so its area does not change.
    """

    def __init__(self, problem: Problem, theta: dict[str, float]) -> None:
        mesh, bricks = problem.mesh.geometry, isinstance(problem.mesh.geometry, skfem.MeshHex)
        quadratic = skfem.ElementHex2() if bricks else skfem.ElementTetP2()
        linear = skfem.ElementHex1() if bricks else skfem.ElementTetP1()
        self._u = skfem.FacetBasis(
            mesh, quadratic, problem.mesh.facet_mapping(), facets=problem.mesh.facets["pad"], intorder=6
        )
        self._p = self._u.with_element(linear)
        self._n = 3 * problem.space.n_nodes
        cells = material(theta, problem.mesh.cutis)
        self._mu, self._lam = (c[self._u.tind][:, None] for c in (cells.mu, cells.lam))

    def force_n(self, x: Array) -> float:
        """Returns the integral [N] at the unknowns x (dofs,)."""
        gradient = np.stack([self._u.interpolate(x[i : self._n : 3]).grad for i in range(3)])
        f = np.eye(3) + gradient.transpose(2, 3, 0, 1)  # (facets, points, 3, 3)
        j = np.linalg.det(f)
        stretch = np.sum(f[..., 0, :] ** 2, axis=-1)
        stress = (self._mu * (stretch - 1.0) + self._lam * np.log(j)) / j
        return float(np.sum((stress - np.asarray(self._p.interpolate(x[self._n :]))) * self._u.dx))


def time_study() -> tuple[dict[str, dict[tuple[float, str], Error]], dict[str, dict[str, Error]]]:
    """Returns the errors by protocol, then by tolerance and point; and the errors of the reference itself.

    The latter are by protocol and point. They compare the reference with a run of ten times its tolerance.
    """
    names = ("demo", "healthy")
    errors: dict[str, dict[tuple[float, str], Error]] = {name: {} for name in names}
    reference_errors: dict[str, dict[str, Error]] = {name: {} for name in names}
    for name, point in product(names, POINTS):
        reference, check = (
            perform(Run(name, point, tolerance=t, settings="reference")) for t in (TIME_REFERENCE, TIME_CHECK)
        )
        if not (reference.force and check.force):
            rows.say(f"no reference: {reference.row['message'] or check.row['message']}")
            continue
        reference_errors[name][point] = error(check.force, reference.force)
        for tolerance in TOLERANCES:
            result = perform(Run(name, point, tolerance=tolerance))
            if result.force:
                errors[name][tolerance, point] = error(result.force, reference.force)
    return errors, reference_errors


def space_study() -> list[Result]:
    """Returns the results of all runs in space, including those of the reference; cheap runs come first."""
    runs = [Run("healthy", point, mesh) for mesh in WHOLE_MESHES for point in POINTS]
    runs += [Run(CYCLE, point, mesh) for mesh in (*CYCLE_MESHES, SPACE_REFERENCE) for point in POINTS]
    loading_meshes = ("bricks-1", "bricks-1-halved", "bricks-2", SPACE_REFERENCE, *LOADING_MESHES)
    runs += [Run(LOADING, "C", mesh) for mesh in loading_meshes]
    supplement = healthy_skin.supplement_mesh("") is not None
    return [perform(run) for run in runs if supplement or run.mesh not in healthy_skin.GMSH_MESHES]


def write_mesh_errors(errors: dict[str, dict[str, float]]) -> None:
    """Writes the errors into the package by the mesh's hash, where `bayeskin simulate` looks them up."""
    by_hash = {}
    for name, mesh_error in errors.items():
        with healthy_skin.spec_on(name, SPACE_TOLERANCE) as spec:
            rounded = {key: float(f"{value:.3g}") for key, value in mesh_error.items()}
            by_hash[problem_of(spec.mesh, spec.refinement).mesh.hash] = {"mesh": name, **rounded}
    path = Path(accuracy.__file__).with_name(accuracy.FILE)
    path.write_text(json.dumps(by_hash, indent=2) + "\n")


def main() -> None:
    (times, reference_errors), results = time_study(), space_study()
    rows.warn_of_mixed_code(ROWS.read())
    parts = [
        f"Time, `{name}`:\n\n{time_table(errors, reference_errors[name], POINTS)}"
        for name, errors in times.items()
    ]
    parts += [
        f"Space, first cycle, against {SPACE_REFERENCE}:\n\n{space_table(results, POINTS)}",
        f"Space, whole protocol, against bricks-2:\n\n{whole_table(results, POINTS)}",
        f"Reaction and face stress at point C:\n\n{peak_table(results)}",
        verdict(times, results, TIME_TARGET, MESH_TARGET),
        "![Errors in space and time, two observations of force by mesh](figures/discretisation.png)",
    ]
    write_mesh_errors(mesh_errors(results))
    block = "\n\n".join(parts)
    print(block)
    rows.into_docs(DOCS / "discretisation.md", "study", block)
    cells = {r.run.mesh: int(r.row["cells"]) for r in results if r.force}
    at_c = [r for r in results if r.run.point == "C" and r.run.protocol != LOADING]
    figure = figure_discretisation(
        {(cells[m], m, p): e.rms for (m, p), e in space_errors(results).items() if m != SPACE_REFERENCE},
        {name: {key: e.rms for key, e in errors.items()} for name, errors in times.items()},
        [(r.run.mesh, r.force, r.face_stress) for r in at_c if r.force and r.face_stress],
        TIME_TARGET,
    )
    save_figure(figure, DOCS / "figures" / "discretisation", "benchmarks/discretisation_study.py")


if __name__ == "__main__":
    main()
