"""The force about a run, and the maximum that a fit reaches from run to run, on a skin in closed form."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pytest
from toys import closed_form_model, closed_form_reduced
from toys.closed_form_reduced import BASE, TRUTH, Exact, a_run
from toys.inference_problems import TRUTH as SKIN
from toys.inference_problems import ToySurrogate, toy_problem

from bayeskin.finite_element import ModelSpec
from bayeskin.forward.interface import ModelRun
from bayeskin.forward.surrogate import SurrogateForward
from bayeskin.inference.gauss_newton import gauss_newton
from bayeskin.inference.reparametrisation import shear_at
from bayeskin.mismatch.answers import answer, read_answer
from bayeskin.mismatch.context import DiagnosisContext
from bayeskin.mismatch.tangent import POWER, Tangent
from bayeskin.mismatch.tasks import FitTask
from bayeskin.mismatch.trust_region import SetFit, TrustSettings, fit_set, solved_columns, within
from bayeskin.mismatch.wrapper import innermost
from bayeskin.types import Correlation, ParameterSpace

SET = ("force-offset", "stiffness-drift")
START = {
    "E_c": 90e3, "E_s": 60e3, "k_c": 1e-13, "k_s": 1e-14, "p_init": 900.0,
    "F0": 0.0, "stiffness_rate": 0.0, "stiffness_time": 300.0,
}  # fmt: skip
PEAKED = dataclasses.replace(BASE.parameters[0], prior="log-normal", centre=150e3, spread=0.5)


@pytest.fixture(scope="module")
def bench() -> Iterator[DiagnosisContext]:
    with pytest.MonkeyPatch.context() as patch:
        yield closed_form_reduced.bench(
            patch, closed_form_reduced.recorded(0, F0=-0.03, stiffness_rate=-8e-4)
        )


def start(bench: DiagnosisContext) -> dict[str, float]:
    return {**bench.noise, **START}


def tangent(bench: DiagnosisContext, space: ParameterSpace = BASE) -> tuple[Tangent, ModelRun]:
    run = a_run(bench)
    assert run.slopes_n is not None
    return Tangent(space, closed_form_reduced.EDGES_S, (run,)), run


@pytest.mark.parametrize("first", [BASE.parameters[0], PEAKED], ids=["flat", "peaked"])
def test_a_tangent_has_the_value_and_the_slopes_of_its_run(bench: DiagnosisContext, first) -> None:
    space = ParameterSpace((first, *BASE.parameters[1:]))
    near, run = tangent(bench, space)
    prediction = near.predict(run.theta)
    np.testing.assert_allclose(prediction.mean[0], run.force_n, rtol=0, atol=1e-12)
    assert not prediction.sd().any()
    unit, step = space.box.to_unit(run.theta), 1e-5
    for i in range(space.dim):
        ends = space.box.from_unit(unit + step * np.outer([-1.0, 1.0], np.eye(space.dim)[i]))
        back, ahead = near.predict_mean(ends)
        np.testing.assert_allclose((ahead - back) / (2.0 * step), run.slopes_n[:, i], rtol=1e-5, atol=1e-9)
        back, ahead = Exact(BASE).predict_mean(ends)
        skin = (ahead - back) / (2.0 * step)  # between steps a force and its slope are interpolated each
        largest = np.abs(run.slopes_n[:, i]).max()
        np.testing.assert_allclose(skin, run.slopes_n[:, i], rtol=0, atol=1e-4 * largest)


def test_a_tangent_is_a_straight_line_in_the_box_of_what_is_no_modulus(bench: DiagnosisContext) -> None:
    near, run = tangent(bench)
    share = np.linspace(0.0, 1.0, 5)[:, None]
    others = run.theta * np.array([1.0, 1.0, 20.0, 0.1, 2.0])
    here, there = BASE.to_unit(run.theta), BASE.to_unit(others)
    mean = near.predict_mean(BASE.from_unit(here + share * (there - here)))
    np.testing.assert_allclose(mean, mean[0] + share * (mean[-1] - mean[0]), rtol=0, atol=1e-12)
    assert np.abs(mean[-1] - mean[0]).max() > 0.01


@pytest.mark.parametrize("factor", [0.3, 4.0])
def test_moduli_times_c_and_permeabilities_over_c_pull_c_times_as_hard(
    bench: DiagnosisContext, factor: float
) -> None:
    """Far from the run, too, if its slopes have it: by Euler, those of moduli and permeabilities add up."""
    run = a_run(bench)
    assert run.slopes_n is not None
    width = np.log(BASE.upper[:4] / BASE.lower[:4])
    by_log = run.slopes_n[:, :4] / width
    by_log[:, 1] = run.force_n + by_log[:, 2] + by_log[:, 3] - by_log[:, 0]
    slopes_n = np.column_stack([by_log * width, run.slopes_n[:, 4:]])
    near = Tangent(BASE, closed_form_reduced.EDGES_S, (ModelRun(run.theta, run.force_n, slopes_n),))
    aside = run.theta * np.array([1.5, 0.7, 2.0, 0.4, 1.0])
    stiffer = aside * np.array([factor, factor, 1.0 / factor, 1.0 / factor, 1.0])
    for here, there in ((run.theta, run.theta * (stiffer / aside)), (aside, stiffer)):
        mean = near.predict_mean(np.array([here, there]))
        np.testing.assert_allclose(mean[1], factor * mean[0], rtol=1e-12, atol=1e-15)


def test_several_runs_are_all_met_with_their_slopes(bench: DiagnosisContext) -> None:
    first = a_run(bench)
    second = bench.run((), {**start(bench), "E_c": 130e3, "k_s": 6e-14})
    assert isinstance(second, ModelRun)
    near, step = Tangent(BASE, closed_form_reduced.EDGES_S, (first, second)), 1e-4
    between = Tangent(BASE, closed_form_reduced.EDGES_S, (first,)).predict_mean(second.theta)[0]
    assert np.abs(between - second.force_n).max() > 1e-3  # which one alone does not know
    for run in (first, second):
        assert run.slopes_n is not None
        np.testing.assert_allclose(near.predict_mean(run.theta)[0], run.force_n, rtol=0, atol=1e-9)
        unit = BASE.to_unit(run.theta)
        for i in range(BASE.dim):
            ends = BASE.from_unit(unit + step * np.outer([-1.0, 1.0], np.eye(BASE.dim)[i]))
            back, ahead = near.predict_mean(ends)
            np.testing.assert_allclose((ahead - back) / (2.0 * step), run.slopes_n[:, i], rtol=0, atol=2e-5)


@pytest.fixture(scope="module")
def highest(bench: DiagnosisContext) -> tuple[float, dict[str, float]]:
    """Log density and values of the highest top of the set's posterior by the skin itself, of many climbs."""
    about = bench.posterior(SET, [a_run(bench, SET)])
    seen: Any = about.surrogate  # what the instrument does, about the skin
    exact = dataclasses.replace(seen, inner=Exact(innermost(seen).space))
    whole = dataclasses.replace(about, surrogate=exact)
    low, high = whole.bounds
    rng = np.random.default_rng(0)
    truth = whole.vector({**start(bench), **TRUTH, "F0": -0.03, "stiffness_rate": -8e-4})
    starts = [truth, *(truth + 0.1 * rng.uniform(-1, 1, (6, len(low))) * (high - low))]
    top = max(
        (gauss_newton(whole, np.clip(x, low, high), None) for x in starts), key=lambda optimum: optimum.value
    )
    return top.value, whole.named(whole.from_sampling(top.vector))


