"""A reduced model for one recording: a few full runs near a point, on the recording's own protocol.

Over all of the prior a set of mechanisms needs many modes; over the skins that a recording leaves plausible
few will do. Full runs at and near a point, on the recording's protocol, give these modes, and reduced runs
near by the cubature. Each further full run is first predicted, which measures the error. When that is below
what is asked the model is done; else the run joins it. All full runs are kept.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import scipy.sparse as sp

from bayeskin.errors import InputError
from bayeskin.mechanisms import catalogue
from bayeskin.reduced.basis import pod
from bayeskin.reduced.build import BuildSettings, Progress, RunTask, make_runs, read_run, rule_of, shadowed
from bayeskin.reduced.cases import Case
from bayeskin.reduced.library import Library, Modes, scaled_basis
from bayeskin.reduced.model import Cubatures, ReducedModel, inner_of
from bayeskin.reduced.operators import point_fields
from bayeskin.reduced.simulate import simulate_reduced
from bayeskin.reduced.training import TrainingRun
from bayeskin.types import Array, PadMotion, ParameterSpace
from bayeskin.workers import Map


@dataclass(frozen=True)
class EnrichmentSettings:
    """How a reduced model is fitted to a recording.

    width : share of each prior within which full and reduced runs lie, around the point
    first : full runs before the first prediction; most : full runs at most
    kept : modes with singular values below this share of the largest are left out
    modes : displacement and pressure modes at most
    points, shadows : of the cubature, and reduced runs that train it
    wanted : RMS error of a predicted run, as a share of its peak, at which the model is done
    """

    width: float = 0.05
    first: int = 4
    most: int = 10
    kept: float = 3e-5
    modes: tuple[int, int] = (90, 60)
    points: int = 400
    shadows: int = 8
    wanted: float = 1e-3
    seed: int = 1
    build: BuildSettings = field(default_factory=BuildSettings)


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
    task = RunTask(model.trained.geometry, model.refinement)
    runs = _full_runs(task, cases[: settings.first], folder, run_all, progress)
    errors: list[float] = []
    while True:
        fitted = _fitted(model, near, theta, runs, shadows, settings)
        ahead = cases[len(runs)] if len(runs) < len(cases) else None
        if ahead is None:
            break
        (run,) = _full_runs(task, [ahead], folder, run_all, progress)
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

    def box(self, space: ParameterSpace, theta: Mapping[str, float]) -> ParameterSpace:
        """The part of priors within twice the width of a point: where the model is trusted."""
        unit = space.to_unit([theta[name] for name in space.names])
        low = space.from_unit(np.clip(unit - 2.0 * self._width, 0.0, 1.0))
        high = space.from_unit(np.clip(unit + 2.0 * self._width, 0.0, 1.0))
        return ParameterSpace(tuple(
            replace(p, lower=float(a), upper=float(b))
            for p, a, b in zip(space.parameters, low, high, strict=True)
        ))  # fmt: skip


def _full_runs(
    task: RunTask, cases: Sequence[Case], folder: Path, run_all: Map, progress: Progress
) -> list[TrainingRun]:
    """Full runs of cases, made where they are not kept."""
    paths = [folder / f"{case_hash(case)}.h5" for case in cases]
    make_runs(task, list(zip(cases, paths, strict=True)), run_all, progress)
    return [read_run(path) for path in paths]


def case_hash(case: Case) -> str:
    """Returns the sha256 of all that a case's full run depends on but the model."""
    said = [
        sorted(case.theta.items()), case.mechanisms, case.geometry.hash,
        case.motion.time_s.tolist(), case.motion.displacement_m.tolist(),
    ]  # fmt: skip
    return hashlib.sha256(json.dumps(said).encode()).hexdigest()


def _fitted(
    model: ReducedModel, near: _Near, theta: Mapping[str, float], runs: Sequence[TrainingRun],
    shadows: Sequence[Case], settings: EnrichmentSettings,
) -> ReducedModel:  # fmt: skip
    """The reduced model of full runs."""
    problem = model.problem()
    inner, rng = inner_of(problem), np.random.default_rng([settings.seed, 8])
    finished = [run for run in runs if not run.message]
    if not finished:
        raise InputError("enrichment", "no full run that finishes near this point", "a point away from folds")
    modes = Modes(
        _largest([run.displacement for run in finished], inner.displacement, settings, 0),
        _largest([run.pressure for run in finished], inner.pressure, settings, 1),
    )
    basis, rows, rule = scaled_basis(modes, inner), list[Array](), None
    at = point_fields(problem, basis)
    for number, case in enumerate(shadows):
        taken = shadowed(problem, basis, case, rule, settings.build.cubature, rng)
        if len(taken.missing) and np.abs(taken.missing).max() < settings.build.trusted:
            rows.append(taken.rows)
        if number >= 1 and rows:
            rule = rule_of(at, rows, settings.points, settings.build.cubature)
    if rule is None:
        raise InputError(
            "enrichment", "no reduced run that stays near the full model", "a point away from folds"
        )
    empty = Modes(np.zeros((0, modes.displacement.shape[1])), np.zeros((0, modes.pressure.shape[1])))
    known = catalogue()
    tissue = [name for name in near.mechanisms if name in model.trained.mechanisms]
    trained = replace(
        model.trained, base=near.box(model.trained.base, theta),
        mechanisms={name: near.box(ParameterSpace(known[name].parameters), theta) for name in tissue},
    )  # fmt: skip
    return ReducedModel(
        trained, model.refinement, Library(modes, dict.fromkeys(tissue, empty)), Cubatures(rule, rule),
        model.full_hash, f"{model.hash}, enriched",
    )  # fmt: skip


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
