"""One full run: a specification, a motion and parameters in; a force history out."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from bayeskin.errors import InputError
from bayeskin.external.model import identity, simulate_own
from bayeskin.finite_element import article
from bayeskin.finite_element.gmsh import read_gmsh
from bayeskin.finite_element.gradients import ForceGradients
from bayeskin.finite_element.lagrangian import LagrangianModel, Step
from bayeskin.finite_element.linear import SOLVER_NAME
from bayeskin.finite_element.mesh import SkinMesh, brick_mesh
from bayeskin.finite_element.newton import NewtonSolver
from bayeskin.finite_element.problem import (
    PARAMETERS,
    Constants,
    Material,
    Problem,
    build_problem,
    material,
    moved_problem,
)
from bayeskin.finite_element.stepping import integrate
from bayeskin.finite_element.tissue import Bind
from bayeskin.geometry import LENGTHS, Geometry, moved
from bayeskin.types import Array, Observation, PadMotion, Simulation, frozen_array

PHYSICS_VERSION = 2  # raised when a change of the code changes a force by more than its tolerance
ARTICLE_STEP_S = 0.5  # every 50th sample of a 100 Hz recording

OnState = Callable[[float, Array, float], None]  # time_s, x (dofs,), force_n


@dataclass(frozen=True)
class ModelSpec:
    """Choice of a model: its device and tissue, the force that is observed, the mesh and the tolerance.

    observation : "reaction" (what the load cell measures), "article" (its released code), or "own"
    mesh : "bricks" (our graded bricks) or the path of a gmsh file with the article's names
    refinement : of the bricks, toward the edges of the pads; 1 gives 448 of them, 0 gives 80
    tolerance : estimated local error of the reaction a step, relative to the nominal force; the
        article's steps are its own
    forward : with observation "own": where the model is that stands in this one's place, as
        `bayeskin.external.model` says; mesh, refinement and tolerance are then nothing to it
    geometry : device and tissue; the observations "article" and "own" know the article's only
    """

    observation: Observation = "reaction"
    mesh: str = "bricks"
    refinement: int = 1
    tolerance: float = 1e-3
    forward: str | None = None
    geometry: Geometry = Geometry()

    def __post_init__(self) -> None:
        if (self.observation == "own") != (self.forward is not None):
            raise InputError("model.forward", self.forward, "one with observation 'own', and only there")
        if self.observation == "article" and self.mesh == "bricks":
            raise InputError("model.mesh", "bricks", "the article's gmsh mesh for observation 'article'")
        if self.observation != "reaction" and self.geometry != Geometry():
            found = f"another than the article's, with observation {self.observation!r}"
            raise InputError("geometry", found, "observation 'reaction', or the article's device and tissue")

    @property
    def mesh_hash(self) -> str:
        """Hash by which `accuracy.mesh_error` knows the mesh."""
        return _mesh(self.mesh, self.refinement, self.geometry).hash

    @property
    def hash(self) -> str:
        """sha256 of all that the force depends on besides motion and parameters."""
        if self.forward is not None:
            return identity(self.forward)
        steps = ARTICLE_STEP_S if self.observation == "article" else self.tolerance
        known = [PHYSICS_VERSION, self.observation, self.mesh_hash, steps, asdict(Constants())]
        if self.geometry != Geometry():  # hashes of the article's device are older than any other
            known.append(self.geometry.hash)
        return hashlib.sha256(json.dumps(known, sort_keys=True).encode()).hexdigest()


@lru_cache(maxsize=2)
def _mesh(mesh: str, refinement: int, geometry: Geometry) -> SkinMesh:
    return brick_mesh(refinement, geometry) if mesh == "bricks" else read_gmsh(Path(mesh), geometry)


@lru_cache(maxsize=2)
def problem_of(mesh: str, refinement: int, geometry: Geometry = Geometry()) -> Problem:
    """Builds the boundary-value problem of a mesh, once a process."""
    return build_problem(_mesh(mesh, refinement, geometry))


def problem_at(spec: ModelSpec, theta: Mapping[str, float]) -> Problem:
    """Returns the problem of a specification, its nodes moved to the tissue's lengths that are in theta.

    Raises InputError for lengths that cannot be, and for a gmsh mesh, whose nodes stay where they are.
    """
    nominal, geometry = problem_of(spec.mesh, spec.refinement, spec.geometry), moved(spec.geometry, theta)
    if geometry == spec.geometry:
        return nominal
    if spec.mesh != "bricks":
        raise InputError("model.mesh", f"{spec.mesh!r} with another length of the tissue", "'bricks'")
    return moved_problem(nominal, brick_mesh(spec.refinement, geometry, spec.geometry))


def simulate(
    spec: ModelSpec,
    motion: PadMotion,
    theta: Mapping[str, float],
    on_progress: Callable[[float], None] | None = None,
    on_state: OnState | None = None,
    gradients: Mapping[str, float] | None = None,
    laws: Sequence[Bind] = (),
    falls_too: bool = True,
) -> Simulation:
    """Runs the full model over the whole motion.

    theta : E_c, E_s [Pa], k_c, k_s [m^2], p_init [Pa], the parameters of `laws`, and lengths of the tissue
        [m] in place of the specification's
    on_progress : called with the fraction of the motion that is done
    on_state : called with time [s], all unknowns (dofs,) and force [N] of each accepted step
    gradients : also the force's derivatives by these parameters, each for the change that stands with it,
        `reaction` only (`gradients.logarithms`: by the logarithms of the base's four and of lengths)
    falls_too : whether a skin that folds is followed across the fold, which takes minutes; else it has failed
    laws : physics beyond the base model, `reaction` only; with pads that were opened before the test the
        force is relative to that at its start, where all is at rest

    A run that does not converge is a Simulation with status "failed", its steps so far, and a
    message with the step, the time and a remedy. Raises InputError for a parameter that is
    missing, unknown, not finite, or not positive where it must be; of a model of one's own as `simulate_own`.
    """
    if spec.forward is None:
        _check(theta, bool(laws))
    if gradients and spec.observation != "reaction":
        raise InputError("gradients", f"observation {spec.observation!r}", "observation 'reaction'")
    if laws and spec.observation != "reaction":
        raise InputError("tissue mechanisms", f"observation {spec.observation!r}", "observation 'reaction'")
    if spec.forward is not None:
        return simulate_own(spec.forward, motion, theta)
    started = time.perf_counter()
    problem = problem_at(spec, theta)
    history = _History(motion, on_progress, on_state)
    if spec.observation == "reaction":
        solid = material(theta, problem.mesh.cutis)
        outcome = _run_reaction(
            problem, solid, spec.tolerance, laws, motion, theta, history,
            partial(_slopes, spec, theta, gradients, laws) if gradients else None, falls_too,
        )  # fmt: skip
    else:
        outcome = (*_run_article(problem, motion, theta, history), None)
    return _simulation(problem, motion, theta, history, outcome, time.perf_counter() - started, spec.hash)


def _slopes(
    spec: ModelSpec,
    theta: Mapping[str, float],
    changes: Mapping[str, float],
    laws: Sequence[Bind],
    model: LagrangianModel,
) -> ForceGradients:
    return ForceGradients(model, theta, changes, laws, partial(problem_at, spec))


def simulate_on(
    problem: Problem,
    solid: Material,
    tolerance: float,
    motion: PadMotion,
    theta: Mapping[str, float],
    laws: Sequence[Bind] = (),
) -> Simulation:
    """The reaction on any mesh and with any constants of its cells, as `simulate` gives it.

    solid : of each cell, in place of what theta makes of the article's constants; the rest as `simulate`.
    The result's model_hash is the mesh's.
    """
    _check(theta, bool(laws))
    started = time.perf_counter()
    history = _History(motion, None, None)
    outcome = _run_reaction(problem, solid, tolerance, laws, motion, theta, history, None)
    seconds = time.perf_counter() - started
    return _simulation(problem, motion, theta, history, outcome, seconds, problem.mesh.hash)


_Outcome = tuple[str, NewtonSolver, ForceGradients | None]  # message, empty for a run that finished


def _simulation(
    problem: Problem,
    motion: PadMotion,
    theta: Mapping[str, float],
    history: _History,
    outcome: _Outcome,
    seconds: float,
    model_hash: str,
) -> Simulation:
    message, solver, slopes = outcome
    solver.release()
    force = np.array(history.forces_n)
    stats = {
        "seconds": seconds,
        "steps": float(len(force) - 1),
        "dofs": float(problem.space.dofs),
        "time_error_n": float(np.linalg.norm(history.errors_n)),  # see `accuracy`
        "peak_force_n": float(np.abs(force).max()),
        "last_residual": float(solver.last_residual),
        **{name: float(count) for name, count in solver.counts.items()},
        **({"seconds_of_gradients": slopes.seconds} if slopes else {}),
    }
    return Simulation(
        theta={name: float(value) for name, value in theta.items()},
        time_s=np.array(history.times_s),
        displacement_m=motion.at(history.times_s),
        force_n=force,
        corner=frozen_array(history.corners, bool),
        status="failed" if message else "ok",
        message=message,
        stats=stats,
        model_hash=model_hash,
        gradient_names=slopes.names if slopes else (),
        gradient_n=_beyond_start(slopes.force_n[-len(force) :]) if slopes else np.zeros((0, 0)),
    )


def _beyond_start(rows: Sequence[Array]) -> Array:
    return np.array(rows) - rows[0]


class _History:
    """Accepted steps so far, from the state of rest on; tells whoever listens of each."""

    def __init__(
        self, motion: PadMotion, on_progress: Callable[[float], None] | None, on_state: OnState | None
    ) -> None:
        self._end_s, self._on_progress, self._on_state = float(motion.time_s[-1]), on_progress, on_state
        self.times_s, self.forces_n, self.errors_n, self.corners = [0.0], [0.0], [0.0], [True]

    def add(self, time_s: float, x: Array, force_n: float, corner: bool, error_n: float = 0.0) -> None:
        if time_s > 0.0:
            self.times_s.append(time_s)
            self.forces_n.append(force_n)
            self.corners.append(corner)
            self.errors_n.append(error_n)
        if self._on_state is not None:
            self._on_state(time_s, x, force_n)
        if self._on_progress is not None:
            self._on_progress(time_s / self._end_s)


def _run_reaction(
    problem: Problem,
    solid: Material,
    tolerance: float,
    laws: Sequence[Bind],
    motion: PadMotion,
    theta: Mapping[str, float],
    history: _History,
    slopes_of: Callable[[LagrangianModel], ForceGradients] | None,
    falls_too: bool = True,
) -> _Outcome:
    """Fills the history; returns a message, empty for a run that finished."""
    bound = tuple(bind(theta, problem.sites) for bind in laws)
    model = LagrangianModel(problem, solid, motion, bound)
    slopes = slopes_of(model) if slopes_of is not None else None
    at_start: list[float] = []

    def on_step(step: Step) -> None:
        if slopes is not None and step.stages:
            slopes.follow(step)
        time_s = step.state.time_s - model.starts_s
        if time_s > -1e-6:
            at_start.append(step.force_n)
            model.zero_n = at_start[0]
            force_n = step.force_n - model.zero_n
            history.add(max(time_s, 0.0), step.state.x, force_n, step.corner, step.error_n)

    try:
        message = integrate(model, theta["p_init"], tolerance, on_step, falls_too)
    except FloatingPointError as error:
        message = str(error)
    return message, model.solver, slopes


def _run_article(
    problem: Problem, motion: PadMotion, theta: Mapping[str, float], history: _History
) -> tuple[str, NewtonSolver]:
    model = article.ArticleModel(problem, material(theta, problem.mesh.cutis))
    samples = np.arange(0.0, motion.time_s[-1] + 1e-9, ARTICLE_STEP_S)

    def on_step(time_s: float, x: Array, force_n: float) -> None:
        history.add(time_s, x, force_n, bool(np.abs(motion.time_s - time_s).min() < 1e-6))

    message = article.run(model, samples, motion.at(samples), theta["p_init"], on_step)
    return message, model.solver


def _check(theta: Mapping[str, float], more: bool) -> None:
    """`more`: of laws, which alone know their parameters."""
    for name in PARAMETERS:
        if name not in theta:
            raise InputError("parameters", f"no {name}", f"all of {', '.join(PARAMETERS)}")
        value = theta[name]
        if not np.isfinite(value) or (name != "p_init" and value <= 0):
            raise InputError(f"parameters: {name}", value, "a finite positive number")
    for name, value in theta.items():
        if not np.isfinite(value):
            raise InputError(f"parameters: {name}", value, "a finite number")
        if name not in (*PARAMETERS, *LENGTHS) and not more:
            raise InputError("parameters", name, f"one of {', '.join(PARAMETERS)}")


__all__ = ["SOLVER_NAME", "ModelSpec", "problem_at", "problem_of", "simulate", "simulate_on"]
