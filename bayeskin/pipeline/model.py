"""The full model that a configuration asks for."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from bayeskin.errors import InputError
from bayeskin.model.simulate import ModelSpec
from bayeskin.pipeline.engine import Run


def model_spec(run: Run, mesh: str | None = None, observation: str | None = None) -> ModelSpec:
    """The configuration's model; a mesh file or an observation given here goes before the configuration's.

    A mesh file in the configuration lies beside it, one given here in the working folder.
    Raises InputError for a mesh that does not exist or does not fit the observation, or uncertain lengths.
    """
    model, geometry = run.config.model, run.config.certain_geometry(run.config_path)
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


def own_files(run: Run) -> list[Path]:
    """The file in which a forward model of one's own stands beside the configuration."""
    place = (run.config.model.forward or "").rpartition(":")[0]
    return [run.beside(place)] if place.endswith(".py") else []


def _beside(run: Run, forward: str) -> str:
    """Where a forward model is, from wherever it is called."""
    files = own_files(run)
    return f"{files[0]}:{forward.rpartition(':')[2]}" if files else forward


def waves_spec(run: Run) -> ModelSpec:
    """The model that the design's waves run: the configuration's, or a coarser one that it corrects."""
    coarse = run.config.design.coarse
    return model_spec(run) if coarse is None else replace(model_spec(run), refinement=coarse)
