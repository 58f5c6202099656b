"""One full run: a specification, a motion and parameters in; a force history out."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from bayeskin.errors import InputError
from bayeskin.model import article, lagrangian
from bayeskin.model.gradients import DIFFERENTIATED, ForceGradients
from bayeskin.model.linear import SOLVER_NAME
from bayeskin.model.mesh import SkinMesh, brick_mesh, read_gmsh
from bayeskin.model.problem import PARAMETERS, Constants, Problem, build_problem, material
from bayeskin.types import Array, Observation, PadMotion, Simulation, frozen_array

PHYSICS_VERSION = 1  # raised when a change of the code changes a force by more than its tolerance
ARTICLE_STEP_S = 0.5  # every 50th sample of a 100 Hz recording
ARTICLE_HOLD_STEPS = (0.5, 8.0, 1.3)  # first, longest, growth: see ModelSpec.article_steps

OnState = Callable[[float, Array, float], None]  # time_s, x (dofs,), force_n


@dataclass(frozen=True)
class ModelSpec:
    """Which model: what force is observed, on which mesh, to what tolerance.

    observation : "reaction" (what a load cell on the pad measures) or "article" (its released code)
    mesh : "bricks" (our graded bricks) or the path of a gmsh file with the article's names
    refinement : of the bricks; 1 gives 231 of them
    tolerance : estimated local error of the reaction a step, relative to the nominal force
    article_steps : "fixed" (0.5 s throughout, as the article) or "growing" (0.5 s while the pads
        move and just after, longer in holds and rests: a third of the steps)
    """

    observation: Observation = "reaction"
    mesh: str = "bricks"
    refinement: int = 1
    tolerance: float = 1e-3
    article_steps: str = "fixed"

    def __post_init__(self) -> None:
        if self.observation == "article" and self.mesh == "bricks":
            raise InputError("model.mesh", "bricks", "the article's gmsh mesh for observation 'article'")

    @property
    def hash(self) -> str:
        """sha256 of all that the force depends on besides motion and parameters."""
        spec = asdict(self) | {"mesh": _mesh(self.mesh, self.refinement).hash}
        text = json.dumps([PHYSICS_VERSION, spec, asdict(Constants())], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


@lru_cache(maxsize=2)
def _mesh(mesh: str, refinement: int) -> SkinMesh:
    return brick_mesh(refinement) if mesh == "bricks" else read_gmsh(Path(mesh))


@lru_cache(maxsize=2)
def problem_of(mesh: str, refinement: int) -> Problem:
    """The boundary-value problem of a mesh, built once a process."""
    return build_problem(_mesh(mesh, refinement))


def simulate(
    spec: ModelSpec,
    motion: PadMotion,
    theta: Mapping[str, float],
    on_progress: Callable[[float], None] | None = None,
    on_state: OnState | None = None,
    gradients: bool = False,
) -> Simulation:
    """Runs the full model over the whole motion.

    theta : E_c, E_s [Pa], k_c, k_s [m^2], p_init [Pa]
    on_progress : called with the fraction of the motion that is done
    on_state : called with time [s], all unknowns (dofs,) and force [N] of each accepted step
    gradients : also the force's derivatives by the logarithms of `gradients.DIFFERENTIATED`, `reaction` only

    A run that does not converge is a Simulation with status "failed", its steps so far, and a
    message with the step, the time and a remedy. Raises InputError for a parameter that is
    missing, unknown, not finite, or not positive where it must be.
    """
    _check(theta)
    if gradients and spec.observation != "reaction":
        raise InputError("gradients", f"observation {spec.observation!r}", "observation 'reaction'")
    slopes: ForceGradients | None = None
    problem = problem_of(spec.mesh, spec.refinement)
    times, forces = [0.0], [0.0]
    corners, errors = [True], [0.0]
    end = float(motion.time_s[-1])

    def record(time_s: float, x: Array, force_n: float, corner: bool, error_n: float = 0.0) -> None:
        if time_s > 0.0:
            times.append(time_s)
            forces.append(force_n)
            corners.append(corner)
            errors.append(error_n)
        if on_state is not None:
            on_state(time_s, x, force_n)
        if on_progress is not None:
            on_progress(time_s / end)

    started = time.perf_counter()
    cells = material(theta, problem.mesh.cutis)
    if spec.observation == "reaction":
        model = lagrangian.LagrangianModel(problem, cells, motion)
        slopes = ForceGradients(model, theta) if gradients else None

        def on_step(step: lagrangian.Step) -> None:
            if slopes is not None and step.stages:
                slopes.follow(step)
            record(step.state.time_s, step.state.x, step.force_n, step.corner, step.error_n)

        try:
            message = lagrangian.integrate(model, theta["p_init"], spec.tolerance, on_step)
        except FloatingPointError as error:
            message = str(error)
        solver = model.solver
    else:
        old = article.ArticleModel(problem, cells)
        samples = article_samples(motion, spec.article_steps)
        message = article.run(
            old,
            samples,
            motion.at(samples),
            theta["p_init"],
            lambda t, x, f: record(t, x, f, bool(np.abs(motion.time_s - t).min() < 1e-6)),
        )
        solver = old.solver
    solver.release()
    force = np.array(forces)
    peak = float(np.abs(force).max())
    stats = {
        "seconds": time.perf_counter() - started,
        "steps": float(len(times) - 1),
        "dofs": float(problem.space.dofs),
        "time_error_n": float(np.sum(errors)),  # sum of local estimates: pessimistic
        "peak_force_n": peak,
        "last_residual": float(solver.last_residual),
        **{name: float(count) for name, count in solver.counts.items()},
        **({"seconds_of_gradients": slopes.seconds} if slopes else {}),
    }
    return Simulation(
        theta={name: float(theta[name]) for name in PARAMETERS},
        time_s=np.array(times),
        displacement_m=motion.at(times),
        force_n=force,
        corner=frozen_array(corners, bool),
        status="failed" if message else "ok",
        message=message,
        stats=stats,
        model_hash=spec.hash,
        gradient_names=DIFFERENTIATED if slopes else (),
        gradient_n=np.array(slopes.force_n) if slopes else np.zeros((0, 0)),
    )


def article_samples(motion: PadMotion, steps: str) -> Array:
    """Times of the article's backward-Euler steps (n,) [s], starting at 0."""
    fixed = np.arange(0.0, motion.time_s[-1] + 1e-9, ARTICLE_STEP_S)
    if steps == "fixed":
        return fixed
    moving = np.abs(np.diff(motion.at(fixed))) > 2e-5
    first, longest, growth = ARTICLE_HOLD_STEPS
    chosen, i, stride = [0], 0, first
    while i < len(moving):
        stride = first if moving[i] else min(stride * growth, longest)
        jump = max(1, round(stride / ARTICLE_STEP_S))
        upcoming = np.flatnonzero(moving[i : i + jump])
        i = min(i + (jump if moving[i] or not len(upcoming) else int(upcoming[0])), len(moving))
        chosen.append(i)
    return fixed[chosen]


def _check(theta: Mapping[str, float]) -> None:
    for name in PARAMETERS:
        if name not in theta:
            raise InputError("parameters", f"no {name}", f"all of {', '.join(PARAMETERS)}")
        value = theta[name]
        if not np.isfinite(value) or (name != "p_init" and value <= 0):
            raise InputError(f"parameters: {name}", value, "a finite positive number")
    for name in theta:
        if name not in PARAMETERS:
            raise InputError("parameters", name, f"one of {', '.join(PARAMETERS)}")


__all__ = ["SOLVER_NAME", "ModelSpec", "article_samples", "problem_of", "simulate"]