def test_a_fit_reaches_the_maximum_of_the_skin_itself(
    bench: DiagnosisContext, highest: tuple[float, dict[str, float]]
) -> None:
    set_fit = fit_set(SET, start(bench), bench.run, bench.posterior)
    value, theta = highest
    assert isinstance(set_fit, SetFit)
    assert set_fit.settled
    assert set_fit.fit.names == SET
    assert set_fit.fit.value == pytest.approx(value, abs=2.0 * TrustSettings().enough)
    deviations = np.sqrt(np.diag(set_fit.fit.covariance))
    low, high = set_fit.fit.log_posterior.bounds
    there = (set_fit.fit.log_posterior.vector(theta) - low) / (high - low)
    assert np.all(np.abs(set_fit.fit.unit - there) < np.maximum(1.5 * deviations, 0.01))
    assert set_fit.fit.theta["F0"] == pytest.approx(-0.03, abs=2e-3)
    np.testing.assert_allclose(set_fit.fit.mean_n, set_fit.fit.log_posterior.binned.force_n, atol=0.05)
    at_run = [set_fit.fit.theta[name] for name in set_fit.fit.log_posterior.surrogate.space.names]
    np.testing.assert_allclose(set_fit.run.theta[:5], at_run[:5], rtol=1e-6)


