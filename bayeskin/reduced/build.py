"""Building a reduced model: training runs of the full model, then modes, then cubatures.

The base model comes first and can be used by itself. Training runs are independent of each other, and each is
kept as soon as it is finished, so that an interrupted building goes on; modes and cubatures take minutes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import h5py
import numpy as np

from bayeskin import storage
from bayeskin.errors import InputError
from bayeskin.mechanisms import catalogue
from bayeskin.model.mesh import brick_mesh
from bayeskin.model.problem import Problem, build_problem
from bayeskin.model.simulate import ModelSpec, problem_of
from bayeskin.model.tissue import Bind
from bayeskin.reduced.basis import Inner, inner_products, pod
from bayeskin.reduced.cases import BASE, Case, Trained
from bayeskin.reduced.cubature import CubatureSettings, Taken, choose_points, take, with_volumes
from bayeskin.reduced.equations import ReducedEquations, ReducedSpace
from bayeskin.reduced.library import Library, Modes, library
from bayeskin.reduced.model import Cubatures, ReducedModel, SurfacesOf, reduced_space
from bayeskin.reduced.operators import Basis, LinearParts, Rule, point_fields
from bayeskin.reduced.shadow import Shadow
from bayeskin.reduced.training import training_run
from bayeskin.types import Array
from bayeskin.workers import Lost, Map

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class BuildSettings:
    """How large a reduced model is and what it learns from.

    runs : training runs of the base model and of each mechanism
    base, each : displacement and pressure modes of the base model, and of each mechanism beyond the base's
    base_points, set_points : of the cubatures
    base_shadows, set_shadows : reduced runs that train the cubatures, of the base model and of each mechanism
    trusted : the largest share of the peak force that points left out in a run whose integrands are learnt
    seed : of the training cases; those of the cubatures have others
    """

    runs: int = 38
    base: tuple[int, int] = (76, 72)
    each: tuple[int, int] = (30, 20)
    base_points: int = 350
    set_points: int = 700
    base_shadows: int = 40
    set_shadows: int = 4
    trusted: float = 0.1
    seed: int = 1
    cubature: CubatureSettings = field(default_factory=CubatureSettings)


@dataclass(frozen=True)
class TrainingTask:
    """Runs one training case and keeps its modes in a file; picklable, for workers.

    Given (kind, index) it returns the message of a run that ended early, else an empty one.
    """

    trained: Trained
    refinement: int
    seed: int
    folder: Path

    def __call__(self, item: tuple[str, int]) -> str:
        kind, index = item
        case = self.trained.case(kind, index, self.seed)
        own = self.trained.geometry
        nominal = problem_of("bricks", self.refinement, own)
        moved = case.geometry != own
        problem = build_problem(brick_mesh(self.refinement, case.geometry, own)) if moved else nominal
        run = training_run(problem, _inner_of(self.refinement, own), case, _binds(case.mechanisms))

        def fill(handle: h5py.File) -> None:
            handle.attrs["message"] = run.message
            handle["displacement"], handle["pressure"] = run.displacement, run.pressure

        storage.write_hdf5(run_path(self.folder, kind, index), fill)
        return run.message


def run_path(folder: Path, kind: str, index: int) -> Path:
    """Returns where a training run is kept."""
    return folder / f"{kind}-{index:04d}.h5"


@cache
def _inner_of(refinement: int, geometry: object) -> Inner:
    return inner_products(problem_of("bricks", refinement, geometry))  # type: ignore[arg-type]


def _binds(mechanisms: Sequence[str]) -> list[Bind]:
    known = catalogue()
    return [bind for name in mechanisms if (bind := known[name].act.bind) is not None]


def train(
    trained: Trained, refinement: int, kinds: Sequence[str], settings: BuildSettings, folder: Path,
    run_all: Map, progress: Progress,
) -> None:  # fmt: skip
    """Makes the training runs that are not in `folder` yet. Raises InputError where a worker is lost."""
    wanted = [(kind, index) for index in range(settings.runs) for kind in kinds]
    todo = [item for item in wanted if not run_path(folder, *item).is_file()]
    task = TrainingTask(trained, refinement, settings.seed, folder)
    done = len(wanted) - len(todo)
    progress("training runs", done / max(len(wanted), 1))
    for number, result in run_all(task, todo):
        if isinstance(result, Lost):
            raise InputError(f"training run {todo[number]}", result.reason, "a worker that finishes it")
        done += 1
        progress("training runs", done / len(wanted))


def weighted_of(kind: str, settings: BuildSettings, folder: Path, inner: Inner) -> Modes:
    """Returns the modes of a kind's training runs, each times its singular value, without failed runs."""
    rows: tuple[list[Array], list[Array]] = ([], [])
    for index in range(settings.runs):
        with storage.reading(run_path(folder, kind, index), "a training run") as handle:
            if not handle.attrs["message"]:
                for kept, name in zip(rows, ("displacement", "pressure"), strict=True):
                    kept.append(handle[name][()].astype(float))
    if not rows[0]:
        raise InputError(f"{folder}: {kind}", "no training run that finished", "one at least")
    u, p = (
        pod(np.concatenate(r), i) for r, i in zip(rows, (inner.displacement, inner.pressure), strict=True)
    )
    return Modes(u[0][:, None] * u[1], p[0][:, None] * p[1])


