"""The reduced model against the full one, on the modes of its own run: what lies in series, and memory."""

from __future__ import annotations

from itertools import chain

import numpy as np
import pytest
from toys.same_steps import on_steps_of, run
from toys.snapshots import binds_of, full_model, snapshot_basis

from bayeskin.finite_element.mesh import brick_mesh
from bayeskin.finite_element.problem import build_problem
from bayeskin.geometry import Geometry
from bayeskin.reduced.basis import inner_products
from bayeskin.reduced.build import whole_space
from bayeskin.reduced.cases import Case
from bayeskin.reduced.cubature import CubatureSettings, take
from bayeskin.reduced.equations import ReducedEquations
from bayeskin.reduced.shadow import Shadow
from bayeskin.types import PadMotion

THETA = {"E_c": 6e4, "E_s": 2e4, "k_c": 1e-14, "k_s": 5e-13, "p_init": 300.0}
MOTION = PadMotion(np.array([0.0, 4.0, 8.0, 12.0]), 1e-3 * np.array([0.0, 5.0, 5.0, 0.0]))
STRONG = {
    "backlash": {"gap": 2e-4, "frame_compliance": 1e-3},
    "pad-slip": {"slip_rate": 2e-4, "slip_threshold": 0.02},
    "slow-recovery": {"recovery_compliance": 1e-3, "recovery_time": 10.0},
    "pre-stretch": {"opening": 0.05},
    "solid-viscoelasticity": {"g_1": 0.8, "tau_1": 0.5, "g_2": 0.4, "tau_2": 30.0},
    "bottom-adherence": {"adherence": 3e6},
}
IN_SERIES = ("backlash", "pad-slip", "slow-recovery")
TOGETHER = ("pre-stretch", "slow-recovery", "solid-viscoelasticity")
SETS = [(), *((name,) for name in STRONG), IN_SERIES, TOGETHER]


def case_of(*names: str) -> Case:
    values = dict(chain.from_iterable(STRONG[name].items() for name in names))
    return Case(THETA | values, names, Geometry(), MOTION)


@pytest.fixture(scope="session")
def problem():
    return build_problem(brick_mesh(0))


@pytest.fixture(scope="session")
def inner(problem):
    return inner_products(problem)


@pytest.mark.parametrize("names", SETS, ids="+".join)
def test_the_force_is_the_full_models_on_the_same_steps(problem, inner, names):
    case = case_of(*names)
    full = full_model(problem, case)
    steps = run(full, case.theta["p_init"])
    full.solver.release()
    space = whole_space(problem, snapshot_basis(problem, inner, case))
    reduced = ReducedEquations(space, case.theta, binds_of(names), MOTION)
    forces_n = np.array([step.force_n for step in steps])
    found_n = on_steps_of(reduced, case.theta["p_init"], steps)
    peak_n = np.abs(forces_n - full.zero_n).max()
    assert reduced.nominal_force() == pytest.approx(full.nominal_force(), rel=1e-12)
    np.testing.assert_allclose(found_n, forces_n, rtol=0, atol=1e-4 * peak_n)


def test_a_run_for_a_cubature_zeroes_the_load_cell_where_the_test_starts(problem, inner):
    """All points as the chosen ones miss nothing, and pads that were opened pull before the test."""
    case = case_of(*TOGETHER)
    p_init, binds = case.theta["p_init"], binds_of(TOGETHER)
    space = whole_space(problem, snapshot_basis(problem, inner, case))
    reduced = ReducedEquations(space, case.theta, binds, MOTION)
    shadow, settings = Shadow(space, case.theta, binds, MOTION), CubatureSettings()
    taken = take(reduced, shadow, p_init, settings, np.random.default_rng(0), tolerance=1e-3)
    assert taken.message == ""
    full = full_model(problem, case)
    run(full, p_init)
    full.solver.release()
    assert full.zero_n > 0.02
    assert reduced.zero_n == pytest.approx(full.zero_n, rel=1e-3)
    assert np.abs(taken.missing).max() < 1e-4
