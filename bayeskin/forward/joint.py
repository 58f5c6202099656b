"""Forward models of several recordings of one skin: each recording runs on its own protocol, from rest.

The recordings share the parameters of the skin. A value that a recording has for itself, such as its initial
pressure, has its number in its name (`types.joint`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bayeskin.finite_element.simulate import ModelSpec
from bayeskin.forward.design_model import ForceModel
from bayeskin.forward.interface import ForwardModel, ModelRun
from bayeskin.mechanisms import Mechanism
from bayeskin.mechanisms.each_recording import in_one_recording
from bayeskin.types import Array, PadMotion, ParameterSpace, Simulation
from bayeskin.types.joint import end_to_end, plain_name, values_in


@dataclass(frozen=True)
class JointForward:
    """The forward model of several recordings; `parts` are the forward models of the single ones."""

    parts: tuple[ForwardModel, ...]

    @property
    def solves(self) -> frozenset[str]:
        """Returns the names of the mechanisms that the forward model of each recording solves."""
        return self.parts[0].solves

    @property
    def hash(self) -> str:
        return self.parts[0].hash

    @property
    def spec(self) -> ModelSpec:
        """Returns the specification of the full model that it replaces."""
        return self.parts[0].spec

    def run(
        self, space: ParameterSpace, at: Array, mechanisms: Sequence[Mechanism], derive: bool
    ) -> ModelRun | str:
        """Returns the runs of all recordings as one run, or the reason why one of them failed."""
        plain, runs, columns = [in_one_recording(m) for m in mechanisms], [], []
        for number, part in enumerate(self.parts):
            own = _columns(space, number)
            run = part.run(_space(space, own), at[own], plain, derive)
            if isinstance(run, str):
                return f"recording {number + 1}: {run}"
            runs.append(run)
            columns.append(own)
        force_n = end_to_end([run.force_n for run in runs], 0.0)
        if not derive:
            return ModelRun(at, force_n, None)
        slopes_n = []
        for run, own in zip(runs, columns, strict=True):
            assert run.slopes_n is not None
            slopes = np.zeros((space.dim, len(run.force_n)))
            slopes[own] = run.slopes_n.T
            slopes_n.append(slopes)
        return ModelRun(at, force_n, end_to_end(slopes_n, 0.0).T)

    def errors(self, at: Array) -> Array:
        """Returns no errors (0, m), since the reduced models of the recordings state none."""
        return np.zeros((0, sum(part.errors(at).shape[1] for part in self.parts) + len(self.parts) - 1))


def _columns(space: ParameterSpace, recording: int) -> list[int]:
    """Returns the columns of a joint space that one recording uses: its own values, and shared ones."""
    columns = {name: column for column, name in enumerate(space.names)}
    return sorted(values_in(columns, recording).values())


def _space(space: ParameterSpace, columns: Sequence[int]) -> ParameterSpace:
    """Returns the parameters in some columns of a space, with their plain names."""
    chosen = (space.parameters[column] for column in columns)
    return ParameterSpace(tuple(replace(p, name=plain_name(p.name)) for p in chosen))


@dataclass(frozen=True)
class EachRecording:
    """A model whose runs make a design, on the protocols of several recordings one after the other."""

    model: ForceModel

    @property
    def hash(self) -> str:
        return self.model.hash

    def __call__(self, motion: PadMotion, theta: Mapping[str, float]) -> Simulation:
        """Returns the runs of all recordings as one simulation; a failed run is returned as it is."""
        return on_each_recording(lambda part, values, _: self.model(part, values), motion, theta)


# Returns a run on a protocol at values by name; with changes by name, it has derivatives by these parameters.
RunOnOne = Callable[[PadMotion, Mapping[str, float], Mapping[str, float] | None], Simulation]


def on_each_recording(
    run: RunOnOne, motion: PadMotion, theta: Mapping[str, float], by: Mapping[str, float] | None = None
) -> Simulation:
    """Returns the runs of all recordings as one simulation on their common axis of time.

    A run that fails is returned as it is. A single recording is run as it is.

    theta : values by name, with those that each recording has for itself
    by : changes of the parameters to differentiate by; None for no derivatives
    """
    if not motion.spans:
        return run(motion, theta, by)
    runs: list[Simulation] = []
    for number, part in enumerate(motion.parts):
        own = run(part, values_in(theta, number), None if by is None else values_in(by, number))
        if own.status != "ok":
            return replace(own, theta=dict(theta), message=f"recording {number + 1}: {own.message}")
        runs.append(own)
    starts_s = [span.start_s for span in motion.spans]
    return replace(
        runs[0],
        theta=dict(theta),
        time_s=np.concatenate([own.time_s + start for own, start in zip(runs, starts_s, strict=True)]),
        displacement_m=np.concatenate([own.displacement_m for own in runs]),
        force_n=np.concatenate([own.force_n for own in runs]),
        corner=np.concatenate([_with_ends(own.corner) for own in runs]),
        message="; ".join(own.message for own in runs if own.message),
        stats={name: sum(own.stats.get(name, 0.0) for own in runs) for name in runs[0].stats},
        gradient_names=tuple(by or ()),
        gradient_n=np.concatenate(
            [_gradient(own, number, tuple(by or ())) for number, own in enumerate(runs)]
        ),
    )


def _with_ends(corner: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Returns flags of corners that are also True at the ends of a recording."""
    flags = corner.copy()
    flags[[0, -1]] = True
    return flags


def _gradient(run: Simulation, recording: int, names: Sequence[str]) -> Array:
    """Returns the derivatives (n, r) [N] of one recording's run by the parameters of all recordings."""
    gradient_n = np.zeros((len(run.time_s), len(names)))
    columns = values_in({name: column for column, name in enumerate(names)}, recording)
    for plain, values in zip(run.gradient_names, run.gradient_n.T, strict=True):
        gradient_n[:, columns[plain]] = values
    return gradient_n
