"""Makes training runs of the full model and compresses their states to a few weighted modes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bayeskin.finite_element.lagrangian import LagrangianModel
from bayeskin.finite_element.problem import Problem, material
from bayeskin.finite_element.stages import Step
from bayeskin.finite_element.stepping import integrate
from bayeskin.finite_element.tissue import Bind
from bayeskin.reduced.basis import Inner, weighted_modes
from bayeskin.reduced.cases import Case
from bayeskin.types import Array


@dataclass(frozen=True)
class CompressionSettings:
    """Settings of the compression of a run.

    dual_every : number of steps from one stored adjoint solution to the next
    dual_scale_m : weight of adjoint solutions relative to states, as a displacement
    kept : modes with singular values below this fraction of the largest are left out
    most_modes : largest number of modes of each kind
    """

    dual_every: int = 8
    dual_scale_m: float = 5e-3
    kept: float = 1e-5
    most_modes: int = 24


COMPRESSION = CompressionSettings()


@dataclass(frozen=True)
class TrainingRun:
    """One full run as weighted modes, whose linear combinations are its states and adjoint solutions.

    displacement (a, 3 nodes) : modes [m], without the part that moves with the pads
    pressure (b, corners) : modes relative to the peak force of the run [Pa/N], without their means
    time_s, force_n (n,) : times of the steps and the force there
    message : empty, or the reason why the run ended early
    """

    displacement: Array
    pressure: Array
    time_s: Array
    force_n: Array
    message: str


class _States:
    """Collects the unknowns at each step of a run, and the adjoint solutions at some steps."""

    def __init__(self, model: LagrangianModel) -> None:
        self.model = model
        self.unknowns: list[Array] = []
        self.duals: list[Array] = []
        self.time_s, self.force_n = [0.0], [0.0]
        self._at_start: list[float] = []

    def on_step(self, step: Step) -> None:
        model = self.model
        time_s = step.state.time_s - model.starts_s
        if time_s > -1e-6:
            self._at_start.append(step.force_n)
            model.zero_n = self._at_start[0]
        if not step.stages:
            return
        if time_s > 0.0:
            self.time_s.append(time_s)
            self.force_n.append(step.force_n - model.zero_n)
        self.unknowns.append(step.state.x)
        if step.corner or len(self.unknowns) % COMPRESSION.dual_every == 1:
            self.duals.append(self._dual(step))

    def _dual(self, step: Step) -> Array:
        """Returns the adjoint (dofs,) of half the force at the end of a step."""
        model, stage = self.model, step.stages[-1]
        equations = model.equations(stage.length_s, stage.history, stage.elapsed_s)
        model.solver.renew(equations, stage.state.x)
        dual = np.zeros(model.problem.space.dofs)
        dual[equations.free] = -0.5 * model.solver.back_substitute(model.pad_gradient)
        dual[model.problem.measured_x] = 1.0
        return dual


def training_run(
    problem: Problem,
    inner: Inner,
    case: Case,
    binds: Sequence[Bind],
    tolerance: float = 1e-3,
) -> TrainingRun:
    """Runs the full model of a case and returns the run with compressed states.

    binds : functions that bind the laws of the case's mechanisms
    tolerance : allowed local error of the force in a time step, relative to the nominal force
    """
    laws = tuple(bind(case.theta, problem.sites) for bind in binds)
    model = LagrangianModel(problem, material(case.theta, problem.mesh.cutis), case.motion, laws)
    states = _States(model)
    try:
        message = integrate(model, case.theta["p_init"], tolerance, states.on_step, falls_too=False)
    except FloatingPointError as error:
        message = str(error)
    model.solver.release()
    force_n = np.array(states.force_n)
    peak_n = max(float(np.abs(force_n).max()), 1e-9)
    states_u, states_p = _weighted(states.unknowns, inner.moving, inner, peak_n, 1.0)
    duals_u, duals_p = _weighted(states.duals, inner.dual, inner, peak_n, COMPRESSION.dual_scale_m)
    return TrainingRun(
        np.concatenate([states_u, duals_u]).astype(np.float32),
        np.concatenate([states_p, duals_p]).astype(np.float32),
        np.array(states.time_s), force_n, message,
    )  # fmt: skip


def _weighted(
    unknowns: Sequence[Array], along: Array, inner: Inner, peak_n: float, scale: float
) -> tuple[Array, Array]:
    """Returns weighted modes of displacements and of pressures.

    The pads' displacement times `along` is subtracted from displacements, and the mean from each pressure.
    """
    n, corners = inner.displacement.shape[0], inner.pressure.shape[0]
    states = np.array(unknowns).reshape(-1, n + corners)
    u = states[:, :n] - np.outer(states[:, inner.pad_dof], along)
    p = inner.without_mean(states[:, n:] / peak_n)
    factor = scale / np.sqrt(max(len(states), 1))
    return (
        weighted_modes(factor * u, inner.displacement, COMPRESSION.kept, COMPRESSION.most_modes),
        weighted_modes(factor * p, inner.pressure, COMPRESSION.kept, COMPRESSION.most_modes),
    )
