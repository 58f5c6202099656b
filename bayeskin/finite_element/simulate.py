"""Runs the full model: it computes a force history from a specification, a motion and parameters."""

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
from bayeskin.finite_element.lagrangian import LagrangianModel
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
from bayeskin.finite_element.stages import Step
from bayeskin.finite_element.stepping import integrate
from bayeskin.finite_element.tissue import Bind
from bayeskin.geometry import LENGTHS, Geometry, moved
from bayeskin.types import Array, Observation, PadMotion, Simulation, frozen_array

PHYSICS_VERSION = 2  # increase it when a change of the code changes a force by more than its tolerance
ARTICLE_STEP_S = 0.5  # every 50th sample of a 100 Hz recording

OnState = Callable[[float, Array, float], None]  # time_s, x (dofs,), force_n


@dataclass(frozen=True)
class ModelSpec:
    """Specification of a model: device and tissue, the observed force, the mesh and the tolerance.

    observation : "reaction" (the force that the load cell measures), "article" (the force of the article's
        released code), or "own" (the force of a user's own model)
    mesh : "bricks" (bayeskin's graded bricks) or the path of a gmsh file with the article's names
    refinement : refinement of the bricks toward the edges of the pads; 1 gives 448 bricks, 0 gives 80
    tolerance : limit of the estimated local error of the reaction in a step, relative to the nominal force;
        the observation "article" has fixed steps
    forward : location of the user's own model, with observation "own", as `bayeskin.external.model`
        describes; mesh, refinement and tolerance then have no effect
    geometry : device and tissue; the observations "article" and "own" allow only the article's
    """

    observation: Observation = "reaction"
    mesh: str = "bricks"
    refinement: int = 1
    tolerance: float = 1e-3
    forward: str | None = None
    geometry: Geometry = Geometry()

    def __post_init__(self) -> None:
        if (self.observation == "own") != (self.forward is not None):
            raise InputError(
                "model.forward", self.forward, "a forward model if the observation is 'own', and only then"
            )
        if self.observation == "article" and self.mesh == "bricks":
            raise InputError("model.mesh", "bricks", "the article's gmsh mesh for observation 'article'")
        if self.observation != "reaction" and self.geometry != Geometry():
            given = f"settings other than the article's, with observation {self.observation!r}"
            raise InputError("geometry", given, "observation 'reaction', or the article's device and tissue")

    @property
    def mesh_hash(self) -> str:
        """Returns the hash of the mesh, which `accuracy.mesh_error` takes."""
        return _mesh(self.mesh, self.refinement, self.geometry).hash

    @property
    def hash(self) -> str:
        """Returns the sha256 of all that the force depends on besides the motion and the parameters."""
        if self.forward is not None:
            return identity(self.forward)
        steps = ARTICLE_STEP_S if self.observation == "article" else self.tolerance
        known = [PHYSICS_VERSION, self.observation, self.mesh_hash, steps, asdict(Constants())]
        if self.geometry != Geometry():  # older hashes of the article's device stay valid
            known.append(self.geometry.hash)
        return hashlib.sha256(json.dumps(known, sort_keys=True).encode()).hexdigest()


@lru_cache(maxsize=2)
def _mesh(mesh: str, refinement: int, geometry: Geometry) -> SkinMesh:
    """Returns the mesh of a specification."""
    return brick_mesh(refinement, geometry) if mesh == "bricks" else read_gmsh(Path(mesh), geometry)


@lru_cache(maxsize=2)
def problem_of(mesh: str, refinement: int, geometry: Geometry = Geometry()) -> Problem:
    """Returns the boundary-value problem of a mesh, which is built once in each process."""
    return build_problem(_mesh(mesh, refinement, geometry))


