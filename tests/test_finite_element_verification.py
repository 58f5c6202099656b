"""The finite-element model verified: manufactured solutions, balances, objectivity, another program.

docs/verification.md lists what each test measured.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import skfem
from scipy.spatial.transform import Rotation
from toys.driven_model import DrivenModel, Point, TightModel, block, by_layer, corner_points, driven, march
from toys.manufactured_solutions import Manufactured, errors, exact_state, strong_load, weak_load

from bayeskin.finite_element.lagrangian import SOLVER_TOLERANCE, LagrangianModel
from bayeskin.finite_element.mesh import brick_mesh
from bayeskin.finite_element.problem import build_problem, material
from bayeskin.finite_element.space import taylor_hood
from bayeskin.finite_element.stepping import integrate
from bayeskin.types import PadMotion

EDGE_M = 10e-3
UPPER = Point(mu=5e4, lam=2e5, mobility=1e-9, storage=2e-6)
LOWER = Point(mu=1e4, lam=1.5e4, mobility=6e-9, storage=8e-6)
KINDS = ["bricks", "tetrahedra"]


def slower(layer: Point, factor: float) -> Point:
    return Point(layer.mu, layer.lam, factor * layer.mobility, layer.storage)


def wave() -> Manufactured:
    """Plane waves with strains up to 0.2, J from 0.85 to 1.15, pressures of 1.5 kPa, growing by 10 %."""
    amplitude = 1.4e-3 * np.array([[0.9, 0.5, -0.4], [-0.5, 0.8, 0.6], [0.4, -0.6, 0.9]])
    number = 70.0 * np.array([[1.3, 0.6, -0.5], [0.4, 1.4, 0.8], [-0.6, 0.7, 1.5]])
    shift = np.array([[0.3], [1.0], [-0.6]])
    number_p, shift_p = 70.0 * np.array([[1.2, -0.7, 0.9], [0.5, 1.1, -1.0]]), np.array([[0.4], [-0.9]])

    def gradient(points, t):
        return (1 + 0.2 * t) * np.einsum("ki,kj,kn->nij", amplitude, number, np.cos(number @ points + shift))

    def pressure_gradient(points, t):
        return 1.5e3 * (1 - 0.1 * t) * (number_p.T @ np.cos(number_p @ points + shift_p)).T

    return Manufactured(
        lambda points, t: (1 + 0.2 * t) * amplitude.T @ np.sin(number @ points + shift),
        gradient,
        lambda points, t: 1.5e3 * (1 - 0.1 * t) * np.sin(number_p @ points + shift_p).sum(0),
        pressure_gradient,
    )


def wave_errors(kind: str, cells: int, mobility_factor: float) -> dict[str, float]:
    """Relative errors on a rolled block of two layers: u prescribed on three faces, p on one."""
    line = np.linspace(0, EDGE_M, cells + 1)
    flat = taylor_hood(block(kind, (line, line, line), EDGE_M / 3, radius=None))
    space = taylor_hood(block(kind, (line, line, line), EDGE_M / 3, radius=48e-3))
    x, _, z = flat.points_u
    held = np.flatnonzero(np.isclose(z, 0) | np.isclose(x, 0) | np.isclose(x, EDGE_M))
    drained = 3 * space.n_nodes + np.flatnonzero(np.isclose(corner_points(flat)[1], 0))
    fixed = np.concatenate([(3 * held[:, None] + np.arange(3)).ravel(), drained])
    exact, layers = wave(), (slower(UPPER, mobility_factor), slower(LOWER, mobility_factor))
    model = driven(
        space.mesh,
        by_layer(space.mesh.cutis, *layers),
        fixed,
        lambda t: exact.unknowns(space, t)[fixed],
        strong_load(exact, space, *layers),
        space=space,
    )
    *_, last = march(model, exact_state(exact, space, 0.0), np.array([0.25, 0.5]))
    return errors(exact, space, last.state.x, 0.5)


def wave_rates(kind: str, cells: tuple[int, int], mobility_factor: float) -> dict[str, float]:
    coarse, fine = (wave_errors(kind, n, mobility_factor) for n in cells)
    assert coarse["grad u"] < 0.01
    assert coarse["p"] < 0.1
    return {name: np.log(coarse[name] / fine[name]) / np.log(cells[1] / cells[0]) for name in coarse}


CELLS = [(3, 6), pytest.param((6, 9), marks=pytest.mark.slow)]


@pytest.mark.parametrize("cells", CELLS)
@pytest.mark.parametrize("kind", KINDS)
def test_undrained_fields_converge_at_the_rates_of_taylor_and_hood(kind, cells):
    """Cubic u, quadratic gradient and pressure: little fluid moves in the time, as in the skin's cutis."""
    rate = wave_rates(kind, cells, 1e-4)
    assert 2.9 < rate["u"] < 3.2
    assert 1.95 < rate["grad u"] < 2.1
    assert 2.0 < rate["p"] < 2.35


