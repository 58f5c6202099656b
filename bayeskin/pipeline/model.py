"""The full model that a configuration asks for."""

from __future__ import annotations

from dataclasses import replace

from bayeskin.model.simulate import ModelSpec
from bayeskin.pipeline.engine import Run


def model_spec(run: Run, mesh: str | None = None, observation: str | None = None) -> ModelSpec:
    """The configuration's model; a mesh file or an observation given here goes before the configuration's.

    A mesh file in the configuration lies beside it, one given here in the working folder.
    Raises InputError for a mesh that does not exist or does not fit the observation.
    """
    model = run.config.model
    if mesh is None:
        mesh = model.mesh if model.mesh == "bricks" else str(run.beside(model.mesh))
    return ModelSpec(
        observation=observation or model.observation,  # type: ignore[arg-type]
        mesh=mesh,
        refinement=model.refinement,
    )


def waves_spec(run: Run) -> ModelSpec:
    """The model that the design's waves run: the configuration's, or a coarser one that it corrects."""
    coarse = run.config.design.coarse
    return model_spec(run) if coarse is None else replace(model_spec(run), refinement=coarse)
