"""Building a reduced model: training runs of the full model, then modes, then cubatures.

The base model comes first and can be used by itself. Training runs are independent of each other, and each is
kept as soon as it is finished, so that an interrupted building goes on; modes and cubatures take minutes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np
import scipy.sparse as sp

from bayeskin import storage
from bayeskin.errors import InputError
from bayeskin.geometry import Geometry
from bayeskin.mechanisms import catalogue
from bayeskin.model.mesh import brick_mesh
from bayeskin.model.problem import Problem, build_problem
from bayeskin.model.simulate import ModelSpec, problem_of
from bayeskin.model.tissue import Bind
from bayeskin.reduced.basis import Inner, pod
from bayeskin.reduced.cases import BASE, Case, Trained
from bayeskin.reduced.cubature import CubatureSettings, Taken, choose_points, take, with_volumes
from bayeskin.reduced.equations import ReducedEquations, ReducedSpace
from bayeskin.reduced.library import Library, Modes, library
from bayeskin.reduced.model import Cubatures, ReducedModel, SurfacesOf, inner_of, reduced_space
from bayeskin.reduced.operators import Basis, LinearParts, PointFields, Rule, point_fields
from bayeskin.reduced.shadow import Shadow
from bayeskin.reduced.training import TrainingRun, training_run
from bayeskin.types import Array
from bayeskin.workers import Lost, Map

Progress = Callable[[str, float], None]
RUN_ARRAYS = ("displacement", "pressure", "time_s", "force_n")


@dataclass(frozen=True)
class BuildSettings:
    """How large a reduced model is and what it learns from.

    base_runs, runs : training runs of the base model, and of each mechanism
    base, each : displacement and pressure modes of the base model, and of each mechanism beyond the base's
    base_points, set_points : of the cubatures
    base_shadows, set_shadows : reduced runs that train the cubatures, of the base model and of each mechanism
    trusted : the largest share of the peak force that points left out in a run whose integrands are learnt
    seed : of the training cases; those of the cubatures have others
    """

    base_runs: int = 128
    runs: int = 48
    base: tuple[int, int] = (76, 72)
    each: tuple[int, int] = (30, 20)
    base_points: int = 450
    set_points: int = 700
    base_shadows: int = 80
    set_shadows: int = 4
    trusted: float = 0.1
    seed: int = 1
    cubature: CubatureSettings = field(default_factory=CubatureSettings)

    def runs_of(self, kind: str) -> int:
        """Number of training runs of a kind."""
        return self.base_runs if kind == BASE else self.runs


@dataclass(frozen=True)
class RunTask:
    """Makes the full run of a case and keeps its modes in a file; picklable, for workers.

    geometry, refinement : of the mesh whose nodes the modes are on; a case's own geometry moves them
    Given (case, path) it returns the message of a run that ended early, else an empty one.
    """

    geometry: Geometry
    refinement: int

    def __call__(self, item: tuple[Case, Path]) -> str:
        case, path = item
        nominal = problem_of("bricks", self.refinement, self.geometry)
        moved = case.geometry != self.geometry
        mesh = brick_mesh(self.refinement, case.geometry, self.geometry) if moved else None
        problem = nominal if mesh is None else build_problem(mesh)
        run = training_run(problem, inner_of(nominal), case, _binds(case.mechanisms))

        def fill(handle: h5py.File) -> None:
            handle.attrs["message"] = run.message
            for name in RUN_ARRAYS:
                handle[name] = getattr(run, name)

        storage.write_hdf5(path, fill)
        return run.message


def read_run(path: Path) -> TrainingRun:
    """Reads a run that a `RunTask` kept. Raises InputError for a file that is damaged."""
    with storage.reading(path, "a training run") as handle:
        arrays = {name: handle[name][()] for name in RUN_ARRAYS}
        return TrainingRun(**arrays, message=str(handle.attrs["message"]))


def make_runs(task: RunTask, wanted: Sequence[tuple[Case, Path]], run_all: Map, progress: Progress) -> None:
    """Makes the runs whose files are not there yet. Raises InputError where a worker is lost."""
    todo = [item for item in wanted if not item[1].is_file()]
    done = len(wanted) - len(todo)
    progress("full runs", done / max(len(wanted), 1))
    for number, result in run_all(task, todo):
        if isinstance(result, Lost):
            raise InputError(f"full run {todo[number][1].stem}", result.reason, "a worker that finishes it")
        done += 1
        progress("full runs", done / len(wanted))


def _binds(mechanisms: Sequence[str]) -> list[Bind]:
    known = catalogue()
    return [bind for name in mechanisms if (bind := known[name].act.bind) is not None]


def training_cases(
    trained: Trained, kinds: Sequence[str], settings: BuildSettings, folder: Path
) -> list[tuple[Case, Path]]:
    """Returns the training cases of some kinds, in turn, and where their runs are kept."""
    most = max(settings.runs_of(kind) for kind in kinds)
    return [
        (trained.case(kind, index, settings.seed), run_path(folder, kind, index))
        for index in range(most)
        for kind in kinds
        if index < settings.runs_of(kind)
    ]


def run_path(folder: Path, kind: str, index: int) -> Path:
    """Returns where a training run is kept."""
    return folder / f"{kind}-{index:04d}.h5"


def weighted_of(kind: str, settings: BuildSettings, folder: Path, inner: Inner) -> Modes:
    """Returns the modes of a kind's training runs, each times its singular value, without failed runs.

    Raises InputError where none has finished.
    """
    runs = [read_run(run_path(folder, kind, index)) for index in range(settings.runs_of(kind))]
    finished = [run for run in runs if not run.message]
    if not finished:
        raise InputError(f"{folder}: {kind}", "no training run that finished", "one at least")

    def weighted(name: str, product: sp.csr_matrix) -> Array:
        rows = np.concatenate([getattr(run, name) for run in finished]).astype(float)
        values, modes = pod(rows, product)
        return values[:, None] * modes

    return Modes(weighted("displacement", inner.displacement), weighted("pressure", inner.pressure))


def assemble(
    trained: Trained, refinement: int, weighted: Mapping[str, Modes], settings: BuildSettings,
    progress: Progress,
) -> ReducedModel:  # fmt: skip
    """Returns the reduced model of the modes of each kind, with its cubatures trained."""
    spec = ModelSpec(refinement=refinement, geometry=trained.geometry)
    problem = problem_of("bricks", refinement, trained.geometry)
    inner = inner_of(problem)
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
            if index + 1 in (4, 10, 20, 40):
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
        return rule_of(self._volumes, self._rows, points, self._settings.cubature)


def rule_of(at: PointFields, rows: Sequence[Array], points: int, settings: CubatureSettings) -> Rule:
    """Returns a cubature of so many points for integrands at all points `at`."""
    whole = with_volumes(np.concatenate(rows), at, settings)
    return choose_points(whole, [points], settings)[points][0]


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
