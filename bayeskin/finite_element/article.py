"""Reproduces the article's own formulation, because the article's numbers rest on it.

The force of this formulation is not the reaction force on the pad. The script that was released with the
article differs from the total-Lagrangian model in four ways:

- After each time step the mesh's corners move with the displacement increment. The next step takes all
  gradients on this moved mesh, whose edges are straight, while the displacement stays total. So the "F" in
  the stress is I + du/dx on the mesh at the start of the step, where a total-Lagrangian F is I + du/dX.
- The momentum balance uses the Cauchy stress of this F, t_eff - p I. The fluid's mass balance uses the
  small-strain rate div(du)/dt + S dp/dt - div((k/mu_f) grad p). Both are integrated over the mesh at the
  start of the step.
- The force is the integral of t_xx - p over the pad's top face, whose normal is z. It is not doubled.
- Time integration is backward Euler on every 50th sample of the recording.

This updating is unstable where the subcutis is soft compared with the cutis (E_s below about 0.03 E_c). The
force then oscillates from step to step while the pads move at a steady speed, and soon no step converges. A
run that does so counts as failed.

Source: the script released with the article, with its physics unchanged (observation `article`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bayeskin.finite_element.accepted import AcceptedSteps
from bayeskin.finite_element.article_equations import ArticleModel
from bayeskin.finite_element.extrapolation import EXTRAPOLATION_POINTS, extrapolate
from bayeskin.finite_element.formulation import Formulation, RunRequest
from bayeskin.finite_element.problem import material
from bayeskin.types import Array, Simulation

STEP_S = 0.5  # every 50th sample of a 100 Hz recording
SMALLEST_STRESS = 1e-3  # relative to the shear modulus; a force of smaller stresses is mere rounding error
# relative to the largest force so far; at a steady speed no relaxation makes the force swing so much
SWING = 0.05


@dataclass(frozen=True)
class Article(Formulation):
    """The article's formulation, which observes the stress integrated over the pad's face."""

    fixed_discretisation = True
    error_unknown = "the article's force depends on the mesh and does not converge"
    steps = STEP_S

    def run(self, request: RunRequest) -> Simulation:
        accepted, problem, motion = AcceptedSteps(request), request.problem_at(request.theta), request.motion
        model = ArticleModel(problem, material(request.theta, problem.mesh.cutis))
        samples_s = np.arange(0.0, motion.time_s[-1] + 1e-9, STEP_S)

        def on_step(time_s: float, x: Array, force_n: float) -> None:
            accepted.add(time_s, x, force_n, bool(np.abs(motion.time_s - time_s).min() < 1e-6))

        message = integrate(model, samples_s, motion.at(samples_s), request.theta["p_init"], on_step)
        return accepted.simulation(problem, model.solver, message)


def integrate(
    model: ArticleModel,
    time_s: Array,
    displacement_m: Array,
    p_init: float,
    on_step: Callable[[float, Array, float], None],
) -> str:
    """Runs backward Euler over the given samples (n,).

    The function calls `on_step(time_s, x, force_n)` after each step.

    displacement_m : displacement of the LVDT; each pad moves half of it
    p_init : initial interstitial pressure [Pa]
    Returns an empty string, or for a run that failed one line with the step, the time and a remedy.
    """
    space = model.problem.space
    x = np.zeros(space.dofs)
    x[3 * space.n_nodes :] = p_init
    corners = model.problem.mesh.geometry.p.T.copy()
    past, old_speed = [(0.0, x)], np.nan  # states since the speed of the pads last changed
    forces = [0.0]  # the force at each of these states
    largest = SMALLEST_STRESS * float(model.material.mu.max()) * model.problem.lengths.quarter_pad_m2
    for n in range(1, len(time_s)):
        dt = float(time_s[n] - time_s[n - 1])
        speed = (displacement_m[n] - displacement_m[n - 1]) / dt
        if not abs(speed - old_speed) < 0.2 * abs(speed) + 1e-5:
            past, forces = past[-1:], forces[-1:]
        pad = 0.5 * float(displacement_m[n])
        guess = extrapolate(past, float(time_s[n])) if len(past) > 1 else None
        solution = model.step(x, corners, dt, pad, guess)
        if solution is None and guess is not None:
            solution = model.step(x, corners, dt, pad, None)
        if solution is None:
            return (
                f"step {n} at t = {time_s[n]:.2f} s did not converge; the article's formulation has "
                "fixed steps: try stiffer or more permeable parameters"
            )
        new, force = solution
        corners = model.move(corners, x, new)
        largest, forces = max(largest, abs(force)), [*forces, force][-3:]
        turns = np.diff(forces)
        if len(turns) == 2 and turns[0] * turns[1] < 0 and np.abs(turns).min() > SWING * largest:
            return (
                f"the force oscillates by {np.abs(turns).min():.2g} N per step at t = {time_s[n]:.2f} s "
                "at constant pad speed: the article's updated mesh is unstable; try a stiffer subcutis"
            )
        x, old_speed = new, speed
        past = [*past, (float(time_s[n]), x)][-EXTRAPOLATION_POINTS:]
        on_step(float(time_s[n]), x, force)
    return ""
