"""Derivatives of the force history against central differences over the same steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayeskin.errors import InputError
from bayeskin.mechanisms.bottom_adherence import BottomAdherence
from bayeskin.mechanisms.solid_viscoelasticity import Relaxation
from bayeskin.model import ModelSpec, lagrangian, simulate
from bayeskin.model.directional import TangentAction
from bayeskin.model.gradients import DIFFERENTIATED, ForceGradients
from bayeskin.model.lagrangian import Evaluated, LagrangianModel, Stage, State, Step, advance, integrate
from bayeskin.model.newton import EXTRAPOLATION_POINTS
from bayeskin.model.problem import Material, material
from bayeskin.model.simulate import problem_of
from bayeskin.model.tissue import Bind
from bayeskin.types import PadMotion

THETA = {"E_c": 6e4, "E_s": 2e4, "k_c": 1e-14, "k_s": 5e-13, "p_init": 700.0}
MOTION = PadMotion(np.array([0.0, 4.0, 20.0, 23.0]), np.array([0.0, 5e-3, 5e-3, 2e-3]))


def relaxing(theta, problem):
    return Relaxation([0.8, 0.4], [0.5, 30.0])


def adherent(theta, problem):
    """Its stiffness does not scale with the skin's."""
    return BottomAdherence(3e6, problem)


def model(theta: dict[str, float], laws: tuple[Bind, ...] = ()) -> LagrangianModel:
    problem = problem_of("bricks", 1)
    bound = tuple(bind(theta, problem) for bind in laws)
    return LagrangianModel(problem, material(theta, problem.mesh.cutis), MOTION, bound)


def forces_on_the_same_steps(
    theta: dict[str, float], steps: list[Step], laws: tuple[Bind, ...]
) -> np.ndarray:
    skin = model(theta, laws)
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


@pytest.mark.parametrize("laws", [(), (relaxing, adherent)], ids=["base", "laws"])
def test_derivatives_are_central_differences(monkeypatch, laws):
    monkeypatch.setattr(lagrangian, "SOLVER_TOLERANCE", 1e-7)
    skin, steps = model(THETA, laws), []
    slopes = ForceGradients(skin, THETA, laws)

    def on_step(step: Step) -> None:
        steps.append(step)
        if step.stages:
            slopes.follow(step)

    assert integrate(skin, THETA["p_init"], 1e-3, on_step) == ""
    found, h = np.array(slopes.force_n), 1e-3
    largest = np.abs(found).max()
    for column, name in enumerate(DIFFERENTIATED):
        up, down = (
            forces_on_the_same_steps({**THETA, name: THETA[name] * np.exp(sign * h)}, steps, laws)
            for sign in (1, -1)
        )
        difference = (up - down) / (2 * h)
        assert np.abs(found[:, column] - difference).max() < 1e-4 * largest
    assert np.abs(found[:, DIFFERENTIATED.index("k_s")]).max() > 1e-3 * largest  # so that it says something


@pytest.mark.parametrize("h", [0.02, 20.0])
def test_the_exact_tangent_is_the_difference_of_residuals(h):
    skin, rng = model(THETA), np.random.default_rng(0)
    space, r = skin.problem.space, 3
    storing = np.full_like(skin.material.storage, 1e-4)  # enough to be seen
    skin.material = replace(skin.material, storage=storing)
    n, shape = 3 * space.n_nodes, space.weight.shape

    def drawn(u: float, p: float, *columns: int) -> np.ndarray:
        return np.concatenate(
            [u * rng.normal(size=(n, *columns)), p * rng.normal(size=(space.n_corners, *columns))]
        )

    x, along = drawn(2e-6, 500.0), drawn(1e-6, 300.0, r)
    x[:n] += (space.points_u.T @ np.array([[0.2, 0, 0], [0.1, -0.05, 0], [0, 0.03, -0.1]])).ravel()
    start = State(0.0, x, np.full(shape, 1.01), np.full(shape, 200.0))
    stage = Stage(State(h, x, start.volume, start.pressure), h, h, start, (), np.zeros(space.dofs))
    j_old, p_old = 1e-2 * rng.normal(size=(*shape, r)), 50.0 * rng.normal(size=(*shape, r))
    rates = tuple(a[:, None] * rng.normal(size=r) for a in (skin.material.mu, skin.material.lam))
    rates = (*rates, skin.material.mobility[:, None] * rng.normal(size=r))
    found = TangentAction(skin, stage, rates, j_old, p_old)(along)
    for k in range(r):

        def at(by: float, k: int = k) -> Evaluated:
            old = State(0.0, x, start.volume + by * j_old[..., k], start.pressure + by * p_old[..., k])
            m, (mu, lam, mobility) = skin.material, (by * rate[:, k] for rate in rates)
            solid = Material(m.mu + mu, m.lam + lam, m.mobility + mobility, m.storage)
            return skin.residual(x + by * along[:, k], h, old, h, (solid, ()))

        up, down = at(1e-5), at(-1e-5)
        for mine, high, low in (
            (found.residual[:n, k], up.residual[:n], down.residual[:n]),
            (found.residual[n:, k], up.residual[n:], down.residual[n:]),
            (found.volume[..., k], up.volume, down.volume),
            (found.pressure[..., k], up.pressure, down.pressure),
        ):
            expected = (high - low) / 2e-5
            np.testing.assert_allclose(mine, expected, atol=1e-6 * np.abs(expected).max())


def test_a_run_carries_its_derivatives():
    run = simulate(ModelSpec(), MOTION, THETA, gradients=True)
    assert run.gradient_names == DIFFERENTIATED
    assert run.gradient_n.shape == (len(run.time_s), 4)
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
