"""A reduced model for one recording: a few full runs near a point, on the recording's own protocol.

Over all of the prior a set of mechanisms needs many modes; over the skins that a recording leaves plausible
few will do. Full runs at and near a point, on the recording's protocol, give these modes, and reduced runs
near by the cubature. Each further full run is first predicted, which measures the error. When that is below
what is asked the model is done; else the run joins it. All full runs are kept.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import scipy.sparse as sp

from bayeskin.errors import InputError
from bayeskin.execution.local import Map
from bayeskin.mechanisms import catalogue
from bayeskin.reduced.basis import Inner, pod
from bayeskin.reduced.build import BuildSettings, Teacher
from bayeskin.reduced.cases import Case, Trained
from bayeskin.reduced.cubature import CubatureSettings
from bayeskin.reduced.library import Library, Modes
from bayeskin.reduced.model import Cubatures, ReducedModel, inner_of
from bayeskin.reduced.runs import FullRuns, Progress, tissue_of
from bayeskin.reduced.simulate import simulate_reduced
from bayeskin.reduced.training import TrainingRun
from bayeskin.types import Array, PadMotion, ParameterSpace


@dataclass(frozen=True)
class EnrichmentSettings:
    """Settings of the fit of a reduced model to a recording.

    width : share of each prior within which full and reduced runs lie, around the point
    first : full runs before the first prediction; most : full runs at most
    kept : modes with singular values below this share of the largest are left out
    modes : displacement and pressure modes at most
    points, shadows : of the cubature, and reduced runs that train it; so few runs need many test vectors a
        state, or the cubature is exact on these vectors alone
    wanted : RMS error of a predicted run, as a share of its peak, at which the model is done
    """

    width: float = 0.05
    first: int = 4
    most: int = 10
    kept: float = 3e-4
    modes: tuple[int, int] = (90, 60)
    points: int = 600
    shadows: int = 6
    wanted: float = 1e-3
    seed: int = 1
    build: BuildSettings = field(
        default_factory=lambda: BuildSettings(cubature=CubatureSettings(every=3, mixtures=40))
    )


@dataclass(frozen=True)
class Enriched:
    """A reduced model around a point, and the RMS errors, over the peak, of the runs that it predicted."""

    model: ReducedModel
    errors: tuple[float, ...]
    full_runs: int

    @property
    def error(self) -> float:
        """The last measured error, over the peak."""
        return self.errors[-1]


def enrich(
    model: ReducedModel, theta: Mapping[str, float], mechanisms: Sequence[str], motion: PadMotion,
    settings: EnrichmentSettings, folder: Path, run_all: Map, progress: Progress,
) -> Enriched:  # fmt: skip
    """Returns the reduced model of a set of mechanisms around a point, on one protocol.

    folder : where full runs are kept, and found again
    Raises InputError where no full run finishes.
    """
    rng = np.random.default_rng([settings.seed, 7])
    near = _Near(model, mechanisms, motion, settings.width)
    cases = [near.case(theta, None), *(near.case(theta, rng) for _ in range(settings.most - 1))]
    shadows = [near.case(theta, rng) for _ in range(settings.shadows)]
    full = FullRuns(model.trained.geometry, model.refinement, folder)

    def made(some: Sequence[Case]) -> list[TrainingRun]:
        full.make(some, run_all, progress)
        return [full.read(case) for case in some]

    runs = made(cases[: settings.first])
    errors: list[float] = []
    while True:
        library = _library(near, runs, inner_of(model.problem()), settings)
        teacher = Teacher(full, library, settings.build, "cubature near the point")
        rule = teacher.rule(shadows, settings.points, run_all, progress)
        fitted = replace(
            model, trained=near.region(model.trained, theta), library=library,
            cubatures=Cubatures(rule, rule), hash=f"{model.hash}, enriched",
        )  # fmt: skip
        ahead = cases[len(runs)] if len(runs) < len(cases) else None
        if ahead is None:
            break
        (run,) = made([ahead])
        errors.append(_error(fitted, ahead, run))
        if errors[-1] <= settings.wanted:
            break
        runs.append(run)
    return Enriched(fitted, tuple(errors), len(runs) + (1 if ahead is not None else 0))


class _Near:
    """Cases around a point."""

    def __init__(
        self, model: ReducedModel, mechanisms: Sequence[str], motion: PadMotion, width: float
    ) -> None:
        known = catalogue()
        spaces = [model.trained.base, *(ParameterSpace(known[name].parameters) for name in mechanisms)]
        self.space = ParameterSpace(tuple(p for space in spaces for p in space.parameters))
        self.mechanisms, self._motion, self._width = tuple(sorted(mechanisms)), motion, width
        self._geometry = model.trained.geometry

    def case(self, theta: Mapping[str, float], rng: np.random.Generator | None) -> Case:
        """The point itself, or one drawn within the width of it on each prior."""
        unit = self.space.to_unit([theta[name] for name in self.space.names])
        if rng is not None:
            unit = np.clip(unit + rng.uniform(-self._width, self._width, self.space.dim), 0.0, 1.0)
        values = dict(zip(self.space.names, map(float, self.space.from_unit(unit)), strict=True))
        return Case(values, self.mechanisms, self._geometry, self._motion)

    def region(self, trained: Trained, theta: Mapping[str, float]) -> Trained:
        """The part of a trained region within twice the width of a point: where the model is trusted."""
        known = catalogue()
        spaces = {name: ParameterSpace(known[name].parameters) for name in tissue_of(self.mechanisms)}
        mechanisms = {name: self._part(space, theta) for name, space in spaces.items()}
        return replace(trained, base=self._part(trained.base, theta), mechanisms=mechanisms)

    def _part(self, space: ParameterSpace, theta: Mapping[str, float]) -> ParameterSpace:
        unit = space.to_unit([theta[name] for name in space.names])
        low = space.from_unit(np.clip(unit - 2.0 * self._width, 0.0, 1.0))
        high = space.from_unit(np.clip(unit + 2.0 * self._width, 0.0, 1.0))
        return ParameterSpace(tuple(
            replace(p, lower=float(a), upper=float(b))
            for p, a, b in zip(space.parameters, low, high, strict=True)
        ))  # fmt: skip


def _library(near: _Near, runs: Sequence[TrainingRun], inner: Inner, settings: EnrichmentSettings) -> Library:
    """The modes of full runs, as those of the base model; the mechanisms have none beside them."""
    finished = [run for run in runs if not run.message]
    if not finished:
        raise InputError("enrichment", "no full run that finishes near this point", "a point away from folds")
    modes = Modes(
        _largest([run.displacement for run in finished], inner.displacement, settings, 0),
        _largest([run.pressure for run in finished], inner.pressure, settings, 1),
    )
    empty = Modes(np.zeros((0, modes.displacement.shape[1])), np.zeros((0, modes.pressure.shape[1])))
    return Library(modes, dict.fromkeys(tissue_of(near.mechanisms), empty))


def _largest(rows: Sequence[Array], inner: sp.csr_matrix, settings: EnrichmentSettings, field: int) -> Array:
    """The modes of weighted rows with the largest singular values; field : 0 displacement, 1 pressure."""
    values, modes = pod(np.concatenate(rows).astype(float), inner)
    return modes[: min(settings.modes[field], int((values > settings.kept * values[0]).sum()))]


def _error(model: ReducedModel, case: Case, run: TrainingRun) -> float:
    """The RMS error of a reduced run beside the full one, over its peak; infinite where either fails."""
    known = catalogue()
    found = simulate_reduced(model, case.motion, case.theta, [known[name] for name in case.mechanisms])
    if run.message or found.status != "ok":
        return float("inf")
    wrong_n = found.at(run.time_s) - run.force_n
    weight = np.gradient(run.time_s)
    rms_n = np.sqrt(np.average(np.square(wrong_n), weights=weight))
    return float(rms_n / np.abs(run.force_n).max())
