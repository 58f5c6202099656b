"""The posterior by an emulator is that by the force itself, on a skin in closed form."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import pytest
from toys import closed_form_reduced
from toys.closed_form_reduced import TRUTH, Exact

from bayeskin.mismatch import emulate as emulate_module
from bayeskin.mismatch.context import DiagnosisContext
from bayeskin.mismatch.emulate import EmulatedPosterior, EmulationSettings, Forces, emulate
from bayeskin.mismatch.fit import fit_near
from bayeskin.mismatch.resample import ResampleSettings, resample
from bayeskin.mismatch.trust_region import SetFit, fit_set, within
from bayeskin.mismatch.wrapper import innermost
from bayeskin.surrogates import train
from bayeskin.types import Array, Design, Surrogate

SETS = ((), ("force-offset",))
FEW = EmulationSettings(points=30)


@pytest.fixture(scope="module", params=SETS, ids=["base", "offset"])
def fitted(request: pytest.FixtureRequest) -> Iterator[tuple[DiagnosisContext, SetFit]]:
    names = request.param
    recorded = closed_form_reduced.recorded(3, **({"F0": -0.03} if names else {}))
    with pytest.MonkeyPatch.context() as patch:
        bench = closed_form_reduced.bench(patch, recorded)
        set_fit = fit_set(names, {**bench.noise, **TRUTH, "F0": 0.0}, bench.run, bench.posterior)
        assert isinstance(set_fit, SetFit)
        yield bench, set_fit


Answers = Sequence[Array | str]


def by_the_toy(bench: DiagnosisContext, names: tuple[str, ...], asked: list[int]) -> Forces:
    """Runs of the toy, which counts them; it is exact, so no full model is asked for."""

    def forces(points: Array, full: int) -> tuple[Answers, Answers]:
        assert full == 0
        asked.append(len(points))
        space = bench.space(names)
        return [bench.force(names, dict(zip(space.names, row, strict=True))) for row in points], []

    return forces


def learnt(design: Design) -> Surrogate:
    return train(design, "gp", 1)[0]


def emulation(
    fitted: tuple[DiagnosisContext, SetFit], asked: list[int], settings: EmulationSettings = FEW
) -> EmulatedPosterior:
    """The posterior that is learnt from runs of the toy."""
    bench, set_fit = fitted
    forces = by_the_toy(bench, set_fit.fit.names, asked)
    emulated = emulate([set_fit], forces, learnt, closed_form_reduced.NOISE_N, 1, settings)
    assert isinstance(emulated, EmulatedPosterior)
    return emulated


@pytest.fixture
def few_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few steps for the draws of the last wave, where a test asks for no draws."""
    few = functools.partial(ResampleSettings, legs=FEW.steps, modes=0)
    monkeypatch.setattr(emulate_module, "ResampleSettings", few)


@pytest.fixture(scope="module")
def emulated_with_counts(fitted: tuple[DiagnosisContext, SetFit]) -> tuple[EmulatedPosterior, list[int]]:
    """An emulation, and how many runs it asked for in each wave."""
    asked: list[int] = []
    return emulation(fitted, asked), asked


def test_it_ends_as_soon_as_fresh_runs_agree(
    fitted: tuple[DiagnosisContext, SetFit], emulated_with_counts: tuple[EmulatedPosterior, list[int]]
) -> None:
    _, set_fit = fitted
    emulated, asked = emulated_with_counts
    assert emulated.settled
    assert emulated.error_n is not None
    assert emulated.error_n < FEW.enough * closed_form_reduced.NOISE_N
    assert emulated.runs == sum(asked) == FEW.points + FEW.further_points
    assert emulated.fit.value == pytest.approx(set_fit.fit.value, abs=1.0)
    low, high = np.quantile(emulated.draws.draws, [0.01, 0.99], axis=0)
    truth = [{**TRUTH, "F0": -0.03}.get(name, np.nan) for name in emulated.draws.names]
    inside = [bool(a < t < b) for a, t, b in zip(low, truth, high, strict=True) if np.isfinite(t)]
    assert sum(inside) >= len(inside) - 1