def test_what_is_added_to_the_force_is_part_of_each_run(bench: DiagnosisContext) -> None:
    """A recording by the reduced model and more is fitted as the recording by the reduced model alone."""
    plain = fit_set(SET, start(bench), bench.run, bench.posterior)
    correction_n = 5e-3 * np.sin(np.arange(len(bench.binned.force_n)) / 7.0)
    binned = dataclasses.replace(bench.binned, force_n=bench.binned.force_n + correction_n)
    other = dataclasses.replace(bench, binned=binned)
    set_fit = fit_set(SET, start(bench), other.run, other.posterior, correction_n=correction_n)
    assert isinstance(plain, SetFit)
    assert isinstance(set_fit, SetFit)
    assert set_fit.fit.value == pytest.approx(plain.fit.value, abs=0.2)
    assert set_fit.fit.theta["F0"] == pytest.approx(plain.fit.theta["F0"], abs=2e-4)
    alone = bench.run(SET, set_fit.fit.theta)
    assert isinstance(alone, ModelRun)
    np.testing.assert_allclose(set_fit.run.force_n, alone.force_n + correction_n, atol=1e-6)
    np.testing.assert_array_equal(set_fit.correction_n, correction_n)
    assert not plain.correction_n.any()


class Unsteady:
    """Runs of a bench, some of which fail."""

    def __init__(self, bench: DiagnosisContext, failing: Sequence[int]) -> None:
        self.bench, self.failing, self.count = bench, failing, 0

    def __call__(self, names: Sequence[str], theta: Mapping[str, float]) -> ModelRun | str:
        self.count += 1
        return "near folding" if self.count in self.failing else self.bench.run(names, theta)


@pytest.mark.parametrize("failing", [(2,), (3,), (2, 4)])
def test_a_fit_goes_on_where_a_run_in_the_middle_fails(
    bench: DiagnosisContext, highest: tuple[float, dict[str, float]], failing: tuple[int, ...]
) -> None:
    skin = Unsteady(bench, failing)
    set_fit = fit_set(SET, start(bench), skin, bench.posterior, TrustSettings(runs=14))
    assert isinstance(set_fit, SetFit)
    assert set_fit.runs == skin.count > max(failing)
    assert set_fit.settled
    assert set_fit.fit.value == pytest.approx(highest[0], abs=2.0 * TrustSettings().enough)


def test_a_fit_whose_first_run_fails_is_its_message(bench: DiagnosisContext) -> None:
    skin = Unsteady(bench, (1,))
    assert fit_set(SET, start(bench), skin, bench.posterior) == "near folding"
    assert skin.count == 1


def test_a_fit_is_the_first_run_s_where_all_others_fail(bench: DiagnosisContext) -> None:
    set_fit = fit_set(SET, start(bench), Unsteady(bench, range(2, 99)), bench.posterior)
    assert isinstance(set_fit, SetFit)
    assert not set_fit.settled
    np.testing.assert_array_equal(set_fit.run.theta[:5], [START[name] for name in BASE.names])