def problem_at(spec: ModelSpec, theta: Mapping[str, float]) -> Problem:
    """Returns the problem of a specification, with its nodes moved to the lengths of the tissue in theta.

    Raises InputError for impossible lengths, and for a gmsh mesh, whose nodes cannot be moved.
    """
    nominal, geometry = problem_of(spec.mesh, spec.refinement, spec.geometry), moved(spec.geometry, theta)
    if geometry == spec.geometry:
        return nominal
    if spec.mesh != "bricks":
        raise InputError("model.mesh", f"{spec.mesh!r} with changed lengths of the tissue", "'bricks'")
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
    """Runs the full model over the whole motion, and returns the force history.

    theta : E_c, E_s [Pa], k_c, k_s [m^2], p_init [Pa], the parameters of `laws`, and optionally lengths of
        the tissue [m], which replace those of the specification
    on_progress : function that is called with the completed fraction of the motion
    on_state : function that is called with time [s], all unknowns (dofs,) and force [N] of each accepted step
    gradients : parameters for which derivatives of the force are also computed, each with the change to which
        the derivative refers; only for the observation "reaction". `gradients.logarithms` gives the changes
        for derivatives with respect to the logarithms of the base model's four parameters and of lengths
    laws : physics beyond the base model; only for the observation "reaction". If the pads were opened before
        the test, the force is relative to the force at the start of the test, where everything is at rest
    falls_too : True to follow a skin that folds across the fold, which takes minutes; otherwise such a run
        fails

    A run that does not converge returns a Simulation with status "failed", the steps so far, and a message
    with the step, the time and a remedy. Raises InputError for a parameter that is missing, unknown, not
    finite, or not positive where it must be. For the observation "own", `simulate_own` describes the errors.
    """
    if spec.forward is None:
        _check_parameters(theta, bool(laws))
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
            partial(_gradients_of, spec, theta, gradients, laws) if gradients else None, falls_too,
        )  # fmt: skip
    else:
        outcome = (*_run_article(problem, motion, theta, history), None)
    return _simulation(problem, motion, theta, history, outcome, time.perf_counter() - started, spec.hash)


def _gradients_of(
    spec: ModelSpec,
    theta: Mapping[str, float],
    changes: Mapping[str, float],
    laws: Sequence[Bind],
    model: LagrangianModel,
) -> ForceGradients:
    """Returns the object that differentiates a run of the model."""
    return ForceGradients(model, theta, changes, laws, partial(problem_at, spec))


def simulate_on(
    problem: Problem,
    solid: Material,
    tolerance: float,
    motion: PadMotion,
    theta: Mapping[str, float],
    laws: Sequence[Bind] = (),
) -> Simulation:
    """Runs the model on any mesh with any constants of its cells, and returns the history of the reaction.

    solid : constants of each cell, which replace those computed from theta

    The other arguments and the errors are those of `simulate`. The result's model_hash is that of the mesh.
    """
    _check_parameters(theta, bool(laws))
    started = time.perf_counter()
    history = _History(motion, None, None)
    outcome = _run_reaction(problem, solid, tolerance, laws, motion, theta, history, None)
    seconds = time.perf_counter() - started
    return _simulation(problem, motion, theta, history, outcome, seconds, problem.mesh.hash)


_Outcome = tuple[str, NewtonSolver, ForceGradients | None]  # the message is empty for a run that finished


def _simulation(
    problem: Problem,
    motion: PadMotion,
    theta: Mapping[str, float],
    history: _History,
    outcome: _Outcome,
    seconds: float,
    model_hash: str,
) -> Simulation:
    """Frees the solver's memory and returns the result of a run."""
    message, solver, slopes = outcome
    solver.release()
    force = np.array(history.forces_n)
    stats = {
        "seconds": seconds,
        "steps": float(len(force) - 1),
        "dofs": float(problem.space.dofs),
        "time_error_n": float(np.linalg.norm(history.errors_n)),  # `accuracy` describes it
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
    """Returns the rows relative to the first row, (n, r)."""
    return np.array(rows) - rows[0]


class _History:
    """The accepted steps so far, starting with the state of rest. It reports each step to the callbacks."""

    def __init__(
        self, motion: PadMotion, on_progress: Callable[[float], None] | None, on_state: OnState | None
    ) -> None:
        self._end_s, self._on_progress, self._on_state = float(motion.time_s[-1]), on_progress, on_state
        self.times_s, self.forces_n, self.errors_n, self.corners = [0.0], [0.0], [0.0], [True]

    def add(self, time_s: float, x: Array, force_n: float, corner: bool, error_n: float = 0.0) -> None:
        """Stores a step after the start, and calls the callbacks."""
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
    """Runs the model for the observation "reaction", fills the history and returns the outcome."""
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
    """Runs the article's formulation and fills the history; returns the message and the solver."""
    model = article.ArticleModel(problem, material(theta, problem.mesh.cutis))
    samples = np.arange(0.0, motion.time_s[-1] + 1e-9, ARTICLE_STEP_S)

    def on_step(time_s: float, x: Array, force_n: float) -> None:
        history.add(time_s, x, force_n, bool(np.abs(motion.time_s - time_s).min() < 1e-6))

    message = article.run(model, samples, motion.at(samples), theta["p_init"], on_step)
    return message, model.solver


def _check_parameters(theta: Mapping[str, float], more: bool) -> None:
    """Raises InputError for a parameter that is missing, unknown, not finite or wrongly not positive.

    more : True if there are laws, whose parameters only the laws know, so that other names are allowed
    """
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
