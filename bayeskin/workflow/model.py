"""The models that a configuration asks for: the full model, and the one that makes a design's waves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from bayeskin.errors import InputError
from bayeskin.finite_element.accuracy import mesh_error
from bayeskin.finite_element.simulate import ModelSpec
from bayeskin.forward.design_model import ForceModel, FullModel, ReducedOrFull
from bayeskin.inference.model_error import CALIBRATION, ModelError
from bayeskin.reduced.files import load_reduced
from bayeskin.reduced.region import protocol_outside
from bayeskin.types import Array, PadMotion
from bayeskin.workflow.engine import Run
from bayeskin.workflow.reducing import reduced_file

UNKNOWN_MESH = 5e-3  # RMS error of bricks that no study was made of, over the force (docs/discretisation.md)


def model_spec(run: Run, mesh: str | None = None, observation: str | None = None) -> ModelSpec:
    """The configuration's model; a mesh file or an observation given here goes before the configuration's.

    A mesh file in the configuration lies beside it, one given here in the working folder.
    Uncertain lengths stand at their means; a run has them among its parameters.
    Raises InputError for a mesh that does not exist or does not fit the observation.
    """
    model, geometry = run.config.model, run.config.geometry(run.config_path).geometry
    if model.forward is not None and mesh is None and observation is None:
        return ModelSpec(observation="own", forward=_beside(run, model.forward))
    if model.observation == "own" and observation is None:
        raise InputError(f"--mesh {mesh}", "a model of your own, which has none", "--observation with it")
    if mesh is None:
        mesh = model.mesh if model.mesh == "bricks" else str(run.beside(model.mesh))
    return ModelSpec(
        observation=observation or model.observation,  # type: ignore[arg-type]
        mesh=mesh,
        refinement=model.refinement,
        geometry=geometry,
    )


def model_error(spec: ModelSpec, motion: PadMotion, edges_s: Array) -> ModelError | None:
    """Returns the errors that are allowed for of a model's force in bins.

    None for the article's observation, which is defined on its own mesh and steps, and for a model of one's
    own, of whose error nothing is known.
    """
    if spec.observation != "reaction":
        return None
    known = mesh_error(spec.mesh_hash)
    mesh = UNKNOWN_MESH if known is None else known.rms
    return ModelError(motion, edges_s, float(np.hypot(mesh, CALIBRATION)))


def own_files(run: Run) -> list[Path]:
    """The file in which a forward model of one's own stands beside the configuration."""
    place = (run.config.model.forward or "").rpartition(":")[0]
    return [run.beside(place)] if place.endswith(".py") else []


def _beside(run: Run, forward: str) -> str:
    """Returns the place of a forward model, as it is called from anywhere."""
    files = own_files(run)
    return f"{files[0]}:{forward.rpartition(':')[2]}" if files else forward


def full_model(run: Run) -> ForceModel:
    """Returns the configuration's model. Raises InputError as `model_spec`."""
    return FullModel(model_spec(run))


def waves_model(run: Run) -> ForceModel:
    """Returns the model that the design's waves run: the configuration's, or a quicker one that it corrects.

    Raises InputError as `model_spec`, and where the configuration's device has no reduced model.
    """
    coarse, spec = run.config.design.coarse, model_spec(run)
    if coarse is None:
        return FullModel(spec)
    if coarse != "reduced":
        return FullModel(replace(spec, refinement=coarse))
    (file,) = reduced_files(run)
    return ReducedOrFull(file, FullModel(replace(spec, refinement=load_reduced(file).refinement)))


def reduced_files(run: Run) -> list[Path]:
    """Returns the file of the reduced model that makes the design's waves; none where another model does.

    Raises InputError where the configuration's device has no reduced model.
    """
    if run.config.design.coarse != "reduced":
        return []
    return [reduced_file(run.config.geometry(run.config_path).geometry, [run.config_path])]


def check_protocol(run: Run, motion: PadMotion) -> None:
    """Raises InputError where a reduced model makes the waves and does not know the protocol."""
    for file in reduced_files(run):
        lines = protocol_outside(load_reduced(file).trained.protocols, motion)
        if lines:
            found = f"'reduced' on a protocol that {file.name} does not know: {lines[0]}"
            raise InputError(f"{run.config_path}: design.coarse", found, "coarse = 0, or no such key")
