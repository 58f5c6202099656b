"""The parts of a reduced model: bases, training cases, cubature, the trained region."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import nnls

from bayeskin.design import default_space
from bayeskin.finite_element.mesh import brick_mesh
from bayeskin.finite_element.problem import build_problem
from bayeskin.geometry import Geometry
from bayeskin.mechanisms import catalogue
from bayeskin.reduced.basis import inner_products, pod, weighted_modes
from bayeskin.reduced.cases import BASE, SETS, Protocols, Trained, random_motion
from bayeskin.reduced.cubature import CubatureSettings, choose_points, rows_of_state
from bayeskin.reduced.library import Library, Modes, modes_beyond, modes_of, scaled_basis
from bayeskin.reduced.model import reduced_space
from bayeskin.reduced.operators import Rule, linear_parts, point_fields, whole_linear_parts
from bayeskin.reduced.region import outside
from bayeskin.reduced.training import training_run
from bayeskin.types import PadMotion, ParameterSpace

NAMES = ("solid-viscoelasticity", "strain-stiffening", "pre-stretch")
TRAINED = Trained(
    Geometry(), default_space(), {name: ParameterSpace(catalogue()[name].parameters) for name in NAMES}
)
THETA = {"E_c": 6e4, "E_s": 2e4, "k_c": 1e-14, "k_s": 5e-13, "p_init": 300.0}
SOFT_CUTIS = {"E_c": 6e4, "E_s": 2e5}
ACTING = {p.name: 0.5 * (p.lower + p.upper) for p in TRAINED.mechanisms[NAMES[0]].parameters}
MOTION = PadMotion(np.array([0.0, 5.0, 20.0]), np.array([0.0, 5e-3, 5e-3]))


@pytest.fixture(scope="module")
def problem():
    return build_problem(brick_mesh(0))


@pytest.fixture(scope="module")
def inner(problem):
    return inner_products(problem)


def random_modes(problem, inner, count, seed=0):
    rng = np.random.default_rng(seed)
    n = 3 * problem.space.n_nodes
    u = rng.standard_normal((count, n))
    u[:, problem.pattern.fixed[problem.pattern.fixed < n]] = 0.0
    p = inner.without_mean(rng.standard_normal((count, problem.space.n_corners)))
    return Modes(pod(u, inner.displacement)[1], pod(p, inner.pressure)[1])


def test_modes_are_orthonormal_and_span_the_rows(inner, problem) -> None:
    rng = np.random.default_rng(1)
    rows = rng.standard_normal((4, 3)) @ rng.standard_normal((3, problem.space.n_corners))
    values, modes = pod(rows, inner.pressure)
    assert len(values) == 3
    np.testing.assert_allclose(modes @ inner.pressure @ modes.T, np.eye(3), atol=1e-9)
    np.testing.assert_allclose((rows @ (inner.pressure @ modes.T)) @ modes, rows, atol=1e-9)
    energy = np.einsum("ij,ij->", rows, (inner.pressure @ rows.T).T)
    assert (values**2).sum() == pytest.approx(energy)


def test_weighted_modes_keep_the_largest(inner, problem) -> None:
    rows = np.diag([1.0, 1e-2, 1e-7]) @ random_modes(problem, inner, 3).pressure
    kept = weighted_modes(rows, inner.pressure, 1e-5, 24)
    norms = np.sqrt(np.einsum("ij,ij->i", kept, (inner.pressure @ kept.T).T))
    np.testing.assert_allclose(norms, [1.0, 1e-2], rtol=1e-9)


def test_the_pads_fields_are_one_where_they_should_be(inner, problem) -> None:
    assert set(inner.moving[3 * problem.pads]) == {1.0}
    assert set(inner.dual[problem.measured_x]) == {1.0}
    guard = np.setdiff1d(3 * problem.pads, problem.measured_x)
    assert len(guard) > 0
    assert set(inner.dual[guard]) == {0.0}
    assert inner.moving.min() >= -1e-9
    assert inner.moving.max() <= 1.0 + 1e-9


def test_pressures_without_their_mean_have_none(inner) -> None:
    rows = np.random.default_rng(2).standard_normal((3, inner.pressure.shape[0])) + 5.0
    np.testing.assert_allclose(inner.without_mean(rows) @ inner.pressure @ inner.constant, 0.0, atol=1e-12)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6))
def test_protocols_stay_within_their_bounds(seed: int) -> None:
    bounds = Protocols()
    motion = random_motion(np.random.default_rng(seed), bounds)
    speed = np.abs(np.diff(motion.displacement_m) / np.diff(motion.time_s))
    moving = speed > 0.0
    assert np.all(np.diff(motion.time_s) > 0.0)
    assert motion.displacement_m.min() >= 0.0
    assert motion.displacement_m.max() <= bounds.largest_m + 0.03 * bounds.largest_m
    assert np.all(speed[moving] >= 0.999 * bounds.speeds_m_s[0])
    assert np.all(speed[moving] <= 1.001 * bounds.speeds_m_s[1])


@settings(max_examples=40, deadline=None)
@given(st.sampled_from([BASE, SETS, *NAMES]), st.integers(0, 10**4))
def test_training_cases_lie_in_the_trained_region(kind: str, index: int) -> None:
    case = TRAINED.case(kind, index, 3)
    again = TRAINED.case(kind, index, 3)
    assert case.theta == again.theta
    assert (kind in case.mechanisms) == (kind in NAMES)
    assert bool(case.mechanisms) == (kind != BASE)
    motion = PadMotion(case.motion.time_s, np.minimum(case.motion.displacement_m, 10e-3))
    assert outside(TRAINED, case.theta, case.mechanisms, case.geometry, motion) == ""


def test_a_full_run_that_fails_at_once_is_kept_without_modes(problem, inner, monkeypatch) -> None:
    def fails(*_: object, **__: object) -> str:
        raise FloatingPointError("inside out")

    monkeypatch.setattr("bayeskin.reduced.training.integrate", fails)
    run = training_run(problem, inner, TRAINED.case(BASE, 0, 1), ())
    assert run.message == "inside out"
    assert len(run.displacement) == len(run.pressure) == 0


@pytest.mark.parametrize(
    ("theta", "names", "geometry", "motion", "says"),
    [
        ({"E_c": 5e6}, (), Geometry(), MOTION, "E_c is 5e+06"),
        ({}, ("fluid-leakage",), Geometry(), MOTION, "mechanism fluid-leakage was not trained"),
        ({}, (), Geometry(cutis_m=4e-3), MOTION, "cutis is 4 mm"),
        ({}, (), Geometry(gauge_m=30e-3), MOTION, "the pads, the guard or the load cell differ"),
        ({}, (), Geometry(arm_radius_m=None), MOTION, "flat"),
        ({}, (), Geometry(), PadMotion(np.array([0.0, 9.0]), np.array([0.0, 12e-3])), "open by 12.00 mm"),
        ({}, (), Geometry(), PadMotion(np.array([0.0, 9.0]), np.array([0.0, -1e-3])), "pushed together"),
        ({}, (), Geometry(), PadMotion(np.array([0.0, 0.1]), np.array([0.0, 5e-3])), "at 50 mm/s"),
    ],
)
def test_what_lies_outside_is_said(theta, names, geometry, motion, says) -> None:
    assert says in outside(TRAINED, THETA | theta, names, geometry, motion)
    assert outside(TRAINED, THETA, (), Geometry(), MOTION) == ""


def test_a_subcutis_stiffer_than_the_cutis_was_trained() -> None:
    for names in ((), NAMES[:1]):
        assert outside(TRAINED, THETA | SOFT_CUTIS | ACTING, names, Geometry(), MOTION) == ""


def test_a_cubature_integrates_what_it_was_taught_with_positive_weights() -> None:
    """Polynomials of four degrees on a thousand points are integrated by a handful."""
    x = np.linspace(-1.0, 1.0, 1001)
    rows = np.array([x**k for k in range(8)], dtype=np.float32)
    rule, left = choose_points(rows, [8], CubatureSettings())[8]
    assert left < 1e-3
    assert rule.factor.min() > 0.0
    np.testing.assert_allclose(rows[:, rule.points] @ rule.factor, rows.sum(axis=1), atol=1e-2 * 1001)


def test_a_cubature_of_all_columns_is_the_non_negative_least_squares_one() -> None:
    rng = np.random.default_rng(4)
    rows = rng.standard_normal((30, 12)).astype(np.float32)
    right = rows.astype(float).sum(axis=1)
    rule, left = choose_points(rows, [12], CubatureSettings())[12]
    _, residual = nnls(rows.astype(float), right)
    assert left * np.linalg.norm(right) == pytest.approx(residual, abs=1e-5)
    np.testing.assert_allclose(rule.factor, 1.0, rtol=1e-4)


def test_a_cubature_needs_no_more_points_than_there_are_rows() -> None:
    """Non-negative least squares keeps at most as many columns as there are rows, however many are wanted."""
    rows = np.random.default_rng(5).uniform(0.1, 1.0, (40, 600)).astype(np.float32)
    rules = choose_points(rows, [20, 200], CubatureSettings())
    assert len(rules[20][0].points) >= 20
    assert len(rules[200][0].points) <= 40
    assert rules[200][1] < CubatureSettings().exact


def test_all_points_leave_no_linear_part_out(problem, inner) -> None:
    basis = scaled_basis(random_modes(problem, inner, 3), inner)
    at = point_fields(problem, basis)
    everything = Rule(np.arange(len(at.weight)), np.ones(len(at.weight)))
    space = reduced_space(problem, basis, everything)
    for name in ("shear", "bulk", "flow", "coupling"):
        whole = getattr(whole_linear_parts(problem, basis), name)
        np.testing.assert_allclose(
            whole, getattr(linear_parts(at), name), rtol=0, atol=1e-5 * np.abs(whole).max()
        )
        assert np.abs(getattr(space.exact, name)).max() < 1e-5 * np.abs(whole).max()


def test_the_linear_parts_are_the_full_models_matrix(problem, inner) -> None:
    """The elastic matrix on the modes is what the sparse one gives, whatever the layers' constants."""
    basis = scaled_basis(random_modes(problem, inner, 3), inner)
    parts = whole_linear_parts(problem, basis)
    s = problem.space
    mu, lam = np.where(problem.mesh.cutis, 2.0, 3.0), np.where(problem.mesh.cutis, 5.0, 7.0)
    n = 3 * s.n_nodes
    matrix = sp.lil_matrix((n, n))
    for e in range(len(s.nodes_u)):
        dofs = (3 * s.nodes_u[e][:, None] + np.arange(3)).ravel()
        block = np.zeros((len(dofs), len(dofs)))
        for q in range(s.weight.shape[1]):
            g = s.grad_u[e, q]  # (3, a)
            b = np.einsum("ja,ik->aikj", g, np.eye(3)).reshape(len(dofs), 3, 3)
            sym, trace = b + b.transpose(0, 2, 1), np.trace(b, axis1=1, axis2=2)
            block += s.weight[e, q] * (
                mu[e] * np.einsum("aij,bij->ab", b, sym) + lam[e] * np.outer(trace, trace)
            )
        matrix[np.ix_(dofs, dofs)] += block
    expected = basis.fields @ (matrix.tocsr() @ basis.fields.T)
    computed = np.einsum("l,lij->ij", [2.0, 3.0], parts.shear) + np.einsum(
        "l,lij->ij", [5.0, 7.0], parts.bulk
    )
    np.testing.assert_allclose(computed, expected, rtol=0, atol=1e-6 * np.abs(expected).max())


