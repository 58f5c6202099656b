"""Tissue mechanisms: off at their neutral values, consistent tangents, and closed forms away from neutral."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq
from toys.bar_models import LAM, MU, drained_bar
from toys.skin_with_mechanisms import (
    IN_SERIES,
    ONE,
    SOLVED,
    STILL,
    STRONG,
    THETA,
    TISSUE,
    skin,
    strong,
    unknowns,
)

from bayeskin.errors import InputError
from bayeskin.finite_element import ModelSpec, simulate
from bayeskin.finite_element.lagrangian import LagrangianModel
from bayeskin.finite_element.mesh import brick_mesh
from bayeskin.finite_element.problem import build_problem
from bayeskin.finite_element.stepping import advance
from bayeskin.finite_element.tissue import TissueLaw
from bayeskin.mechanisms import laws
from bayeskin.mechanisms.bottom_adherence import springs
from bayeskin.mechanisms.fibres import fibres
from bayeskin.mechanisms.fluid_leakage import open_surface
from bayeskin.types import PadMotion

AT_POINTS = sorted(set(SOLVED) - IN_SERIES - {"pre-stretch"})


@pytest.fixture(scope="module")
def problem():
    return build_problem(brick_mesh(1))


def answered(law, f):
    """Stress (3, 3) that a law without memory adds at one point without fluid."""
    stress, none = np.zeros((1, 3, 3)), np.empty((1, 0))
    f, p, gradient = np.ascontiguousarray(f)[None], np.zeros(1), np.zeros((1, 3))
    law.respond(
        0.0, 1.0, law.par, law.data, f, p, gradient, none, none.copy(), stress, np.zeros(1), gradient.copy()
    )
    return stress[0]


@pytest.mark.parametrize("name", SOLVED)
def test_a_neutral_mechanism_leaves_the_residual_as_it_is(problem, name):
    x = unknowns(problem, 1)
    base, off = (skin(problem), skin(problem, name, **SOLVED[name].neutral))
    assert off.laws[0].opening_m == 0.0
    expected, computed = (m.residual(x, 0.7, m.initial_state(300.0))[0] for m in (base, off))
    np.testing.assert_allclose(computed, expected, rtol=0, atol=1e-14 * np.abs(expected).max())


@pytest.mark.parametrize("name", AT_POINTS)
def test_a_mechanism_off_its_neutral_value_changes_the_residual(problem, name):
    x = unknowns(problem, 1)
    base, on = skin(problem), skin(problem, name)
    expected, computed = (m.residual(x, 0.7, m.initial_state(300.0))[0] for m in (base, on))
    n = 3 * problem.space.n_nodes
    changed = [
        np.abs(computed - expected)[rows].max() / np.abs(expected)[rows].max()
        for rows in (slice(n), slice(n, None))
    ]
    assert max(changed) > 1e-4
    assert name in TISSUE[name].group
    assert TISSUE[name].statement(strong(name)).endswith(".")


def test_the_tangent_of_all_together_is_the_derivative_of_the_residual(problem):
    everything = skin(problem, *SOLVED)
    x, step = unknowns(problem, 2), unknowns(problem, 3)
    equations = everything.equations(0.7, everything.initial_state(300.0))
    free, fixed = problem.pattern.free, problem.pattern.fixed
    free_free, free_fixed = equations.tangent(x)
    exact = free_free @ step[free] + free_fixed @ step[fixed]
    h = 1e-4
    difference = (equations.residual(x + h * step) - equations.residual(x - h * step)) / (2 * h)
    n = 3 * problem.space.n_nodes
    for rows in (free < n, free >= n):
        assert np.abs(difference - exact)[rows].max() < 2e-6 * np.abs(exact[rows]).max()


@pytest.mark.parametrize(("kappa", "tension_only"), [(0.0, True), (0.2, True), (1 / 3, True), (0.0, False)])
def test_fibre_stress_is_the_derivative_of_the_energy(kappa, tension_only):
    rng = np.random.default_rng(4)
    k1, k2 = 2e4, 8.0
    for _ in range(20):
        f = np.eye(3) + 0.15 * rng.standard_normal((3, 3))
        a = rng.standard_normal(3)
        a /= np.linalg.norm(a)

        def energy(f, a=a):
            strain = kappa * (np.sum(f**2) - 3) + (1 - 3 * kappa) * (np.sum((f @ a) ** 2) - 1)
            if tension_only and strain <= 0:
                return 0.0
            return k1 / (2 * k2) * np.expm1(k2 * strain**2)

        stress = answered(fibres(ONE, a, np.array([k1]), k2, kappa, tension_only), f)
        h = 1e-6
        for i in range(3):
            for j in range(3):
                d = np.zeros((3, 3))
                d[i, j] = h
                slope = (energy(f + d) - energy(f - d)) / (2 * h)
                assert stress[i, j] == pytest.approx(slope, rel=1e-5, abs=1e-3)


@pytest.mark.parametrize("kind", ["bricks", "tetrahedra"])
@pytest.mark.parametrize(("stretch", "tension_only"), [(1.3, True), (0.8, True), (0.8, False)])
def test_a_drained_bar_with_fibres_along_it_follows_the_closed_form(kind, stretch, tension_only):
    base = drained_bar(kind)
    k1, k2 = 0.5 * MU, 1.2
    law = fibres(base.problem.sites, np.array([1.0, 0.0, 0.0]), k1, k2, 0.0, tension_only)
    motion = PadMotion(np.array([0.0, 1.0]), np.array([0.0, 2 * (stretch - 1)]))
    held = LagrangianModel(base.problem, base.material, motion, (law,))
    past = [held.initial_state(0.0)]
    for _ in range(4):
        step = advance(held, past, 0.25)
        past.append(step.state)

    def side(across):
        return MU * (across - 1 / across) + LAM * np.log(stretch * across**2) / across

    across = brentq(side, 0.3, 2.0)
    expected = MU * (stretch - 1 / stretch) + LAM * np.log(stretch * across**2) / stretch
    strain = stretch**2 - 1
    if strain > 0 or not tension_only:
        expected += 2 * k1 * strain * np.exp(k2 * strain**2) * stretch
    assert step.force_n / 2.0 == pytest.approx(expected, rel=3e-5)


def test_anisotropy_multiplies_youngs_modulus_along_the_lines():
    """At small strain W'' of the fibres is E_c (ratio - 1) along them."""
    ratio, e_c, h = 3.0, 60e3, 1e-5
    law = TISSUE["fibre-anisotropy"].act.bind({"langer_ratio": ratio, "langer_angle": 0.0, "E_c": e_c}, ONE)
    stress = answered(law, np.diag([1 + h, 1.0, 1.0]))
    assert stress[0, 0] / h == pytest.approx((ratio - 1) * e_c, rel=1e-3)


def test_langer_lines_lie_in_the_skins_plane(problem):
    direction = TISSUE["fibre-anisotropy"].act.bind(strong("fibre-anisotropy"), problem.sites).data[:, 1:]
    x, y, z = problem.space.quadrature_points.reshape(3, -1)
    radial = np.stack([0 * x, y, z], axis=-1)
    np.testing.assert_allclose(np.linalg.norm(direction, axis=-1), 1.0)
    np.testing.assert_allclose(np.sum(direction * radial, axis=-1), 0.0, atol=1e-16)


def test_permeability_follows_the_volume(problem):
    """A uniform expansion J = 1.03: the flux of a pressure gradient is exp(0.03 M) of the base's."""
    stretch = 1.03 ** (1 / 3)
    x = np.zeros(problem.space.dofs)
    n = 3 * problem.space.n_nodes
    x[:n] = ((stretch - 1.0) * problem.space.points_u).T.ravel()
    x[n:] = 1e3 * np.random.default_rng(5).standard_normal(problem.space.n_corners)
    held = [skin(problem), skin(problem, "strain-dependent-permeability", M_k=-40.0)]
    still = [
        (m.residual(np.where(np.arange(len(x)) < n, x, 0.0), 1e6, m.initial_state(0.0))[0]) for m in held
    ]
    flow = [(m.residual(x, 1e6, m.initial_state(0.0))[0] - s)[n:] for m, s in zip(held, still, strict=True)]
    storage = (held[0].residual(x, 0.0, held[0].initial_state(0.0))[0] - still[0])[n:]
    np.testing.assert_allclose(
        flow[1] - storage, np.exp(-40 * 0.03) * (flow[0] - storage), rtol=1e-9, atol=1e-18
    )


