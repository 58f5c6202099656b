"""The parts of a diagnosis on the toy: fits, evidence, windows, draws."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest
from scipy.stats import kstest, norm
from toys import closed_form_model
from toys.inference_problems import NOISE, TRUTH, ToySurrogate, line_problem, toy_problem

from bayeskin.inference import LogPosterior, NoisePriors, find_map
from bayeskin.inference.convergence import Limits
from bayeskin.inference.gauss_newton import gauss_newton
from bayeskin.inference.model_error import ModelError
from bayeskin.inference.score_test import promise
from bayeskin.inference.surrogate_error import surrogate_error
from bayeskin.mechanisms import catalogue
from bayeskin.mismatch.fit import Fit, fit, fit_near, value_for_multiple
from bayeskin.mismatch.fit_starts import likely, other_skins
from bayeskin.mismatch.hypotheses import weight
from bayeskin.mismatch.locate import LocateSettings, exceedance_probability, locate, model_error
from bayeskin.mismatch.observed import ObservedSurrogate
from bayeskin.mismatch.refuted import refuted
from bayeskin.mismatch.resample import ResampleSettings, resample
from bayeskin.mismatch.stiffness_ratio import subcutis_too_stiff
from bayeskin.mismatch.wrapper import innermost
from bayeskin.types import Jumps, ParameterSpace

KNOWN = {
    name: catalogue()[name] for name in ("force-offset", "sensor-drift", "viscous-drag", "sensor-events")
}
NEUTRAL = {name: value for mechanism in KNOWN.values() for name, value in mechanism.neutral.items()}
QUIET = NoisePriors(sd_n=(1e-4, 6e-3), tau_s=(0.1, 5.0), nu=(4.0, 100.0))


def concealing(seed: int, names: Sequence[str] = (), **values: float) -> LogPosterior:
    """The toy's recording with mechanisms at work, and the posterior that knows of none."""
    plain = toy_problem(seed)
    mechanisms = tuple(KNOWN[name] for name in names)
    theta = [*TRUTH.values(), *(values[p.name] for mechanism in mechanisms for p in mechanism.parameters)]
    seen = ObservedSurrogate(ToySurrogate(), mechanisms, closed_form_model.MOTION).predict([theta]).mean[0]
    alone = ToySurrogate().predict([list(TRUTH.values())]).mean[0]
    binned = dataclasses.replace(plain.binned, force_n=plain.binned.force_n + seen - alone)
    return dataclasses.replace(plain, binned=binned, noise_priors=QUIET)


def fitted(alone: LogPosterior) -> Fit:
    """The best fit of the skin and the noise, from the middle of their priors."""
    middle = alone.named(alone.from_sampling(np.mean(alone.bounds, axis=0)))
    return fit((), alone, middle, {}, 1)


def building(alone: LogPosterior, names: Sequence[str]) -> LogPosterior:
    mechanisms = tuple(KNOWN[name] for name in names)
    if not mechanisms:
        return alone
    return dataclasses.replace(
        alone, surrogate=ObservedSurrogate(alone.surrogate, mechanisms, closed_form_model.MOTION)
    )


def test_the_chance_of_the_farthest_window_is_uniform_where_nothing_is_missing() -> None:
    fits = [fitted(alone) for alone in map(concealing, range(12))]
    chances = [locate(each_fit, each_fit.theta, 1).chance for each_fit in fits]
    assert kstest(chances, "uniform").pvalue > 0.01
    off = concealing(0, ("viscous-drag",), drag=30.0)
    assert locate(fitted(off), fits[0].theta, 1).chance < 1e-6