def test_a_fit_takes_shorter_steps_where_long_ones_fail(
    bench: DiagnosisContext, highest: tuple[float, dict[str, float]]
) -> None:
    last, failed = np.array([START["E_c"], START["E_s"]]), []

    def skin(names: Sequence[str], theta: Mapping[str, float]) -> ModelRun | str:
        """Runs as far as moduli change by a third since the last run."""
        nonlocal last
        moduli = np.array([theta["E_c"], theta["E_s"]])
        if np.max(np.abs(np.log(moduli / last))) > np.log(4.0 / 3.0):
            failed.append(moduli)
            return "near folding"
        last = moduli
        return bench.run(names, theta)

    set_fit = fit_set(SET, start(bench), skin, bench.posterior, TrustSettings(runs=30))
    assert isinstance(set_fit, SetFit)
    assert failed
    assert set_fit.settled
    assert set_fit.fit.value == pytest.approx(highest[0], abs=2.0 * TrustSettings().enough)


@pytest.mark.parametrize("power", [1.0, POWER])
def test_a_sum_of_powers_of_moduli_stays_on_the_ridge_that_a_shear_knows(
    bench: DiagnosisContext, power: float
) -> None:
    about = bench.posterior(SET, [a_run(bench, SET)])
    vector = about.vector({**start(bench), **TRUTH, "stiffness_rate": 0.0, "F0": 0.0})
    ridge = shear_at(about, vector, power)
    assert ridge is not None
    np.testing.assert_array_equal(np.flatnonzero(ridge.group), [0, 1])
    aside = np.zeros(about.dim)
    aside[:2] = [0.3, -0.3]
    there = ridge.back(ridge.straight(vector[None]) + np.array([0.0, -0.5, *np.zeros(about.dim - 2)]))[0]
    assert there[1] < vector[1] - 0.1 < vector[0] + 0.05 < there[0]
    share = np.exp(ridge.log_weight[:2] + power * vector[:2])
    sums = [float(share @ np.exp(power * (point - vector)[:2])) for point in (vector, there)]
    assert sums[1] == pytest.approx(sums[0], rel=1e-9)
    force_n = about.predict_mean(about.from_sampling(np.array([vector, there, vector + aside])))
    here, along, across = force_n @ about.binned.force_n
    assert abs(along - here) < (0.03 if power == POWER else 0.15) * abs(across - here)


def test_a_step_that_fails_shortens_the_next_along_what_moved_far(bench: DiagnosisContext) -> None:
    last, failed = START["k_s"], 0

    def skin(names: Sequence[str], theta: Mapping[str, float]) -> ModelRun | str:
        """Runs as far as one permeability changes by a quarter since the last run."""
        nonlocal last, failed
        if abs(np.log(theta["k_s"] / last)) > np.log(1.25):
            failed += 1
            return "near folding"
        last = theta["k_s"]
        return bench.run(names, theta)

    set_fit = fit_set(SET, start(bench), skin, bench.posterior, TrustSettings(runs=4))
    assert isinstance(set_fit, SetFit)
    assert failed
    stiffness = [2e-6 * theta["E_c"] + 4e-6 * theta["E_s"] for theta in (set_fit.fit.theta, TRUTH, START)]
    assert stiffness[0] == pytest.approx(stiffness[1], rel=0.05)  # moduli have gone all the way meanwhile
    assert stiffness[2] != pytest.approx(stiffness[1], rel=0.1)


def test_a_fit_does_not_go_on_from_a_run_that_is_worse(bench: DiagnosisContext) -> None:
    runs: list[ModelRun] = []

    def skin(names: Sequence[str], theta: Mapping[str, float]) -> ModelRun | str:
        """Whose third run pulls ten times as hard as the second's slopes say."""
        run = bench.run(names, theta)
        assert isinstance(run, ModelRun)
        runs.append(dataclasses.replace(run, force_n=(10.0 if len(runs) == 2 else 1.0) * run.force_n))
        return runs[-1]

    set_fit = fit_set(SET, start(bench), skin, bench.posterior, TrustSettings(runs=3))
    assert isinstance(set_fit, SetFit)
    assert len(runs) == set_fit.runs == 3
    assert set_fit.run is runs[1]


