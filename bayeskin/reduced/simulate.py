"""Runs a reduced model: parameters, mechanisms and a protocol in, the force history and its error out."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from bayeskin.finite_element.lagrangian import LagrangianModel
from bayeskin.finite_element.problem import material
from bayeskin.finite_element.simulate import ModelSpec, OnState
from bayeskin.finite_element.stages import Step
from bayeskin.finite_element.stepping import integrate
from bayeskin.geometry import Geometry, moved
from bayeskin.mechanisms import Mechanism, solved
from bayeskin.mechanisms.mechanism import Tissue
from bayeskin.reduced.equations import ReducedEquations
from bayeskin.reduced.error import DualWeightedResidual
from bayeskin.reduced.model import ReducedModel
from bayeskin.reduced.operators import ReducedSpace
from bayeskin.reduced.region import REGION, Stability, outside
from bayeskin.reduced.sensitivities import ReducedGradients
from bayeskin.types import Array, PadMotion, Simulation, frozen_array

TOLERANCE = ModelSpec.tolerance  # the full model's default
ESTIMATES = 12  # approximate number of states, besides the corners, at which the error is estimated
INSIDE_OUT = "the mesh is inverted between the cubature points; run the full model"
# time [s], coefficients (k + m,) of the reduced state, and their derivatives (r, k + m) or None
OnReducedState = Callable[[float, Array, Array | None], None]
SAFETY = 3.0  # factor on the error that the residual gives; chosen on the skins of docs/reduced.md


def simulate_reduced(
    model: ReducedModel,
    motion: PadMotion,
    theta: Mapping[str, float],
    mechanisms: Sequence[Mechanism] = (),
    gradients: Mapping[str, float] | None = None,
    geometry: Geometry | None = None,
    estimate: bool = False,
    on_state: OnState | None = None,
    on_reduced_state: OnReducedState | None = None,
    least_stiffness: float = REGION.least_stiffness,
) -> Simulation:
    """Runs a reduced model over the whole motion and returns the simulation.

    The run includes those of `mechanisms` that the full model solves.

    theta : E_c, E_s [Pa], k_c, k_s [m^2], p_init [Pa], the parameters of the mechanisms, and lengths of the
        tissue [m] that replace the geometry's
    gradients : parameters by which the force is also differentiated, each with the change that its derivative
        is for
    geometry : layers and arm, where they differ from the model's
    estimate : True to estimate the error of the force, which takes longer than the run
    on_state : function that is called with time [s], unknowns of the full model (dofs,) and force [N] of each
        step of the test
    on_reduced_state : function that is called with the reduced state of each step of the test
    least_stiffness : stiffness, relative to rest, below which the skin counts as near folding

    The simulation has status "failed" and a message where the run fails, where it leaves the trained region,
    or where the estimated error is infinite. With `estimate`, its `stats` hold the estimated RMS error of the
    force as "error_estimate_n" [N].
    """
    started = time.perf_counter()
    tissue = sorted(m.name for m in mechanisms if isinstance(m.act, Tissue))
    shape = moved(geometry or model.trained.geometry, theta)
    message = outside(model.trained, theta, tissue, shape, motion)
    history, run = _History(), None
    stats = {"inside": 0.0}
    if not message:
        run = _Run(model, motion, theta, mechanisms, tissue, shape, gradients, least_stiffness)
        message = run.integrate(history)
        stats = run.stats
        if on_state is not None:
            run.show(history, on_state)
        if on_reduced_state is not None:
            run.show_reduced(history, on_reduced_state)
        if estimate and not message:
            stats["error_estimate_n"] = run.estimated_error_n(history)
            if not np.isfinite(stats["error_estimate_n"]):
                message, stats["inside"] = INSIDE_OUT, 0.0
    force_n = np.array(history.force_n)
    stats |= {
        "seconds": time.perf_counter() - started,
        "steps": float(len(force_n) - 1),
        "peak_force_n": float(np.abs(force_n).max()),
    }
    slopes = None if run is None else run.slopes
    return Simulation(
        theta={name: float(value) for name, value in theta.items()},
        time_s=np.array(history.time_s),
        displacement_m=motion.at(history.time_s),
        force_n=force_n,
        corner=frozen_array(history.corner, bool),
        status="failed" if message else "ok",
        message=message,
        stats=stats,
        model_hash=model.hash,
        gradient_names=slopes.names if slopes else (),
        gradient_n=_relative_to_start(slopes, len(force_n)) if slopes else np.zeros((0, 0)),
    )


class _History:
    """Stores the accepted steps of the test, and all steps of the run."""

    def __init__(self) -> None:
        self.time_s, self.force_n, self.corner = [0.0], [0.0], [True]
        self.steps: list[Step] = []


class _Run:
    """One reduced run with its derivatives, its check of stability, and its error on the full mesh."""

    def __init__(
        self, model: ReducedModel, motion: PadMotion, theta: Mapping[str, float],
        mechanisms: Sequence[Mechanism], tissue: Sequence[str], geometry: Geometry,
        gradients: Mapping[str, float] | None, least_stiffness: float,
    ) -> None:  # fmt: skip
        self._model, self._motion, self._theta = model, motion, theta
        self._tissue, self._geometry = tissue, geometry
        self._binds = [m.act.bind for m in solved(mechanisms) if m.act.bind is not None]
        self._equations = ReducedEquations(model.space(tissue, geometry), theta, self._binds, motion)
        self._stability = Stability(self._equations.drive.largest_m, least_stiffness)
        self.slopes = None
        if gradients:
            space_at = partial(_space_at, model, tissue, geometry)
            self.slopes = ReducedGradients(self._equations, theta, gradients, self._binds, motion, space_at)
        self._seconds = 0.0

    def integrate(self, history: _History) -> str:
        """Fills the history and returns a message, which is empty where the run finished without folding."""
        equations = self._equations

        def on_step(step: Step) -> None:
            history.steps.append(step)
            if abs(step.state.time_s - equations.starts_s) < 1e-6:
                equations.zero_n = step.force_n
            time_s = step.state.time_s - equations.starts_s
            if step.stages:
                self._stability.look(step, equations.solid_stiffness)
                if self.slopes is not None:
                    self.slopes.follow(step)
            if time_s > 1e-6:
                history.time_s.append(time_s)
                history.force_n.append(step.force_n - equations.zero_n)
                history.corner.append(step.corner)

        started = time.perf_counter()
        try:
            message = integrate(equations, self._theta["p_init"], TOLERANCE, on_step, falls_too=False)
        except FloatingPointError as error:
            message = str(error)
        self._seconds = time.perf_counter() - started
        return message or self._stability.message

    @property
    def stats(self) -> dict[str, float]:
        """Returns counts and sizes of the run; "inside" is 1 where the skin was not near folding."""
        space = self._equations.space
        counts = dict(zip(("iterations", "residuals", "tangents"), self._equations.spent, strict=True))
        return {
            "inside": float(not self._stability.message), "stiffness_left": self._stability.left,
            "seconds_of_run": self._seconds, "modes": float(sum(space.modes) - 2),
            "points": float(len(space.at.weight)), **{name: float(count) for name, count in counts.items()},
        }  # fmt: skip

    def show(self, history: _History, on_state: OnState) -> None:
        """Calls `on_state` for each step of the test, with the unknowns on the nodes of the full mesh."""
        basis, equations = self._model.basis(self._tissue), self._equations
        for step in history.steps:
            time_s = step.state.time_s - equations.starts_s
            if time_s > -1e-6:
                on_state(max(time_s, 0.0), basis.nodal(step.state.x), step.force_n - equations.zero_n)

    def show_reduced(self, history: _History, on_reduced_state: OnReducedState) -> None:
        """Calls `on_reduced_state` for each step of the test."""
        test = history.steps[-len(history.time_s) :]
        slopes = [None] * len(test) if self.slopes is None else self.slopes.states[-len(test) :]
        for time_s, step, by in zip(history.time_s, test, slopes, strict=True):
            on_reduced_state(time_s, step.state.x, by)

    def estimated_error_n(self, history: _History) -> float:
        """Returns the estimated RMS error of the force [N], from some states of the test."""
        problem, starts_s = self._model.problem(self._geometry), self._equations.starts_s
        laws = tuple(bind(self._theta, problem.sites) for bind in self._binds)
        solid = material(self._theta, problem.mesh.cutis)
        full = LagrangianModel(problem, solid, self._motion, laws)
        residual = DualWeightedResidual(full, self._model.basis(self._tissue))
        test = [step for step in history.steps if step.stages and step.state.time_s > starts_s + 1e-6]
        every = max(1, len(test) // ESTIMATES)
        wanted = {id(step) for number, step in enumerate(test, 1) if step.corner or number % every == 0}
        errors = []
        for step in history.steps:
            for stage in step.stages:
                is_wanted = stage is step.stages[-1] and id(step) in wanted
                error_n = residual.follow(stage, step.force_n if is_wanted else None)
                if error_n is not None:
                    errors.append(error_n)
        full.solver.release()
        return SAFETY * float(np.sqrt(np.mean(np.square(errors))))


def _space_at(
    model: ReducedModel, tissue: Sequence[str], geometry: Geometry, theta: Mapping[str, float]
) -> ReducedSpace:
    return model.space(tissue, moved(geometry, theta))


def _relative_to_start(slopes: ReducedGradients, count: int) -> np.ndarray:
    rows = np.array(slopes.force_n[-count:])
    return rows - rows[0]
