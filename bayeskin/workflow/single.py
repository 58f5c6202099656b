"""The commands that need no run folder: importing a recording, and running a model once."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bayeskin import storage
from bayeskin.config import Config, load_config, parameter_space
from bayeskin.device import load_device_file
from bayeskin.errors import InputError
from bayeskin.finite_element.accuracy import mesh_error
from bayeskin.finite_element.problem import Problem
from bayeskin.finite_element.simulate import ModelSpec, OnState, problem_at, simulate
from bayeskin.forward.observed import reported
from bayeskin.forward.reduced import stands_for
from bayeskin.geometry import LENGTHS, Geometry
from bayeskin.json_files import plain
from bayeskin.mechanisms import Mechanism, catalogue, laws, solved
from bayeskin.number_format import number
from bayeskin.recordings import describe, describe_json, phase_noise, read_recording, segment
from bayeskin.reduced.files import load_reduced
from bayeskin.reduced.simulate import simulate_reduced
from bayeskin.shipped import shipped
from bayeskin.types import PadMotion, Parameter, ParameterSpace, Simulation
from bayeskin.workflow.engine import Reporter, Run
from bayeskin.workflow.field_outputs import FieldOutputs, moments_of
from bayeskin.workflow.model import model_spec
from bayeskin.workflow.provenance import caption
from bayeskin.workflow.recording import pad_motion
from bayeskin.workflow.reducing import reduced_file

REPORTED_EVERY_S = 0.1  # with mechanisms, because their force changes within a time step of the model


def import_recording(file: Path, out: Path, sheet: str | None = None) -> dict[str, Any]:
    """Reads `file`, writes it to `out` as an HDF5 file of bayeskin, and returns the command's answer.

    Raises InputError, with nothing written, for a file that is no recording of a test.
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
    device: Path | None = None,
    recording: Path | None = None,
    settings: Sequence[str] = (),
    mechanisms: Sequence[str] = (),
    mesh: str | None = None,
    observation: str | None = None,
    reduced: bool = False,
    fields: Path | None = None,
    figures: Path | None = None,
    at_s: Sequence[float] = (),
) -> dict[str, Any]:
    """Runs the model once on a recording's displacement, and returns the command's answer.

    The force goes to `out` (.csv or .h5); the fields go to the folders `fields` and `figures`. The
    configuration `config`, by default the demo's, supplies all values that are not given. The sections of the
    file `device` replace its own sections. `settings` ("NAME=VALUE", SI) sets parameters of the model and of
    the named `mechanisms`. Other parameters have the median of their prior, and uncertain lengths of the
    tissue have their mean. The figure shows the fields at the times `at_s`, or at four moments of the
    protocol. With `reduced`, the device's reduced model runs instead of the full model. A run that fails is
    reported, and nothing is written. Raises InputError for wrong input.
    """
    _check_suffix(out, (".csv", ".h5"))
    _check_folders(fields, figures, at_s)
    config_path = config or shipped("runs/demo.toml")
    run = Run(_with_device(load_config(config_path), device), config_path, Path(), reporter)
    added = _mechanisms(mechanisms)
    spec = model_spec(run, mesh, observation)
    if spec.forward is not None and (fields or figures or added):
        raise InputError(
            "simulate",
            f"the model {spec.forward}",
            "no fields, figures or mechanisms with a model of your own",
        )
    base = parameter_space(run.config, config_path)
    added_parameters = tuple(p for mechanism in added for p in mechanism.parameters)
    values = _parameter_values(ParameterSpace((*base.parameters, *added_parameters)), spec.geometry, settings)
    for parameter in added_parameters:
        _refuse_impossible_value(parameter, values[parameter.name])
    theta = {name: values[name] for name in base.names}
    solved_values = {p.name: values[p.name] for mechanism in solved(added) for p in mechanism.parameters}
    source = read_recording(recording or run.beside(run.config.recording.file))
    phases = segment(source)
    motion = pad_motion(spec, source, phases, run.config.recording.protocol)
    moments = moments_of(phases, motion, at_s)
    reporter.log(f"simulating {motion.time_s[-1]:.1f} s, {spec.forward or _on_mesh(spec)}")
    outputs = None
    if fields or figures:
        if not spec.formulation.has_fields:
            found = f"model.observation {spec.observation!r}, whose stresses differ from those of the fields"
            raise InputError("--fields, --figures", found, "model.observation 'reaction'")
        problem = problem_at(spec, theta)
        _refuse_other_stresses(added, theta | solved_values, problem)
        outputs = FieldOutputs(problem, theta, motion, moments, fields, figures)
    on_state = outputs.on_state if outputs else None
    if reduced:
        simulation = _reduced_run(spec, (device, config), motion, theta | solved_values, added, on_state)
    else:
        simulation = simulate(
            spec, motion, theta | solved_values, lambda share: reporter.progress("simulation", share),
            on_state, laws=laws(added),
        )  # fmt: skip
    files: list[Path] = []
    if simulation.status == "ok":
        simulation = _with_instrument(simulation, added, values, motion)
        write_simulation(out, simulation)
        files = [out, *(outputs.write(caption(run)) if outputs else ())]
    return _answer(simulation, spec, files, reduced)


