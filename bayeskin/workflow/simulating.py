"""Runs a model once on a recording's displacement, and writes its force and its fields."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bayeskin import storage
from bayeskin.config import Config, load_config, parameter_space
from bayeskin.config.device import load_device_file
from bayeskin.errors import InputError
from bayeskin.finite_element.problem import Problem
from bayeskin.finite_element.simulate import ModelSpec, OnState, problem_at, simulate
from bayeskin.forward.observed import reported
from bayeskin.forward.reduced import stands_for
from bayeskin.geometry import LENGTHS, Geometry
from bayeskin.mechanisms import Mechanism, catalogue, laws, solved
from bayeskin.recordings import read_recording, segment
from bayeskin.reduced.files import load_reduced
from bayeskin.reduced.simulate import simulate_reduced
from bayeskin.shipped import shipped
from bayeskin.types import PadMotion, Parameter, ParameterSpace, Phase, Simulation
from bayeskin.workflow.engine import Reporter, Run
from bayeskin.workflow.field_outputs import FieldOutputs, moments_of
from bayeskin.workflow.model import model_spec
from bayeskin.workflow.output_paths import check_ending, check_folder
from bayeskin.workflow.provenance import caption
from bayeskin.workflow.recording import pad_motion
from bayeskin.workflow.reducing import reduced_file
from bayeskin.workflow.simulation_answer import simulation_answer

REPORTED_EVERY_S = 0.1  # interval with mechanisms, whose force changes within a time step


@dataclass(frozen=True)
class SimulationRequest:
    """The options of `bayeskin simulate`.

    out : file of the force, .csv or .h5; fields, figures : folders of the fields and of their figure
    config : configuration that supplies all values that are not given, by default the demo's
    device : file whose sections `device` and `tissue` replace those of the configuration
    recording : recording whose displacement drives the run, by default the configuration's
    settings : values "NAME=VALUE" [SI] of parameters of the model and of the named `mechanisms`; without a
        value, a parameter has the median of its prior, and an uncertain length of the tissue has its mean
    mesh, observation : replace those of the configuration
    reduced : whether the device's reduced model runs instead of the full model
    at_s : times [s] that the figure shows, by default four moments of the protocol
    """

    out: Path
    config: Path | None = None
    device: Path | None = None
    recording: Path | None = None
    settings: Sequence[str] = ()
    mechanisms: Sequence[str] = ()
    mesh: str | None = None
    observation: str | None = None
    reduced: bool = False
    fields: Path | None = None
    figures: Path | None = None
    at_s: Sequence[float] = ()


@dataclass(frozen=True)
class _Case:
    """The model, the values and the protocol of one run.

    theta : values of the parameters of the base model; values : these and the values of all mechanisms
    """

    run: Run
    spec: ModelSpec
    mechanisms: Sequence[Mechanism]
    theta: Mapping[str, float]
    values: Mapping[str, float]
    phases: Sequence[Phase]
    motion: PadMotion

    @property
    def solved_theta(self) -> dict[str, float]:
        """Returns the values of the base model and of the mechanisms that the model solves."""
        names = [p.name for mechanism in solved(self.mechanisms) for p in mechanism.parameters]
        return {**self.theta, **{name: self.values[name] for name in names}}


def simulate_once(request: SimulationRequest, reporter: Reporter) -> dict[str, Any]:
    """Runs the model once on a recording's displacement, and returns the command's answer.

    A run that fails is reported, and nothing is written. Raises InputError for wrong input.
    """
    _check_outputs(request)
    case = _case(request, reporter)
    moments = moments_of(case.phases, case.motion, request.at_s)
    model = case.spec.forward or f"{case.spec.observation} on {Path(case.spec.mesh).name}"
    reporter.log(f"simulating {case.motion.time_s[-1]:.1f} s, {model}")
    outputs = _field_outputs(case, request, moments)
    on_state = outputs.on_state if outputs else None
    if request.reduced:
        simulation = _reduced_run(case, (request.device, request.config), on_state)
    else:
        simulation = simulate(
            case.spec, case.motion, case.solved_theta, lambda share: reporter.progress("simulation", share),
            on_state, laws=laws(case.mechanisms),
        )  # fmt: skip
    files: list[Path] = []
    if simulation.status == "ok":
        simulation = _with_instrument(simulation, case)
        write_simulation(request.out, simulation)
        files = [request.out, *(outputs.write(caption(case.run)) if outputs else ())]
    return simulation_answer(simulation, case.spec, files, request.reduced)


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


def _check_outputs(request: SimulationRequest) -> None:
    """Raises InputError where an output cannot be made, and for times of a figure without a figure."""
    check_ending(request.out, ".csv", ".h5")
    check_folder("--fields", request.fields)
    check_folder("--figures", request.figures)
    if request.at_s and request.figures is None:
        raise InputError(
            f"--at {request.at_s[0]:g}", "there is no --figures for this time", "give --figures DIR too"
        )


def _case(request: SimulationRequest, reporter: Reporter) -> _Case:
    """Returns the model, the values and the protocol that a request asks for.

    Raises InputError for wrong input.
    """
    config_path = request.config or shipped("runs/demo.toml")
    run = Run(_with_device(load_config(config_path), request.device), config_path, Path(), reporter)
    mechanisms = _mechanisms(request.mechanisms)
    spec = model_spec(run, request.mesh, request.observation)
    if spec.forward is not None and (request.fields or request.figures or mechanisms):
        problem = f"{spec.forward} is a model of your own, and computes only the force"
        raise InputError("simulate", problem, "leave out fields, figures and mechanisms")
    base = parameter_space(run.config, config_path)
    added = tuple(p for mechanism in mechanisms for p in mechanism.parameters)
    values = _parameter_values(ParameterSpace((*base.parameters, *added)), spec.geometry, request.settings)
    for parameter in added:
        _refuse_impossible_value(parameter, values[parameter.name])
    file = request.recording or run.beside(run.config.only_recording(config_path).file)
    recording = read_recording(file)
    phases = segment(recording)
    motion = pad_motion(spec, recording, phases, run.config.each_recording[0].protocol)
    return _Case(run, spec, mechanisms, {name: values[name] for name in base.names}, values, phases, motion)


def _with_device(config: Config, device: Path | None) -> Config:
    """Returns the configuration with the sections of a device's file."""
    if device is None:
        return config
    stated = load_device_file(device)
    return config.model_copy(update={"device": stated.device, "tissue": stated.tissue})


