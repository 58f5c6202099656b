"""Commands that need no run's folder: import a recording, run the full model once."""

from __future__ import annotations

import csv
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bayeskin import storage
from bayeskin.config import load_config, parameter_space
from bayeskin.errors import InputError
from bayeskin.model.fields import FieldWriter
from bayeskin.model.simulate import ModelSpec, problem_of, simulate
from bayeskin.pipeline.engine import Reporter, Run
from bayeskin.pipeline.folder import plain
from bayeskin.pipeline.model import model_spec
from bayeskin.pipeline.recording import pad_motion
from bayeskin.recordings import describe, describe_json, phase_noise, read_recording, segment
from bayeskin.shipped import shipped
from bayeskin.types import ParameterSpace, Simulation


def import_recording(file: Path, out: Path, sheet: str | None = None) -> dict[str, Any]:
    """Reads `file`, writes it to `out` in bayeskin's HDF5, and says what is in it.

    Raises InputError, with nothing written, when it is no recording of a test.
    """
    _check_suffix(out, (".h5",))
    recording = read_recording(file, sheet=sheet)
    phases = segment(recording)
    noise = phase_noise(recording, phases)
    storage.save(out, recording)
    text = f"{describe(recording, phases, noise)}\n\nwritten to {out}"
    return plain({"ok": True, "out": out, **describe_json(recording, phases, noise), "text": text})


def simulate_once(
    reporter: Reporter,
    out: Path,
    config: Path | None = None,
    recording: Path | None = None,
    settings: Sequence[str] = (),
    mesh: str | None = None,
    observation: str | None = None,
    fields: Path | None = None,
) -> dict[str, Any]:
    """One full run on a recording's displacement, into `out` (.csv or .h5), and its fields into a folder.

    What is not given is the configuration's, or the demo's. Parameters that `settings` ("NAME=VALUE", SI)
    leave out stand at the median of their prior. A run that fails is told, and nothing is written.
    Raises InputError for bad input.
    """
    _check_suffix(out, (".csv", ".h5"))
    config_path = config or shipped("runs/demo.toml")
    run = Run(load_config(config_path), config_path, Path(), reporter)
    theta = _theta(parameter_space(run.config, config_path), settings)
    spec = model_spec(run, mesh, observation)
    source = read_recording(recording or run.beside(run.config.recording.file))
    motion = pad_motion(spec.observation, source, segment(source), run.config.recording.protocol)
    reporter.log(f"simulating {motion.time_s[-1]:.1f} s, {spec.observation} on {Path(spec.mesh).name}")
    writer = FieldWriter(fields, problem_of(spec.mesh, spec.refinement), theta) if fields else None
    simulation = simulate(
        spec, motion, theta, lambda share: reporter.progress("simulation", share),
        writer.on_state if writer else None,
    )  # fmt: skip
    written: Path | None = None
    if simulation.status == "ok":
        written = writer.write() if writer else None
        write_simulation(out, simulation)
    return _answer(simulation, spec, out, written)


def write_simulation(out: Path, simulation: Simulation) -> None:
    """As CSV with the columns time_s, displacement_m, force_n, or as HDF5, by suffix; whole or not at all."""
    if out.suffix == ".h5":
        storage.save(out, simulation)
        return
    out.parent.mkdir(parents=True, exist_ok=True)
    partial = out.with_name(f".{out.name}.{os.getpid()}.partial")
    columns = ("time_s", "displacement_m", "force_n")
    try:
        with open(partial, "w", newline="") as handle:
            writer = csv.writer(handle, lineterminator="\n")
            writer.writerow(columns)
            rows = zip(*(getattr(simulation, name).tolist() for name in columns), strict=True)
            writer.writerows(rows)
        os.replace(partial, out)
    finally:
        partial.unlink(missing_ok=True)


def _theta(space: ParameterSpace, settings: Sequence[str]) -> dict[str, float]:
    theta = dict(zip(space.names, space.from_unit([0.5] * space.dim).tolist(), strict=True))
    for setting in settings:
        name, equals, value = setting.partition("=")
        if not equals or name not in theta:
            raise InputError(f"--set {setting}", repr(name), f"NAME=VALUE with one of {', '.join(theta)}")
        try:
            theta[name] = float(value)
        except ValueError:
            raise InputError(f"--set {setting}", repr(value), "a number in SI units") from None
    return theta


def _answer(simulation: Simulation, spec: ModelSpec, out: Path, fields_file: Path | None) -> dict[str, Any]:
    ok, stats = simulation.status == "ok", simulation.stats
    if ok:
        text = (
            f"{stats['steps']:.0f} steps of {stats['dofs']:.0f} unknowns in {stats['seconds']:.1f} s, "
            f"peak force {stats['peak_force_n']:.4g} N, written to {out}"
        )
        text += f", fields to {fields_file}" if fields_file else ""
    else:
        text = f"failed: {simulation.message}"
    answer = {"ok": ok, "status": simulation.status, "message": simulation.message, "theta": simulation.theta}
    model = {"observation": spec.observation, "mesh": spec.mesh, "model_hash": simulation.model_hash}
    return plain(
        {**answer, **model, "stats": stats, "out": out if ok else None, "fields": fields_file, "text": text}
    )


def _check_suffix(out: Path, suffixes: tuple[str, ...]) -> None:
    if out.suffix not in suffixes:
        raise InputError(f"-o {out}", f"ending {out.suffix!r}", f"ending {' or '.join(suffixes)}")