@pytest.mark.parametrize("share", [1e-3, 1e-2])
def test_what_the_model_is_wrong_by_is_no_mismatch(share: float) -> None:
    """The model errs by another amount in each phase, with an allowed sd below and above the noise's."""
    settings, chances = LocateSettings(mesh_error=share, draws=400), []
    for seed in range(30):
        alone = concealing(seed)
        binned = alone.binned
        normals = np.random.default_rng([seed, 1]).standard_normal(len(binned.phases))
        error_n = model_error(alone, settings) * normals
        binned = dataclasses.replace(binned, force_n=binned.force_n + error_n[binned.phase])
        off = dataclasses.replace(alone, binned=binned)
        at = Fit((), off, {**TRUTH, **NOISE}, 0.0, 0.0, 1e-6 * np.eye(off.dim), np.zeros(3))
        chances.append(locate(at, at.theta, seed, settings).chance)
    assert np.sum(np.array(chances) < 0.05) <= 5


@pytest.mark.parametrize("scale", [1.0, 0.7])
def test_the_chance_of_a_window_farther_than_all_draws_is_read_from_their_tail(scale: float) -> None:
    """The largest of 200 Gaussians has a known exceedance probability, whatever their sd."""
    computed = []
    for seed in range(20):
        tall = scale * np.abs(np.random.default_rng(seed).standard_normal((1000, 200))).max(axis=1)
        for chance in (0.3, 1e-3, 1e-5):
            height = scale * norm.isf(0.5 * (1.0 - (1.0 - chance) ** (1.0 / 200.0)))
            computed.append(np.log(exceedance_probability(tall, height, 0.1) / chance))
    by_chance = np.reshape(computed, (20, 3))
    assert np.all(np.abs(by_chance.mean(axis=0)) < np.log([1.05, 1.3, 2.0]))
    assert np.all(by_chance.std(axis=0) < np.log([1.1, 1.7, 3.0]))


def test_a_fit_where_nothing_is_possible_has_no_weight() -> None:
    alone = dataclasses.replace(concealing(0), excludes=lambda space, theta: np.ones(len(theta), bool))
    middle = alone.named(alone.from_sampling(np.mean(alone.bounds, axis=0)))
    near_fit = fit_near((), alone, middle)
    assert weight(near_fit) == near_fit.value == -np.inf
    assert np.all(np.isfinite(near_fit.covariance))


def test_what_is_off_at_infinity_is_climbed_to_from_there() -> None:
    """Creep of friction has an infinite time constant where there is none."""
    both = tuple(catalogue()[name] for name in ("device-friction", "friction-creep"))
    names = tuple(mechanism.name for mechanism in both)
    truth = {"Fc": 0.08, "presliding": 5e-5, "friction_start": 0.0, "friction_tau": 15.0}
    seen = ObservedSurrogate(ToySurrogate(), both, closed_form_model.MOTION)
    plain = concealing(0)
    gap = (
        seen.predict([[*TRUTH.values(), *truth.values()]]).mean
        - ToySurrogate().predict([[*TRUTH.values()]]).mean
    )
    binned = dataclasses.replace(plain.binned, force_n=plain.binned.force_n + gap[0])
    wide = dataclasses.replace(plain, binned=binned, surrogate=seen)
    base = fitted(dataclasses.replace(plain, binned=binned))
    neutral = {name: value for mechanism in both for name, value in mechanism.neutral.items()}
    parts = [part for mechanism in both for part in mechanism.whole_or_parts]
    joint = fit(names, wide, base.theta, neutral, 1, parts)
    best = fit_near(names, wide, {**base.theta, **TRUTH, **truth})
    assert joint.value > best.value - 0.5
    assert joint.theta["friction_tau"] == pytest.approx(15.0, rel=0.3)
    assert value_for_multiple(2.0, 30.0, np.inf) == 15.0
    assert value_for_multiple(-1.0, 30.0, np.inf) == np.inf
    assert value_for_multiple(2.0, 0.3, 0.1) == pytest.approx(0.5)


