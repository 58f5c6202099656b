"""Derivatives of the force history against central differences over the same steps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from toys.same_steps import on_steps_of, start_at_zero

from bayeskin.errors import InputError
from bayeskin.finite_element import ModelSpec, lagrangian, series, simulate
from bayeskin.finite_element.balances import Evaluated
from bayeskin.finite_element.directional import TangentAction
from bayeskin.finite_element.gradients import ForceGradients, logarithms
from bayeskin.finite_element.lagrangian import LagrangianModel
from bayeskin.finite_element.problem import Material, material
from bayeskin.finite_element.simulate import problem_of
from bayeskin.finite_element.stages import Stage, State, Step
from bayeskin.finite_element.stepping import integrate
from bayeskin.finite_element.tissue import Bind
from bayeskin.mechanisms import catalogue, laws
from bayeskin.types import PadMotion

THETA = {"E_c": 6e4, "E_s": 2e4, "k_c": 1e-14, "k_s": 5e-13, "p_init": 700.0}
MOTION = PadMotion(np.array([0.0, 4.0, 20.0, 23.0]), np.array([0.0, 5e-3, 5e-3, 2e-3]))
WITH = {  # mechanisms, and values of their parameters away from neutral
    "base": {},
    "fibres": {
        "strain-stiffening": {"fibre_stress": 3e4, "k2": 3.0, "dispersion": 0.1},
        "fibre-anisotropy": {"langer_ratio": 2.0, "langer_angle": 0.5},
    },
    "memory": {
        "solid-viscoelasticity": {"g_1": 0.8, "tau_1": 0.5, "g_2": 0.4, "tau_2": 30.0},
        "bottom-adherence": {"adherence": 3e6},
        "preconditioning": {"damage": 0.3, "damage_energy": 2e3},
    },
    "skeleton": {"skeleton-compressibility": {"nu_c": 0.3, "nu_s": 0.1}},
    "solid": {
        "stiffness-drift": {"stiffness_rate": 1e-3, "stiffness_time": 60.0},
        "plastic-set": {"set_share": 0.3, "yield_stretch": 1.05},
    },
    "fluid": {
        "strain-dependent-permeability": {"M_k": 5.0},
        "fluid-leakage": {"leakage": 1e-10},
    },
    "series": {
        "pad-slip": {"slip_rate": 2e-4, "slip_threshold": 0.02},
        "slow-recovery": {"recovery_compliance": 1e-3, "recovery_time": 10.0},
        "backlash": {"gap": 1e-4, "frame_compliance": 5e-4},
    },
    "opened": {
        "pre-stretch": {"opening": 0.05},
        "slow-recovery": {"recovery_compliance": 1e-3, "recovery_time": 10.0},
    },
}

SLOWLY = ("fibres", "memory", "opened", "solid")


def model(theta: dict[str, float], laws: Sequence[Bind] = (), refinement: int = 1) -> LagrangianModel:
    problem = problem_of("bricks", refinement)
    bound = tuple(bind(theta, problem.sites) for bind in laws)
    return LagrangianModel(problem, material(theta, problem.mesh.cutis), MOTION, bound)


def directions(names: Sequence[str]) -> list[Counter[str]]:
    """Relative changes of parameters: twice of nearly all together, then of the others alone."""
    alone = [name for name in ("yield_stretch", "gap") if name in names]
    together = [name for name in names if name not in alone]
    rng = np.random.default_rng(1)
    changes = [Counter(dict(zip(together, 1e-3 * rng.uniform(-1.0, 1.0, len(together)), strict=True)))
               for _ in range(2)]  # fmt: skip
    # Few points begin to yield over a small change of the stretch.
    return changes + [Counter({name: 2e-6 if name == "yield_stretch" else 1e-3}) for name in alone]


def forces_on_the_same_steps(skin: LagrangianModel, p_init: float, steps: list[Step]) -> np.ndarray:
    forces = on_steps_of(skin, p_init, steps)
    skin.solver.release()
    return forces


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=[pytest.mark.slow] * (case in SLOWLY)) for case in WITH]
)
def test_derivatives_are_central_differences(monkeypatch, case):
    monkeypatch.setattr(lagrangian, "SOLVER_TOLERANCE", 1e-7)
    monkeypatch.setattr(series, "SERIES_TOLERANCE", 1e-9)
    refinement = 0
    theta = THETA | {name: value for values in WITH[case].values() for name, value in values.items()}
    binds = laws([catalogue()[name] for name in WITH[case]])
    skin, steps = model(theta, binds, refinement), []
    slopes = ForceGradients(skin, theta, theta, binds, lambda values: skin.problem)

    def on_step(step: Step) -> None:
        steps.append(step)
        if step.stages:
            slopes.follow(step)
        start_at_zero(skin, step)

    assert integrate(skin, theta["p_init"], 1e-2, on_step) == ""
    computed = np.array(slopes.force_n)
    largest = np.abs(computed).max()
    others = () if case == "base" else ("E_s", "k_c", "k_s", "p_init")  # "base" checks these
    for by in directions([name for name in theta if name not in others]):
        up, down = (
            forces_on_the_same_steps(model(varied, binds, refinement), varied["p_init"], steps)
            for varied in (
                {name: value * (1 + sign * by[name]) for name, value in theta.items()} for sign in (1, -1)
            )
        )
        smooth = np.array([not by["gap"] or not step.corner for step in steps])  # a gap moves the corners
        expected = computed @ np.array([by[name] for name in theta])
        errors = np.abs(0.5 * (up - down) - expected)[smooth]
        assert errors.max() < 1e-4 * largest * max(map(abs, by.values()))
    column = list(theta).index("k_s")
    assert np.abs(computed[:, column]).max() > 1e-3 * largest  # so that it says something


@pytest.mark.parametrize("h", [0.02, 20.0])
def test_the_exact_tangent_is_the_difference_of_residuals(h):
    skin, rng = model(THETA), np.random.default_rng(0)
    space, r = skin.problem.space, 3
    storing = np.full_like(skin.material.storage, 1e-4)  # enough to be seen
    skin.material = replace(skin.material, storage=storing)
    n, shape = 3 * space.n_nodes, space.weight.shape

    def drawn(u: float, p: float, *columns: int) -> np.ndarray:
        return np.concatenate(
            [u * rng.normal(size=(n, *columns)), p * rng.normal(size=(space.n_corners, *columns))]
        )

    x, along = drawn(2e-6, 500.0), drawn(1e-6, 300.0, r)
    x[:n] += (space.points_u.T @ np.array([[0.2, 0, 0], [0.1, -0.05, 0], [0, 0.03, -0.1]])).ravel()
    start = State(0.0, x, np.full(shape, 1.01), np.full(shape, 200.0))
    stage = Stage(State(h, x, start.volume, start.pressure), h, h, start, (), np.zeros(space.dofs))
    j_old, p_old = 1e-2 * rng.normal(size=(*shape, r)), 50.0 * rng.normal(size=(*shape, r))
    rates = tuple(a[:, None] * rng.normal(size=r) for a in (skin.material.mu, skin.material.lam))
    rates = (*rates, skin.material.mobility[:, None] * rng.normal(size=r))
    computed = TangentAction(skin, stage, rates, j_old, p_old)(along)
    for k in range(r):

        def at(by: float, k: int = k) -> Evaluated:
            old = State(0.0, x, start.volume + by * j_old[..., k], start.pressure + by * p_old[..., k])
            m, (mu, lam, mobility) = skin.material, (by * rate[:, k] for rate in rates)
            solid = Material(m.mu + mu, m.lam + lam, m.mobility + mobility, m.storage)
            return skin.residual(x + by * along[:, k], h, old, h, (solid, ()))

        up, down = at(1e-5), at(-1e-5)
        for mine, high, low in (
            (computed.residual[:n, k], up.residual[:n], down.residual[:n]),
            (computed.residual[n:, k], up.residual[n:], down.residual[n:]),
            (computed.volume[..., k], up.volume, down.volume),
            (computed.pressure[..., k], up.pressure, down.pressure),
        ):
            expected = (high - low) / 2e-5
            np.testing.assert_allclose(mine, expected, atol=1e-6 * np.abs(expected).max())


def test_a_run_carries_its_derivatives():
    run = simulate(ModelSpec(refinement=0), MOTION, THETA, gradients=logarithms(THETA))
    assert run.gradient_names == ("E_c", "E_s", "k_c", "k_s")
    assert run.gradient_n.shape == (len(run.time_s), 4)
    means = run.gradient_bin_means(np.linspace(0, 23, 24))
    assert means.shape == (23, 4)
    assert not simulate(
        ModelSpec(refinement=0), PadMotion(MOTION.time_s[:2], MOTION.displacement_m[:2]), THETA
    ).gradient_names


def test_the_articles_formulation_has_no_derivatives(tmp_path):
    spec = ModelSpec.__new__(ModelSpec)
    object.__setattr__(spec, "observation", "article")
    with pytest.raises(InputError, match="reaction"):
        simulate(spec, MOTION, THETA, gradients=logarithms(THETA))
