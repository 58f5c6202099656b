"""The finite-element model verified: manufactured solutions, consolidation, balances, another program.

docs/verification.md lists what each test measured.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import skfem
from consolidation import Mandel, compression_stress, cryer_centre
from driven import (
    DrivenModel,
    Manufactured,
    Point,
    TightModel,
    block,
    by_layer,
    corner_points,
    driven,
    errors,
    exact_state,
    march,
    strong_load,
    weak_load,
)
from scipy.spatial.transform import Rotation

from bayeskin.model.lagrangian import SOLVER_TOLERANCE, LagrangianModel, integrate
from bayeskin.model.mesh import SkinMesh, brick_mesh
from bayeskin.model.problem import build_problem, material
from bayeskin.model.space import taylor_hood
from bayeskin.types import PadMotion

EDGE_M = 10e-3
UPPER = Point(mu=5e4, lam=2e5, mobility=1e-9, storage=2e-6)
LOWER = Point(mu=1e4, lam=1.5e4, mobility=6e-9, storage=8e-6)
KINDS = ["bricks", "tetrahedra"]


def elastic(nu: float, mobility: float, shear: float = 1e4, storage: float = 1e-13) -> Point:
    return Point(shear, 2 * shear * nu / (1 - 2 * nu), mobility, storage)


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
    found = []
    for steps in (16, 32, 64):
        *_, last = march(model, exact_state(exact, space, 0.0), np.linspace(0, 1, steps + 1)[1:])
        found.append(errors(exact, space, last.state.x, 1.0))
    for name in ("u", "p"):
        rates = np.log2([a[name] / b[name] for a, b in pairwise(found)])
        assert np.all((rates > 1.9) & (rates < 2.25)), (name, rates, found)
    assert found[-1]["u"] < 1e-4


def test_the_pressure_in_mandels_slab_rises_before_it_falls():
    """Pressure and constant plate force against the series, for shortening as in the series."""
    layer, width = elastic(nu=0.2, mobility=1e-9), EDGE_M
    slab = Mandel(layer.mu, 0.2, stress=2e-4 * layer.mu)
    modulus = layer.lam + 2 * layer.mu
    lines = (np.array([0, width]), width * np.sin(np.linspace(0, np.pi / 2, 25)), np.array([0, width]))
    space = taylor_hood(block("bricks", lines, 1.0, radius=None))
    points, n = space.points_u, space.n_nodes
    bottom, plate = (np.flatnonzero(np.isclose(points[0], at)) for at in (0.0, width))
    middle = np.flatnonzero(np.isclose(points[1], 0.0))
    corners = corner_points(space)[1] / width
    drained = 3 * n + np.flatnonzero(np.isclose(corners, 1.0))
    fixed = np.unique(np.concatenate([3 * bottom, 3 * plate, 3 * middle + 1, 3 * np.arange(n) + 2, drained]))
    seconds = width**2 / (layer.mobility * modulus)

    def values(t):
        x = np.zeros(space.dofs)
        x[3 * plate] = -width * slab.shortening(t / seconds)
        return x[fixed]

    material = by_layer(space.mesh.cutis, layer, layer)
    model = driven(space.mesh, material, fixed, values, pad=plate, space=space)
    x = np.zeros(space.dofs)  # undrained: stretched sideways as it is shortened
    x[0 : 3 * n : 3] = -slab.stress / (4 * layer.mu) * points[0]
    x[1 : 3 * n : 3] = slab.stress / (4 * layer.mu) * points[1]
    x[3 * n :] = initial = slab.stress / 2
    centre = []
    taus = np.concatenate([np.geomspace(1e-4, 0.02, 24), np.geomspace(0.02, 1.0, 33)[1:]])
    for tau, step in zip(taus, march(model, model.state_at(x), seconds * taus), strict=True):
        pressure = step.state.x[3 * n :] / initial
        centre.append(pressure[np.isclose(corners, 0)].mean())
        if tau > 0.01:
            expected = slab.pressure(corners, tau) / initial
            np.testing.assert_allclose(pressure, expected, atol=5e-3)
            assert step.force_n / 2 == pytest.approx(-slab.stress * width**2, rel=3e-3)
    highest = int(np.argmax(centre))
    assert 0.04 < taus[highest] < 0.1
    assert centre[highest] == pytest.approx(1.107, abs=2e-3)


def octant(cells: int) -> SkinMesh:
    """Octant of a ball of radius EDGE_M: a cubic core, and three shells of bricks curved on the surface."""
    core = 0.45
    flat = skfem.MeshHex.init_tensor(*3 * [np.linspace(0, core, cells + 1)])
    line = np.sin(np.linspace(0, np.pi / 2, cells + 1))
    across = skfem.MeshHex.init_tensor(line, *2 * [np.linspace(0, core, cells + 1)])
    inner = np.stack([np.full(across.nvertices, core), across.p[1], across.p[2]])
    shell = inner + across.p[0] * (inner / np.linalg.norm(inner, axis=0) - inner)
    for turn in range(3):
        flat = flat + skfem.MeshHex(np.roll(shell, turn, axis=0), across.t)
    curved = skfem.MeshHex2.from_mesh(flat)
    outside = np.linalg.norm(flat.p, axis=0) > 1 - 1e-6
    facets = np.flatnonzero(outside[flat.facets].all(axis=0))
    on_surface = skfem.CellBasis(curved, skfem.ElementHex2()).get_dofs(facets).all()
    points = curved.doflocs.copy()
    points[:, on_surface] /= np.linalg.norm(points[:, on_surface], axis=0)
    mesh = skfem.MeshHex2(EDGE_M * points, curved.t)
    return SkinMesh(mesh, {"surface": facets}, np.zeros(mesh.nelements, bool), "octant")


CRYER = [(4, 0.03), pytest.param(6, 0.014, marks=pytest.mark.slow)]


@pytest.mark.parametrize(("cells", "bound"), CRYER)
def test_the_pressure_at_the_centre_of_cryers_sphere_rises_before_it_falls(cells, bound):
    """To 3 % of the surface's pressure; half as much on bricks of two thirds the size."""
    layer = elastic(nu=0.2, mobility=1e-9)
    mesh = octant(cells)
    space = taylor_hood(mesh)
    n, corners = space.n_nodes, corner_points(space)
    symmetry = [3 * np.flatnonzero(np.isclose(space.points_u[i], 0.0)) + i for i in range(3)]
    surface = 3 * n + np.flatnonzero(np.isclose(np.linalg.norm(corners, axis=0), EDGE_M, rtol=1e-6))
    fixed = np.unique(np.concatenate([*symmetry, surface]))
    pressure = 1e-4 * layer.mu
    facets = skfem.FacetBasis(mesh.geometry, skfem.ElementHex2(), facets=mesh.facets["surface"], intorder=6)
    area = sum(facets.dx.ravel())
    assert area == pytest.approx(np.pi / 2 * EDGE_M**2, rel=1e-3)
    load = np.zeros(space.dofs)
    for a, shape in enumerate(facets.basis):
        push = -pressure * np.einsum("eq,ieq,eq->ei", shape[0], facets.normals, facets.dx)
        np.add.at(load[: 3 * n].reshape(-1, 3), facets.element_dofs[a], push)
    model = driven(
        mesh,
        by_layer(mesh.cutis, layer, layer),
        fixed,
        lambda t: np.zeros(len(fixed)),
        lambda t, h: load,
        space=space,
    )
    x = np.zeros(space.dofs)
    x[3 * n :] = pressure
    seconds = EDGE_M**2 / (layer.mobility * (layer.lam + 2 * layer.mu))
    taus = np.concatenate([np.geomspace(1e-4, 0.01, 8), np.geomspace(0.01, 0.4, 30)[1:]])
    centre = int(np.argmin(np.linalg.norm(corners, axis=0)))
    found = [s.state.x[3 * n + centre] / pressure for s in march(model, model.state_at(x), seconds * taus)]
    expected = [cryer_centre(0.2, tau) for tau in taus]
    assert max(found) == pytest.approx(1.364, abs=bound)
    np.testing.assert_allclose(found, expected, atol=bound)


