"""One run of a reduced model: parameters, mechanisms and a protocol in; force history and its error out."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

import numpy as np

from bayeskin.geometry import Geometry
from bayeskin.mechanisms import Mechanism, solved
from bayeskin.mechanisms.mechanism import Tissue
from bayeskin.model.lagrangian import LagrangianModel, Step
from bayeskin.model.problem import material
from bayeskin.model.simulate import OnState
from bayeskin.model.stepping import integrate
from bayeskin.model.tissue import Bind
from bayeskin.reduced.equations import ReducedEquations
from bayeskin.reduced.error import DualWeightedResidual
from bayeskin.reduced.model import ReducedModel
from bayeskin.reduced.region import outside
from bayeskin.reduced.sensitivities import ReducedGradients
from bayeskin.types import PadMotion, Simulation, frozen_array

TOLERANCE = 1e-3  # of a step's error in time, relative to the nominal force: the full model's default
ESTIMATES = 12  # states at which the error is estimated


def simulate_reduced(
    model: ReducedModel,
    motion: PadMotion,
    theta: Mapping[str, float],
    mechanisms: Sequence[Mechanism] = (),
    gradients: Mapping[str, float] | None = None,
    geometry: Geometry | None = None,
    estimate: bool = False,
    on_state: OnState | None = None,
) -> Simulation:
    """Runs a reduced model over the whole motion, with those of `mechanisms` that the full model solves.

    theta : E_c, E_s [Pa], k_c, k_s [m^2], p_init [Pa], and the mechanisms' parameters
    gradients : also the force's derivatives by these parameters, each for the change that stands with it
    geometry : layers and arm that differ from the model's
    estimate : whether the force's error is estimated, which takes longer than the run
    on_state : called with time [s], the full model's unknowns (dofs,) and force [N] of each step of the test

    A run that fails, or that leaves the trained region, is a Simulation with status "failed" and a message;
    `stats` has "error_estimate_n" [N], RMS over the states looked at, where it was asked for.
    """
    started = time.perf_counter()
    binds = [m.act.bind for m in solved(mechanisms) if m.act.bind is not None]
    tissue = sorted(m.name for m in mechanisms if isinstance(m.act, Tissue))
    shape = geometry or model.trained.geometry
    message = outside(model.trained, theta, tissue, shape, motion)
    inside = not message
    history = _History()
    stats: dict[str, float] = {}
    slopes = None
    if not message:
        space = model.space(tissue, shape)
        prepared = time.perf_counter()
        equations = ReducedEquations(space, theta, binds, motion)
        slopes = ReducedGradients(equations, theta, gradients, binds, motion) if gradients else None
        message = _integrated(equations, theta["p_init"], history, slopes)
        ran = time.perf_counter()
        iterations, residuals, tangents = map(float, equations.spent)
        (k, m), points = space.modes, len(space.at.weight)
        stats = {
            "seconds_of_run": ran - prepared, "modes": float(k - 2 + m), "points": float(points),
            "iterations": iterations, "residuals": residuals, "tangents": tangents,
        }  # fmt: skip
        if on_state is not None:
            _show(model, equations, tissue, history, on_state)
        if estimate and not message:
            stats["error_estimate_n"] = _estimated(
                model, equations, binds, theta, tissue, shape, motion, history
            )
    force_n = np.array(history.force_n)
    return Simulation(
        theta={name: float(value) for name, value in theta.items()},
        time_s=np.array(history.time_s),
        displacement_m=motion.at(history.time_s),
        force_n=force_n,
        corner=frozen_array(history.corner, bool),
        status="failed" if message else "ok",
        message=message,
        stats={
            "seconds": time.perf_counter() - started, "steps": float(len(force_n) - 1),
            "peak_force_n": float(np.abs(force_n).max()), "inside": float(inside), **stats,
        },
        model_hash=model.hash,
        gradient_names=slopes.names if slopes else (),
        gradient_n=_beyond_start(slopes, len(force_n)) if slopes else np.zeros((0, 0)),
    )  # fmt: skip


class _History:
    """Accepted steps of the test, and all steps of the run."""

    def __init__(self) -> None:
        self.time_s, self.force_n, self.corner = [0.0], [0.0], [True]
        self.steps: list[Step] = []


def _integrated(
    equations: ReducedEquations, p_init: float, history: _History, slopes: ReducedGradients | None
) -> str:
    """Fills the history; returns a message, empty for a run that finished."""

    def on_step(step: Step) -> None:
        history.steps.append(step)
        if abs(step.state.time_s - equations.starts_s) < 1e-6:
            equations.zero_n = step.force_n
        time_s = step.state.time_s - equations.starts_s
        if slopes is not None and step.stages:
            slopes.follow(step)
        if time_s > 1e-6:
            history.time_s.append(time_s)
            history.force_n.append(step.force_n - equations.zero_n)
            history.corner.append(step.corner)

    try:
        return integrate(equations, p_init, TOLERANCE, on_step, falls_too=False)
    except FloatingPointError as error:
        return str(error)


def _show(
    model: ReducedModel, equations: ReducedEquations, tissue: Sequence[str], history: _History,
    on_state: OnState,
) -> None:  # fmt: skip
    """Shows each step of the test on the nodes of the full model's mesh."""
    basis = model.basis(tissue)
    for step in history.steps:
        time_s = step.state.time_s - equations.starts_s
        if time_s > -1e-6:
            on_state(max(time_s, 0.0), basis.nodal(step.state.x), step.force_n - equations.zero_n)


def _beyond_start(slopes: ReducedGradients, count: int) -> np.ndarray:
    rows = np.array(slopes.force_n[-count:])
    return rows - rows[0]


def _estimated(
    model: ReducedModel, equations: ReducedEquations, binds: Sequence[Bind], theta: Mapping[str, float],
    tissue: Sequence[str], geometry: Geometry, motion: PadMotion, history: _History,
) -> float:  # fmt: skip
    """The RMS of the force's estimated error [N] over some states of a run."""
    problem = model.problem(geometry)
    laws = tuple(bind(theta, problem.sites) for bind in binds)
    full = LagrangianModel(problem, material(theta, problem.mesh.cutis), motion, laws)
    residual = DualWeightedResidual(full, model.basis(tissue))
    test = [step for step in history.steps if step.stages and step.state.time_s > equations.starts_s + 1e-6]
    every = max(1, len(test) // ESTIMATES)
    wanted = {id(step) for number, step in enumerate(test) if step.corner or number % every == every - 1}
    errors = []
    for step in history.steps:
        for stage in step.stages:
            looked_at = stage is step.stages[-1] and id(step) in wanted
            error_n = residual.follow(stage, step.force_n if looked_at else None)
            if error_n is not None:
                errors.append(error_n)
    full.solver.release()
    return float(np.sqrt(np.mean(np.square(errors))))
