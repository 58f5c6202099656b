"""Nonlinear solves where Newton's own step goes too far, or leads nowhere."""

from __future__ import annotations

import re

import numpy as np
import pytest
import scipy.sparse as sp

from bayeskin.finite_element import stepping
from bayeskin.finite_element.lagrangian import LagrangianModel
from bayeskin.finite_element.mesh import layered_mesh
from bayeskin.finite_element.newton import Equations, NewtonSolver
from bayeskin.finite_element.problem import build_problem, material
from bayeskin.finite_element.relaxation import relax
from bayeskin.finite_element.stepping import StepSettings, integrate
from bayeskin.types import PadMotion


@pytest.mark.parametrize("start", [1.0, 3.0, -40.0])
def test_a_step_that_does_not_contract_is_damped(start: float) -> None:
    """arctan x = 0: undamped Newton diverges from |x| > 1.39."""
    equations = Equations(
        free=np.arange(2),
        residual=np.arctan,
        tangent=lambda x: (sp.csr_matrix(np.diag(1.0 / (1.0 + x**2))), sp.csr_matrix((2, 0))),
        weight=np.full(2, 1e8),
        scale=np.ones(2),
        place=np.zeros(1),
    )
    solution = NewtonSolver().solve(equations, np.array([start, 0.5 * start]))
    assert solution is not None
    np.testing.assert_allclose(solution, 0.0, atol=1e-7)


def arch(load: float) -> Equations:
    """Stationary points of x^4 / 12 - x^2 - load x + x p - p^2 / 2: a snapping arch with a pressure p = x.

    Without p: x^3 / 3 = x + load. Folds: x = -1 at load 2 / 3 and x = 1 at load -2 / 3.
    """
    return Equations(
        free=np.arange(2),
        residual=lambda x: np.array([x[0] ** 3 / 3 - 2 * x[0] - load + x[1], x[0] - x[1]]),
        tangent=lambda x: (sp.csr_matrix([[x[0] ** 2 - 2, 1.0], [1.0, -1.0]]), sp.csr_matrix((2, 0))),
        weight=np.full(2, 1e8),
        scale=np.ones(2),
        place=np.zeros(1),
    )


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_past_a_fold_a_fall_ends_in_the_next_equilibrium(side: float) -> None:
    load, before = side * 0.7, np.full(2, side * -1.05)
    assert NewtonSolver().solve(arch(load), before) is None
    solver = NewtonSolver()
    rest = relax(solver, arch(load), before, np.array([1.0, 0.0]))
    assert rest is not None
    np.testing.assert_allclose(rest, side * max(np.roots([1 / 3, 0, -1, -0.7]).real), atol=1e-7)
    assert solver.counts["falls"] == 1


def foldable() -> LagrangianModel:
    """Skin whose cutis, a thousand times softer than the subcutis, snaps beyond the guard."""
    beyond_guard = (36.5, 38.0, 41.0, 46.0, 60.0, 105.0)  # finer than the project's bricks, so that it folds
    x = (0.0, 9.0, 18.0, 26.0, 27.0, 33.0, 35.0, *beyond_guard)
    lines = [1e-3 * np.array(axis) for axis in (x, (0.0, 4.0, 5.0, 12.0, 18.0, 84.0), (0.0, 8.0, 10.0))]
    problem = build_problem(layered_mesh(lines, "coarse bricks"))
    theta = {"E_c": 2.3e5, "E_s": 2.24e8, "k_c": 1.4e-16, "k_s": 2.5e-13}
    motion = PadMotion(np.array([0.0, 9.4]), np.array([0.0, 6.7e-3]))
    return LagrangianModel(problem, material(theta, problem.mesh.cutis), motion)


def test_a_soft_cutis_on_a_stiff_subcutis_folds_and_the_run_goes_on() -> None:
    """Before and after it snaps the skin's reactions along x are in equilibrium."""
    model, steps = foldable(), []
    assert integrate(model, 700.0, 1e-3, steps.append) == ""
    assert steps[-1].state.time_s == pytest.approx(9.4)
    assert model.solver.counts["falls"] >= 1
    problem = model.problem
    supports = 3 * np.union1d(problem.pads, problem.space.facet_nodes("symmetry_x"))
    for step in steps[1:]:
        assert step.state.volume.min() > 0.5
        assert abs(step.stages[-1].residual[supports].sum()) < 1e-4 * step.force_n
    model.solver.release()


def test_a_run_that_folds_too_often_is_given_up_and_says_where(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stepping, "STEPPING", StepSettings(most_crawls=2))
    model = foldable()
    message = integrate(model, 700.0, 1e-3, lambda step: None)
    assert re.fullmatch(r"step \d+ at t = \S+ s: the skin has folded and snapped 1 times; try .*", message)
    model.solver.release()


def test_a_skin_that_folds_has_failed_where_falls_are_not_followed() -> None:
    model, steps = foldable(), []
    message = integrate(model, 700.0, 1e-3, steps.append, falls_too=False)
    assert re.fullmatch(r"step \d+ at t = \S+ s: the skin folds, or .*; try .*", message)
    assert model.solver.counts["falls"] == 0
    assert 0.0 < steps[-1].state.time_s < 9.4
    model.solver.release()