@pytest.mark.parametrize("fitted", SETS[:1], ids=["base"], indirect=True)
@pytest.mark.usefixtures("few_steps")
def test_the_first_points_are_about_all_maxima(
    fitted: tuple[DiagnosisContext, SetFit], monkeypatch: pytest.MonkeyPatch
) -> None:
    bench, set_fit = fitted
    softer = {name: 0.7 * TRUTH[name] for name in ("E_c", "E_s")}
    recorded = closed_form_reduced.recorded(3)
    elsewhere = closed_form_reduced.bench(
        monkeypatch, dataclasses.replace(recorded, force_n=0.7 * recorded.force_n)
    )
    start = {**elsewhere.noise, **TRUTH, **softer, "F0": 0.0}
    other = fit_set(set_fit.fit.names, start, elsewhere.run, elsewhere.posterior)
    assert isinstance(other, SetFit)
    run, waves = by_the_toy(bench, set_fit.fit.names, []), list[Array]()

    def forces(points: Array, full: int) -> tuple[Answers, Answers]:
        waves.append(points)
        return run(points, full)

    emulated = emulate([set_fit, other], forces, learnt, closed_form_reduced.NOISE_N, 1, FEW)
    assert not isinstance(emulated, str)
    np.testing.assert_array_equal(waves[0][-2:], [set_fit.run.theta, other.run.theta])
    unit = bench.space(set_fit.fit.names).to_unit
    at, first, second = unit(waves[0][:-2]), unit(set_fit.run.theta), unit(other.run.theta)
    assert np.linalg.norm(first - second) > 0.05
    nearer = np.linalg.norm(at - second, axis=1) < np.linalg.norm(at - first, axis=1)
    assert 0.2 < nearer.mean() < 0.8


@pytest.mark.slow
def test_it_is_the_posterior_by_the_force_itself(
    fitted: tuple[DiagnosisContext, SetFit], emulated_with_counts: tuple[EmulatedPosterior, list[int]]
) -> None:
    _, set_fit = fitted
    emulated, _ = emulated_with_counts
    about = set_fit.fit.log_posterior
    exact = Exact(innermost(about.surrogate).space)
    seen = dataclasses.replace(about.surrogate, inner=exact) if set_fit.fit.names else exact
    whole = dataclasses.replace(about, surrogate=seen)
    there = fit_near(set_fit.fit.names, whole, emulated.fit.theta)
    assert emulated.fit.value == pytest.approx(there.value, abs=1.0)
    # Permeabilities that change places make almost the same force: the toy has another mode far away.
    near = within(whole, whole.vector(there.theta), 0.2)
    right = resample(dataclasses.replace(there, log_posterior=near), 2, ResampleSettings(legs=(120,)))
    draws = [whole.to_sampling(sample.draws) for sample in (emulated.draws, right)]
    of_force = slice(0, whole.surrogate.space.dim)
    (mean, sd), (exact_mean, exact_sd) = (
        (values[:, of_force].mean(axis=0), values[:, of_force].std(axis=0)) for values in draws
    )
    assert np.all(np.abs(mean - exact_mean) < 0.4 * exact_sd)
    assert np.all(np.abs(np.log(sd / exact_sd)) < np.log(1.5))


@pytest.mark.parametrize("fitted", SETS[:1], ids=["base"], indirect=True)
def test_the_same_seed_gives_the_same_draws(
    fitted: tuple[DiagnosisContext, SetFit], emulated_with_counts: tuple[EmulatedPosterior, list[int]]
) -> None:
    np.testing.assert_array_equal(emulation(fitted, []).draws.draws, emulated_with_counts[0].draws.draws)