@pytest.mark.parametrize("cells", CELLS)
@pytest.mark.parametrize("kind", KINDS)
def test_draining_fields_converge_at_the_rates_of_taylor_and_hood(kind, cells):
    """Quadratic gradient and pressure. The pressure is now Darcy's, linear elements gain nothing in a
    negative norm, and as a load it moves u by O(h^2): between 2 (far) and 3 (near) is all that u can have.
    """
    rate = wave_rates(kind, cells, 1.0)
    assert 2.0 < rate["u"] < 3.1
    assert 1.95 < rate["grad u"] < 2.1
    assert 1.85 < rate["p"] < 2.1


def test_time_integration_of_large_strain_is_of_second_order_in_both_fields():
    """Quadratic u and linear p lie in the finite-element space: what is left is the scheme's own error."""
    line = np.linspace(0, EDGE_M, 3)
    space = taylor_hood(block("bricks", (line, line, line), EDGE_M / 2, radius=None))
    bend = np.random.default_rng(2).uniform(-1, 1, (3, 3, 3))
    bend = 6.0 * (bend + bend.transpose(0, 2, 1))
    shear = np.array([[0.1, 0.08, -0.04], [0.03, -0.08, 0.05], [0.0, -0.04, 0.07]])
    slope = np.array([[9e4, -5e4, 1.2e5]])

    def grown(t):
        return np.sin(2.5 * t)

    def eased(t):
        return np.cos(3.0 * t)

    exact = Manufactured(
        lambda points, t: grown(t) * (shear @ points + np.einsum("ijk,jn,kn->in", bend, points, points)),
        lambda points, t: grown(t) * (shear + 2 * np.einsum("ijk,kn->nij", bend, points)),
        lambda points, t: eased(t) * (slope @ points)[0],
        lambda points, t: eased(t) * np.repeat(slope, points.shape[1], axis=0),
    )
    x, y, _ = space.points_u
    held = np.flatnonzero(np.isclose(x, 0) | np.isclose(y, EDGE_M))
    drained = 3 * space.n_nodes + np.flatnonzero(np.isclose(corner_points(space)[2], EDGE_M))
    fixed = np.concatenate([(3 * held[:, None] + np.arange(3)).ravel(), drained])
    layers = slower(UPPER, 0.01), slower(LOWER, 0.01)
    model = driven(
        space.mesh,
        by_layer(space.mesh.cutis, *layers),
        fixed,
        lambda t: exact.unknowns(space, t)[fixed],
        weak_load(exact, space, *layers),
        space=space,
    )
    computed = []
    for steps in (16, 32, 64):
        *_, last = march(model, exact_state(exact, space, 0.0), np.linspace(0, 1, steps + 1)[1:])
        computed.append(errors(exact, space, last.state.x, 1.0))
    for name in ("u", "p"):
        rates = np.log2([a[name] / b[name] for a, b in pairwise(computed)])
        assert np.all((rates > 1.9) & (rates < 2.25)), (name, rates, computed)
    assert computed[-1]["u"] < 1e-4


