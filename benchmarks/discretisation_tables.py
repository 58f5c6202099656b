"""What the discretisation study compares, its tables, and what it chooses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import rows

from bayeskin.finite_element import ModelSpec
from bayeskin.finite_element.stepping import STEPS_PER_PHASE
from bayeskin.types import Simulation

SPACE_TOLERANCE = 3e-4
SPACE_REFERENCE = "bricks-3"
LOADING = "first loading"
TimeErrors = Mapping[tuple[float, str], "Error"]  # by tolerance and point


@dataclass(frozen=True)
class Run:
    """One run of the study, as it is asked for; names of a motion, a point, a mesh and of settings."""

    protocol: str
    point: str
    mesh: str = "bricks-1"
    tolerance: float = SPACE_TOLERANCE
    settings: str = "as run"


@dataclass(frozen=True)
class Result:
    """Its row, and where it was simulated its force history and the one of the face's stress."""

    run: Run
    row: rows.Row
    force: Simulation | None = None
    face_stress: Simulation | None = None


@dataclass(frozen=True)
class Error:
    """Of a history against a reference's: relative to the reference's peak, and that peak [N].

    scale : factor on the history that brings it nearest; rms_scaled : what is left then
    """

    rms: float
    largest: float
    peak_n: float
    scale: float
    rms_scaled: float


def error(found: Simulation, reference: Simulation) -> Error:
    """Over the time that both cover."""
    end = min(found.time_s[-1], reference.time_s[-1])
    time_s = np.linspace(0.0, end, round(10 * end) + 1)
    a, b = found.at(time_s), reference.at(time_s)
    peak = float(np.abs(b).max())
    scale = float(a @ b / (a @ a))
    rms, rms_scaled = (float(np.sqrt(np.mean(d**2))) / peak for d in (a - b, scale * a - b))
    return Error(rms, float(np.abs(a - b).max()) / peak, peak, scale, rms_scaled)


def time_table(errors: TimeErrors, check: Mapping[str, Error], points: Sequence[str]) -> str:
    """Errors by tolerance ("-": the run failed); last the reference's own, as one ten times looser tells."""
    header = ["tolerance", *(f"{p}: rms, max [% of peak]" for p in points), "A: rms, max [mN]"]
    lines = []
    for tolerance in sorted({t for t, _ in errors}, reverse=True):
        cells = [_percent(errors.get((tolerance, p))) for p in points]
        lines.append([f"{tolerance:g}", *cells, _millinewton(errors.get((tolerance, "A")))])
    own = [_percent(check.get(p)) for p in points]
    return rows.markdown(header, [*lines, ["reference's own", *own, _millinewton(check.get("A"))]])


def space_errors(results: Sequence[Result]) -> dict[tuple[str, str], Error]:
    """By mesh and point, over the first cycle, against the reference where it is done."""
    histories = {(r.run.mesh, r.run.point): r.force for r in results if r.force and r.run.protocol != LOADING}
    return {
        (mesh, point): error(force, histories[SPACE_REFERENCE, point])
        for (mesh, point), force in histories.items()
        if (SPACE_REFERENCE, point) in histories
    }


def space_table(results: Sequence[Result], points: Sequence[str]) -> str:
    errors = space_errors(results)
    header = ["mesh", "cells", "unknowns", "CPU s a run", *(f"{p}: rms, max [% of peak]" for p in points)]
    header += ["A: rms, max [mN]", "rms left after one factor [%]"]
    lines = []
    for mesh in dict.fromkeys(r.run.mesh for r in results if r.run.protocol != LOADING):
        mine = [r for r in results if r.run.mesh == mesh and r.run.protocol != LOADING]
        done = [r for r in mine if r.force]
        if not done:
            lines.append([mesh, mine[0].row["status"], mine[0].row["message"], *[""] * (len(header) - 3)])
            continue
        seconds = f"{np.median([float(r.row['cpu_s']) for r in done]):.0f}"
        of = [errors.get((mesh, p)) for p in points]
        left = [f"{100 * e.rms_scaled:.2f} (x {e.scale:.4f})" for e in of if e]
        cells = ["reference"] * len(of) if mesh == SPACE_REFERENCE else [_percent(e) for e in of]
        tail = (
            ["", ""] if mesh == SPACE_REFERENCE else [_millinewton(errors.get((mesh, "A"))), ", ".join(left)]
        )
        length = "first cycle" if "first" in done[0].run.protocol else "whole"
        row = done[0].row
        lines.append([mesh, row["cells"], row["dofs"], f"{seconds} ({length})", *cells, *tail])
    return rows.markdown(header, lines)


def mesh_errors(results: Sequence[Result]) -> dict[str, dict[str, float]]:
    """RMS and largest error by mesh, the worst of the points; the reference's own by the finest's loading."""
    errors = space_errors(results)
    found = {
        mesh: {"rms": max(e.rms for e in of), "largest": max(e.largest for e in of)}
        for mesh in dict.fromkeys(mesh for mesh, _ in errors if mesh != SPACE_REFERENCE)
        for of in [[e for (name, _), e in errors.items() if name == mesh]]
    }
    loads = {r.run.mesh: r for r in results if r.force and r.run.protocol == LOADING}
    if SPACE_REFERENCE in loads:
        finest = max(loads.values(), key=lambda r: int(r.row["cells"])).force
        own = error(loads[SPACE_REFERENCE].force, finest)
        found[SPACE_REFERENCE] = {"rms": own.rms, "largest": own.largest}
    return found