@pytest.mark.parametrize("runs", [1, 2, 3, 5])
def test_no_more_runs_are_made_than_asked_for_and_more_are_never_worse(
    bench: DiagnosisContext, runs: int
) -> None:
    values = []
    for most in (runs, runs + 1):
        skin = Unsteady(bench, ())
        set_fit = fit_set(SET, start(bench), skin, bench.posterior, TrustSettings(runs=most))
        assert isinstance(set_fit, SetFit)
        assert skin.count == set_fit.runs <= most
        values.append(set_fit.fit.value)
    assert values[1] >= values[0] - 1e-9


@pytest.mark.parametrize("reach", [0.0, 0.15])
def test_a_trust_region_holds_what_the_model_solves_and_nothing_else(
    bench: DiagnosisContext, reach: float
) -> None:
    about = bench.posterior(SET, [a_run(bench, SET)])
    space, (low, high) = about.surrogate.space, about.bounds
    assert [n for n, held in zip(space.names, solved_columns(about), strict=True) if not held] == ["F0"]
    vector = np.clip(about.vector({**start(bench), **TRUTH}), low, high)
    near = within(about, vector, reach)
    lower, upper = near.bounds
    held = np.append(solved_columns(about), np.zeros(about.dim - space.dim, bool))
    far = max(reach, 1e-9) * (high - low)
    np.testing.assert_allclose(lower[held], np.maximum(vector - far, low)[held], rtol=0, atol=1e-9)
    np.testing.assert_allclose(upper[held], np.minimum(vector + far, high)[held], rtol=0, atol=1e-9)
    np.testing.assert_array_equal((lower[~held], upper[~held]), (low[~held], high[~held]))
    assert near.names == about.names


def test_priors_that_go_together_do_so_in_a_fit_and_its_trust_region(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    other = dataclasses.replace(BASE.parameters[1], prior="log-normal", centre=30e3, spread=0.5)
    together = (Correlation("E_c", "E_s", 0.6),)
    base = ParameterSpace((PEAKED, other, *BASE.parameters[2:]), together)
    bench = closed_form_reduced.bench(monkeypatch, closed_form_reduced.recorded(0), base)
    for names in ((), ("force-offset",), SET):
        about = bench.posterior(names, [a_run(bench, names)])
        assert about.space.correlations == together
        vector = np.clip(about.vector({**start(bench), **TRUTH}), *about.bounds)
        assert within(about, vector, 0.1).space.correlations == together


def test_what_lies_in_series_goes_by_its_shortcut_where_a_surrogate_is_the_skin() -> None:
    skin: Any = ToySurrogate()
    binned = toy_problem().binned
    forward = SurrogateForward(skin, ModelSpec())
    bench = DiagnosisContext(
        binned, closed_form_reduced.NO_WORD, closed_form_model.MOTION, forward, skin.space, 1
    )
    assert "slow-recovery" in bench.known
    names = ("slow-recovery",)
    assert bench.space(names).names == skin.space.names
    values = {"recovery_compliance": 1e-3, "recovery_time": 20.0}
    task = FitTask(names, {**bench.noise, **SKIN, **values}, 4)
    set_fit = read_answer(bench, task, answer(bench, task))
    assert isinstance(set_fit, SetFit)
    assert set(values) <= set(set_fit.fit.theta)
    plain = bench.reported(names, {**set_fit.fit.theta, "recovery_compliance": 0.0})
    slower = bench.reported(names, {**set_fit.fit.theta, **values})
    assert np.abs(np.asarray(slower) - np.asarray(plain)).max() > 1e-3
