"""Holds the runs and errors of the discretisation study, makes its tables, and chooses mesh and tolerance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import rows

from bayeskin.finite_element import ModelSpec
from bayeskin.finite_element.stepping import STEPPING
from bayeskin.types import Simulation

SPACE_TOLERANCE = 3e-4
SPACE_REFERENCE = "bricks-3"
LOADING = "first loading"
TimeErrors = Mapping[tuple[float, str], "Error"]  # keys: tolerance and point


@dataclass(frozen=True)
class Run:
    """Describes one run of the study by the names of its protocol, point, mesh and solver settings."""

    protocol: str
    point: str
    mesh: str = "bricks-1"
    tolerance: float = SPACE_TOLERANCE
    settings: str = "as run"


@dataclass(frozen=True)
class Result:
    """Holds the row of a run and, where the run finished, the histories of force and face stress."""

    run: Run
    row: rows.Row
    force: Simulation | None = None
    face_stress: Simulation | None = None


@dataclass(frozen=True)
class Error:
    """Difference between a force history and a reference, relative to the reference's peak.

    rms, largest : RMS and largest difference over the peak
    peak_n : peak of the reference [N]
    scale : factor on the history that minimises the difference
    rms_scaled : RMS difference over the peak that remains after multiplying by `scale`
    """

    rms: float
    largest: float
    peak_n: float
    scale: float
    rms_scaled: float


def error(simulation: Simulation, reference: Simulation) -> Error:
    """Returns the error of a history against a reference, over the time that both cover."""
    end = min(simulation.time_s[-1], reference.time_s[-1])
    time_s = np.linspace(0.0, end, round(10 * end) + 1)
    a, b = simulation.at(time_s), reference.at(time_s)
    peak = float(np.abs(b).max())
    scale = float(a @ b / (a @ a))
    rms, rms_scaled = (float(np.sqrt(np.mean(d**2))) / peak for d in (a - b, scale * a - b))
    return Error(rms, float(np.abs(a - b).max()) / peak, peak, scale, rms_scaled)


def time_table(errors: TimeErrors, check: Mapping[str, Error], points: Sequence[str]) -> str:
    """Returns the errors by tolerance as a table; "-" stands for a failed run.

    The last row has the error of the reference itself, estimated with a tolerance ten times looser.
    """
    header = ["tolerance", *(f"{p}: rms, max [% of peak]" for p in points), "A: rms, max [mN]"]
    table = []
    for tolerance in sorted({t for t, _ in errors}, reverse=True):
        cells = [_percent(errors.get((tolerance, p))) for p in points]
        table.append([f"{tolerance:g}", *cells, _millinewton(errors.get((tolerance, "A")))])
    reference_cells = [_percent(check.get(p)) for p in points]
    return rows.markdown(
        header, [*table, ["reference itself", *reference_cells, _millinewton(check.get("A"))]]
    )


def space_errors(results: Sequence[Result]) -> dict[tuple[str, str], Error]:
    """Returns the errors over the first cycle by mesh and point, at the points that the reference has."""
    histories = {(r.run.mesh, r.run.point): r.force for r in results if r.force and r.run.protocol != LOADING}
    return {
        (mesh, point): error(force, histories[SPACE_REFERENCE, point])
        for (mesh, point), force in histories.items()
        if (SPACE_REFERENCE, point) in histories
    }


def space_table(results: Sequence[Result], points: Sequence[str]) -> str:
    """Returns the errors and costs of all meshes as a table."""
    errors = space_errors(results)
    header = ["mesh", "cells", "unknowns", "CPU s a run", *(f"{p}: rms, max [% of peak]" for p in points)]
    header += ["A: rms, max [mN]", "RMS error after best factor [%]"]
    table = []
    for mesh in dict.fromkeys(r.run.mesh for r in results if r.run.protocol != LOADING):
        of_mesh = [r for r in results if r.run.mesh == mesh and r.run.protocol != LOADING]
        finished = [r for r in of_mesh if r.force]
        if not finished:
            table.append(
                [mesh, of_mesh[0].row["status"], of_mesh[0].row["message"], *[""] * (len(header) - 3)]
            )
            continue
        seconds = f"{np.median([float(r.row['cpu_s']) for r in finished]):.0f}"
        errors_of_mesh = [errors.get((mesh, p)) for p in points]
        after_factor = [f"{100 * e.rms_scaled:.2f} (x {e.scale:.4f})" for e in errors_of_mesh if e]
        cells = (
            ["reference"] * len(errors_of_mesh)
            if mesh == SPACE_REFERENCE
            else [_percent(e) for e in errors_of_mesh]
        )
        last_cells = (
            ["", ""]
            if mesh == SPACE_REFERENCE
            else [_millinewton(errors.get((mesh, "A"))), ", ".join(after_factor)]
        )
        length = "first cycle" if "first" in finished[0].run.protocol else "whole"
        row = finished[0].row
        table.append([mesh, row["cells"], row["dofs"], f"{seconds} ({length})", *cells, *last_cells])
    return rows.markdown(header, table)


def mesh_errors(results: Sequence[Result]) -> dict[str, dict[str, float]]:
    """Returns the RMS and largest error of each mesh, at the worst of the points.

    The error of the reference itself is that of its first loading against the finest mesh.
    """
    errors = space_errors(results)
    by_mesh = {
        mesh: {"rms": max(e.rms for e in at_points), "largest": max(e.largest for e in at_points)}
        for mesh in dict.fromkeys(mesh for mesh, _ in errors if mesh != SPACE_REFERENCE)
        for at_points in [[e for (name, _), e in errors.items() if name == mesh]]
    }
    loads = {
        r.run.mesh: (int(r.row["cells"]), r.force) for r in results if r.force and r.run.protocol == LOADING
    }
    if SPACE_REFERENCE in loads:
        _, finest = max(loads.values(), key=lambda load: load[0])
        reference_error = error(loads[SPACE_REFERENCE][1], finest)
        by_mesh[SPACE_REFERENCE] = {"rms": reference_error.rms, "largest": reference_error.largest}
    return by_mesh


def whole_table(results: Sequence[Result], points: Sequence[str]) -> str:
    """Returns a table of errors over the whole protocol against bricks-2, the finest mesh that ran it."""
    done = {(r.run.mesh, r.run.point): r.force for r in results if r.force and r.run.protocol == "healthy"}
    table = []
    for mesh in dict.fromkeys(mesh for mesh, _ in done if mesh != "bricks-2"):
        pairs = [(done.get((mesh, p)), done.get(("bricks-2", p))) for p in points]
        table.append([mesh, *(_percent(error(a, b) if a and b else None) for a, b in pairs)])
    return rows.markdown(["mesh", *(f"{p}: rms, max [% of peak]" for p in points)], table)


def peak_table(results: Sequence[Result]) -> str:
    """Returns a table of reaction and face stress at the first peak, and their relaxation in the hold."""
    table = []
    for r in [r for r in results if r.run.point == "C"]:
        if not (r.force and r.face_stress):
            continue
        forces_n = [np.interp([9.4], h.time_s, h.force_n) for h in (r.force, r.face_stress)]
        cells = [f"{forces_n[0][0]:.4f}", f"{forces_n[1][0]:.4f}", "", ""]
        if r.run.protocol != LOADING:
            forces_n = [np.interp([19.0, 79.0], h.time_s, h.force_n) for h in (r.force, r.face_stress)]
            cells = [f"{e[0]:.4f}" for e in forces_n] + [f"{100 * (1 - e[1] / e[0]):.1f}" for e in forces_n]
        table.append([r.run.protocol, r.run.mesh, r.row["cells"], *cells])
    header = [
        "protocol",
        "mesh",
        "cells",
        "reaction at the first peak [N]",
        "face stress at the first peak [N]",
    ]
    header += ["relaxation of the reaction in the hold [%]", "relaxation of the face stress [%]"]
    return rows.markdown(header, table)


def choose(errors: TimeErrors, target: float) -> float | None:
    """Returns the loosest tolerance with an RMS error below the target at every point.

    All tighter tolerances must be below the target too. A point without a run does not count as below.
    Returns None if no tolerance qualifies.
    """
    chosen, points = None, {point for _, point in errors}
    for tolerance in sorted({t for t, _ in errors}):
        rms_by_point = {point: e.rms for (t, point), e in errors.items() if t == tolerance}
        if set(rms_by_point) != points or max(rms_by_point.values()) >= target:
            break
        chosen = tolerance
    return chosen


def choose_mesh(results: Sequence[Result], target: float) -> str | None:
    """Returns the brick mesh of fewest cells with an RMS error below the target at every point.

    A mesh without a run at every point is not considered. Returns None if no mesh qualifies.
    """
    errors = space_errors(results)
    points = {point for _, point in errors}
    cells = {r.run.mesh: int(r.row["cells"]) for r in results if r.force and r.run.mesh.startswith("bricks")}
    worst = {
        m: max(e.rms for (mesh, _), e in errors.items() if mesh == m)
        for m in cells
        if {point for mesh, point in errors if mesh == m} == points
    }
    accurate = [m for m, rms in worst.items() if rms < target and m != SPACE_REFERENCE]
    return min(accurate, key=lambda mesh: cells[mesh], default=None)


def verdict(
    times: Mapping[str, TimeErrors], results: Sequence[Result], time_target: float, mesh_target: float
) -> str:
    """Returns sentences on the tolerance and the mesh that the errors choose.

    The tolerance is chosen on the first protocol of `times` and tested on the second.
    """
    sentences = []
    (chosen_on, chosen_from), (tested_on, tested) = times.items()
    tolerance = choose(chosen_from, time_target)
    if tolerance is not None:
        worst_rms = max((e.rms for (t, _), e in tested.items() if t == tolerance), default=np.nan)
        sentences.append(
            f"Tolerance: {tolerance:g} is the loosest with an RMS error on the protocol `{chosen_on}` below "
            f"{100 * time_target:g} % of the peak at all points. On the protocol `{tested_on}` its RMS error "
            f"is at most {100 * worst_rms:.3f} %."
        )
        default = ModelSpec().tolerance
        default_rms = [
            max((e.rms for (t, _), e in errors.items() if t == default), default=np.nan)
            for errors in (chosen_from, tested)
        ]
        sentences.append(
            f"The default is {default:g}. Its RMS error is at most {100 * default_rms[0]:.3f} and "
            f"{100 * default_rms[1]:.3f} % on these protocols. Looser tolerances take as many steps, because "
            f"no phase has fewer than {STEPPING.steps_per_phase}."
        )
    else:
        sentences.append(
            f"Tolerance: no tested value has an RMS error below {100 * time_target:g} % of the peak."
        )
    mesh = choose_mesh(results, mesh_target)
    if mesh is not None:
        worst_rms = max(e.rms for (m, _), e in space_errors(results).items() if m == mesh)
        sentences.append(
            f"Mesh: {mesh} is the coarsest brick mesh with an RMS error below "
            f"{100 * mesh_target:g} % of the peak at all points (at most {100 * worst_rms:.2f} %)."
        )
    elif space_errors(results):
        sentences.append(f"Mesh: no tested mesh has an RMS error below {100 * mesh_target:g} % of the peak.")
    return "\n\n".join(sentences)


def _percent(of: Error | None) -> str:
    """Returns RMS and largest error in percent of the peak as text."""
    return f"{100 * of.rms:.4f}, {100 * of.largest:.4f}" if of else "-"


def _millinewton(of: Error | None) -> str:
    """Returns RMS and largest error in mN as text."""
    return f"{1e3 * of.rms * of.peak_n:.3f}, {1e3 * of.largest * of.peak_n:.3f}" if of else "-"
