"""Makes a set of recordings: simulates each case with the full model and adds noise.

The mesh and the time steps differ from those of the surrogates. A recording that is finished is not made
again. If the full model fails for a case, another case is drawn from its plan.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

import bayeskin
from bayeskin import storage
from bayeskin.errors import InputError
from bayeskin.execution.local import Lost, Map, local
from bayeskin.finite_element.mesh import layered_mesh, unroll
from bayeskin.finite_element.problem import Problem, build_problem, material
from bayeskin.finite_element.simulate import simulate_on
from bayeskin.geometry import Geometry
from bayeskin.mechanisms import bin_means, catalogue, laws, observed
from bayeskin.mechanisms.mechanism import ForceOfTime
from bayeskin.proof import seals
from bayeskin.proof.cases import Case, draw
from bayeskin.proof.noise import noise
from bayeskin.proof.outside import OUTSIDE, Change
from bayeskin.proof.plans import Plan, plans
from bayeskin.proof.protocol import EDGES_S, MOTION, samples_s
from bayeskin.proof.refit_residual import rms, windows
from bayeskin.proof.screen import Screen, shipped_screen
from bayeskin.types import Array, Recording, Simulation

# Grid lines of the bricks [mm]: more than in the model of the shipped surrogates, and graded differently.
_X_MM = (0.0, 9.0, 16.0, 18.0, 19.0, 22.0, 25.0, 26.0, 27.0, 28.0, 31.0, 34.0, 35.0, 37.0, 43.0, 58.0, 105.0)
_Y_MM = (0.0, 2.5, 4.0, 5.0, 6.5, 10.0, 12.0, 15.0, 24.0, 45.0, 84.0)
_DEEP, _OUTER = 0.5, 0.65  # the subcutis is divided in its middle, the cutis nearer to its surface
TOLERANCE = 5e-4  # error tolerance of a time step; the surrogates' runs have twice this tolerance
ATTEMPTS = 8
LVDT_STEP_M, CELL_STEP_N = 1e-5, 2.0**-13

TWO_AT_ONCE = local(2)  # two processes; each needs about 1.5 GB

Run = Callable[[Case, Sequence[str], Change], Simulation]  # a run with the mechanisms named, and a change


@dataclass(frozen=True)
class Concealed:
    """A recording and its key."""

    recording: Recording
    key: Mapping[str, Any]


Outcome = Concealed | tuple[str, str, str]  # or the texts of an InputError: where, problem, remedy


@lru_cache(maxsize=3)
def problem_of(tetrahedra: bool, geometry: Geometry) -> Problem:
    """Builds the boundary-value problem of a test with the article's device, on the proof's own mesh."""
    bottom, height = 1e3 * geometry.subcutis_m, 1e3 * geometry.thickness_m
    z = (0.0, _DEEP * bottom, bottom, bottom + _OUTER * (height - bottom), height)
    lines = [1e-3 * np.array(axis) for axis in (_X_MM, _Y_MM, z)]
    return build_problem(layered_mesh(lines, "the proof's mesh", tetrahedra, geometry))


def full_run(case: Case, names: Sequence[str], change: Change) -> Simulation:
    """Runs the full model with the mechanisms `names` and a change."""
    known = catalogue()
    problem, lengths = problem_of(case.plan.tetrahedra, change.geometry), change.geometry
    corners = problem.mesh.geometry.p[:, problem.mesh.geometry.t]
    height = unroll(corners, lengths.arm_radius_m)[2].mean(axis=0)
    solid = change.solid(
        material(case.theta, problem.mesh.cutis, change.constants), height / lengths.subcutis_m
    )
    values = {p.name: case.values[p.name] for name in names for p in known[name].parameters}
    binds = [*laws([known[name] for name in names]), *change.laws]
    return simulate_on(problem, solid, TOLERANCE, change.moved(MOTION), {**case.theta, **values}, binds)


def concealed_or_error(plan: Plan) -> Outcome:
    """Returns `concealed` by the full model and the shipped surrogates, or the texts of an InputError.

    A worker process calls this function.
    """
    try:
        return concealed(plan, shipped_screen(), full_run)
    except InputError as error:
        return error.where, error.problem, error.remedy


def conceal(
    folder: Path,
    seed: int,
    count: int,
    only: Sequence[str] = (),
    tell: Callable[[float, str], None] = lambda share, note: None,
    make: Callable[[Plan], Outcome] = concealed_or_error,
    run_all: Map = TWO_AT_ONCE,
) -> int:
    """Makes the missing recordings of a set of `count`, and returns how many it made.

    only : see `plans`
    tell : called with the share that is done and a note
    run_all : maps `make` over plans
    Raises InputError if the folder holds a set with other settings, if `plans` does not know a name, or if
    the full model fails at every attempt.
    """
    wanted = plans(seed, count, only)
    _start_or_check(folder, seed, count, only)
    numbers = [f"{place + 1:03d}" for place in range(count)]
    missing = [place for place, number in enumerate(numbers) if not _finished(folder, number)]
    written = 0
    with closing(run_all(make, [wanted[place] for place in missing])) as results:
        for index, result in results:
            if isinstance(result, Lost):
                raise InputError("proof", result.reason, "run the same command again")
            if not isinstance(result, Concealed):
                raise InputError(*result)
            _write(folder, numbers[missing[index]], result)
            written += 1
            done = count - len(missing) + written
            tell(done / count, f"{done} of {count}")
    return written


def concealed(plan: Plan, screen: Screen, run: Run = full_run) -> Concealed:
    """Returns the recording and the key of one plan.

    If the full model fails, another case of the plan is drawn.
    Raises InputError if it fails at every attempt.
    """
    for attempt in range(ATTEMPTS):
        case = draw(plan, attempt, screen)
        runs = _FullRuns(case, run)
        if runs.ok:
            return _recording_and_key(case, runs, screen, attempt)
    raise InputError(
        f"proof: {plan.label}", f"the full model failed in {ATTEMPTS} attempts", "use another seed"
    )


class _FullRuns:
    """The full runs that a case needs, each made once: with and without mechanisms that the model solves."""

    def __init__(self, case: Case, run: Run) -> None:
        known = catalogue()
        self._case, self._known = case, known
        self._change = OUTSIDE[case.plan.outside].change(case.strength) if case.plan.outside else Change()
        solved = [n for n in case.plan.mechanisms if known[n].act.bind is not None]
        runs_as_base = not solved and self._change.of_force_alone
        self._base = run(case, (), Change())
        self._solved = self._base if runs_as_base else run(case, solved, self._change)

    @property
    def ok(self) -> bool:
        return self._base.status == self._solved.status == "ok"

    @property
    def seconds(self) -> float:
        different = [self._base] if self._solved is self._base else [self._base, self._solved]
        return float(sum(simulation.stats.get("seconds", 0.0) for simulation in different))

    def force(self, names: Sequence[str], changed: bool) -> ForceOfTime:
        """Returns the force without noise, with the mechanisms `names`.

        changed : whether it also has the effect outside the catalogue
        """
        solved = [n for n in names if self._known[n].act.bind is not None]
        simulation = self._solved if solved or changed else self._base
        adding = [self._known[n] for n in names if n not in solved]
        values = {name: np.array([value]) for name, value in self._case.values.items()}
        force = observed(adding, values, MOTION, lambda t: np.atleast_2d(simulation.at(t)))
        return self._change.reported(force) if changed else force


def _recording_and_key(case: Case, runs: _FullRuns, screen: Screen, attempt: int) -> Concealed:
    plan = case.plan
    force = runs.force(plan.mechanisms, bool(plan.outside))
    time_s = samples_s()
    rng = np.random.default_rng([*plan.numbers, attempt, 1])
    measured = force(time_s)[0] + noise(rng, time_s, case.floor_n)
    force_n = CELL_STEP_N * np.round(measured / CELL_STEP_N)
    recording = Recording(
        time_s=time_s,
        displacement_m=LVDT_STEP_M * np.round(MOTION.at(time_s) / LVDT_STEP_M),
        force_n=force_n,
        name="recording",
        sha256=hashlib.sha256(force_n.tobytes()).hexdigest(),
        notes=("simulated, not measured",),
    )
    return Concealed(recording, _key(case, runs, screen, attempt, float(np.abs(force_n).max())))


def _key(case: Case, runs: _FullRuns, screen: Screen, attempt: int, peak_n: float) -> dict[str, Any]:
    """Returns everything that a score needs, and everything that is needed to make the case again."""
    plan, refit = case.plan, screen.refit
    theta = np.array([case.theta[name] for name in refit.surrogate.space.names])

    def means(names: Sequence[str], changed: bool) -> Array:
        mechanisms = [screen.known[name] for name in names]
        return bin_means(runs.force(names, changed), MOTION, EDGES_S, mechanisms)[0]

    whole, base = means(plan.mechanisms, bool(plan.outside)), means((), False)
    expected = refit.force(theta[None])[0]

    def remains(with_n: Array, without_n: Array) -> Array:
        """Returns what remains of an effect after the base model is fitted to its force plus the effect."""
        return refit.residual(expected + with_n - without_n, theta)

    remaining = remains(whole, base)
    size_n = float(rms(remaining))
    others = {name: [n for n in plan.mechanisms if n != name] for name in plan.mechanisms}
    return {
        "label": plan.label,
        "kind": plan.kind,
        "mechanisms": list(plan.mechanisms),
        "outside": plan.outside,
        "strength": case.strength,
        "theta": dict(case.theta),
        "values": dict(case.values),
        "floor_n": case.floor_n,
        "size_n": size_n,
        "size": size_n / case.floor_n,
        "sizes": {name: float(rms(remains(whole, means(kept, False)))) for name, kept in others.items()},
        "effect_n": float(rms(whole - base)),
        "target": case.target,
        "windows": windows(remaining, case.floor_n, EDGES_S),
        "mesh_n": float(rms(refit.residual(base, theta))),
        "tetrahedra": plan.tetrahedra,
        "tolerance": TOLERANCE,
        "attempt": attempt,
        "numbers": list(plan.numbers),
        "peak_n": peak_n,
        "seconds": runs.seconds,
        "version": bayeskin.__version__,
    }


def _start_or_check(folder: Path, seed: int, count: int, only: Sequence[str]) -> None:
    """Starts a set in a folder without one. Raises InputError if the folder holds another set."""
    path = folder / seals.SEALS / seals.SET
    settings: dict[str, Any] = {"seed": seed, "count": count, **({"only": list(only)} if only else {})}
    if not path.is_file():
        if (folder / seals.INDEX).is_file() and seals.read_index(folder):
            raise InputError(
                folder, "it contains a set without its seals", "use another folder for a new set"
            )
        seals.write_json(folder / seals.INDEX, {"recordings": {}})
        seals.write_json(path, settings)
    elif (stored := seals.read_json(path)) != settings:
        raise InputError(
            folder,
            f"it contains a set with the settings {stored}",
            f"use another folder for the settings {settings}",
        )


def _finished(folder: Path, number: str) -> bool:
    indexed = seals.read_index(folder).get(number)
    return indexed is not None and indexed == _hashes(folder, number)


def _hashes(folder: Path, number: str) -> dict[str, str]:
    return {
        "recording_sha256": seals.sha256(seals.recording_path(folder, number)),
        "key_sha256": seals.sha256(folder / seals.SEALS / f"{number}.json"),
    }


def _write(folder: Path, number: str, result: Concealed) -> None:
    storage.save(seals.recording_path(folder, number), result.recording)
    seals.write_json(folder / seals.SEALS / f"{number}.json", dict(result.key))
    index = {**seals.read_index(folder), number: _hashes(folder, number)}
    seals.write_json(folder / seals.INDEX, {"recordings": dict(sorted(index.items()))})
