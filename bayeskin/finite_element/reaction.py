"""Runs bayeskin's own formulation: the total-Lagrangian model, whose force is the reaction on the pads."""

from __future__ import annotations

from dataclasses import dataclass

from bayeskin.finite_element.accepted import AcceptedSteps
from bayeskin.finite_element.formulation import Formulation, RunRequest
from bayeskin.finite_element.gradients import ForceGradients
from bayeskin.finite_element.lagrangian import LagrangianModel
from bayeskin.finite_element.problem import Material, Problem, material
from bayeskin.finite_element.stages import Step
from bayeskin.finite_element.stepping import integrate
from bayeskin.types import Simulation


@dataclass(frozen=True)
class Reaction(Formulation):
    """The total-Lagrangian formulation, which observes the force on the parts that the load cell holds.

    tolerance : limit of the estimated local error of the reaction in a step, relative to the nominal force
    """

    tolerance: float

    any_device = differentiable = takes_laws = has_fields = reducible = True

    @property
    def steps(self) -> float:
        return self.tolerance

    def run(self, request: RunRequest) -> Simulation:
        accepted, problem = AcceptedSteps(request), request.problem_at(request.theta)
        return self.run_on(problem, material(request.theta, problem.mesh.cutis), accepted)

    def run_on(self, problem: Problem, solid: Material, accepted: AcceptedSteps) -> Simulation:
        """Returns a run on a problem with any constants of its cells; `accepted` is still empty."""
        request = accepted.request
        bound = tuple(bind(request.theta, problem.sites) for bind in request.laws)
        model = LagrangianModel(problem, solid, request.motion, bound)
        slopes = None
        if request.gradients:
            slopes = ForceGradients(model, request.theta, request.gradients, request.laws, request.problem_at)
        at_start: list[float] = []

        def on_step(step: Step) -> None:
            if slopes is not None and step.stages:
                slopes.follow(step)
            time_s = step.state.time_s - model.starts_s
            if time_s > -1e-6:
                at_start.append(step.force_n)
                model.zero_n = at_start[0]
                force_n = step.force_n - model.zero_n
                accepted.add(max(time_s, 0.0), step.state.x, force_n, step.corner, step.error_n)

        try:
            message = integrate(model, request.theta["p_init"], self.tolerance, on_step, request.falls_too)
        except FloatingPointError as error:
            message = str(error)
        return accepted.simulation(problem, model.solver, message, slopes)