def prescribed_block(kind: str, turn) -> tuple[DrivenModel, dict[str, np.ndarray]]:
    """Two layers, pulled, sheared and twisted by 30 % at one end; turn(t) is laid on every end's motion."""
    line = np.linspace(0, EDGE_M, 3)
    space = taylor_hood(block(kind, (line, line, line), EDGE_M / 2, radius=None))
    ends = np.flatnonzero(np.isclose(space.points_u[0], 0) | np.isclose(space.points_u[0], EDGE_M))
    drained = 3 * space.n_nodes + np.flatnonzero(np.isclose(corner_points(space)[2], EDGE_M))
    fixed = np.concatenate([(3 * ends[:, None] + np.arange(3)).ravel(), drained])
    points = space.points_u[:, ends]

    def values(t):
        stretch = np.array([[1 + 0.3 * t, 0, 0], [0.2 * t, 1, 0], [0, 0, 1]])
        twist = Rotation.from_rotvec([0.3 * t, 0, 0]).as_matrix()
        moved = twist @ stretch @ points
        return np.concatenate([(turn(t) @ moved - points).T.ravel(), np.zeros(len(drained))])

    layers = Point(5e4, 2e5, 1e-9, 1e-12), Point(1e4, 1.5e4, 6e-9, 1e-12)
    model = driven(space.mesh, by_layer(space.mesh.cutis, *layers), fixed, values, space=space)
    return model, {"ends": ends, "points": points}


@pytest.mark.parametrize("kind", KINDS)
def test_whole_steps_turn_with_the_body(kind):
    """With a rotation that grows to 60 degrees, forces turn with it; pressure, J and energy know nothing."""
    axis = np.radians(60) * np.array([2.0, -1.0, 2.0]) / 3.0
    plain, _ = prescribed_block(kind, lambda t: np.eye(3))
    turned, _ = prescribed_block(kind, lambda t: Rotation.from_rotvec(t * axis).as_matrix())
    times, n = np.linspace(0, 1, 9)[1:], 3 * plain.problem.space.n_nodes
    runs = []
    for model in (plain, turned):
        forces = []
        for step in march(model, model.initial_state(0.0), times):
            forces.append(model.full_residual[:n].reshape(-1, 3))
            last = step.state
        runs.append((forces, last))
    (before, state), (after, state_turned) = runs
    for t, force, force_turned in zip(times, before, after, strict=True):
        expected = force @ Rotation.from_rotvec(t * axis).as_matrix().T
        assert np.abs(force_turned - expected).max() < 3e-7 * np.abs(force).max()
    assert np.abs(state.x[n:]).max() > 100.0
    np.testing.assert_allclose(state_turned.x[n:], state.x[n:], atol=3e-7 * np.abs(state.x[n:]).max())
    np.testing.assert_allclose(state_turned.volume, state.volume, rtol=1e-7)


@pytest.mark.parametrize("kind", KINDS)
def test_reactions_of_a_held_body_have_neither_sum_nor_moment(kind):
    """Cauchy's stress is symmetric: about the places where they act, reactions make no moment."""
    model, held = prescribed_block(kind, lambda t: np.eye(3))
    ends, n = held["ends"], 3 * model.problem.space.n_nodes
    *_, last = march(model, model.initial_state(0.0), np.linspace(0, 1, 5)[1:])
    force = model.full_residual[:n].reshape(-1, 3)[ends]
    where = held["points"].T + last.state.x[:n].reshape(-1, 3)[ends]
    size = np.abs(force).sum()
    assert np.abs(force.sum(axis=0)).max() < 1e-9 * size
    assert np.abs(np.cross(where, force).sum(axis=0)).max() < 1e-9 * size * EDGE_M


@pytest.fixture(scope="module", params=[LagrangianModel, TightModel], ids=["as run", "tightly solved"])
def skin_run(request):
    """One cycle on the two-layer skin: the model, the states, residuals, tolerance of the solver."""
    problem = build_problem(brick_mesh(0))
    theta = {"E_c": 6e4, "E_s": 1.5e4, "k_c": 2e-13, "k_s": 8e-12}
    motion = PadMotion(np.array([0.0, 10.0, 25.0, 35.0, 45.0]), 1e-3 * np.array([0.0, 8.0, 8.0, 0.0, 0.0]))
    model = request.param(problem, material(theta, problem.mesh.cutis), motion)
    states, residuals = [], []

    def keep(step):
        states.append(step.state)
        residuals.append(model.full_residual)

    assert integrate(model, 300.0, 1e-2, keep) == ""
    model.solver.release()
    return model, states, residuals, SOLVER_TOLERANCE / getattr(model, "precision", 1.0)