def test_springs_below_answer_a_shift_along_the_arm_by_their_stiffness(problem):
    x = np.zeros(problem.space.dofs)
    x[0 : 3 * problem.space.n_nodes : 3] = 1e-4
    computed = [
        m.residual(x, 1.0, m.initial_state(0.0))[0]
        for m in (skin(problem), skin(problem, "bottom-adherence"))
    ]
    force = (computed[1] - computed[0])[: 3 * problem.space.n_nodes].reshape(-1, 3)
    assert force[:, 0].sum() == pytest.approx(STRONG["adherence"] * 1e-4 * 0.105 * 0.084, rel=1e-3)
    np.testing.assert_allclose(force[:, 1:], 0.0, atol=1e-12)


def test_springs_below_let_the_skin_lift(problem):
    """Displacements along the radius meet no spring."""
    x = np.zeros(problem.space.dofs)
    y, z = problem.space.points_u[1:]
    u = 1e-4 * np.stack([0 * y, y, z]) / np.hypot(y, z)
    x[: 3 * problem.space.n_nodes] = u.T.ravel()
    assert np.abs(springs(problem) @ x).max() < 1e-3 * 1e-4 * 0.105 * 0.084 / 100


def test_leakage_of_a_uniform_pressure_is_conductance_times_the_open_area(problem):
    x = np.zeros(problem.space.dofs)
    n = 3 * problem.space.n_nodes
    x[n:] = 2e3
    computed = [
        m.residual(x, 5.0, m.initial_state(2e3))[0] for m in (skin(problem), skin(problem, "fluid-leakage"))
    ]
    area = 1e-6 * (105 * 84 - 8 * 4 - (17 * 7 + 8 * 5))
    assert -(computed[1] - computed[0])[n:].sum() == pytest.approx(
        STRONG["leakage"] * 5.0 * 2e3 * area, rel=1e-3
    )
    assert not set(open_surface(problem)) & set(problem.mesh.facets["pad"])


