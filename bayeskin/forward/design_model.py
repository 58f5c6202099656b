"""Defines the models whose runs make a design: the full model, or the reduced model where it was trained."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from bayeskin.finite_element.simulate import ModelSpec, simulate
from bayeskin.hashing import sha256_of
from bayeskin.reduced.files import load_reduced
from bayeskin.reduced.simulate import simulate_reduced
from bayeskin.types import PadMotion, Simulation


class ForceModel(Protocol):
    """A model whose runs make a design. It is frozen and can be pickled, so that worker processes can use it.

    hash : sha256 of all that the force depends on besides motion and parameters; each run carries it
    """

    @property
    def hash(self) -> str: ...

    def __call__(self, motion: PadMotion, theta: Mapping[str, float]) -> Simulation: ...


@dataclass(frozen=True)
class FullModel:
    """Runs the model of a specification: the full model on any mesh, or the user's own model."""

    spec: ModelSpec

    @property
    def hash(self) -> str:
        return self.spec.hash

    def __call__(self, motion: PadMotion, theta: Mapping[str, float]) -> Simulation:
        return simulate(self.spec, motion, theta)


@dataclass(frozen=True)
class ReducedOrFull:
    """Runs the reduced model of a file, and the full model where the reduced model fails or was not trained.

    The message of a run by the full model says why it was needed.

    replaces : True to run the full model there; False to return the failed reduced run
    """

    file: Path
    full: FullModel
    replaces: bool = True

    @property
    def hash(self) -> str:
        return sha256_of([load_reduced(self.file).hash, self.full.hash])

    def __call__(self, motion: PadMotion, theta: Mapping[str, float]) -> Simulation:
        model = load_reduced(self.file)
        run = simulate_reduced(model, motion, theta, geometry=self.full.spec.geometry)
        if run.status != "ok" and self.replaces:
            full = self.full(motion, theta)
            run = full if full.message else replace(full, message=f"run by the full model: {run.message}")
        return replace(run, model_hash=self.hash)
