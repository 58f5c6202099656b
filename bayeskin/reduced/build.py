"""Building a reduced model: full runs, then modes, then cubatures; the base model first, then mechanisms.

The base model can be used by itself. Full runs and the reduced runs that train cubatures are independent of
each other, and workers make them.
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
from bayeskin.reduced.equations import ReducedEquations, ReducedSpace
from bayeskin.reduced.library import Library, Modes, modes_beyond, modes_of
from bayeskin.reduced.model import Cubatures, ReducedModel, SurfacesOf, inner_of, reduced_space
from bayeskin.reduced.operators import Basis, LinearParts, Rule, point_fields
from bayeskin.reduced.runs import FullRuns, Progress, binds_of, tissue_of
from bayeskin.reduced.shadow import Shadow
from bayeskin.types import Array

ROUNDS = (4, 10, 20, 40)  # reduced runs after which a cubature is trained anew, for those that follow


@dataclass(frozen=True)
class BuildSettings:
    """Sizes of a reduced model and of its training.

    base_runs, runs : full runs of the base model, and of each mechanism
    base, each : displacement and pressure modes of the base model, and of each mechanism beyond the base's
    base_points, set_points : of the cubatures
    base_shadows, set_shadows : reduced runs that train the cubatures
    trusted : the largest share of the peak force that points left out in a run whose integrands are learnt
    seed : of the training cases; those of the cubatures have others
    """

    base_runs: int = 128
    runs: int = 48
    base: tuple[int, int] = (76, 72)
    each: tuple[int, int] = (30, 20)
    base_points: int = 450
    set_points: int = 800
    base_shadows: int = 80
    set_shadows: int = 120
    trusted: float = 0.1
    seed: int = 1
    cubature: CubatureSettings = field(default_factory=CubatureSettings)

    def cases(self, trained: Trained, kind: str) -> list[Case]:
        """Returns the cases of the full runs of a kind."""
        count = self.base_runs if kind == BASE else self.runs
        return [trained.case(kind, index, self.seed) for index in range(count)]


def base_model(
    trained: Trained, full: FullRuns, settings: BuildSettings, run_all: Map, progress: Progress
) -> ReducedModel:
    """Returns the reduced model without mechanisms, from full runs that are made where they are not kept.

    Raises InputError where no full run finishes, or a worker is lost.
    """
    cases = settings.cases(trained, BASE)
    full.make(cases, run_all, progress)
    spec = ModelSpec(refinement=full.refinement, geometry=trained.geometry)
    inner = inner_of(problem_of("bricks", full.refinement, trained.geometry))
    library = Library(modes_of(weighted_modes_of(full, cases, inner), inner, settings.base), {})
    teacher = Teacher(full, library, settings, "cubature of the base model")
    shadows = [trained.case(BASE, index, settings.seed + 1) for index in range(settings.base_shadows)]
    rule = teacher.rule(shadows, settings.base_points, run_all, progress)
    region = replace(trained, mechanisms={})
    return ReducedModel(region, full.refinement, library, Cubatures(rule, rule), spec.hash)


def with_mechanisms(
    base: ReducedModel, trained: Trained, full: FullRuns, settings: BuildSettings, run_all: Map,
    progress: Progress,
) -> ReducedModel:  # fmt: skip
    """Returns a base model with all mechanisms of a region, from full runs that are made where not kept.

    Raises InputError where no full run of a mechanism finishes, or a worker is lost.
    """
    cases = {kind: settings.cases(trained, kind) for kind in sorted(trained.mechanisms)}
    full.make([case for turn in zip(*cases.values(), strict=True) for case in turn], run_all, progress)
    inner, own = inner_of(base.problem()), base.library.base
    beyond = {
        kind: modes_beyond(own, weighted_modes_of(full, of_kind, inner), inner, settings.each)
        for kind, of_kind in cases.items()
    }
    library = Library(own, beyond)
    teacher = Teacher(full, library, settings, "cubature of sets")
    shadows = [trained.case(SETS, index, settings.seed + 1) for index in range(settings.set_shadows)]
    rule = teacher.rule(shadows, settings.set_points, run_all, progress)
    return replace(base, trained=trained, library=library, cubatures=Cubatures(base.cubatures.base, rule))


def weighted_modes_of(full: FullRuns, cases: Sequence[Case], inner: Inner) -> Modes:
    """Returns the modes of full runs, each times its singular value, without runs that ended early.

    Raises InputError where none has finished.
    """
    finished = [run for run in map(full.read, cases) if not run.message]
    if not finished:
        raise InputError(f"{full.folder}", "no full run that finished", "one at least")

    def weighted(name: str, product: sp.csr_matrix) -> Array:
        rows = np.concatenate([getattr(run, name) for run in finished]).astype(float)
        values, modes = pod(rows, product)
        return values[:, None] * modes

    return Modes(weighted("displacement", inner.displacement), weighted("pressure", inner.pressure))


@dataclass(frozen=True)
class Teacher:
    """Trains a cubature on reduced runs that are followed on all points; picklable, for workers.

    full : says the mesh; label : what progress is told of
    known : the rule on whose points it runs, or None for all points
    Given a case and the number of its random mixtures' stream, it returns what the run teaches.
    """

    full: FullRuns
    library: Library
    settings: BuildSettings
    label: str
    known: Rule | None = None

    def __call__(self, item: tuple[Case, int]) -> Taken:
        case, number = item
        problem = problem_of("bricks", self.full.refinement, self.full.geometry)
        basis = self.library.basis(tissue_of(case.mechanisms), inner_of(problem))
        rng = np.random.default_rng([self.settings.seed, 2, number])
        return shadowed(problem, basis, case, self.known, self.settings.cubature, rng)

    def rule(self, cases: Sequence[Case], points: int, run_all: Map, progress: Progress) -> Rule:
        """Returns a cubature of so many points, from runs on all points first, then on those of a first one.

        Raises InputError where no run stays near the full model, or a worker is lost.
        """
        problem = problem_of("bricks", self.full.refinement, self.full.geometry)
        at = point_fields(problem, self.library.basis((), inner_of(problem)))
        taught, rule, done = list[Array](), None, 0
        ends = [end for end in ROUNDS if end < len(cases)]
        for end in (*ends, len(cases)):
            items = [(case, done + number) for number, case in enumerate(cases[done:end])]
            found: dict[int, Taken] = {}
            for number, taken in run_all(replace(self, known=rule), items):
                if isinstance(taken, Lost):
                    raise InputError(self.label, taken.reason, "a worker that finishes a reduced run")
                found[number] = taken
                progress(self.label, (done + len(found)) / len(cases))
            taught += [found[number].rows for number in sorted(found) if self._near(found[number])]
            if not taught:
                none = "no reduced run that stays near the full model"
                raise InputError(self.label, none, "a point away from folds")
            whole = with_volumes(np.concatenate(taught), at, self.settings.cubature)
            rule = choose_points(whole, [points], self.settings.cubature)[points][0]
            done = end
        assert rule is not None
        return rule

    def _near(self, taken: Taken) -> bool:
        """Returns whether the points of a run left out so little that its integrands are worth learning."""
        return bool(len(taken.missing)) and float(np.abs(taken.missing).max()) < self.settings.trusted


def shadowed(
    problem: Problem, basis: Basis, case: Case, rule: Rule | None, settings: CubatureSettings,
    rng: np.random.Generator,
) -> Taken:  # fmt: skip
    """Runs a case by the reduced model on the points of a rule, or on all, and follows it on all points."""
    binds = binds_of(case.mechanisms)
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