def _reduced_run(
    spec: ModelSpec, sources: Sequence[Path | None], motion: PadMotion, theta: Mapping[str, float],
    mechanisms: Sequence[Mechanism], on_state: OnState | None,
) -> Simulation:  # fmt: skip
    """Returns a run of the reduced model that fits, with its estimated error.

    Raises InputError where no reduced model exists for this device, mesh or observation.
    """
    if not stands_for(spec) or spec.refinement != 1:
        found = f"observation {spec.observation!r} on {spec.mesh!r}, refinement {spec.refinement}"
        raise InputError("--reduced", found, "observation 'reaction' on 'bricks', refinement 1")
    model = load_reduced(reduced_file(spec.geometry, [source for source in sources if source is not None]))
    return simulate_reduced(
        model, motion, theta, mechanisms, geometry=spec.geometry, estimate=True, on_state=on_state
    )


def _with_device(config: Config, device: Path | None) -> Config:
    """Returns the configuration with the sections of a device's file."""
    if device is None:
        return config
    stated = load_device_file(device)
    return config.model_copy(update={"device": stated.device, "tissue": stated.tissue})


def _on_mesh(spec: ModelSpec) -> str:
    """Returns the observation and the mesh of the full model in words."""
    return f"{spec.observation} on {Path(spec.mesh).name}"


def write_simulation(out: Path, simulation: Simulation) -> None:
    """Writes a run, completely or not at all, as CSV or HDF5 by the suffix of `out`.

    The CSV file has the columns time_s, displacement_m, force_n.
    """
    if out.suffix == ".h5":
        storage.save(out, simulation)
        return
    columns, text = ("time_s", "displacement_m", "force_n"), io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*(getattr(simulation, name).tolist() for name in columns), strict=True))
    storage.write_bytes(out, text.getvalue().encode())


def _mechanisms(names: Sequence[str]) -> list[Mechanism]:
    """Returns the named mechanisms. Raises InputError for an unknown name."""
    known = catalogue()
    for name in names:
        if name not in known:
            raise InputError(f"--mechanism {name}", "an unknown mechanism", f"one of {', '.join(known)}")
    return [known[name] for name in dict.fromkeys(names)]


def _refuse_other_stresses(
    mechanisms: Sequence[Mechanism], values: Mapping[str, float], problem: Problem
) -> None:
    """Raises InputError for a mechanism that changes the tissue's law, because fields are of the base law."""
    for mechanism in mechanisms:
        bind = mechanism.act.bind
        if bind is not None and bind(values, problem.sites).respond is not None:
            expected = (
                "no mechanism that changes the tissue's stress or flow, because fields are of the base law"
            )
            raise InputError("--fields, --figures", f"--mechanism {mechanism.name}", expected)


def _refuse_impossible_value(parameter: Parameter, value: float) -> None:
    """Raises InputError for a value that is not finite or that the parameter cannot have."""
    positive = parameter.in_log and parameter.offset == 0.0
    least = "positive number" if positive else "number of at least 0" if parameter.in_log else "number"
    below = parameter.in_log and (value < 0.0 or (positive and value == 0.0))
    if not np.isfinite(value) or below:
        expected = f"a finite {least}"
        raise InputError(f"--set {parameter.name}", f"{value:g}", expected)


