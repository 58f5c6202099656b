"""Lengths of the tissue as parameters: moved nodes, and derivatives by them in both models."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain

import numpy as np
import pytest
from toys.same_steps import Model, on_steps_of, start_at_zero
from toys.snapshots import binds_of, full_model, snapshot_basis

from bayeskin.errors import InputError
from bayeskin.finite_element import lagrangian, series
from bayeskin.finite_element.gradients import ForceGradients
from bayeskin.finite_element.simulate import ModelSpec, problem_at, problem_of, simulate
from bayeskin.finite_element.stages import Step
from bayeskin.finite_element.stepping import integrate
from bayeskin.geometry import Geometry
from bayeskin.reduced import equations as equations_module
from bayeskin.reduced.basis import inner_products
from bayeskin.reduced.build import whole_space
from bayeskin.reduced.cases import Case
from bayeskin.reduced.equations import ReducedEquations
from bayeskin.reduced.operators import ReducedSpace
from bayeskin.reduced.sensitivities import ReducedGradients
from bayeskin.types import Array, PadMotion

SPEC = ModelSpec(refinement=0)
LENGTHS = {"cutis_m": 2.2e-3, "subcutis_m": 7e-3, "arm_radius_m": 45e-3}
THETA = {"E_c": 6e4, "E_s": 2e4, "k_c": 1e-14, "k_s": 5e-13, "p_init": 300.0}
MOTION = PadMotion(np.array([0.0, 4.0, 8.0, 12.0]), 1e-3 * np.array([0.0, 5.0, 5.0, 0.0]))
STRONG = {
    "solid-viscoelasticity": {"g_1": 0.8, "tau_1": 0.5, "g_2": 0.4, "tau_2": 30.0},
    "bottom-adherence": {"adherence": 3e6},
    "slow-recovery": {"recovery_compliance": 1e-3, "recovery_time": 10.0},
}
STILL = ("bottom-adherence", "solid-viscoelasticity")
IN_SERIES = ("slow-recovery", "solid-viscoelasticity")
CHANGED = (*LENGTHS, "E_s")
SETS = [  # of mechanisms, with the parameters that change
    ((), CHANGED),
    pytest.param(STILL, CHANGED, marks=pytest.mark.slow),
    (STILL[:1], ("subcutis_m",)),
    (IN_SERIES, CHANGED),
]


def theta_of(names: Sequence[str]) -> dict[str, float]:
    return THETA | LENGTHS | dict(chain.from_iterable(STRONG[name].items() for name in names))


def followed(
    model: Model, slopes: ForceGradients | ReducedGradients, tolerance: float
) -> tuple[list[Step], Array]:
    """Steps of a run, and the derivatives (n, r) of its force there."""
    steps: list[Step] = []

    def on_step(step: Step) -> None:
        steps.append(step)
        if step.stages:
            slopes.follow(step)
        start_at_zero(model, step)

    assert integrate(model, THETA["p_init"], tolerance, on_step, falls_too=False) == ""
    return steps, np.array(slopes.force_n)


def differences(
    model_at: Callable[[dict[str, float]], Model], theta: dict[str, float], along: Mapping[str, float],
    steps: list[Step],
) -> Array:  # fmt: skip
    """Derivatives (n,) of the force along logarithms of parameters, from two runs on the same steps."""
    ends = []
    for sign in (1.0, -1.0):
        model = model_at(theta | {name: (1.0 + 2e-3 * sign * by) * theta[name] for name, by in along.items()})
        ends.append(on_steps_of(model, theta["p_init"], steps))
        if not isinstance(model, ReducedEquations):
            model.solver.release()
    return (ends[0] - ends[1]) / 4e-3


@pytest.fixture
def tight(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lagrangian, "SOLVER_TOLERANCE", 1e-7)
    monkeypatch.setattr(equations_module, "SOLVER_TOLERANCE", 1e-9)
    monkeypatch.setattr(series, "SERIES_TOLERANCE", 1e-9)


@pytest.mark.usefixtures("tight")
@pytest.mark.parametrize(("names", "changed"), SETS, ids="+".join)
def test_the_reduced_models_derivatives_are_differences_of_runs(names, changed) -> None:
    theta, binds, problem = theta_of(names), binds_of(names), problem_of("bricks", 0)
    case = Case(theta, names, Geometry(), MOTION)
    basis = snapshot_basis(problem, inner_products(problem), case)

    def space_at(values: dict[str, float]) -> ReducedSpace:
        return whole_space(problem_at(SPEC, values), basis)

    def model_at(values: dict[str, float]) -> ReducedEquations:
        return ReducedEquations(space_at(values), values, binds, MOTION)

    model = model_at(theta)
    changes = {name: theta[name] for name in changed}
    slopes = ReducedGradients(model, theta, changes, binds, MOTION, space_at)
    steps, derivatives = followed(model, slopes, 1e-2)
    for name, column in zip(changes, derivatives.T, strict=True):
        right = differences(model_at, theta, {name: 1.0}, steps)
        assert np.abs(right).max() > 1e-3 * np.abs(derivatives).max()
        np.testing.assert_allclose(column, right, rtol=0, atol=2e-3 * np.abs(right).max(), err_msg=name)


@pytest.mark.usefixtures("tight")
@pytest.mark.parametrize("names", [(), pytest.param(STILL, marks=pytest.mark.slow)], ids="+".join)
def test_the_full_models_derivatives_are_differences_of_runs(names) -> None:
    theta, binds = theta_of(names), binds_of(names)

    def model_at(values: dict[str, float]) -> lagrangian.LagrangianModel:
        return full_model(problem_at(SPEC, values), Case(values, names, Geometry(), MOTION))

    model = model_at(theta)
    tissue = {"E_c": 1.0, "E_s": -0.5, "k_c": 0.7, "k_s": -0.3}
    changes = {name: theta[name] for name in (*LENGTHS, *tissue)}
    slopes = ForceGradients(model, theta, changes, binds, partial(problem_at, SPEC))
    steps, derivatives = followed(model, slopes, 1e-2)
    model.solver.release()
    for along in ({"cutis_m": 1.0}, {"subcutis_m": 1.0}, {"arm_radius_m": 1.0}, tissue):
        right = differences(model_at, theta, along, steps)
        computed = derivatives @ [along.get(name, 0.0) for name in changes]
        allowed = 1e-4 * np.abs(derivatives).max() + 1e-3 * np.abs(right).max()
        np.testing.assert_allclose(computed, right, rtol=0, atol=allowed, err_msg=str(along))


def test_lengths_among_the_parameters_move_the_nodes() -> None:
    moved = simulate(SPEC, MOTION, THETA | LENGTHS)
    stated = simulate(replace(SPEC, geometry=replace(Geometry(), **LENGTHS)), MOTION, THETA)
    np.testing.assert_allclose(moved.force_n, stated.force_n, rtol=0, atol=1e-9)
    assert moved.model_hash == SPEC.hash
    at_means = simulate(SPEC, MOTION, THETA | {name: getattr(Geometry(), name) for name in LENGTHS})
    np.testing.assert_array_equal(at_means.force_n, simulate(SPEC, MOTION, THETA).force_n)


def test_lengths_that_cannot_be_are_refused() -> None:
    with pytest.raises(InputError, match="cutis_m: it is 20 mm; it must be"):
        simulate(SPEC, MOTION, THETA | {"cutis_m": 20e-3})