def test_no_fluid_enters_or_leaves_the_skin(skin_run):
    """The integral of each stage's content, and over the cycle the whole content, is what it was.

    To the solver's tolerance, and 1e-9 for S p dJ, which a storage written as J S dp does not count.
    """
    model, states, residuals, tolerance = skin_run
    space, storage = model.problem.space, model.material.storage[:, None]
    whole = space.weight.sum()
    for residual in residuals:
        assert abs(residual[3 * space.n_nodes :].sum()) < 1e-4 * tolerance * whole
    assert max(np.abs(state.volume - 1).max() for state in states) > 0.02  # much of it moved
    for state in states:
        content = state.volume - 1 + state.volume * storage * (state.pressure - 300.0)
        assert abs((space.weight * content).sum()) < (1e-3 * tolerance + 1e-9) * whole


def test_the_reactions_on_the_skin_are_in_equilibrium(skin_run):
    """Along x: pad, guard and the plane x = 0; no other support acts that way."""
    model, _, residuals, tolerance = skin_run
    problem, n = model.problem, 3 * model.problem.space.n_nodes
    supports = np.union1d(problem.pads, problem.space.facet_nodes("symmetry_x"))
    peak = max(abs(residual[problem.measured_x].sum()) for residual in residuals)
    for residual in residuals:
        assert abs(residual[0:n:3][supports].sum()) < 5 * tolerance * peak


def test_the_drained_limit_agrees_with_felupe():
    """An independent finite-element program: same bricks of 27 nodes, law and quadrature, drained."""
    felupe = pytest.importorskip("felupe")
    line = np.linspace(0, EDGE_M, 4)
    space = taylor_hood(block("bricks", (line, line, line), EDGE_M / 3, radius=20e-3))
    points, n = space.points_u, space.n_nodes
    bottom, end = (np.flatnonzero(np.isclose(points[0], at)) for at in (0.0, EDGE_M))
    held = np.union1d(bottom, end)
    fixed = np.concatenate([(3 * held[:, None] + np.arange(3)).ravel(), np.arange(3 * n, space.dofs)])
    gradient = np.array([[0.3, 0.0, 0.0], [0.2, -0.05, 0.0], [-0.1, 0.0, 0.08]])

    def values(t):
        x = np.zeros(space.dofs)
        x[: 3 * n] = t * (gradient @ points).T.ravel()
        return x[fixed]

    model = driven(space.mesh, by_layer(space.mesh.cutis, UPPER, LOWER), fixed, values, space=space)
    *_, last = march(model, model.initial_state(0.0), np.array([0.5, 1.0]))
    computed = last.state.x[: 3 * n].reshape(-1, 3)

    ours = 1 - 2 * skfem.ElementHex2().doflocs  # inverted: scikit-fem's bricks are left-handed
    theirs = felupe.element.TriQuadraticHexahedron().points
    order = [int(np.argmin(np.abs(ours - place).sum(axis=1))) for place in theirs]
    mesh = felupe.Mesh(points.T, space.nodes_u[:, order], "hexahedron27")
    field = felupe.FieldContainer([felupe.Field(felupe.RegionTriQuadraticHexahedron(mesh), dim=3)])
    law = felupe.NeoHookeCompressible(model.material.mu[None], model.material.lam[None])
    body = felupe.SolidBody(law, field)
    prescribed = (gradient @ points).T[held].ravel()
    free = np.setdiff1d(np.arange(3 * n), fixed)
    for share in (0.5, 1.0):
        felupe.newtonraphson(
            x0=field,
            items=[body],
            dof0=fixed[: 3 * len(held)],
            dof1=free,
            ext0=share * prescribed,
            tol=1e-10,
            verbose=False,
        )
    reference = field[0].values
    force = body.assemble.vector(field).toarray().reshape(-1, 3)[end].sum(axis=0)
    reaction = model.full_residual[: 3 * n].reshape(-1, 3)[end].sum(axis=0)
    assert np.abs(computed - reference).max() < 1e-7 * np.abs(reference).max()
    np.testing.assert_allclose(reaction, force, atol=1e-7 * np.abs(force).max())