def _with_instrument(
    simulation: Simulation, mechanisms: Sequence[Mechanism], values: Mapping[str, float], motion: PadMotion
) -> Simulation:
    """Returns the same run as an instrument with `mechanisms` reports it.

    It has more times than the time steps of the model.
    """
    if not mechanisms:
        return simulation
    time_s = motion.times(REPORTED_EVERY_S, simulation.time_s)
    force_n = reported(simulation, mechanisms, values, motion)(time_s)[0]
    return replace(
        simulation,
        theta=dict(values),
        time_s=time_s,
        displacement_m=motion.at(time_s),
        force_n=force_n,
        stats={**simulation.stats, "peak_force_n": float(np.abs(force_n).max())},
        corner=np.isin(time_s, simulation.time_s[simulation.corner]),
    )


def _parameter_values(space: ParameterSpace, geometry: Geometry, settings: Sequence[str]) -> dict[str, float]:
    """Returns the values of all parameters by name, with the changes of `settings`.

    Raises InputError for a setting that is not NAME=VALUE with a known name.
    """
    theta = dict(zip(space.names, space.from_unit([0.5] * space.dim).tolist(), strict=True))
    theta |= {name: getattr(geometry, name) for name in LENGTHS if name in theta}
    for setting in settings:
        name, equals, value = setting.partition("=")
        if not equals or name not in theta:
            raise InputError(f"--set {setting}", repr(name), f"NAME=VALUE with one of {', '.join(theta)}")
        try:
            theta[name] = float(value)
        except ValueError:
            raise InputError(f"--set {setting}", repr(value), "a number in SI units") from None
    return theta


def _answer(simulation: Simulation, spec: ModelSpec, files: Sequence[Path], reduced: bool) -> dict[str, Any]:
    """Returns the command's answer; `files` are the files that the run wrote, the force first."""
    ok, stats = simulation.status == "ok", simulation.stats
    text = f"failed: {simulation.message}"
    if ok:
        own_model = spec.forward is not None
        unknowns = stats.get("modes") if reduced else stats.get("dofs")
        steps = "one run" if own_model else f"{stats['steps']:.0f} steps of {unknowns:.0f} unknowns"
        text = (
            f"{steps} in {stats['seconds']:.1f} s, peak force {number(stats['peak_force_n'], 4)} N, "
            f"written to {', '.join(map(str, files))}"
        )
        lines = _reduced_accuracy(simulation) if reduced else _accuracy(simulation, spec)
        text += "".join(f"\n{line}" for line in lines)
    answer = {"ok": ok, "status": simulation.status, "message": simulation.message, "theta": simulation.theta}
    model = {"observation": spec.observation, "mesh": spec.mesh, "model_hash": simulation.model_hash}
    written = {
        "out": files[0] if files else None,
        "fields": next((file for file in files if file.suffix == ".xdmf"), None),
        "figures": [file for file in files if file.suffix in (".png", ".svg")],
        "files": files,
    }
    facts = _reduced_facts(simulation) if reduced else {}
    return plain({**answer, **model, "stats": stats, **facts, **written, "text": text})


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


def _check_suffix(out: Path, suffixes: tuple[str, ...]) -> None:
    """Raises InputError for a file with another suffix than the allowed ones."""
    if out.suffix not in suffixes:
        raise InputError(f"-o {out}", f"the ending {out.suffix!r}", f"the ending {' or '.join(suffixes)}")


def _check_folders(fields: Path | None, figures: Path | None, at_s: Sequence[float]) -> None:
    """Raises InputError where a folder cannot be made, and for times of a figure without a figure."""
    for option, folder in (("--fields", fields), ("--figures", figures)):
        above = [path for path in (folder, *folder.parents) if path.exists()] if folder else []
        if above and not above[0].is_dir():
            raise InputError(f"{option} {folder}", f"the file {above[0]}", "a folder")
    if at_s and figures is None:
        raise InputError(f"--at {at_s[0]:g}", "no --figures", "--at together with --figures DIR")