def test_whole_skins_are_drawn_anew_and_no_instrument_also_from_a_bound() -> None:
    """All that the innermost surrogate has is drawn; rounding loses none."""
    plain = concealing(0)
    inner = ObservedSurrogate(ToySurrogate(), (KNOWN["sensor-drift"],), closed_form_model.MOTION)
    wide = dataclasses.replace(plain, surrogate=inner)
    low, high = wide.bounds
    vector = 0.5 * (low + high)
    vector[-1] = np.nextafter(high[-1], np.inf)
    trials = other_skins(vector, wide, 1, innermost(wide.surrogate).space.dim)
    assert len(trials) > 20
    spread = np.ptp(trials, axis=0)
    assert np.all(spread[: len(TRUTH)] > 0.5 * (high - low)[: len(TRUTH)])
    assert np.all(spread[len(TRUTH) :] == 0.0)
    assert np.all((trials >= low) & (trials <= high))


def test_evidence_is_that_of_a_line_in_closed_form() -> None:
    problem = line_problem()
    priors = dataclasses.replace(problem.noise_priors, nu=(1e4, 1.001e4))  # at 1e6 lgamma rounds
    problem = dataclasses.replace(problem, noise_priors=priors)
    top = fitted(problem)
    columns, sd = problem.surrogate.columns, 0.05  # type: ignore[attr-defined]
    noise = (sd**2 + 1e-6) * np.eye(columns.shape[1]) + 1e-4 * np.outer(columns[1], columns[1])
    force = problem.chain.force_n
    precision = columns @ np.linalg.solve(noise, columns.T)
    best = np.linalg.solve(precision, columns @ np.linalg.solve(noise, force))
    left = force - best @ columns
    peak = -0.5 * (left @ np.linalg.solve(noise, left) + np.linalg.slogdet(2.0 * np.pi * noise)[1])
    exact = peak + np.log(2.0 * np.pi) - 0.5 * np.linalg.slogdet(precision)[1] - np.log(4.0)
    assert top.log_evidence == pytest.approx(exact, abs=0.05)


def test_climbs_reach_at_least_what_the_global_search_finds() -> None:
    problem = toy_problem()
    searched = find_map(problem, seed=1, starts=3, evaluations=12000)
    assert fitted(problem).value > searched.value - 0.2


def test_a_climb_never_ends_below_its_start_nor_outside_the_box() -> None:
    problem = toy_problem()
    low, high = problem.bounds
    for x in np.random.default_rng(4).uniform(low, high, (4, problem.dim)):
        top = gauss_newton(problem, x, None, 6)
        assert top.value >= problem.log_prob(x[None])[0]
        assert np.all((top.vector >= low) & (top.vector <= high))


def test_a_quick_climb_goes_on_as_far_as_a_thorough_one() -> None:
    """The start has noise that is much too large, and the surrogate's error is not small."""
    problem = toy_problem()
    assert problem.predict(problem.from_sampling(np.mean(problem.bounds, axis=0))).factor[0].any()
    start = problem.vector({**TRUTH, **NOISE})
    kinds = [i for i, name in enumerate(problem.names) if name.startswith("sd_")]
    start[kinds] = problem.bounds[1][kinds]
    quick, thorough = (gauss_newton(problem, start, None, quick=quick) for quick in (True, False))
    assert quick.value > float(problem.log_prob(start[None])[0]) + 50.0
    assert quick.value > thorough.value - 2.0


def test_a_promise_points_at_the_moment_of_a_step() -> None:
    values = {"event_1_at": 0.4, "event_1_step": 0.03, "event_2_at": 0.5, "event_2_step": 0.0}
    alone = concealing(3, ("sensor-events",), **values)
    wide = building(alone, ("sensor-events",))
    vector = wide.vector({**NEUTRAL, **TRUTH, **NOISE, "nu_noise": 20.0})
    at, step = (wide.names.index(name) for name in ("event_1_at", "event_1_step"))
    trials = np.tile(vector, (99, 1))
    trials[:, at], trials[:, step] = np.linspace(0.01, 0.99, 99), 0.01
    free = np.array([not name.startswith("event") for name in wide.names])
    row, gain, multiple, _ = promise(wide, vector, trials, free, 1)[0]
    assert trials[row, at] == pytest.approx(0.4, abs=0.011)
    assert gain > 20.0
    assert multiple == pytest.approx(3.0, rel=0.3)


