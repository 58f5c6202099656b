"""States the result of a single run of a model, as text and as JSON, with an estimate of its error."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bayeskin.finite_element.accuracy import mesh_error
from bayeskin.finite_element.simulate import ModelSpec
from bayeskin.json_files import plain
from bayeskin.number_format import number
from bayeskin.types import Simulation


def simulation_answer(
    simulation: Simulation, spec: ModelSpec, files: Sequence[Path], reduced: bool
) -> dict[str, Any]:
    """Returns the answer of `bayeskin simulate`.

    files : the files that the run wrote, the force first; none where the run failed
    reduced : whether the reduced model ran
    """
    facts = {
        "ok": simulation.status == "ok",
        "status": simulation.status,
        "message": simulation.message,
        "theta": simulation.theta,
        "observation": spec.observation,
        "mesh": spec.mesh,
        "model_hash": simulation.model_hash,
        "stats": simulation.stats,
        **(_reduced_facts(simulation) if reduced else {}),
        "out": files[0] if files else None,
        "fields": next((file for file in files if file.suffix == ".xdmf"), None),
        "figures": [file for file in files if file.suffix in (".png", ".svg")],
        "files": files,
    }
    return plain({**facts, "text": _in_words(simulation, spec, files, reduced)})


def _in_words(simulation: Simulation, spec: ModelSpec, files: Sequence[Path], reduced: bool) -> str:
    """Returns the answer as text."""
    if simulation.status != "ok":
        return f"failed: {simulation.message}"
    stats, steps = simulation.stats, "one run"
    if spec.forward is None:
        steps = f"{stats['steps']:.0f} steps of {stats['modes' if reduced else 'dofs']:.0f} unknowns"
    lines = _reduced_accuracy(simulation) if reduced else _accuracy(simulation, spec)
    return "\n".join(
        [
            f"{steps} in {stats['seconds']:.1f} s, peak force {number(stats['peak_force_n'], 4)} N, "
            f"written to {', '.join(map(str, files))}",
            *lines,
        ]
    )


def _reduced_facts(simulation: Simulation) -> dict[str, Any]:
    """Returns the facts of a reduced run that programs need most."""
    stats = simulation.stats
    return {
        "seconds": stats["seconds"],
        "error_estimate_n": stats.get("error_estimate_n"),
        "inside": stats["inside"] == 1.0,
    }


def _reduced_accuracy(simulation: Simulation) -> list[str]:
    """Returns lines with the estimated error of a reduced run against the full model on the same mesh."""
    stats = simulation.stats
    error_n = stats["error_estimate_n"]
    share = 100 * error_n / stats["peak_force_n"] if stats["peak_force_n"] > 0.0 else 0.0
    return [
        f"estimated error from the full model: {number(1e3 * error_n, 2)} mN, {number(share, 2)} % of peak",
        f"{stats['seconds_of_run']:.2f} s of this time for the run itself, the rest to prepare and check it",
    ]


def _accuracy(simulation: Simulation, spec: ModelSpec) -> list[str]:
    """Returns lines with the estimated error of the model's force."""
    if spec.formulation.error_unknown:
        return [f"no error estimate: {spec.formulation.error_unknown}"]
    peak_n = simulation.stats["peak_force_n"]
    time_share = simulation.stats["time_error_n"] / peak_n if peak_n > 0.0 else 0.0
    error = mesh_error(spec.mesh_hash)
    mesh = (
        "unknown, because the mesh is not in the convergence study"
        if error is None
        else f"{number(100 * error.rms, 2)} % RMS"
    )
    falls = simulation.stats["falls"]
    snap_lines = [f"the skin folded: it snapped to another equilibrium {falls:.0f} times"] if falls else []
    return [
        *snap_lines,
        f"estimated error, relative to the peak: time steps {number(100 * time_share, 2)} %, mesh {mesh}",
    ]
