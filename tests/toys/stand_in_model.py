"""The toy behind the full model's own signature, importable by worker processes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from toys.closed_form_model import SPACE, toy_force

from bayeskin.finite_element.simulate import ModelSpec
from bayeskin.types import PadMotion, Simulation, frozen_array

SCALE = 1e-3  # the toy is a thousand times too stiff for a skin test
MESH_ERROR = 0.03  # of refinement 1, quartered by each more


def simulate(
    spec: ModelSpec,
    motion: PadMotion,
    theta: Mapping[str, float],
    on_progress: Callable[[float], None] | None = None,
    on_state: Callable[[float, object, float], None] | None = None,
    gradients: Mapping[str, float] | None = None,
    laws: Sequence[object] = (),
) -> Simulation:
    if on_state is not None:
        on_state(0.0, None, 0.0)
    time_s = np.unique(np.concatenate([np.linspace(0, motion.time_s[-1], 261), motion.time_s]))
    names = tuple(gradients or ())
    force, step = finer(spec.refinement, theta) * _force(theta, time_s, motion), 1.001
    slopes = [
        finer(spec.refinement, theta)
        * (_force({**theta, name: theta[name] * step}, time_s, motion) - _force(theta, time_s, motion))
        / np.log(step)
        for name in names
    ]
    return Simulation(
        theta=dict(theta),
        time_s=time_s,
        displacement_m=motion.at(time_s),
        force_n=force,
        corner=frozen_array(np.isin(time_s, motion.time_s), bool),
        status="ok",
        message="",
        stats={
            "seconds": 0.0,
            "steps": 261.0,
            "dofs": 1.0,
            "peak_force_n": 1.0,
            "time_error_n": 1e-4,
            "falls": 0.0,
        },
        model_hash=spec.hash,
        gradient_names=names,
        gradient_n=np.array(slopes).T if names else np.zeros((0, 0)),
    )


@dataclass(frozen=True)
class ToyModel:
    """Stands in the place of `bayeskin.forward.design_model.FullModel`."""

    spec: ModelSpec

    @property
    def hash(self) -> str:
        return self.spec.hash

    def __call__(self, motion: PadMotion, theta: Mapping[str, float]) -> Simulation:
        return simulate(self.spec, motion, theta)


def finer(refinement: int, theta: Mapping[str, float]) -> float:
    """Factor on the force of the coarsest mesh: nearly the same everywhere, as the full model's."""
    share = 1.0 - 4.0 ** (1 - refinement)
    return float(1.0 - MESH_ERROR * share * (1.0 + 0.1 * np.log10(theta["E_c"] / theta["E_s"])))


def _force(theta: Mapping[str, float], time_s: np.ndarray, motion: PadMotion) -> np.ndarray:
    return SCALE * toy_force(np.array([[theta[name] for name in SPACE.names]]), time_s, motion)[0]
