"""Derivatives of the force history against central differences over the same steps."""

from __future__ import annotations

import numpy as np
import pytest

from bayeskin.errors import InputError
from bayeskin.model import ModelSpec, lagrangian, simulate
from bayeskin.model.gradients import DIFFERENTIATED, ForceGradients
from bayeskin.model.lagrangian import LagrangianModel, Step, advance, integrate
from bayeskin.model.newton import EXTRAPOLATION_POINTS
from bayeskin.model.problem import material
from bayeskin.model.simulate import problem_of
from bayeskin.types import PadMotion

THETA = {"E_c": 6e4, "E_s": 2e4, "k_c": 1e-14, "k_s": 5e-13, "p_init": 700.0}
MOTION = PadMotion(np.array([0.0, 4.0, 20.0, 23.0]), np.array([0.0, 5e-3, 5e-3, 2e-3]))


def model(theta: dict[str, float]) -> LagrangianModel:
    problem = problem_of("bricks", 1)
    return LagrangianModel(problem, material(theta, problem.mesh.cutis), MOTION)


def forces_on_the_same_steps(theta: dict[str, float], steps: list[Step]) -> np.ndarray:
    skin = model(theta)
    past, forces = [skin.initial_state(theta["p_init"])], [0.0]
    for step in steps[1:]:
        made = advance(skin, past, step.state.time_s - past[-1].time_s)
        forces.append(made.force_n)
        past = [*past, made.state][-EXTRAPOLATION_POINTS:]
        if step.corner:
            skin.remember_travel(past)
            past = past[-1:]
    skin.solver.release()
    return np.array(forces)


def test_derivatives_are_central_differences(monkeypatch):
    monkeypatch.setattr(lagrangian, "SOLVER_TOLERANCE", 1e-7)
    skin, steps = model(THETA), []
    slopes = ForceGradients(skin, THETA)

    def on_step(step: Step) -> None:
        steps.append(step)
        if step.stages:
            slopes.follow(step)

    assert integrate(skin, THETA["p_init"], 1e-3, on_step) == ""
    found, h = np.array(slopes.force_n), 1e-3
    largest = np.abs(found).max()
    for column, name in enumerate(DIFFERENTIATED):
        up, down = (
            forces_on_the_same_steps({**THETA, name: THETA[name] * np.exp(sign * h)}, steps)
            for sign in (1, -1)
        )
        difference = (up - down) / (2 * h)
        assert np.abs(found[:, column] - difference).max() < 1e-4 * largest
    assert np.abs(found[:, DIFFERENTIATED.index("k_s")]).max() > 1e-3 * largest  # so that it says something


def test_a_run_carries_its_derivatives_and_they_obey_the_scaling_law():
    run = simulate(ModelSpec(), MOTION, THETA, gradients=True)
    assert run.gradient_names == DIFFERENTIATED
    assert run.gradient_n.shape == (len(run.time_s), 4)
    # Euler: F = E_c dF/dE_c + E_s dF/dE_s - k_c dF/dk_c - k_s dF/dk_s
    euler = run.gradient_n @ np.array([1.0, 1.0, -1.0, -1.0])
    np.testing.assert_allclose(euler, run.force_n, atol=1e-3 * run.force_n.max())
    means = run.gradient_bin_means(np.linspace(0, 23, 24))
    assert means.shape == (23, 4)
    assert not simulate(
        ModelSpec(), PadMotion(MOTION.time_s[:2], MOTION.displacement_m[:2]), THETA
    ).gradient_names


def test_the_articles_formulation_has_no_derivatives(tmp_path):
    spec = ModelSpec.__new__(ModelSpec)
    object.__setattr__(spec, "observation", "article")
    with pytest.raises(InputError, match="reaction"):
        simulate(spec, MOTION, THETA, gradients=True)