def assemble(
    trained: Trained, refinement: int, weighted: Mapping[str, Modes], settings: BuildSettings,
    progress: Progress,
) -> ReducedModel:  # fmt: skip
    """Returns the reduced model of the modes of each kind, with its cubatures trained."""
    spec = ModelSpec(refinement=refinement, geometry=trained.geometry)
    problem = problem_of("bricks", refinement, trained.geometry)
    inner = _inner_of(refinement, trained.geometry)
    modes = library(weighted, inner, settings.base, settings.each)
    teacher = _Teacher(trained, problem, inner, modes, settings, progress)
    base = teacher.base_rule()
    return ReducedModel(trained, refinement, modes, Cubatures(base, teacher.set_rule(base)), spec.hash)


class _Teacher:
    """Trains cubatures on reduced runs that are followed on all points."""

    def __init__(
        self, trained: Trained, problem: Problem, inner: Inner, modes: Library, settings: BuildSettings,
        progress: Progress,
    ) -> None:  # fmt: skip
        self._trained, self._problem, self._inner, self._modes = trained, problem, inner, modes
        self._settings, self._progress = settings, progress
        self._rng = np.random.default_rng([settings.seed, 2])
        self._rows: list[Array] = []
        self._volumes = point_fields(problem, modes.basis((), inner))

    def base_rule(self) -> Rule:
        """Trains the cubature of the base model: on all points first, then on the points of a first rule."""
        s, basis = self._settings, self._modes.basis((), self._inner)
        rule: Rule | None = None
        for index in range(s.base_shadows):
            self._learn(basis, self._trained.case(BASE, index, s.seed + 1), rule)
            if index + 1 in (4, 10, 20):
                rule = self._rule(s.base_points)
            self._progress("cubature of the base model", (index + 1) / s.base_shadows)
        return self._rule(s.base_points)

    def set_rule(self, base: Rule) -> Rule:
        """The cubature of sets of mechanisms; `base` where there are none."""
        s, kinds = self._settings, sorted(self._modes.beyond)
        if not kinds:
            return base
        rule: Rule | None = None
        for index in range(s.set_shadows):
            for number, kind in enumerate(kinds):
                case = self._trained.case(kind, index, s.seed + 1)
                self._learn(self._modes.basis(case.mechanisms, self._inner), case, rule)
                self._progress("cubature of sets", (index + (number + 1) / len(kinds)) / s.set_shadows)
            rule = self._rule(s.set_points)
        return rule if rule is not None else base

    def _learn(self, basis: Basis, case: Case, rule: Rule | None) -> None:
        """Adds what a reduced run teaches, on the points of a rule or on all, unless it went astray."""
        taken = shadowed(self._problem, basis, case, rule, self._settings.cubature, self._rng)
        if len(taken.missing) and np.abs(taken.missing).max() < self._settings.trusted:
            self._rows.append(taken.rows)

    def _rule(self, points: int) -> Rule:
        s = self._settings.cubature
        rows = with_volumes(np.concatenate(self._rows), self._volumes, s)
        return choose_points(rows, [points], s)[points][0]


def shadowed(
    problem: Problem, basis: Basis, case: Case, rule: Rule | None, settings: CubatureSettings,
    rng: np.random.Generator,
) -> Taken:  # fmt: skip
    """Runs a case by the reduced model on the points of a rule, or on all, and follows it on all points."""
    binds = _binds(case.mechanisms)
    whole = whole_space(problem, basis)
    space = whole if rule is None else reduced_space(problem, basis, rule)
    run = ReducedEquations(space, case.theta, binds, case.motion)
    shadow = Shadow(whole, case.theta, binds, case.motion)
    return take(run, shadow, case.theta["p_init"], settings, rng)


def whole_space(problem: Problem, basis: Basis) -> ReducedSpace:
    """Returns a basis at all points of a problem, which leave nothing out."""
    at = point_fields(problem, basis)
    k, m = at.gradient.shape[2], at.pressure.shape[1]
    nothing = LinearParts(np.zeros((2, k, k)), np.zeros((2, k, k)), np.zeros((2, m, m)), np.zeros((k, m)))
    return ReducedSpace(problem.lengths, at, nothing, SurfacesOf(problem, basis))
