"""Fits a reduced model to one recording, with a few full runs near a point and on the recording's protocol.

A set of mechanisms needs many modes over the whole prior, but few over the skins that a recording leaves
plausible. Full runs at and near a point, on the recording's protocol, give these modes. Reduced runs near the
point train the cubature. The model predicts each further full run before that run is added, which measures
the error. The model is finished when the error is not above the wanted value; otherwise the run is added.
All full runs are kept in a store.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.sparse as sp

from bayeskin.errors import InputError
from bayeskin.execution.local import Map
from bayeskin.finite_element.simulate import ModelSpec
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
from bayeskin.store import Store
from bayeskin.types import Array, PadMotion, ParameterSpace


@dataclass(frozen=True)
class EnrichmentSettings:
    """Settings of the fit of a reduced model to a recording.

    width : largest distance of a run's parameters from the point, in the unit coordinate of each prior
    first : number of full runs before the first prediction; most : largest number of full runs
    kept : modes with singular values below this fraction of the largest are left out
    modes : largest numbers of displacement and pressure modes
    points : number of cubature points; shadows : number of reduced runs that train the cubature. Since these
        runs are few, each state needs many test vectors; else the cubature is exact on those vectors alone
    wanted : RMS error of a predicted run at which the model is finished, as a fraction of its peak force
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
    """A reduced model around a point, and the RMS errors of its predictions, relative to the peak force."""

    model: ReducedModel
    errors: tuple[float, ...]
    full_runs: int

    @property
    def error(self) -> float:
        """Returns the last measured error, relative to the peak force."""
        return self.errors[-1]


def enrich(
    model: ReducedModel, theta: Mapping[str, float], mechanisms: Sequence[str], motion: PadMotion,
    settings: EnrichmentSettings, store: Store, run_all: Map, progress: Progress,
) -> Enriched:  # fmt: skip
    """Returns the reduced model of a set of mechanisms around a point, on one protocol.

    store : an open store, which keeps the full runs
    Raises InputError where no full run finishes.
    """
    rng = np.random.default_rng([settings.seed, 7])
    nearby = _NearbyCases(model, mechanisms, motion, settings.width)
    cases = [nearby.case(theta, None), *(nearby.case(theta, rng) for _ in range(settings.most - 1))]
    shadows = [nearby.case(theta, rng) for _ in range(settings.shadows)]
    full = FullRuns(ModelSpec(refinement=model.refinement, geometry=model.trained.geometry), store)

    def full_runs_of(wanted: Sequence[Case]) -> list[TrainingRun]:
        full.make(wanted, run_all, progress)
        return [full.read(case) for case in wanted]

    runs = full_runs_of(cases[: settings.first])
    errors: list[float] = []
    while True:
        library = _library(nearby, runs, inner_of(model.problem()), settings)
        teacher = Teacher(full.spec, library, settings.build, "cubature near the point")
        rule = teacher.rule(shadows, settings.points, run_all, progress)
        fitted = replace(
            model, trained=nearby.region(model.trained, theta), library=library,
            cubatures=Cubatures(rule, rule), hash=f"{model.hash}, enriched",
        )  # fmt: skip
        next_case = cases[len(runs)] if len(runs) < len(cases) else None
        if next_case is None:
            break
        (run,) = full_runs_of([next_case])
        errors.append(_rms_error(fitted, next_case, run))
        if errors[-1] <= settings.wanted:
            break
        runs.append(run)
    return Enriched(fitted, tuple(errors), len(runs) + (1 if next_case is not None else 0))


class _NearbyCases:
    """Draws training cases around a point of the priors, on one protocol."""

    def __init__(
        self, model: ReducedModel, mechanisms: Sequence[str], motion: PadMotion, width: float
    ) -> None:
        known = catalogue()
        spaces = [model.trained.base, *(ParameterSpace(known[name].parameters) for name in mechanisms)]
        self.space = ParameterSpace(tuple(p for space in spaces for p in space.parameters))
        self.mechanisms, self._motion, self._width = tuple(sorted(mechanisms)), motion, width
        self._geometry = model.trained.geometry

    def case(self, theta: Mapping[str, float], rng: np.random.Generator | None) -> Case:
        """Returns the case at the point itself, or with `rng` a random case within the width around it."""
        unit = self.space.to_unit([theta[name] for name in self.space.names])
        if rng is not None:
            unit = np.clip(unit + rng.uniform(-self._width, self._width, self.space.dim), 0.0, 1.0)
        values = dict(zip(self.space.names, map(float, self.space.from_unit(unit)), strict=True))
        return Case(values, self.mechanisms, self._geometry, self._motion)

    def region(self, trained: Trained, theta: Mapping[str, float]) -> Trained:
        """Returns a trained region narrowed to twice the width around a point, where the model is trusted."""
        known = catalogue()
        spaces = {name: ParameterSpace(known[name].parameters) for name in tissue_of(self.mechanisms)}
        mechanisms = {name: self._narrowed(space, theta) for name, space in spaces.items()}
        return replace(trained, base=self._narrowed(trained.base, theta), mechanisms=mechanisms)

    def _narrowed(self, space: ParameterSpace, theta: Mapping[str, float]) -> ParameterSpace:
        unit = space.to_unit([theta[name] for name in space.names])
        low = space.from_unit(np.clip(unit - 2.0 * self._width, 0.0, 1.0))
        high = space.from_unit(np.clip(unit + 2.0 * self._width, 0.0, 1.0))
        return ParameterSpace(tuple(
            replace(p, lower=float(a), upper=float(b))
            for p, a, b in zip(space.parameters, low, high, strict=True)
        ))  # fmt: skip


def _library(
    near: _NearbyCases, runs: Sequence[TrainingRun], inner: Inner, settings: EnrichmentSettings
) -> Library:
    """Returns a library whose base modes are the modes of full runs; its mechanisms add no modes."""
    finished = [run for run in runs if not run.message]
    if not finished:
        raise InputError(
            "enrichment",
            "no full run near this point finishes",
            "use parameters with which the skin does not fold",
        )
    modes = Modes(
        _largest_modes([run.displacement for run in finished], inner.displacement, settings, 0),
        _largest_modes([run.pressure for run in finished], inner.pressure, settings, 1),
    )
    empty = Modes(np.zeros((0, modes.displacement.shape[1])), np.zeros((0, modes.pressure.shape[1])))
    return Library(modes, dict.fromkeys(tissue_of(near.mechanisms), empty))


def _largest_modes(
    rows: Sequence[Array], inner: sp.csr_matrix, settings: EnrichmentSettings, field: int
) -> Array:
    """Returns the modes of weighted rows with the largest singular values.

    field : 0 for displacement, 1 for pressure
    """
    values, modes = pod(np.concatenate(rows).astype(float), inner)
    return modes[: min(settings.modes[field], int((values > settings.kept * values[0]).sum()))]


def _rms_error(model: ReducedModel, case: Case, run: TrainingRun) -> float:
    """Returns the RMS error of a reduced run over the full run's peak force; infinite where a run fails."""
    known = catalogue()
    prediction = simulate_reduced(model, case.motion, case.theta, [known[name] for name in case.mechanisms])
    if run.message or prediction.status != "ok":
        return float("inf")
    error_n = prediction.at(run.time_s) - run.force_n
    weight = np.gradient(run.time_s)
    rms_n = np.sqrt(np.average(np.square(error_n), weights=weight))
    return float(rms_n / np.abs(run.force_n).max())