def test_what_the_surrogate_does_not_know_is_not_searched() -> None:
    problem = dataclasses.replace(toy_problem(), sure_within_n=1e-9)
    vector = problem.vector({**TRUTH, **NOISE})
    assert problem.log_prob(vector[None])[0] == -np.inf
    assert np.isfinite(dataclasses.replace(problem, sure_within_n=1.0).log_prob(vector[None])[0])


def test_a_mechanism_that_does_nothing_gains_nothing() -> None:
    alone = concealing(2)
    base = fitted(alone)
    wide = building(alone, ("sensor-drift",))
    more = fit(("sensor-drift",), wide, base.theta, NEUTRAL, 1, KNOWN["sensor-drift"].whole_or_parts)
    assert more.log_evidence < base.log_evidence + 2.0


def allowing(amplitude: float) -> ModelError | None:
    """Errors of the toy whose factor has this sd; none of 0."""
    return ModelError(closed_form_model.MOTION, ToySurrogate().edges_s, amplitude) if amplitude else None


def test_a_mesh_that_is_off_by_a_factor_stays_inside_the_intervals() -> None:
    right = concealing(0)
    off = dataclasses.replace(right.binned, force_n=1.004 * right.binned.force_n)
    truth = right.surrogate.predict([list(TRUTH.values())]).mean[0].max()
    for allows, inside in ((False, False), (True, True)):
        skin = ToySurrogate(sd_n=1e-9)
        error = allowing(0.004 if allows else 0.0)
        alone = dataclasses.replace(right, binned=off, surrogate=skin, model_error=error)
        resampled = resample(fitted(alone), 1, ResampleSettings(legs=(150,), modes=0))
        force = skin.predict(resampled.draws[:, : len(TRUTH)]).mean.max(axis=1)
        low, high = np.quantile(force, [0.05, 0.95])
        assert (low < truth < high) == inside, (low, truth, high)


@pytest.mark.slow
def test_draws_are_the_same_however_often_it_is_asked_whether_they_do() -> None:
    alone = concealing(0)
    base = fitted(alone)

    def drawn(legs: tuple[int, ...], effective: float) -> np.ndarray:
        return resample(base, 1, ResampleSettings(legs=legs, limits=Limits(effective, 5.0, 1.1))).draws

    whole = drawn((600,), np.inf)
    np.testing.assert_array_equal(drawn((300, 600), np.inf), whole)
    assert 0 < len(drawn((300, 600), 50.0)) < len(whole)


@pytest.mark.parametrize(("of_sd", "there"), [(2.0, False), (30.0, True)])
def test_what_is_allowed_for_takes_up_no_more_than_is_believed_of_it(of_sd: float, there: bool) -> None:
    """A force that bends with displacement as a mesh's error does, by so many sd of what that may be."""
    alone = concealing(0)
    allowed = dataclasses.replace(alone, surrogate=ToySurrogate(sd_n=1e-9), model_error=allowing(0.01))
    factor = allowed.predict([TRUTH[n] for n in alone.surrogate.space.names]).factor[0]
    bend = 4  # column of the factor: the toy's own three have no error, and the scale is the next
    binned = dataclasses.replace(alone.binned, force_n=alone.binned.force_n + of_sd * factor[:, bend])
    latent = np.zeros(factor.shape[1])
    latent[bend] = min(of_sd, 3.0)
    off = dataclasses.replace(allowed, binned=binned)
    at = Fit((), off, {**TRUTH, **NOISE}, 0.0, 0.0, 1e-6 * np.eye(off.dim), latent)
    assert (locate(at, at.theta, 1).chance < 0.01) == there
    np.testing.assert_allclose(at.force_n, at.mean_n + factor @ latent, atol=1e-9)
    assert np.max(np.abs(at.force_n - at.mean_n)) > 1e-3


