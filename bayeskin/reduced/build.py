"""Builds a reduced model: first full runs, then modes, then cubatures; the base model first, then mechanisms.

The base model can be used by itself. The full runs are independent of each other, and so are the reduced
runs that train a cubature. Worker processes therefore make them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.sparse as sp

from bayeskin.errors import InputError
from bayeskin.execution.local import Lost, Map
from bayeskin.finite_element.problem import Problem
from bayeskin.finite_element.simulate import ModelSpec, problem_of
from bayeskin.reduced.basis import Inner, pod
from bayeskin.reduced.cases import BASE, SETS, Case, Trained
from bayeskin.reduced.cubature import CubatureSettings, Taken, choose_points, take, with_volumes
from bayeskin.reduced.equations import ReducedEquations
from bayeskin.reduced.library import Library, Modes, modes_beyond, modes_of
from bayeskin.reduced.model import Cubatures, ReducedModel, SurfacesOf, inner_of, reduced_space
from bayeskin.reduced.operators import Basis, LinearParts, ReducedSpace, Rule, point_fields
from bayeskin.reduced.runs import FullRuns, Progress, binds_of, tissue_of
from bayeskin.reduced.shadow import Shadow
from bayeskin.types import Array

ROUNDS = (4, 10, 20, 40)  # numbers of reduced runs after which the cubature is trained; the next runs use it


@dataclass(frozen=True)
class BuildSettings:
    """Sizes of a reduced model and of its training.

    base_runs, runs : number of full runs of the base model, and of each mechanism
    first_base_runs, first_runs : the same numbers for a first model, which can be used meanwhile
    base : numbers of displacement and pressure modes of the base model
    each : numbers of displacement and pressure modes that each mechanism adds to the base's
    base_points, set_points : number of cubature points of the base model, and of sets of mechanisms
    base_shadows, set_shadows : number of reduced runs that train the cubature of each
    first_base_shadows : number of those that train the cubature of the first base model
    trusted : largest force that the points may leave out in a reduced run, as a fraction of its peak force; a
        cubature does not learn from runs that leave out more
    seed : random seed of the full runs; the reduced runs that train cubatures use seed + 1
    """

    base_runs: int = 128
    runs: int = 48
    first_base_runs: int = 64
    first_runs: int = 24
    base: tuple[int, int] = (76, 72)
    each: tuple[int, int] = (30, 20)
    base_points: int = 450
    set_points: int = 800
    base_shadows: int = 80
    set_shadows: int = 120
    first_base_shadows: int = 64
    trusted: float = 0.1
    seed: int = 1
    cubature: CubatureSettings = field(default_factory=CubatureSettings)

    @property
    def first(self) -> BuildSettings:
        """Returns the settings of the first model."""
        return replace(
            self, base_runs=self.first_base_runs, base_shadows=self.first_base_shadows, runs=self.first_runs
        )

    def cases(self, trained: Trained, kind: str) -> list[Case]:
        """Returns the cases of the full runs of a kind."""
        count = self.base_runs if kind == BASE else self.runs
        return [trained.case(kind, index, self.seed) for index in range(count)]


def base_model(
    trained: Trained, full: FullRuns, settings: BuildSettings, run_all: Map, progress: Progress
) -> ReducedModel:
    """Returns the reduced model without mechanisms; makes the full runs that are not in the store yet.

    Raises InputError where no full run finishes, or where a worker is lost.
    """
    cases = settings.cases(trained, BASE)
    full.make(cases, run_all, progress)
    inner = inner_of(problem_of("bricks", full.spec.refinement, full.spec.geometry))
    library = Library(modes_of(weighted_modes_of(full, cases, inner), inner, settings.base), {})
    teacher = Teacher(full.spec, library, settings, "cubature of the base model")
    shadows = [trained.case(BASE, index, settings.seed + 1) for index in range(settings.base_shadows)]
    rule = teacher.rule(shadows, settings.base_points, run_all, progress)
    region = replace(trained, mechanisms={})
    return ReducedModel(region, full.spec.refinement, library, Cubatures(rule, rule), full.spec.hash)


def with_mechanisms(
    base: ReducedModel, trained: Trained, full: FullRuns, settings: BuildSettings, run_all: Map,
    progress: Progress,
) -> ReducedModel:  # fmt: skip
    """Returns a base model with all mechanisms of a region added; makes the full runs that are missing.

    Raises InputError where no full run of a mechanism finishes, or where a worker is lost.
    """
    cases = {kind: settings.cases(trained, kind) for kind in sorted(trained.mechanisms)}
    full.make([case for row in zip(*cases.values(), strict=True) for case in row], run_all, progress)
    inner, modes_of_base = inner_of(base.problem()), base.library.base
    beyond = {
        kind: modes_beyond(modes_of_base, weighted_modes_of(full, cases_of_kind, inner), inner, settings.each)
        for kind, cases_of_kind in cases.items()
    }
    library = Library(modes_of_base, beyond)
    teacher = Teacher(full.spec, library, settings, "cubature of mechanism sets")
    shadows = [trained.case(SETS, index, settings.seed + 1) for index in range(settings.set_shadows)]
    rule = teacher.rule(shadows, settings.set_points, run_all, progress)
    return replace(base, trained=trained, library=library, cubatures=Cubatures(base.cubatures.base, rule))


def weighted_modes_of(full: FullRuns, cases: Sequence[Case], inner: Inner) -> Modes:
    """Returns the modes of full runs, each times its singular value. Runs that ended early are left out.

    Raises InputError where no run has finished.
    """
    finished = [run for run in map(full.read, cases) if not run.message]
    if not finished:
        raise InputError(full.store.path, "no full run has finished", "at least one must finish")

    def weighted(name: str, product: sp.csr_matrix) -> Array:
        rows = np.concatenate([getattr(run, name) for run in finished]).astype(float)
        values, modes = pod(rows, product)
        return values[:, None] * modes

    return Modes(weighted("displacement", inner.displacement), weighted("pressure", inner.pressure))


@dataclass(frozen=True)
class Teacher:
    """Trains a cubature on reduced runs that are followed on all points of the mesh.

    spec : full model, whose mesh and geometry are used; label : name of this work in the progress report
    known : cubature at whose points the reduced runs are solved, or None for all points

    A call takes a case and the number of a random stream for the mixtures, and returns the integrands of the
    case's run. Instances can be pickled, so that worker processes can use them.
    """

    spec: ModelSpec
    library: Library
    settings: BuildSettings
    label: str
    known: Rule | None = None

    def __call__(self, item: tuple[Case, int]) -> Taken:
        case, number = item
        problem = problem_of("bricks", self.spec.refinement, self.spec.geometry)
        basis = self.library.basis(tissue_of(case.mechanisms), inner_of(problem))
        rng = np.random.default_rng([self.settings.seed, 2, number])
        return shadowed(problem, basis, case, self.known, self.settings.cubature, rng)

    def rule(self, cases: Sequence[Case], points: int, run_all: Map, progress: Progress) -> Rule:
        """Returns a cubature of `points` points.

        The first runs are solved on all points, the later ones on the points of the cubature trained so far.
        Raises InputError where no reduced run is accurate enough to learn from, or where a worker is lost.
        """
        problem = problem_of("bricks", self.spec.refinement, self.spec.geometry)
        at = point_fields(problem, self.library.basis((), inner_of(problem)))
        rows, rule, done = list[Array](), None, 0
        ends = [end for end in ROUNDS if end < len(cases)]
        for end in (*ends, len(cases)):
            items = [(case, done + number) for number, case in enumerate(cases[done:end])]
            runs: dict[int, Taken] = {}
            for number, run in run_all(replace(self, known=rule), items):
                if isinstance(run, Lost):
                    raise InputError(self.label, run.reason, "run the same command again")
                runs[number] = run
                progress(self.label, (done + len(runs)) / len(cases))
            rows += [runs[number].rows for number in sorted(runs) if self._is_near(runs[number])]
            if not rows:
                raise InputError(
                    self.label,
                    "no reduced run is close to the full model",
                    "use parameters with which the skin does not fold",
                )
            all_rows = with_volumes(np.concatenate(rows), at, self.settings.cubature)
            rule = choose_points(all_rows, [points], self.settings.cubature)[points][0]
            done = end
        assert rule is not None
        return rule

    def _is_near(self, taken: Taken) -> bool:
        """Returns whether the points of a run left out so little force that a cubature can learn from it."""
        return bool(len(taken.missing)) and float(np.abs(taken.missing).max()) < self.settings.trusted


def shadowed(
    problem: Problem, basis: Basis, case: Case, rule: Rule | None, settings: CubatureSettings,
    rng: np.random.Generator,
) -> Taken:  # fmt: skip
    """Runs a case with the reduced model and returns its integrands at all points.

    The run is solved at the points of `rule`, or at all points where `rule` is None.
    """
    binds = binds_of(case.mechanisms)
    all_points = whole_space(problem, basis)
    space = all_points if rule is None else reduced_space(problem, basis, rule)
    run = ReducedEquations(space, case.theta, binds, case.motion)
    shadow = Shadow(all_points, case.theta, binds, case.motion)
    return take(run, shadow, case.theta["p_init"], settings, rng)


def whole_space(problem: Problem, basis: Basis) -> ReducedSpace:
    """Returns a basis at all points of a problem. No exact part is added, since no point is left out."""
    at = point_fields(problem, basis)
    k, m = at.gradient.shape[2], at.pressure.shape[1]
    no_parts = LinearParts(np.zeros((2, k, k)), np.zeros((2, k, k)), np.zeros((2, m, m)), np.zeros((k, m)))
    return ReducedSpace(problem.lengths, at, no_parts, SurfacesOf(problem, basis))
