"""Law kernels: one signature, callable from compiled code, point by point; and forces as they were."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from numba.typed import List

from bayeskin.finite_element import ModelSpec, simulate
from bayeskin.finite_element.kernels import LINEARISE, RESPOND
from bayeskin.finite_element.mesh import brick_mesh
from bayeskin.finite_element.problem import Sites, build_problem
from bayeskin.mechanisms import catalogue, laws
from bayeskin.proof.outside import OUTSIDE
from bayeskin.types import PadMotion

THETA = {"E_c": 60e3, "E_s": 20e3, "k_c": 1e-14, "k_s": 5e-13, "p_init": 300.0}
STRONG = {
    "fibre_stress": 2e5, "k2": 5.0, "dispersion": 0.1, "M_k": 30.0, "adherence": 1e7, "leakage": 1e-9,
    "langer_ratio": 3.0, "langer_angle": 0.7, "opening": 0.05, "g_1": 0.6, "tau_1": 1.5, "g_2": 0.3,
    "tau_2": 40.0, "damage": 0.5, "damage_energy": 1e3, "recovery_compliance": 1e-3, "recovery_time": 20.0,
    "gap": 2e-4, "frame_compliance": 1e-3, "slip_rate": 1e-4, "slip_threshold": 0.02, "set_share": 0.5,
    "yield_stretch": 1.02, "stiffness_rate": -1e-3, "stiffness_time": 300.0,
}  # fmt: skip
KNOWN = catalogue()
SOLVED = {name: mechanism.act.bind for name, mechanism in KNOWN.items() if mechanism.act.bind is not None}
BINDS = SOLVED | {name: OUTSIDE[name].change(0.3).laws[0] for name in ("thixotropy", "strain-softening")}
POINTS = 40
MOTION = PadMotion(np.array([0.0, 4.0, 8.0, 12.0]), 1e-3 * np.array([0.0, 5.0, 5.0, 0.0]))
FORCES_N = {  # at the corners, on the 80 coarsest bricks, before laws became kernels of one signature
    "base": (0.248343075914, 0.247050524115, -0.00270225718153),
    "backlash": (0.228562920109, 0.227381193402, -0.00239636309318),
    "bottom-adherence": (0.434384818335, 0.429161360609, -0.00944074476088),
    "fibre-anisotropy": (0.226952668704, 0.224892055327, -0.00376944804893),
    "fluid-leakage": (0.248091873954, 0.246767272155, -0.00278097008436),
    "pad-slip": (0.246365491949, 0.240950988355, -0.0119816354544),
    "pre-stretch": (0.236124678406, 0.234993349404, -0.00221187013648),
    "preconditioning": (0.214355606889, 0.212646717922, -0.00225519220665),
    "slow-recovery": (0.247252981923, 0.24410851281, -0.00665403898661),
    "solid-viscoelasticity": (0.367808108941, 0.31319047266, -0.066763430517),
    "strain-dependent-permeability": (0.248222460065, 0.24657078073, -0.00290814434909),
    "strain-stiffening": (0.950122373912, 0.948475011566, 0.00062703249728),
}


def sites(seed: int = 0) -> Sites:
    rng = np.random.default_rng(seed)
    return Sites(rng.random(POINTS) < 0.5, np.array([[0.02], [0.01], [0.05]]) * rng.random((3, POINTS)))


def acting(where: Sites):
    """The laws that answer at points, by name."""
    bound = {name: bind(THETA | STRONG, where) for name, bind in BINDS.items()}
    return {name: law for name, law in bound.items() if law.respond is not None}


LAWS = acting(sites())


def state(law, seed: int = 1):
    """Everything that kernels are given, and room for what they change."""
    rng, n, m = np.random.default_rng(seed), POINTS, law.remembers
    given = [np.eye(3) + 0.1 * rng.standard_normal((n, 3, 3)), 1e3 * rng.standard_normal(n),
             1e5 * rng.standard_normal((n, 3)), rng.random((n, m))]  # fmt: skip
    answer = [np.full((n, m), np.nan), *(rng.random(shape) for shape in ((n, 3, 3), n, (n, 3)))]
    slopes = [rng.random((n, *tail)) for tail in ((9, 9), (9,), (9,), (), (3, 9), (3, 3))]
    return given, answer, slopes


def called(law, given, answer, slopes, rows=slice(None)):
    """Changes rows of `answer` and of `slopes` as the law does."""
    data, given = law.data[rows], [array[rows] for array in given]
    answer, slopes = [a[rows] for a in answer], [s[rows] for s in slopes]
    law.respond(7.0, 0.5, law.par, data, *given, *answer)
    law.linearise(7.0, 0.5, law.par, data, *given, *slopes)


@pytest.mark.parametrize("name", LAWS)
def test_a_kernel_fills_the_memory_and_acts_on_each_point_alone(name):
    law = LAWS[name]
    (given, answer, slopes), (_, one_by_one, their_slopes) = state(law), state(law)
    called(law, given, answer, slopes)
    for n in range(POINTS):
        called(law, given, one_by_one, their_slopes, slice(n, n + 1))
    for whole, single in zip([*answer, *slopes], [*one_by_one, *their_slopes], strict=True):
        assert np.isfinite(whole).all()
        np.testing.assert_allclose(single, whole, rtol=1e-13)


@pytest.mark.parametrize("name", LAWS)
def test_a_law_bound_to_some_points_is_that_of_all_at_these(name):
    where, few = sites(), np.array([3, 17, 18, 30])
    some = BINDS[name](THETA | STRONG, Sites(where.cutis[few], where.points_m[:, few]))
    np.testing.assert_array_equal(some.data, LAWS[name].data[few])
    np.testing.assert_array_equal(some.par, LAWS[name].par)


@pytest.mark.slow
def test_compiled_code_calls_the_kernels_of_any_laws_by_their_address():
    @numba.njit
    def one_after_the_other(kernels, par, data, f, p, g, before, after, stress, content, flux):
        for k in range(len(kernels)):
            kernels[k](7.0, 0.5, par[k], data[k], f, p, g, before[k], after[k], stress, content, flux)

    kernels = List.empty_list(numba.types.FunctionType(RESPOND))
    for law in LAWS.values():
        kernels.append(law.respond)
        assert law.respond.signatures == [RESPOND.args]
        assert law.linearise.signatures == [LINEARISE.args]
    given = state(LAWS["strain-stiffening"])[0][:3]
    before, after = (
        List([state(law)[part][place] for law in LAWS.values()]) for part, place in ((0, 3), (1, 0))
    )
    computed, expected = (state(LAWS["strain-stiffening"])[1][1:] for _ in range(2))
    par, data = (List([getattr(law, name) for law in LAWS.values()]) for name in ("par", "data"))
    one_after_the_other(kernels, par, data, *given, before, after, *computed)
    for law in LAWS.values():
        own, room, _ = state(law)
        law.respond(7.0, 0.5, law.par, law.data, *given, own[3], room[0], *expected)
    for mine, theirs in zip(computed, expected, strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_the_matrix_of_a_surface_term_is_made_once_a_problem():
    problem = build_problem(brick_mesh(0))
    for name in ("bottom-adherence", "fluid-leakage"):
        terms = [SOLVED[name](THETA | STRONG | {"adherence": a}, problem.sites).surfaces for a in (1.0, 2.0)]
        first, second = (problem.linear(term.unit) for (term,) in terms)
        assert first is second


@pytest.mark.parametrize("name", FORCES_N)
def test_forces_are_what_they_were(name):
    mechanisms = [] if name == "base" else [KNOWN[name]]
    theta = THETA | (STRONG if mechanisms else {})
    run = simulate(ModelSpec(refinement=0), MOTION, theta, laws=laws(mechanisms))
    assert run.status == "ok"
    computed = run.at(MOTION.time_s[1:])
    np.testing.assert_allclose(computed, FORCES_N[name], rtol=0, atol=1e-7 * max(FORCES_N[name]))