def test_a_subcutis_much_stiffer_than_the_cutis_is_not_believed() -> None:
    problem = dataclasses.replace(toy_problem(), excludes=subcutis_too_stiff)
    for ratio, possible in ((1.9, True), (2.1, False)):
        theta = {**TRUTH, **NOISE, "E_c": TRUTH["E_s"] / ratio}
        assert np.isfinite(problem.log_prob(problem.vector(theta)[None])[0]) == possible
    line = line_problem()
    assert np.isfinite(
        dataclasses.replace(line, excludes=subcutis_too_stiff).log_prob(sum(line.bounds)[None] / 2)
    )


def test_an_error_that_the_surrogate_denies_is_held_by_its_spring() -> None:
    problem = line_problem()
    slope = 0.01 * problem.surrogate.columns[1]
    binned = dataclasses.replace(problem.binned, force_n=40.0 * slope)
    near = tuple(dataclasses.replace(p, lower=-1e-4, upper=1e-4) for p in problem.surrogate.space.parameters)
    held = dataclasses.replace(problem, binned=binned, material=ParameterSpace(near))
    top = gauss_newton(held, np.mean(held.bounds, axis=0), None)
    information = np.sum(slope**2) / (0.05**2 + 1e-6)
    expected = (40.0 * information + 300.0) / (information + 101.0)
    np.testing.assert_allclose(top.latent, [expected], rtol=1e-3)
    # what is known of the line is what the density's curvature says, by differences along each parameter
    low, high = held.bounds
    step = np.diag(0.1 * (high - low))[:2]
    middle = np.mean(held.bounds, axis=0)
    middle[2:] = top.vector[2:]
    up, here, down = (held.log_prob(middle + sign * step) for sign in (1, 0, -1))
    at = gauss_newton(held, middle, None, 0)
    np.testing.assert_allclose(np.diag(at.information)[:2], (2 * here - up - down) / 0.01, rtol=0.02)


def test_starts_are_among_those_that_can_be() -> None:
    problem = dataclasses.replace(toy_problem(), excludes=subcutis_too_stiff)
    low, high = problem.bounds
    trials = np.random.default_rng(3).uniform(low, high, (400, problem.dim))
    ratio = problem.from_sampling(trials)[:, 1] / problem.from_sampling(trials)[:, 0]
    assert (ratio > 2.0).sum() > 50
    possible = trials[ratio <= 2.0]
    for start, other in zip(likely(problem, trials, 6), likely(problem, possible, 6), strict=True):
        np.testing.assert_array_equal(start, other)


def test_what_a_posterior_rules_out_is_part_of_what_it_is() -> None:
    plain = toy_problem()
    others = [
        dataclasses.replace(plain, excludes=subcutis_too_stiff),
        dataclasses.replace(plain, sure_within_n=1.0),
    ]
    assert len({posterior.identity["parameters"] for posterior in (plain, *others)}) == 3


def test_the_most_probable_error_of_a_surrogate_that_knows_nothing_is_found() -> None:
    """In a normal equation, columns that are alike and huge lose their prior to rounding."""
    rng = np.random.default_rng(0)
    residual, column = rng.standard_normal((2, 400))
    for size in (1.0, 1e12):
        latent = surrogate_error(residual, size * np.repeat(column[:, None], 3, axis=1), 50.0)
        assert size * latent.sum() == pytest.approx(column @ residual / (column @ column), rel=0.1)


@pytest.mark.parametrize("smoother", [None, "amplifier-lag", "clock-delay"])
def test_samples_refute_no_step_beside_what_smooths_or_shifts_it(smoother: str | None) -> None:
    names = ("sensor-events",) if smoother is None else ("sensor-events", smoother)
    known = {name: catalogue()[name] for name in names}
    alone = concealing(0)
    edges_s = alone.binned.edges_s
    none = Jumps(edges_s, *np.zeros((2, len(edges_s))))
    theta = {name: value for mechanism in known.values() for name, value in mechanism.neutral.items()}
    theta |= {"event_1_step": 0.03}
    neutral_fit = Fit(names, alone, theta, 0.0, 0.0, np.eye(1), np.zeros(1))
    assert refuted(neutral_fit, known, closed_form_model.MOTION, none) == (
        [] if smoother else ["sensor-events"]
    )
