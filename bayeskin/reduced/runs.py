"""Makes the full runs that reduced models learn from, and keeps them in a folder.

Worker processes make the runs. Each run is stored as soon as it is finished, so that an interrupted building
can be continued. The name of its file is a hash of all that the run depends on. A run of another version of
the laws therefore has another name and is not used by mistake.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import h5py

from bayeskin import storage
from bayeskin.errors import InputError
from bayeskin.execution.local import Lost, Map
from bayeskin.finite_element.mesh import brick_mesh
from bayeskin.finite_element.problem import build_problem
from bayeskin.finite_element.simulate import ModelSpec, problem_of
from bayeskin.finite_element.tissue import Bind
from bayeskin.geometry import Geometry
from bayeskin.mechanisms import catalogue
from bayeskin.mechanisms.hashes import law_hashes
from bayeskin.mechanisms.mechanism import Tissue
from bayeskin.reduced.cases import Case
from bayeskin.reduced.model import inner_of
from bayeskin.reduced.training import TrainingRun, training_run

Progress = Callable[[str, float], None]
RUN_ARRAYS = ("displacement", "pressure", "time_s", "force_n")


@dataclass(frozen=True)
class FullRuns:
    """The full runs of one device, stored in one folder.

    geometry, refinement : of the mesh on whose nodes the modes are defined; a case with another geometry
        moves the nodes

    A call takes a case, makes its run and stores the modes. It returns the message of a run that ended early,
    otherwise an empty string. Instances can be pickled, so that worker processes can use them.
    """

    geometry: Geometry
    refinement: int
    folder: Path

    def __call__(self, case: Case) -> str:
        nominal = problem_of("bricks", self.refinement, self.geometry)
        moved = case.geometry != self.geometry
        mesh = brick_mesh(self.refinement, case.geometry, self.geometry) if moved else None
        problem = nominal if mesh is None else build_problem(mesh)
        run = training_run(problem, inner_of(nominal), case, binds_of(case.mechanisms))

        def fill(handle: h5py.File) -> None:
            handle.attrs["message"] = run.message
            for name in RUN_ARRAYS:
                handle[name] = getattr(run, name)

        storage.write_hdf5(self.path(case), fill)
        return run.message

    def path(self, case: Case) -> Path:
        """Returns the path of a case's run. The file name is the sha256 of all that the run depends on."""
        spec = ModelSpec(refinement=self.refinement, geometry=self.geometry)
        depends_on = [
            spec.hash, law_hashes(case.mechanisms), sorted(case.theta.items()), case.geometry.hash,
            case.motion.time_s.tolist(), case.motion.displacement_m.tolist(),
        ]  # fmt: skip
        return self.folder / f"{hashlib.sha256(json.dumps(depends_on).encode()).hexdigest()}.h5"

    def read(self, case: Case) -> TrainingRun:
        """Returns the stored run of a case. Raises InputError for a file that is absent or damaged."""
        with storage.reading(self.path(case), "a training run") as handle:
            arrays = {name: handle[name][()] for name in RUN_ARRAYS}
            return TrainingRun(**arrays, message=str(handle.attrs["message"]))

    def make(self, wanted: Sequence[Case], run_all: Map, progress: Progress) -> None:
        """Makes the runs that are not stored yet. Raises InputError where a worker is lost."""
        todo = [case for case in wanted if not self.path(case).is_file()]
        done = len(wanted) - len(todo)
        progress("full runs", done / max(len(wanted), 1))
        for number, result in run_all(self, todo):
            if isinstance(result, Lost):
                where = f"full run {self.path(todo[number]).stem}"
                raise InputError(where, result.reason, "a worker that finishes this run")
            done += 1
            progress("full runs", done / len(wanted))


def binds_of(mechanisms: Sequence[str]) -> list[Bind]:
    """Returns the functions that bind the laws of those mechanisms that have a law."""
    known = catalogue()
    return [bind for name in mechanisms if (bind := known[name].act.bind) is not None]


def tissue_of(mechanisms: Sequence[str]) -> list[str]:
    """Returns the names of the tissue mechanisms among `mechanisms`; only these have modes of their own."""
    known = catalogue()
    return [name for name in mechanisms if isinstance(known[name].act, Tissue)]