@pytest.mark.parametrize("fitted", SETS[:1], ids=["base"], indirect=True)
@pytest.mark.usefixtures("few_steps")
def test_runs_that_fail_are_done_without_and_are_the_answer_where_all_do(
    fitted: tuple[DiagnosisContext, SetFit],
) -> None:
    bench, set_fit = fitted
    run = by_the_toy(bench, set_fit.fit.names, [])

    def some(points: Array, full: int) -> tuple[Answers, Answers]:
        return [
            "near folding" if i % 5 == 4 else force_n for i, force_n in enumerate(run(points, full)[0])
        ], []

    def none(points: Array, full: int) -> tuple[Answers, Answers]:
        return ["near folding"] * len(points), []

    emulated = emulate(
        [set_fit], some, learnt, closed_form_reduced.NOISE_N, 1, dataclasses.replace(FEW, waves=2)
    )
    assert not isinstance(emulated, str)
    assert emulated.runs == 24 + 16
    assert emulate([set_fit], none, learnt, closed_form_reduced.NOISE_N, 1, FEW) == "near folding"


MIDDLE = 0.5 * (closed_form_reduced.EDGES_S[1:] + closed_form_reduced.EDGES_S[:-1])


@pytest.mark.usefixtures("few_steps")
def test_an_error_that_changes_along_the_posterior_is_part_of_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The forward model lacks a force that depends on the skin: its values at the fit alone would mislead.

    One of the full runs about it fails.
    """
    shape = 5e-3 * np.sin(MIDDLE / 3.0)

    def off(values: Mapping[str, float]) -> Array:
        return shape * (1.0 + 10.0 * np.log(values["E_s"] / TRUTH["E_s"]))

    recorded = closed_form_reduced.recorded(3)
    recorded = dataclasses.replace(recorded, force_n=recorded.force_n + off(TRUTH))
    bench = closed_form_reduced.bench(monkeypatch, recorded)
    start = {**bench.noise, **TRUTH}
    aside = off({**TRUTH, "E_s": 1.05 * TRUTH["E_s"]})  # where the fit was checked
    local = functools.partial(bench.posterior, correction_n=aside)
    set_fit = fit_set((), start, bench.run, local, correction_n=aside)
    assert isinstance(set_fit, SetFit)
    run = by_the_toy(bench, (), [])
    asked: list[int] = []

    def forces(points: Array, count: int) -> tuple[Answers, Answers]:
        asked.append(count)
        names, forward = bench.space(()).names, run(points, 0)[0]
        full = [np.asarray(force) + off(dict(zip(names, row, strict=True)))
                for force, row in zip(forward[:count], points[:count], strict=True)]  # fmt: skip
        return forward, ["it folds", *full[1:]] if count else full

    emulated = emulate([set_fit], forces, learnt, closed_form_reduced.NOISE_N, 1, FEW)
    assert not isinstance(emulated, str)
    assert asked[0] == FEW.checks
    assert sum(asked) == FEW.checks
    allowed = emulated.fit.log_posterior.model_error
    assert allowed is not None
    assert allowed.measured_n is not None
    assert len(allowed.measured_n) == 1 + FEW.checks - 1
    assert np.abs(allowed.measured_n).max() > 0.1 * np.abs(shape).max()
    about = emulated.fit.log_posterior
    behind = emulated.fit.value - float(about.log_prob(about.vector({**emulated.fit.theta, **TRUTH}))[0])
    assert behind < 8.0


@pytest.mark.parametrize("fitted", SETS[:1], ids=["base"], indirect=True)
@pytest.mark.usefixtures("few_steps")
def test_one_wave_alone_is_never_settled(fitted: tuple[DiagnosisContext, SetFit]) -> None:
    emulated = emulation(fitted, [], dataclasses.replace(FEW, waves=1))
    assert emulated.error_n is None
    assert not emulated.settled


@pytest.mark.parametrize("fitted", SETS[:1], ids=["base"], indirect=True)
@pytest.mark.usefixtures("few_steps")
def test_an_emulator_that_is_sure_nowhere_is_believed_but_never_settled(
    fitted: tuple[DiagnosisContext, SetFit],
) -> None:
    emulated = emulation(fitted, [], dataclasses.replace(FEW, sure=1e-9, waves=2))
    assert np.isfinite(emulated.fit.value)
    assert not emulated.settled