def test_a_set_has_the_modes_of_its_members_beside_the_base_models(problem, inner) -> None:
    kinds = {BASE: 6, "a": 5, "b": 4}
    weighted = {
        kind: random_modes(problem, inner, count, seed) for seed, (kind, count) in enumerate(kinds.items())
    }
    own = modes_of(weighted[BASE], inner, (4, 3))
    modes = Library(own, {name: modes_beyond(own, weighted[name], inner, (2, 2)) for name in "ab"})
    basis = modes.basis(("a", "b"), inner)
    assert len(basis.displacement) == 4 + 2 + 2
    assert len(basis.pressure) == 1 + 3 + 2 + 2
    gram = basis.displacement @ inner.displacement @ basis.displacement.T
    np.testing.assert_allclose(gram / gram[0, 0], np.eye(8), atol=1e-8)
    alone = modes.basis((), inner)
    np.testing.assert_allclose(alone.displacement, basis.displacement[:4], rtol=1e-12)


def test_a_flat_arm_has_no_radius_to_leave() -> None:
    flat = replace(TRAINED, geometry=Geometry(arm_radius_m=None))
    assert outside(flat, THETA, (), Geometry(arm_radius_m=None), MOTION) == ""
    assert "round" in outside(flat, THETA, (), Geometry(), MOTION)


def test_a_state_beyond_all_measure_outweighs_no_other(problem, inner) -> None:
    at = point_fields(problem, scaled_basis(random_modes(problem, inner, 3), inner))
    shape = len(at.weight), at.gradient.shape[2] + at.pressure.shape[1]
    own, dual = CubatureSettings(), np.ones(shape[1])
    integrand = np.random.default_rng(2).standard_normal(shape)
    rows = {
        size: rows_of_state(size * integrand, dual, at, 1.0, own, np.random.default_rng(3))
        for size in (1.0, 10.0, 1e9)
    }
    norms = {size: np.linalg.norm(r, axis=1).max() for size, r in rows.items()}
    assert norms[1.0] < 0.1 * own.most
    np.testing.assert_allclose(rows[10.0], 10.0 * rows[1.0], rtol=1e-4)
    assert norms[1e9] == pytest.approx(own.most, rel=1e-4)
