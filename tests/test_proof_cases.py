"""The cases of the proof: what a seed draws, how large effects remain, and effects outside the catalogue."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from toys.quick_proof import SKIN, THETA

from bayeskin.errors import InputError
from bayeskin.finite_element.lagrangian import LagrangianModel
from bayeskin.finite_element.mesh import brick_mesh
from bayeskin.finite_element.problem import build_problem, material
from bayeskin.mechanisms import catalogue
from bayeskin.proof import seals
from bayeskin.proof.cases import draw
from bayeskin.proof.outside import OUTSIDE, Change
from bayeskin.proof.plans import CONCEALED, Plan, plans
from bayeskin.proof.protocol import MOTION
from bayeskin.proof.refit_residual import rms, windows
from bayeskin.proof.scoring.look_alikes import group_of
from bayeskin.types import PadMotion


def test_a_seed_decides_which_cases_there_are_and_another_gives_others() -> None:
    assert plans(7, 64) == plans(7, 64)
    assert [p.label for p in plans(7, 64)] != [p.label for p in plans(8, 64)]


@pytest.mark.parametrize("name", ["proof", "sizes", "nothing", "development"])
def test_the_seed_of_a_committed_set_draws_what_it_conceals(name: str) -> None:
    """Whatever the catalogue has since."""
    folder = Path(__file__).parents[1] / "data" / name / seals.SEALS
    asked = seals.read_json(folder / seals.SET)
    drawn = plans(asked["seed"], asked["count"], asked.get("only", ()))
    for number, plan in enumerate(drawn, 1):
        kept = seals.read_json(folder / f"{number:03d}.json")
        assert (kept["label"], kept["outside"]) == (plan.label, plan.outside)
        assert (tuple(kept["mechanisms"]), tuple(kept["numbers"])) == (plan.mechanisms, plan.numbers)
        assert (kept["kind"], kept["tetrahedra"]) == (plan.kind, plan.tetrahedra)


def test_a_set_of_64_has_every_mechanism_alone_and_at_least_15_effects_outside() -> None:
    drawn = plans(3, 64)
    of = {kind: [p for p in drawn if p.kind == kind] for kind in ("nothing", "alone", "pair", "outside")}
    assert {kind: len(some) for kind, some in of.items()} == {
        "nothing": 20,
        "alone": 22,
        "pair": 7,
        "outside": 15,
    }
    assert {p.label for p in of["alone"]} == set(CONCEALED)
    assert set(CONCEALED) <= set(catalogue())
    assert len({p.outside for p in of["outside"]}) == 15
    assert len(OUTSIDE) >= 15
    assert not set(OUTSIDE) & set(CONCEALED)
    assert sum(p.tetrahedra for p in drawn) >= 64 / 3


def test_a_set_of_what_was_asked_for_has_each_as_often_with_sizes_even_in_logarithm() -> None:
    drawn = plans(3, 18, ["nothing", "friction-creep", "breathing"])
    of = {name: [p for p in drawn if p.label == name] for name in ("nothing", "friction-creep", "breathing")}
    assert [len(some) for some in of.values()] == [6, 6, 6]
    assert {p.kind for p in of["nothing"]} == {"nothing"}
    assert {p.mechanisms for p in of["friction-creep"]} == {("device-friction", "friction-creep")}
    assert {p.outside for p in of["breathing"]} == {"breathing"}
    targets = sorted(p.target for p in of["friction-creep"])
    np.testing.assert_allclose(np.diff(np.log(targets)), np.log(30.0) / 6)
    assert (targets[0] * targets[-1]) == pytest.approx(30.0)
    assert len({p.numbers for p in drawn}) == 18
    assert sum(p.tetrahedra for p in drawn) == 7
    assert draw(of["friction-creep"][0], 0, SKIN).target == of["friction-creep"][0].target
    with pytest.raises(InputError, match=r"--only: pad-slop is not known; use one of nothing, backlash"):
        plans(3, 18, ["pad-slop"])


def test_the_order_of_a_set_tells_nothing_of_its_kinds() -> None:
    kinds = [p.kind for p in plans(3, 64)]
    assert max(kinds[:20].count("nothing"), kinds[-20:].count("nothing")) < 15


def test_a_pair_is_no_pair_of_look_alikes() -> None:
    for plan in plans(11, 256):
        if plan.kind == "pair":
            first, second = plan.mechanisms
            assert second not in group_of(first)


def test_a_draw_is_its_plan_s_alone_and_an_attempt_later_another() -> None:
    plan = Plan("force-offset", "alone", ("force-offset",), "", False, (1, 1, 0))
    screen = SKIN
    case = draw(plan, 0, screen)
    assert case == draw(plan, 0, screen)
    assert case.theta != draw(plan, 1, screen).theta
    space = screen.refit.surrogate.space
    assert space.contains([case.theta[name] for name in space.names])
    assert -0.15 <= case.values["F0"] <= 0.05


def test_nothing_remains_of_what_the_base_parameters_can_do() -> None:
    screen = SKIN
    theta = np.array([THETA[name] for name in screen.refit.surrogate.space.names])
    other = theta * [1.3, 0.8, 1.5, 0.7, 1.0]
    left = screen.refit.residual(screen.refit.force(other[None])[0], theta)
    assert rms(left) < 1e-6
    effect = screen.refit.force((theta * [1.002, 1.0, 1.0, 1.0, 1.0])[None]) - screen.refit.force(theta[None])
    assert rms(screen.refit.linear(effect, theta[None]))[0] < 1e-2 * rms(effect)[0]


def test_windows_are_where_the_remaining_effect_exceeds_the_floor() -> None:
    left = np.array([0.0, 3.0, -3.0, 0.5, 3.0])
    assert windows(left, 1.0, np.arange(6.0)) == [(1.0, 3.0), (4.0, 5.0)]
    assert windows(0.5 * np.ones(3), 1.0, np.arange(4.0)) == []


@pytest.fixture(scope="module")
def problem():
    return build_problem(brick_mesh(1))


@pytest.mark.parametrize("name", ["hardening", "strain-softening"])
def test_the_tangent_of_a_law_outside_is_the_derivative_of_its_residual(problem, name: str) -> None:
    change = OUTSIDE[name].change(0.3)
    bound = tuple(bind(THETA, problem.sites) for bind in change.laws)
    still = PadMotion(np.array([0.0, 1.0]), np.zeros(2))
    model = LagrangianModel(problem, material(THETA, problem.mesh.cutis), still, bound)
    rng, n = np.random.default_rng(0), 3 * problem.space.n_nodes
    x, direction = (
        np.concatenate([s * rng.standard_normal(n), 1e3 * rng.standard_normal(problem.space.n_corners)])
        for s in (2e-5, 2e-5)
    )
    old, free = model.initial_state(0.0), problem.pattern.free
    free_free, free_fixed = model.tangent(x, 0.7, old, 100.0)
    slope = free_free @ direction[free] + free_fixed @ direction[problem.pattern.fixed]
    step = 1e-4
    ends = [model.residual(x + sign * step * direction, 0.7, old, 100.0).residual for sign in (1, -1)]
    difference = (ends[0] - ends[1])[free] / (2 * step)
    np.testing.assert_allclose(slope, difference, rtol=0, atol=1e-5 * np.abs(difference).max())


def test_every_effect_outside_changes_something() -> None:
    none = Change()
    for name, outside in OUTSIDE.items():
        low, high = outside.strengths
        changes = [outside.change(strength) for strength in (low, high)]
        assert 0.0 < low < high, name
        for change in changes:
            parts = [
                getattr(change, part) != getattr(none, part)
                for part in ("constants", "geometry", "deep", "laws")
            ]
            time_s = np.linspace(0.0, 347.0, 701)
            force = change.reported(lambda t: np.atleast_2d(100.0 * MOTION.at(t)))(time_s)
            parts.append(not np.allclose(force, 100.0 * MOTION.at(time_s)))
            parts.append(not np.allclose(change.moved(MOTION).at(time_s), MOTION.at(time_s)))
            assert sum(parts) == 1, name
