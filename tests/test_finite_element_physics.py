"""The full model against what is known exactly: rigid motion, patches, stretch, consolidation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from toys.bar_models import LAM, MU, YOUNG, bar, drained_bar, model
from toys.driven_model import corner_points

from bayeskin.finite_element.lagrangian import LagrangianModel
from bayeskin.finite_element.simulate import ModelSpec, simulate
from bayeskin.finite_element.space import taylor_hood
from bayeskin.finite_element.stages import State
from bayeskin.finite_element.stepping import GAMMA, advance
from bayeskin.types import PadMotion


def still_state(skin: LagrangianModel, x: np.ndarray) -> State:
    """The state at x with a history that is x itself, so that no fluid is asked to move."""
    blank = skin.initial_state(0.0)
    _, volume, pressure, _ = skin.residual(x, 1.0, blank)
    return State(0.0, x, volume, pressure)


@pytest.mark.parametrize("kind", ["bricks", "tetrahedra"])
def test_a_rigid_motion_makes_no_force_and_moves_no_fluid(kind):
    mesh = bar(kind, distort=0.1)
    skin = model(mesh, np.arange(3), np.arange(1))
    points, n = skin.problem.space.points_u, skin.problem.space.n_nodes
    turned = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix() @ points + np.array([[0.3], [2.0], [-1.0]])
    x = np.zeros(skin.problem.space.dofs)
    x[: 3 * n] = (turned - points).T.ravel()
    residual, volume, *_ = skin.residual(x, 1.0, skin.initial_state(0.0))
    assert np.abs(volume - 1).max() < 1e-12
    assert np.abs(residual).max() < 1e-11 * YOUNG


@pytest.mark.parametrize("kind", ["bricks", "tetrahedra"])
def test_forces_turn_with_the_body(kind):
    mesh = bar(kind, distort=0.1)
    skin = model(mesh, np.arange(3), np.arange(1))
    space, rng = skin.problem.space, np.random.default_rng(1)
    n, q = 3 * space.n_nodes, Rotation.from_rotvec([0.2, 0.5, -0.9]).as_matrix()
    x = np.concatenate([0.02 * rng.standard_normal(n), 100.0 * rng.standard_normal(space.n_corners)])
    turned = x.copy()
    here = space.points_u.T + x[:n].reshape(-1, 3)
    turned[:n] = (here @ q.T - space.points_u.T).ravel()
    before, *_ = skin.residual(x, 1.0, skin.initial_state(0.0))
    after, *_ = skin.residual(turned, 1.0, skin.initial_state(0.0))
    np.testing.assert_allclose(after[:n].reshape(-1, 3), before[:n].reshape(-1, 3) @ q.T, atol=1e-9 * YOUNG)
    np.testing.assert_allclose(after[n:], before[n:], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("kind", ["bricks", "tetrahedra"])
def test_patch_a_linear_field_on_a_distorted_mesh_is_in_equilibrium(kind):
    mesh = bar(kind, distort=0.12)
    skin = model(mesh, np.arange(3), np.arange(1))
    space = skin.problem.space
    gradient = np.array([[0.25, 0.1, -0.05], [0.02, -0.1, 0.04], [0.0, 0.06, -0.08]])
    x = np.zeros(space.dofs)
    x[: 3 * space.n_nodes] = (gradient @ space.points_u).T.ravel()
    x[3 * space.n_nodes :] = 500.0
    residual, volume, *_ = skin.residual(x, 1.0, still_state(skin, x))
    outside = [np.isclose(c, end) for c in space.points_u for end in (c.min(), c.max())]
    inner = ~np.any(outside, axis=0)
    assert inner.sum() > 20
    assert np.abs(residual[: 3 * space.n_nodes].reshape(-1, 3)[inner]).max() < 1e-11 * YOUNG
    assert np.abs(residual[3 * space.n_nodes :]).max() < 1e-10
    np.testing.assert_allclose(volume, np.linalg.det(np.eye(3) + gradient), rtol=1e-12)


@pytest.mark.parametrize("kind", ["bricks", "tetrahedra"])
@pytest.mark.parametrize("stretch", [0.7, 1.1, 1.6])
def test_drained_uniaxial_stretch_follows_the_closed_form(kind, stretch):
    pull = PadMotion(np.array([0.0, 1.0]), np.array([0.0, 2 * (stretch - 1)]))
    skin = replace(drained_bar(kind), protocol=pull)
    past = [skin.initial_state(0.0)]
    for _ in range(4):
        step = advance(skin, past, 0.25)
        past.append(step.state)

    def side(across: float) -> float:  # lateral first Piola-Kirchhoff stress
        j = stretch * across**2
        return MU * (across - 1 / across) + LAM * np.log(j) / across

    across = brentq(side, 0.3, 2.0)
    j = stretch * across**2
    expected = MU * (stretch - 1 / stretch) + LAM * np.log(j) / stretch
    assert step.force_n / 2.0 == pytest.approx(expected, rel=1e-5)  # the problem doubles for symmetry


@pytest.mark.parametrize("kind", ["bricks", "tetrahedra"])
def test_tangent_is_the_derivative_of_the_residual(kind):
    mesh = bar(kind, distort=0.1)
    skin = model(mesh, np.arange(3), np.arange(1), permeability=1e-8)
    space, rng = skin.problem.space, np.random.default_rng(5)
    n = 3 * space.n_nodes
    x = np.concatenate([0.02 * rng.standard_normal(n), 1e3 * rng.standard_normal(space.n_corners)])
    step = np.concatenate([0.02 * rng.standard_normal(n), 1e3 * rng.standard_normal(space.n_corners)])
    equations = skin.equations(0.7, skin.initial_state(300.0))
    free, fixed = skin.problem.pattern.free, skin.problem.pattern.fixed
    free_free, free_fixed = equations.tangent(x)
    exact = free_free @ step[free] + free_fixed @ step[fixed]
    h = 1e-4
    difference = (equations.residual(x + h * step) - equations.residual(x - h * step)) / (2 * h)
    for rows in (free < n, free >= n):
        assert np.abs(difference - exact)[rows].max() < 1e-6 * np.abs(exact[rows]).max()


@pytest.mark.parametrize("kind", ["bricks", "tetrahedra"])
def test_consolidation_follows_terzaghis_series(kind):
    """A laterally confined column, compressed by q and drained, is relieved of q at t = 0.

    The pressure falls to -q at once and returns to 0 through the drained end as Terzaghi's series
    (1923): p / -q = sum_k 4 / ((2k+1) pi) sin((2k+1) pi s / 2) exp(-((2k+1) pi / 2)^2 c t / L^2),
    s the distance from the drained end over L, c = (k / mu_f) (lambda + 2 mu).
    """
    mesh, length, permeability = bar(kind, cells=16, width=0.1), 1.0, 1e-9
    space = taylor_hood(mesh)
    n = space.n_nodes
    closed = np.flatnonzero(np.isclose(space.points_u[0], 0.0))
    across = 3 * np.arange(n)
    corners = corner_points(space)
    drained = 3 * n + np.flatnonzero(np.isclose(corners[0], length))
    fixed = np.unique(np.concatenate([3 * closed, across + 1, across + 2, drained]))
    skin = model(mesh, fixed, np.array([], int), permeability)
    modulus, strain = LAM + 2 * MU, 1e-4
    load = modulus * strain
    x = np.zeros(space.dofs)
    x[0 : 3 * n : 3] = -strain * space.points_u[0]
    state = still_state(skin, x)
    coefficient = permeability / 5e-3 * modulus / length**2
    past = [State(0.0, x, state.volume, state.pressure)]
    for end in np.concatenate([np.geomspace(1e-4, 0.02, 12), np.linspace(0.02, 0.6, 40)[1:]]) / coefficient:
        past = [*past, advance(skin, past, end - past[-1].time_s).state][-3:]
    time_factor = coefficient * past[-1].time_s
    s = 1.0 - corners[0] / length
    odd = 2 * np.arange(200)[:, None] + 1
    series = (
        4 / (odd * np.pi) * np.sin(odd * np.pi * s / 2) * np.exp(-((odd * np.pi / 2) ** 2) * time_factor)
    ).sum(0)
    assert series.max() > 0.2
    np.testing.assert_allclose(past[-1].x[3 * n :] / -load, series, atol=2e-3)


def test_time_integration_is_of_second_order():
    """Consolidation rebound as above: halving the step divides the error by four."""
    mesh = bar("bricks", cells=4)
    space = taylor_hood(mesh)
    n = space.n_nodes
    closed = np.flatnonzero(np.isclose(space.points_u[0], 0.0))
    end = np.flatnonzero(np.isclose(space.points_u[0], 1.0))
    drained = 3 * n + np.flatnonzero(np.isclose(corner_points(space)[0], 1.0))
    fixed = np.unique(
        np.concatenate([3 * closed, 3 * np.arange(n) + 1, 3 * np.arange(n) + 2, 3 * end, drained])
    )
    permeability = 1e-9
    duration = 0.3 / (permeability / 5e-3 * (LAM + 2 * MU))

    def pressure(steps: int) -> np.ndarray:
        push = PadMotion(np.array([0.0, duration]), np.array([0.0, -0.2]))
        skin = replace(model(mesh, fixed, end, permeability), protocol=push)
        past = [skin.initial_state(0.0)]
        for _ in range(steps):
            past = [*past, advance(skin, past, duration / steps).state][-3:]
        return past[-1].x[3 * n :]

    reference = pressure(128)
    errors = [np.abs(pressure(steps) - reference).max() for steps in (8, 16, 32)]
    rates = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert np.all(rates > 1.9), rates
    assert pytest.approx(1 - 1 / np.sqrt(2)) == GAMMA


def test_forces_scale_with_stresses():
    """Moduli times c, permeabilities over c: c times the force (what `surrogates.similarity` rests on)."""
    motion = PadMotion(np.array([0.0, 5.0, 20.0, 25.0]), np.array([0.0, 5e-3, 5e-3, 0.0]))
    soft = {"E_c": 1e5, "E_s": 1e4, "k_c": 1e-13, "k_s": 1e-12, "p_init": 700.0}
    stiff = {"E_c": 8e5, "E_s": 8e4, "k_c": 1.25e-14, "k_s": 1.25e-13, "p_init": -300.0}
    soft_run, eight = simulate(ModelSpec(), motion, soft), simulate(ModelSpec(), motion, stiff)
    np.testing.assert_allclose(
        eight.at(soft_run.time_s), 8.0 * soft_run.force_n, atol=2e-3 * eight.force_n.max()
    )
