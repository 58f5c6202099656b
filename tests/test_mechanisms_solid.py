"""Tests of mechanisms of the solid: its compressibility, drifting moduli and plastic set."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import brentq
from toys.bar_models import LAM, MU
from toys.pulled_bar import BAR, STRETCH_M, bound, elastic_force, pulled
from toys.skin_with_mechanisms import ONE, SOLVED, THETA, strong

from bayeskin.errors import InputError
from bayeskin.finite_element import ModelSpec, poroelastic, simulate
from bayeskin.finite_element.problem import material
from bayeskin.mechanisms import laws
from bayeskin.mechanisms.fibres import fibres
from bayeskin.mechanisms.plastic_set import setting
from bayeskin.mechanisms.stiffness_drift import LEAST, drifting
from bayeskin.proof.protocol import MOTION
from bayeskin.types import PadMotion

LAYERS = np.array([True, False])
HELD = PadMotion(np.array([0.0, 1e-6, 60.0]), 2 * STRETCH_M * np.array([0.0, 1.0, 1.0]))


def simulated(motion, theta, *names, refinement=0):
    run = simulate(ModelSpec(refinement=refinement), motion, theta, laws=laws([SOLVED[n] for n in names]))
    assert run.status == "ok"
    return run


# Compressibility of the skeleton


@pytest.mark.parametrize(("nu_c", "nu_s"), [(0.0, 0.45), (0.49, 0.0), (0.3, 0.2)])
def test_lames_constants_are_those_of_youngs_modulus_and_poissons_ratio(nu_c, nu_s):
    solid = material(THETA | {"nu_c": nu_c, "nu_s": nu_s}, LAYERS)
    young = solid.mu * (3 * solid.lam + 2 * solid.mu) / (solid.lam + solid.mu)
    np.testing.assert_allclose(young, [THETA["E_c"], THETA["E_s"]])
    np.testing.assert_allclose(0.5 * solid.lam / (solid.lam + solid.mu), [nu_c, nu_s], atol=1e-15)


def test_damage_is_of_the_solid_that_has_the_ratios():
    theta = strong("preconditioning", "skeleton-compressibility")
    solid = material(theta, ONE.cutis)
    law = SOLVED["preconditioning"].act.bind(theta, ONE)
    np.testing.assert_array_equal(law.data, [[solid.mu[0], solid.lam[0]]])


@pytest.mark.parametrize("ratio", [0.5, -1.0])
def test_a_ratio_of_no_stable_solid_is_refused(ratio):
    with pytest.raises(InputError, match=r"nu_s.*above -1 and below 0\.5"):
        material(THETA | {"nu_s": ratio}, LAYERS)


@pytest.mark.parametrize(
    ("nu_c", "nu_s", "relaxed", "after_n"),
    [(0.48, 0.3, 0.021, -0.0136), (0.3, 0.2, 0.058, -0.0413), (0.1, 0.1, 0.087, -0.0723)],
)
def test_a_compressible_skeleton_relaxes_in_the_hold_and_pushes_after_unloading(nu_c, nu_s, relaxed, after_n):
    """The 80 coarsest bricks give the shares of the peak, and the force at the end of the first unloading."""
    first = PadMotion(MOTION.time_s[:5], MOTION.displacement_m[:5])
    run = simulated(first, THETA | {"nu_c": nu_c, "nu_s": nu_s}, "skeleton-compressibility")
    peak, held, after = run.at(first.time_s[2:])
    assert 1.0 - held / peak == pytest.approx(relaxed, abs=5e-4)
    assert after == pytest.approx(after_n, abs=5e-4)


# Moduli that drift


@pytest.mark.parametrize(("rate", "time_s"), [(1e-3, 30.0), (-1e-3, 1000.0), (5e-3, 20.0)])
def test_a_drained_bar_pulls_with_the_factor_times_the_force_without(rate, time_s):
    motion = PadMotion(np.array([0.0, 10.0, 60.0, 70.0]), 2 * STRETCH_M * np.array([0.0, 1.0, 1.0, 0.5]))
    along = fibres(BAR.problem.sites, np.array([1.0, 0.0, 0.0]), 0.5 * MU, 1.2)
    law = bound("stiffness-drift", stiffness_rate=rate, stiffness_time=time_s)
    t, without = pulled(motion, along)
    _, computed = pulled(motion, law, along)
    factor = 1 + rate * time_s * (1 - np.exp(-t / time_s))
    np.testing.assert_allclose(computed, factor * without, atol=3e-4 * without.max())


def test_a_drift_without_end_is_straight_and_pieces_follow_each_other():
    law = drifting(BAR.problem.sites, [(0.0, 1.0, 2e-3, np.inf), (20.0, 1.04, -1e-3, np.inf)])
    t, computed = pulled(HELD, law)
    factor = 1 + np.where(t < 20.0, 2e-3 * t, 0.04 - 1e-3 * (t - 20.0))
    held = t >= 1e-6
    np.testing.assert_allclose(computed[held], factor[held] * elastic_force(1 + STRETCH_M)[0], rtol=2e-5)


def test_branches_relax_the_stress_that_has_drifted():
    """A step of the stretch: the branch's stress answers to S_e f(t), with f' = r exp(-t / T)."""
    rate, end_s, g, tau = 4e-3, 50.0, 0.8, 5.0
    viscous = bound("solid-viscoelasticity", g_1=g, tau_1=tau, g_2=0.0, tau_2=1.0)
    drift = bound("stiffness-drift", stiffness_rate=rate, stiffness_time=end_s)
    t, computed = pulled(HELD, viscous, drift, steps=200)
    grown = rate * (np.exp(-t / end_s) - np.exp(-t / tau)) / (1 / tau - 1 / end_s)
    factor = 1 + rate * end_s * (1 - np.exp(-t / end_s)) + g * (np.exp(-t / tau) + grown)
    held = t >= 1e-6
    expected = factor * elastic_force(1 + STRETCH_M)[0]
    np.testing.assert_allclose(computed[held], expected[held], rtol=5e-5)


def test_a_factor_is_on_the_solids_own_stress_and_not_on_the_pressure():
    f, p = np.array([[[1.2, 0.1, 0.0], [0.0, 0.9, 0.2], [0.0, 0.0, 1.05]]]), np.array([700.0])
    solid, base, out = material(THETA, ONE.cutis), np.zeros((1, 1, 3, 3)), np.zeros((1, 1, 3))
    poroelastic.respond(
        f[None], p[None], np.zeros((1, 1, 3)), solid.mu, solid.lam, solid.mobility, solid.storage, 1.0,
        np.ones((1, 1)), p[None], base, np.zeros((1, 1)), out, np.zeros((1, 1)),
    )  # fmt: skip
    law = bound_at_one("stiffness-drift", stiffness_rate=1e-3, stiffness_time=100.0)
    stress, none = base[0].copy(), np.empty((1, 0))
    law.respond(
        50.0, 1.0, law.par, law.data, f, p, np.zeros((1, 3)), none, none.copy(), stress, np.zeros(1), out[0]
    )
    fluid = -p[0] * np.linalg.det(f[0]) * np.linalg.inv(f[0]).T
    factor = 1 + 0.1 * (1 - np.exp(-0.5))
    np.testing.assert_allclose(stress[0] - fluid, factor * (base[0, 0] - fluid), rtol=1e-12)


def bound_at_one(name, **values):
    return SOLVED[name].act.bind(values, ONE)


def test_moduli_drift_from_the_start_of_the_test_on_and_not_while_the_pads_are_opened():
    """Opened pads that stand still on drained skin: the tension F_0 grows by (f - 1) F_0 from t = 0 on."""
    theta = strong("pre-stretch", "stiffness-drift") | {"k_c": 1e-11, "k_s": 1e-11}
    still = PadMotion(np.array([0.0, 200.0]), np.zeros(2))
    run = simulated(still, theta, "pre-stretch", "stiffness-drift")
    opening = PadMotion(np.array([0.0, 1e3, 1e5]), 2 * theta["opening"] * 18e-3 * np.array([0.0, 1.0, 1.0]))
    tension = simulated(opening, THETA | {"k_c": 1e-11, "k_s": 1e-11}).force_n[-1]
    rate, time_s = theta["stiffness_rate"], theta["stiffness_time"]
    at_s = np.array([0.0, 50.0, 200.0])
    expected = rate * time_s * (1 - np.exp(-at_s / time_s)) * tension
    np.testing.assert_allclose(run.at(at_s), expected, atol=2e-3 * np.abs(expected).max())


def test_moduli_that_would_vanish_are_refused_and_those_that_nearly_do_stay_above_a_bound():
    with pytest.raises(InputError, match=r"stiffness_rate.*at least -0\.01 1/s.*vanish"):
        bound("stiffness-drift", stiffness_rate=-0.011, stiffness_time=100.0)
    law = bound("stiffness-drift", stiffness_rate=-0.01, stiffness_time=100.0)
    motion = PadMotion(np.array([0.0, 1e-6, 1000.0]), 2 * STRETCH_M * np.array([0.0, 1.0, 1.0]))
    t, computed = pulled(motion, law)
    held, rest = t >= 1e-6, elastic_force(1 + STRETCH_M)[0]
    np.testing.assert_allclose(computed[held], rest * np.maximum(np.exp(-t[held] / 100.0), LEAST), rtol=2e-4)


# A set that stays


def set_force(stretch, rest):
    """Returns the axial stress of a bar, free to contract, whose rest length has grown by a factor."""
    across = brentq(lambda a: MU * (a * rest - 1 / a) + LAM * np.log(stretch * a**2) / a, 0.3, 2.0)
    return MU * (stretch / rest**2 - 1 / stretch) + LAM * np.log(stretch * across**2) / stretch


def test_cycles_of_a_bar_that_yields_follow_the_closed_form_whatever_their_rate():
    share, threshold = 0.4, 1.1
    law = setting(share, threshold, BAR.problem.sites.table(MU))
    u = 2 * STRETCH_M * np.array([0.0, 0.7, 0.0, 1.0, 0.0, 1.0])
    corners_s = np.array([0.0, 10.0, 11.0, 50.0, 51.0, 60.0])
    time_s, force = pulled(PadMotion(corners_s, u), law)
    stretch = 1 + 0.5 * np.interp(time_s, corners_s, u)
    rest = 1 + share * np.maximum(np.maximum.accumulate(stretch) - threshold, 0.0)
    expected = [set_force(*pair) for pair in zip(stretch, rest, strict=True)]
    np.testing.assert_allclose(force, expected, atol=3e-4 * max(expected))
    assert force[np.isclose(time_s, 51.0)][0] < -0.05 * force.max()  # pushes where it was at rest before


@pytest.mark.parametrize("before", [0.0, 1.12, 1.5])
@pytest.mark.parametrize("stretch", [1.05, 1.25])
def test_the_derivatives_of_a_set_are_differences_of_its_stress(before, stretch):
    """Below the threshold, yielding, and unloaded from farther on."""
    rng, law = np.random.default_rng(0), setting(0.5, 1.1, np.array([[2e4]]))
    f = np.diag([stretch, 0.9, 1.0]) + 0.02 * rng.standard_normal((3, 3))
    kept, none = np.array([[before]]), np.zeros((1, 3))

    def stress(f):
        out, after = np.zeros((1, 3, 3)), np.zeros((1, 1))
        law.respond(0.0, 1.0, law.par, law.data, f[None], none[:, 0].copy(), none, kept, after, out,
                    none[:, 0].copy(), none.copy())  # fmt: skip
        return out.ravel()

    slopes = [np.zeros((1, *tail)) for tail in ((9, 9), (9,), (9,), (), (3, 9), (3, 3))]
    law.linearise(0.0, 1.0, law.par, law.data, f[None], none[:, 0].copy(), none, kept, *slopes)
    h = 1e-6
    steps = h * np.eye(9).reshape(9, 3, 3)
    columns = [(stress(f + step) - stress(f - step)) / (2 * h) for step in steps]
    np.testing.assert_allclose(slopes[0][0], np.stack(columns, axis=1), atol=1e-8 * 2e4)


def test_skin_that_yields_is_slack_when_the_pads_come_back_and_later_cycles_repeat():
    motion = PadMotion(10.0 * np.arange(7), 1e-3 * np.array([0.0, 8.0, 0.0, 8.0, 0.0, 8.0, 0.0]))
    drained = {"k_c": 1e-11, "k_s": 1e-11}
    base = simulated(motion, THETA | drained)
    run = simulated(motion, strong("plastic-set") | drained, "plastic-set")
    after = [run.at(np.array([t]))[0] for t in (20.0, 40.0, 60.0)]
    assert max(after) < -0.05 * run.force_n.max()
    assert abs(base.at(np.array([20.0]))[0]) < 0.02 * base.force_n.max()
    assert np.ptp(after) < 0.01 * run.force_n.max()
    peaks = [run.at(np.array([t]))[0] for t in (10.0, 30.0, 50.0)]
    for first, second in pairwise(peaks):
        assert second == pytest.approx(first, rel=0.01)
