"""Mechanisms that remember, or lie in series with the skin: closed forms and equations solved otherwise."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from toys.bar_models import LAM, MU
from toys.consolidation_references import EDGE_M, compression_stress
from toys.driven_model import Point, block, by_layer, corner_points, driven, march
from toys.pulled_bar import BAR, STRETCH_M, bound, elastic_force, pulled
from toys.skin_with_mechanisms import IN_SERIES, SOLVED, STRONG, THETA, skin, strong, unknowns

from bayeskin.finite_element import ModelSpec, simulate
from bayeskin.finite_element.mesh import brick_mesh
from bayeskin.finite_element.problem import build_problem
from bayeskin.finite_element.space import taylor_hood
from bayeskin.finite_element.stages import State
from bayeskin.mechanisms import laws, observed
from bayeskin.mechanisms.backlash import trailing
from bayeskin.mechanisms.preconditioning import damaged
from bayeskin.mechanisms.series import mean_beyond
from bayeskin.mechanisms.slow_recovery import KelvinVoigt
from bayeskin.types import PadMotion

COARSE = ModelSpec(refinement=0)
SHORT = PadMotion(np.array([0.0, 6.0, 12.0, 18.0]), 1e-3 * np.array([0.0, 6.0, 6.0, 0.0]))


@pytest.fixture(scope="module")
def problem():
    return build_problem(brick_mesh(1))


@pytest.fixture(scope="module")
def base():
    return simulate(COARSE, SHORT, THETA)


def test_a_step_stretch_relaxes_by_the_branches_exponentials():
    """Ramp of a microsecond, then a hold whose steps are far longer than the first relaxation time."""
    law = bound("solid-viscoelasticity", g_1=0.8, tau_1=0.5, g_2=0.4, tau_2=30.0)
    time_s, force = pulled(
        PadMotion(np.array([0.0, 1e-6, 100.0]), 2 * STRETCH_M * np.array([0, 1.0, 1.0])), law, steps=8
    )
    rest = elastic_force(1 + STRETCH_M)[0]
    held = time_s >= 1e-6
    expected = rest * (1 + 0.8 * np.exp(-time_s / 0.5) + 0.4 * np.exp(-time_s / 30.0))
    assert np.diff(time_s[held]).max() > 10.0
    np.testing.assert_allclose(force[held], expected[held], rtol=5e-5)


def test_a_ramp_relaxes_as_the_convolution_says():
    """Stress that grows with the stretch, against the hereditary integral by quadrature, to 0.5 %."""
    strength, tau, ramp_s = 1.0, 4.0, 10.0
    time_s, force = pulled(
        PadMotion(np.array([0.0, ramp_s, 30.0]), 2 * STRETCH_M * np.array([0, 1.0, 1.0])),
        bound("solid-viscoelasticity", g_1=strength, tau_1=tau, g_2=0.0, tau_2=1.0),
    )
    fine = np.linspace(0.0, 30.0, 3001)
    stretch = 1 + STRETCH_M * np.minimum(fine / ramp_s, 1.0)
    elastic = np.array([elastic_force(s)[0] for s in stretch])
    second = elastic / stretch
    decay = np.exp(-np.subtract.outer(time_s, fine) / tau) * (fine <= time_s[:, None] + 1e-9)
    over = np.trapezoid(decay * np.gradient(second, fine), fine, axis=1)
    expected = np.interp(time_s, fine, elastic) + strength * np.interp(time_s, fine, stretch) * over
    np.testing.assert_allclose(force, expected, atol=5e-3 * expected.max())


def test_damage_follows_the_largest_energy_and_later_cycles_repeat():
    most, scale = 0.5, 300.0
    law = damaged(most, scale, BAR.problem.sites.table(MU, LAM))
    u = 2 * STRETCH_M * np.array([0.0, 0.7, 0.0, 1.0, 0.0, 1.0])
    time_s, force = pulled(PadMotion(10.0 * np.arange(6.0), u), law)
    stretch = 1 + 0.5 * np.interp(time_s, 10.0 * np.arange(6.0), u)

    def energy(s):
        across = elastic_force(s)[1]
        log = np.log(s * across**2)
        return 0.5 * MU * (s**2 + 2 * across**2 - 3 - 2 * log) + 0.5 * LAM * log**2

    largest = np.maximum.accumulate([energy(s) for s in stretch])
    expected = [
        (1 - most * -np.expm1(-w / scale)) * elastic_force(s)[0]
        for s, w in zip(stretch, largest, strict=True)
    ]
    assert largest.max() > 2 * scale
    np.testing.assert_allclose(force, expected, atol=5e-4 * max(expected))


def test_the_tangent_knows_what_is_remembered(problem):
    """The state has been stretched before: some points load further, others unload."""
    everything = skin(problem, *SOLVED)
    start = everything.initial_state(0.0)
    before = everything.residual(unknowns(problem, 7), 0.7, start)
    past = State(0.0, start.x, before.volume, before.pressure, before.memory, start.lost)
    x, step = unknowns(problem, 8), unknowns(problem, 9)
    equations = everything.equations(0.7, past, 1.1)
    free, fixed = problem.pattern.free, problem.pattern.fixed
    free_free, free_fixed = equations.tangent(x)
    exact = free_free @ step[free] + free_fixed @ step[fixed]
    h = 1e-4
    difference = (equations.residual(x + h * step) - equations.residual(x - h * step)) / (2 * h)
    n = 3 * problem.space.n_nodes
    for rows in (free < n, free >= n):
        assert np.abs(difference - exact)[rows].max() < 2e-6 * np.abs(exact[rows]).max()


def test_permeability_follows_the_volume_in_a_confined_column():
    """A column shortened by a fifth, k = k0 exp(M (J - 1)) with M = 3, against one dimension."""
    layer, exponent, ramp, depth = Point(2e4, 4e4, 4e-11, 1e-13), 3.0, 10.0, -0.2 * EDGE_M
    times = np.array([2.0, 5.0, 10.0, 11.0, 13.0, 18.0, 30.0])
    reference = compression_stress(
        EDGE_M,
        ((1.0, layer.mu, layer.lam, layer.mobility),),
        lambda t: depth * min(t / ramp, 1.0),
        lambda t: depth / ramp if t <= ramp else 0.0,
        times,
        exponent=exponent,
    )
    tall, wide = EDGE_M * np.sin(np.linspace(0, np.pi / 2, 17)), np.array([0, 1e-3])
    space = taylor_hood(block("bricks", (wide, wide, tall), EDGE_M, radius=None))
    z, n = space.points_u[2], space.n_nodes
    bottom, top = (np.flatnonzero(np.isclose(z, at)) for at in (0.0, EDGE_M))
    drained = 3 * n + np.flatnonzero(np.isclose(corner_points(space)[2], EDGE_M))
    across = 3 * np.arange(n)
    fixed = np.unique(np.concatenate([across, across + 1, 3 * bottom + 2, 3 * top + 2, drained]))

    def values(t):
        x = np.zeros(space.dofs)
        x[3 * top + 2] = depth * min(t / ramp, 1.0)
        return x[fixed]

    model = driven(space.mesh, by_layer(space.mesh.cutis, layer, layer), fixed, values, space=space)
    model.laws = (SOLVED["strain-dependent-permeability"].act.bind({"M_k": exponent}, model.problem.sites),)
    grid = np.union1d(np.concatenate([np.linspace(0.1, 10, 40), 10 + np.geomspace(0.02, 20, 40)]), times)
    computed = {}
    for t, step in zip(grid, march(model, model.initial_state(0.0), grid, corner_s=ramp), strict=True):
        if np.isclose(times, t).any():
            computed[float(t)] = step.stages[-1].residual[3 * top + 2].sum() / 1e-6
    np.testing.assert_allclose(
        list(computed.values()), reference, rtol=4e-3, atol=4e-3 * np.abs(reference).max()
    )


def solved_series(rate, motion, compliance=0.0):
    """Forces of the drained bar behind ds/dt = rate(F, s), by another integrator; times, forces."""
    table = np.linspace(0.6, 1.7, 400)
    forces = np.array([elastic_force(s)[0] for s in table])

    def force_of(t, s):
        u = 0.5 * (motion.at(t) - s)
        return (
            2.0 * float(np.interp(1 + u, table, forces))
            if compliance == 0.0
            else brentq(
                lambda f: f - 2.0 * np.interp(1 + 0.5 * (motion.at(t) - s - compliance * f), table, forces),
                -1e6,
                1e6,
            )
        )

    corners = motion.time_s
    times, computed, now = [], [], 0.0
    for start, end in pairwise(corners):
        t = np.linspace(start, end, 41)
        run = solve_ivp(
            lambda t, s: [rate(force_of(t, s[0]), s[0])],
            (start, end),
            [now],
            t_eval=t,
            rtol=1e-8,
            atol=1e-12,
            max_step=0.05,
        )
        times.extend(t)
        computed.extend(force_of(a, b) for a, b in zip(t, run.y[0], strict=True))
        now = run.y[0, -1]
    return np.array(times), np.array(computed)


BAR_MOTION = PadMotion(
    np.array([0.0, 5.0, 20.0, 25.0, 40.0]), 2 * STRETCH_M * np.array([0, 1.0, 1.0, 0.0, 0.0])
)


def test_slow_recovery_is_a_kelvin_voigt_element_in_series():
    compliance, tau = 1e-5, 6.0
    law = bound("slow-recovery", recovery_compliance=compliance, recovery_time=tau)
    time_s, force = pulled(BAR_MOTION, law)
    t, expected = solved_series(lambda f, s: (compliance * f - s) / tau, BAR_MOTION)
    np.testing.assert_allclose(2 * force, np.interp(time_s, t, expected), atol=4e-3 * expected.max())
    assert (
        np.abs(2 * force - np.interp(time_s, *solved_series(lambda f, s: 0.0, BAR_MOTION))).max()
        > 0.1 * expected.max()
    )


def test_slip_goes_on_beyond_its_threshold_and_stays():
    rate, threshold = 2e-6, 4e3
    time_s, force = pulled(BAR_MOTION, bound("pad-slip", slip_rate=rate, slip_threshold=threshold))
    t, expected = solved_series(lambda f, s: rate * np.sign(f) * max(abs(f) - threshold, 0.0), BAR_MOTION)
    np.testing.assert_allclose(2 * force, np.interp(time_s, t, expected), atol=6e-3 * expected.max())
    assert expected[-1] < -0.05 * expected.max()  # the pads stand closer than the skin is long


def test_a_gap_and_a_compliant_frame_delay_each_reversal():
    gap, compliance = 0.05, 1e-5
    time_s, force = pulled(BAR_MOTION, bound("backlash", gap=gap, frame_compliance=compliance))
    behind = trailing(BAR_MOTION, gap)
    t, expected = solved_series(lambda f, s: 0.0, behind, compliance)
    np.testing.assert_allclose(2 * force, np.interp(time_s, t, expected), atol=1e-3 * expected.max())
    assert np.abs(force[time_s < 0.4]).max() == 0.0


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.floats(0.0, 1.0), min_size=2, max_size=6),
    st.floats(0.0, 0.5),
)
def test_what_trails_a_gap_is_the_play_operator(heights, gap):
    motion = PadMotion(np.arange(len(heights) + 1.0), np.array([0.0, *heights]))
    fine = np.linspace(0.0, len(heights), 200 * len(heights) + 1)
    u, p, computed = motion.at(fine), 0.0, []
    for value in u:
        p = max(value - gap, min(value, p))
        computed.append(p)
    np.testing.assert_allclose(trailing(motion, gap).at(fine), computed, atol=6e-3)


@settings(max_examples=60, deadline=None)
@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(0.0, 0.5))
def test_slip_over_a_straight_change_of_force_is_its_integral(before, now, threshold):
    t = (np.arange(20000) + 0.5) / 20000
    force = before + t * (now - before)
    expected = np.mean(np.sign(force) * np.maximum(np.abs(force) - threshold, 0.0))
    assert mean_beyond(before, now, threshold) == pytest.approx(expected, abs=1e-6)


def test_the_element_under_a_constant_force_creeps_by_its_exponential():
    element, memory = KelvinVoigt(1e-3, 7.0), np.array([0.0, 0.5])
    for _ in range(4):
        memory = element.follow(0.5, 2.5, memory)
    assert memory[0] == pytest.approx(0.5e-3 * (1 - np.exp(-10 / 7)), rel=1e-12)


@pytest.mark.parametrize("name", sorted(SOLVED))
def test_a_neutral_mechanism_gives_the_base_models_run(base, name):
    simulation = simulate(COARSE, SHORT, THETA | SOLVED[name].neutral, laws=laws([SOLVED[name]]))
    assert simulation.status == "ok"
    np.testing.assert_allclose(simulation.at(base.time_s), base.force_n, atol=1e-4 * base.force_n.max())


@pytest.mark.parametrize("name", sorted(IN_SERIES & set(SOLVED)))
def test_a_shortcut_is_near_the_full_model(base, name):
    """RMS within a tenth of the effect."""
    mechanism = SOLVED[name]
    simulation = simulate(COARSE, SHORT, strong(mechanism.name), laws=laws([mechanism]))
    columns = {key: np.array([value]) for key, value in STRONG.items()}
    times = np.arange(0.0, 18.0, 0.2)
    quick = observed([mechanism], columns, SHORT, lambda t: np.atleast_2d(base.at(t)))(times)[0]
    effect = np.sqrt(np.mean((simulation.at(times) - base.at(times)) ** 2))
    assert effect > 1e-3
    assert np.sqrt(np.mean((quick - simulation.at(times)) ** 2)) < 0.1 * effect