def whole_table(results: Sequence[Result], points: Sequence[str]) -> str:
    """Over the whole protocol, against bricks-2, the finest that ran it."""
    done = {(r.run.mesh, r.run.point): r.force for r in results if r.force and r.run.protocol == "healthy"}
    lines = []
    for mesh in dict.fromkeys(mesh for mesh, _ in done if mesh != "bricks-2"):
        pairs = [(done.get((mesh, p)), done.get(("bricks-2", p))) for p in points]
        lines.append([mesh, *(_percent(error(a, b) if a and b else None) for a, b in pairs)])
    return rows.markdown(["mesh", *(f"{p}: rms, max [% of peak]" for p in points)], lines)


def peak_table(results: Sequence[Result]) -> str:
    """Reaction and face stress at the end of the first loading, and how each relaxes in the first hold."""
    lines = []
    for r in [r for r in results if r.run.point == "C" and r.force and r.face_stress]:
        ends = [np.interp([9.4], h.time_s, h.force_n) for h in (r.force, r.face_stress)]
        cells = [f"{ends[0][0]:.4f}", f"{ends[1][0]:.4f}", "", ""]
        if r.run.protocol != LOADING:
            ends = [np.interp([19.0, 79.0], h.time_s, h.force_n) for h in (r.force, r.face_stress)]
            cells = [f"{e[0]:.4f}" for e in ends] + [f"{100 * (1 - e[1] / e[0]):.1f}" for e in ends]
        lines.append([r.run.protocol, r.run.mesh, r.row["cells"], *cells])
    header = ["protocol", "mesh", "cells", "reaction at the first peak [N]", "face stress there [N]"]
    header += ["reaction relaxes in the hold by [%]", "face stress relaxes by [%]"]
    return rows.markdown(header, lines)


def choose(errors: TimeErrors, target: float) -> float | None:
    """The loosest tolerance whose RMS error is below the target at every point, as are all tighter ones. A
    point without a run is not below."""
    chosen, points = None, {point for _, point in errors}
    for tolerance in sorted({t for t, _ in errors}):
        found = {point: e.rms for (t, point), e in errors.items() if t == tolerance}
        if set(found) != points or max(found.values()) >= target:
            break
        chosen = tolerance
    return chosen


def choose_mesh(results: Sequence[Result], target: float) -> str | None:
    """The bricks of fewest cells whose RMS error is below the target at every point; all must have run."""
    errors = space_errors(results)
    points = {point for _, point in errors}
    cells = {r.run.mesh: int(r.row["cells"]) for r in results if r.force and r.run.mesh.startswith("bricks")}
    worst = {
        m: max(e.rms for (mesh, _), e in errors.items() if mesh == m)
        for m in cells
        if {point for mesh, point in errors if mesh == m} == points
    }
    good = [m for m, rms in worst.items() if rms < target and m != SPACE_REFERENCE]
    return min(good, key=lambda mesh: cells[mesh], default=None)


def verdict(
    times: Mapping[str, TimeErrors], results: Sequence[Result], time_target: float, mesh_target: float
) -> str:
    """What the errors choose: the tolerance by the first protocol of `times`, tested on the second."""
    lines = []
    (chosen_on, chosen_from), (tested_on, tested) = list(times.items()) or [("", {})] * 2
    tolerance = choose(chosen_from, time_target)
    if tolerance is not None:
        worst = max((e.rms for (t, _), e in tested.items() if t == tolerance), default=np.nan)
        lines.append(
            f"Tolerance: {tolerance:g} is the loosest whose RMS error on the protocol `{chosen_on}` is below "
            f"{100 * time_target:g} % of the peak at all points; on `{tested_on}` it gives at most "
            f"{100 * worst:.3f} %."
        )
        default = ModelSpec().tolerance
        found = [
            max((e.rms for (t, _), e in errors.items() if t == default), default=np.nan)
            for errors in (chosen_from, tested)
        ]
        lines.append(
            f"The default is {default:g}: at most {100 * found[0]:.3f} and {100 * found[1]:.3f} %, in as "
            f"many steps as looser ones, because no phase has fewer than {STEPS_PER_PHASE}."
        )
    elif times:
        lines.append(f"Tolerance: none tried is below {100 * time_target:g} % of the peak.")
    mesh = choose_mesh(results, mesh_target)
    if mesh is not None:
        worst = max(e.rms for (m, _), e in space_errors(results).items() if m == mesh)
        lines.append(
            f"Mesh: {mesh} is the coarsest of bricks whose RMS error is below "
            f"{100 * mesh_target:g} % of the peak at all points (at most {100 * worst:.2f} %)."
        )
    elif space_errors(results):
        lines.append(f"Mesh: none tried is below {100 * mesh_target:g} % of the peak.")
    return "\n\n".join(lines)


def _percent(of: Error | None) -> str:
    return f"{100 * of.rms:.4f}, {100 * of.largest:.4f}" if of else "-"


def _millinewton(of: Error | None) -> str:
    return f"{1e3 * of.rms * of.peak_n:.3f}, {1e3 * of.largest * of.peak_n:.3f}" if of else "-"