def _mechanisms(names: Sequence[str]) -> list[Mechanism]:
    """Returns the named mechanisms. Raises InputError for an unknown name."""
    known = catalogue()
    for name in names:
        if name not in known:
            raise InputError(
                f"--mechanism {name}", "this mechanism is not known", f"use one of {', '.join(known)}"
            )
    return [known[name] for name in dict.fromkeys(names)]


def _parameter_values(space: ParameterSpace, geometry: Geometry, settings: Sequence[str]) -> dict[str, float]:
    """Returns the values of all parameters by name, with the changes of `settings`.

    Raises InputError for a setting that is not NAME=VALUE with a known name.
    """
    values = dict(zip(space.names, space.from_unit([0.5] * space.dim).tolist(), strict=True))
    values |= {name: getattr(geometry, name) for name in LENGTHS if name in values}
    for setting in settings:
        name, equals, text = setting.partition("=")
        if not equals or name not in values:
            raise InputError(
                f"--set {setting}",
                f"{name!r} is not known" if equals else "it states no value",
                f"write NAME=VALUE with one of {', '.join(values)}",
            )
        try:
            values[name] = float(text)
        except ValueError:
            raise InputError(
                f"--set {setting}", f"{text!r} is not a number", "give a number in SI units"
            ) from None
    return values


def _refuse_impossible_value(parameter: Parameter, value: float) -> None:
    """Raises InputError for a value that is not finite or that the parameter cannot have."""
    positive = parameter.in_log and parameter.offset == 0.0
    least = "positive number" if positive else "number of at least 0" if parameter.in_log else "number"
    below = parameter.in_log and (value < 0.0 or (positive and value == 0.0))
    if not np.isfinite(value) or below:
        raise InputError(f"--set {parameter.name}", f"it is {value:g}", f"it must be a finite {least}")


def _field_outputs(
    case: _Case, request: SimulationRequest, moments: Mapping[float, str]
) -> FieldOutputs | None:
    """Returns the collector of the requested fields, or None where no fields are requested.

    Raises InputError where the stresses of the run differ from those of the fields.
    """
    if not (request.fields or request.figures):
        return None
    if not case.spec.formulation.has_fields:
        described = f"the stresses of observation {case.spec.observation!r} differ from those of the fields"
        raise InputError("--fields, --figures", described, "use observation 'reaction'")
    problem = problem_at(case.spec, case.theta)
    _refuse_other_stresses(case.mechanisms, case.solved_theta, problem)
    return FieldOutputs(problem, case.theta, case.motion, moments, request.fields, request.figures)


def _refuse_other_stresses(
    mechanisms: Sequence[Mechanism], values: Mapping[str, float], problem: Problem
) -> None:
    """Raises InputError for a mechanism that changes the tissue's law, because fields are of the base law."""
    for mechanism in mechanisms:
        bind = mechanism.act.bind
        if bind is not None and bind(values, problem.sites).respond is not None:
            raise InputError(
                "--fields, --figures",
                f"the mechanism {mechanism.name} changes the tissue's stress or flow",
                "leave out one of them, because fields are of the base law",
            )


def _reduced_run(case: _Case, sources: Sequence[Path | None], on_state: OnState | None) -> Simulation:
    """Returns a run of the reduced model that fits, with its estimated error.

    sources : files beside which the reduced model is looked for
    Raises InputError where no reduced model exists for this device, mesh or observation.
    """
    spec = case.spec
    if not stands_for(spec) or spec.refinement != 1:
        problem = (
            f"the observation is {spec.observation!r} on {spec.mesh!r} with refinement {spec.refinement}"
        )
        raise InputError("--reduced", problem, "it must be 'reaction' on 'bricks' with refinement 1")
    model = load_reduced(reduced_file(spec.geometry, [source for source in sources if source is not None]))
    return simulate_reduced(
        model, case.motion, case.solved_theta, case.mechanisms, geometry=spec.geometry, estimate=True,
        on_state=on_state,
    )  # fmt: skip


def _with_instrument(simulation: Simulation, case: _Case) -> Simulation:
    """Returns the same run as an instrument with the case's mechanisms reports it.

    It has more times than the time steps of the model.
    """
    if not case.mechanisms:
        return simulation
    time_s = case.motion.times(REPORTED_EVERY_S, simulation.time_s)
    force_n = reported(simulation, case.mechanisms, case.values, case.motion)(time_s)[0]
    return replace(
        simulation,
        theta=dict(case.values),
        time_s=time_s,
        displacement_m=case.motion.at(time_s),
        force_n=force_n,
        stats={**simulation.stats, "peak_force_n": float(np.abs(force_n).max())},
        corner=np.isin(time_s, simulation.time_s[simulation.corner]),
    )
