"""The models that a configuration asks for: the full model, and the model that runs a design's waves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from bayeskin.errors import InputError
from bayeskin.finite_element.simulate import ModelSpec
from bayeskin.forward.design_model import ForceModel, FullModel, ReducedOrFull
from bayeskin.forward.joint import EachRecording
from bayeskin.reduced.files import load_reduced
from bayeskin.reduced.region import protocol_outside
from bayeskin.types import PadMotion
from bayeskin.workflow.engine import Run
from bayeskin.workflow.reducing import reduced_file


def model_spec(run: Run, mesh: str | None = None, observation: str | None = None) -> ModelSpec:
    """Returns the configuration's model; `mesh` and `observation` override the configuration.

    A mesh file of the configuration lies beside it; a mesh file given as `mesh` lies in the working folder.
    Uncertain lengths have their means, because a run has them among its parameters. Raises InputError for a
    mesh that does not exist or does not fit the observation.
    """
    model, geometry = run.config.model, run.config.geometry(run.config_path).geometry
    if model.forward is not None and mesh is None and observation is None:
        return ModelSpec(observation="own", forward=_beside(run, model.forward))
    if model.observation == "own" and observation is None:
        raise InputError(
            f"--mesh {mesh}",
            "a model of your own has no mesh",
            "give --observation too, to run the full model",
        )
    if mesh is None:
        mesh = model.mesh if model.mesh == "bricks" else str(run.beside(model.mesh))
    return ModelSpec(
        observation=observation or model.observation,  # type: ignore[arg-type]
        mesh=mesh,
        refinement=model.refinement,
        geometry=geometry,
    )


def own_files(run: Run) -> list[Path]:
    """Returns the file, beside the configuration, of a forward model of the user's own, in a list."""
    place = (run.config.model.forward or "").rpartition(":")[0]
    return [run.beside(place)] if place.endswith(".py") else []


def _beside(run: Run, forward: str) -> str:
    """Returns the address of a forward model, with the full path of its file."""
    files = own_files(run)
    return f"{files[0]}:{forward.rpartition(':')[2]}" if files else forward


def full_model(run: Run) -> ForceModel:
    """Returns the configuration's model. Raises InputError as `model_spec`."""
    return _on_all_recordings(run, FullModel(model_spec(run)))


def _on_all_recordings(run: Run, model: ForceModel) -> ForceModel:
    """Returns a model that runs on the protocol of each recording, where there are several."""
    return EachRecording(model) if run.config.recordings else model


def waves_model(run: Run) -> ForceModel:
    """Returns the model that runs the design's waves: the configuration's model, or a quicker model.

    The configuration's model then corrects the quicker model. Raises InputError as `model_spec`, and where
    the configuration's device has no reduced model.
    """
    coarse, spec = run.config.design.coarse, model_spec(run)
    if coarse is None:
        return full_model(run)
    if coarse != "reduced":
        return _on_all_recordings(run, FullModel(replace(spec, refinement=coarse)))
    (file,) = reduced_files(run)
    full = FullModel(replace(spec, refinement=load_reduced(file).refinement))
    return _on_all_recordings(run, ReducedOrFull(file, full))


def reduced_files(run: Run) -> list[Path]:
    """Returns the file, in a list, of the reduced model that runs the design's waves.

    The list is empty where another model runs the waves. Raises InputError where the configuration's device
    has no reduced model.
    """
    if run.config.design.coarse != "reduced":
        return []
    return [reduced_file(run.config.geometry(run.config_path).geometry, [run.config_path])]


def check_protocol(run: Run, motion: PadMotion) -> None:
    """Raises InputError where a reduced model runs the waves and was not trained for the protocol."""
    for file in reduced_files(run):
        protocols = load_reduced(file).trained.protocols
        lines = [line for part in motion.parts for line in protocol_outside(protocols, part)]
        if lines:
            problem = f"{file.name} was not trained for this protocol ({lines[0]})"
            raise InputError(
                f"{run.config_path}: design.coarse", problem, "use coarse = 0, or no coarse model"
            )
