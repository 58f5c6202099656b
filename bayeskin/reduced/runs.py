"""Makes the full runs that reduced models learn from, and keeps them in a store.

Worker processes make the runs. Each run is kept as soon as it is finished, so that an interrupted building
can be continued.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from bayeskin.errors import InputError
from bayeskin.execution.local import Lost, Map
from bayeskin.finite_element.mesh import brick_mesh
from bayeskin.finite_element.problem import build_problem
from bayeskin.finite_element.simulate import ModelSpec, problem_of
from bayeskin.finite_element.tissue import Bind
from bayeskin.mechanisms import catalogue
from bayeskin.mechanisms.hashes import law_hashes
from bayeskin.mechanisms.mechanism import Tissue
from bayeskin.reduced.cases import Case
from bayeskin.reduced.model import inner_of
from bayeskin.reduced.training import TrainingRun, training_run
from bayeskin.store import Store

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class FullRuns:
    """The full runs of one device.

    spec : the full model, on whose nodes the modes are defined; a case with another geometry moves the nodes
    store : an open store, which keeps the runs
    """

    spec: ModelSpec
    store: Store

    def read(self, case: Case) -> TrainingRun:
        """Returns the finished run of a case. Raises KeyError where there is none."""
        return self.store.read(depends_on(self.spec, case), TrainingRun)

    def make(self, wanted: Sequence[Case], run_all: Map, progress: Progress) -> None:
        """Makes the runs that are not stored yet. Raises InputError where a worker is lost."""
        todo = [case for case in wanted if depends_on(self.spec, case) not in self.store]
        done = len(wanted) - len(todo)
        progress("full runs", done / max(len(wanted), 1))
        for number, result in run_all(partial(full_run, self.spec), todo):
            if isinstance(result, Lost):
                where = f"full run with {', '.join(todo[number].mechanisms) or 'no mechanism'}"
                raise InputError(where, result.reason, "run the same command again")
            self.store.add(depends_on(self.spec, todo[number]), result)
            done += 1
            progress("full runs", done / len(wanted))


def depends_on(spec: ModelSpec, case: Case) -> list[Any]:
    """Returns everything on which the run of a case depends, a version of each law included."""
    return [
        spec.hash, law_hashes(case.mechanisms), sorted(case.theta.items()), case.geometry.hash,
        case.motion.time_s, case.motion.displacement_m,
    ]  # fmt: skip


def full_run(spec: ModelSpec, case: Case) -> TrainingRun:
    """Returns the run of a case, with modes on the nodes of the full model `spec`."""
    nominal = problem_of("bricks", spec.refinement, spec.geometry)
    moved = case.geometry != spec.geometry
    mesh = brick_mesh(spec.refinement, case.geometry, spec.geometry) if moved else None
    problem = nominal if mesh is None else build_problem(mesh)
    return training_run(problem, inner_of(nominal), case, binds_of(case.mechanisms))


def binds_of(mechanisms: Sequence[str]) -> list[Bind]:
    """Returns the functions that bind the laws of those mechanisms that have a law."""
    known = catalogue()
    return [bind for name in mechanisms if (bind := known[name].act.bind) is not None]


def tissue_of(mechanisms: Sequence[str]) -> list[str]:
    """Returns the names of the tissue mechanisms among `mechanisms`; only these have modes of their own."""
    known = catalogue()
    return [name for name in mechanisms if isinstance(known[name].act, Tissue)]