@pytest.mark.slow
def test_pre_stretched_skin_pulls_as_skin_that_was_pulled_slowly_before():
    """The force of drained skin follows the displacement alone, so that F(u) = G(u + d) - G(d)."""
    theta = THETA | {"k_c": 1e-11, "k_s": 1e-11}
    opening_m = 2 * STRONG["opening"] * 18e-3
    motion = PadMotion(np.array([0.0, 10.0]), np.array([0.0, 4e-3]))
    whole = PadMotion(np.array([0.0, 10.0, 20.0]), np.array([0.0, opening_m, opening_m + 4e-3]))
    spec = ModelSpec()
    simulation = simulate(spec, motion, strong("pre-stretch") | theta, laws=laws([TISSUE["pre-stretch"]]))
    slow = simulate(spec, whole, theta)
    times = np.linspace(0.0, 10.0, 6)
    assert simulation.status == "ok"
    assert simulation.time_s[0] == 0.0
    assert simulation.force_n[0] == 0.0
    expected = slow.at(10.0 + times) - slow.at(np.array([10.0]))
    np.testing.assert_allclose(simulation.at(times), expected, atol=0.01 * expected.max())


def test_tissue_mechanisms_need_the_reaction(tmp_path):
    with pytest.raises(InputError, match="observation 'reaction'"):
        simulate(ModelSpec("article", "some.msh"), STILL, THETA, laws=[lambda values, sites: TissueLaw()])