@pytest.mark.parametrize("kind", KINDS)
def test_a_confined_column_compressed_by_a_quarter_follows_the_one_dimensional_equation(kind):
    """Ramp of 10 s and hold, two layers, drained at the moving end."""
    upper = Point(2e4, 1.2e5, 4e-11, 1e-13)
    lower = Point(1e4, 1.5e4, 1e-10, 1e-13)
    ramp, depth = 10.0, -0.25 * EDGE_M
    times = np.array([2.0, 4.0, 6.0, 8.0, 10.0, 10.5, 11.0, 12.0, 14.0, 18.0, 25.0, 40.0])
    reference = compression_stress(
        EDGE_M,
        tuple((0.5, p.mu, p.lam, p.mobility) for p in (lower, upper)),
        lambda t: depth * min(t / ramp, 1.0),
        lambda t: depth / ramp if t <= ramp else 0.0,
        times,
    )
    half = 0.5 * EDGE_M
    tall = np.concatenate([np.linspace(0, half, 7), half + half * np.sin(np.linspace(0, np.pi / 2, 11))[1:]])
    wide = np.array([0, 1e-3])
    space = taylor_hood(block(kind, (wide, wide, tall), half, radius=None))
    z, n = space.points_u[2], space.n_nodes
    across = 3 * np.arange(n)
    bottom, top = (np.flatnonzero(np.isclose(z, at)) for at in (0.0, EDGE_M))
    drained = 3 * n + np.flatnonzero(np.isclose(corner_points(space)[2], EDGE_M))
    fixed = np.unique(np.concatenate([across, across + 1, 3 * bottom + 2, 3 * top + 2, drained]))

    def values(t):
        x = np.zeros(space.dofs)
        x[3 * top + 2] = depth * min(t / ramp, 1.0)
        return x[fixed]

    model = driven(space.mesh, by_layer(space.mesh.cutis, upper, lower), fixed, values, space=space)
    early = np.geomspace(0.02, 1.0, 24)  # after each corner
    fine = np.unique(
        np.concatenate(
            [early, np.arange(11, 101) / 10, ramp + early, np.arange(111, 181) / 10, np.arange(19, 41), times]
        )
    )
    found = {}
    for step in march(model, model.initial_state(0.0), fine, corner_s=ramp):
        found[round(step.state.time_s, 6)] = model.full_residual[3 * top + 2].sum() / 1e-6
    stress = np.array([found[round(t, 6)] for t in times])
    assert reference.min() < 1.2 * reference[-1] < 0  # the fluid carries a good part of the peak
    np.testing.assert_allclose(stress, reference, rtol=2e-3)


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
        assert np.abs(force_turned - expected).max() < 1e-7 * np.abs(force).max()
    assert np.abs(state.x[n:]).max() > 100.0
    np.testing.assert_allclose(state_turned.x[n:], state.x[n:], atol=1e-7 * np.abs(state.x[n:]).max())
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
    """One cycle on the two-layer skin: the model, the states, the residual of each, the solver's tolerance."""
    problem = build_problem(brick_mesh(1))
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
    """The integral of each stage's content, and over the cycle the whole content, is what it was."""
    model, states, residuals, tolerance = skin_run
    space, storage = model.problem.space, model.material.storage[:, None]
    whole = space.weight.sum()
    for residual in residuals:
        assert abs(residual[3 * space.n_nodes :].sum()) < 1e-4 * tolerance * whole
    assert max(np.abs(state.volume - 1).max() for state in states) > 0.02  # much of it moved
    for state in states:
        content = state.volume - 1 + state.volume * storage * (state.pressure - 300.0)
        assert abs((space.weight * content).sum()) < 1e-3 * tolerance * whole


def test_the_reactions_on_the_skin_are_in_equilibrium(skin_run):
    """Along x: pad, guard and the plane x = 0; no other support acts that way."""
    model, _, residuals, tolerance = skin_run
    problem, n = model.problem, 3 * model.problem.space.n_nodes
    supports = np.union1d(problem.pads, problem.space.facet_nodes("symmetry_x"))
    peak = max(abs(residual[problem.pad_x].sum()) for residual in residuals)
    for residual in residuals:
        assert abs(residual[0:n:3][supports].sum()) < tolerance * peak


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
    found = last.state.x[: 3 * n].reshape(-1, 3)

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
    assert np.abs(found - reference).max() < 1e-7 * np.abs(reference).max()
    np.testing.assert_allclose(reaction, force, atol=1e-7 * np.abs(force).max())
