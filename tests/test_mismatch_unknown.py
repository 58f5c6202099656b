"""Tests of the discrepancy: it leaves out what the parameters could explain, and noise is called noise."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal
from toys import closed_form_model
from toys.inference_problems import NOISE, TRUTH, ToySurrogate, empty_recording

from bayeskin.inference import LogPosterior
from bayeskin.inference.noise_model import draw_noise
from bayeskin.mismatch.discrepancy import (
    Discrepancy,
    discrepancy,
    kernel_masks,
    negative_log_evidence,
    squared_distances,
)
from bayeskin.mismatch.fit import Fit
from bayeskin.mismatch.form import propose_form
from bayeskin.mismatch.noise_bounds import instrument_noise
from bayeskin.mismatch.terms import library, memory
from bayeskin.mismatch.unexplained import Place, derivatives, place, unexplained
from bayeskin.report import figure_discrepancy
from bayeskin.types import PadMotion, ParameterSpace

Extra = Callable[[Place], np.ndarray]


def known_fit(seed: int, extra: Extra | None = None, sd_n: float = 1e-4, memory_s: float = 2.0) -> Fit:
    """A recording of the toy with the measured noise, noise with a memory, the surrogate's error and `extra`,
    fitted at TRUTH.
    """
    rng = np.random.default_rng(seed)
    binned, surrogate = empty_recording(), ToySurrogate()
    chain = LogPosterior(surrogate, binned).chain
    prediction = surrogate.predict([list(TRUTH.values())])
    force = prediction.mean[0] + prediction.factor[0] @ rng.standard_normal(3)
    force = force + draw_noise(chain, np.array([[sd_n] * 4 + [memory_s, 100.0]]), prediction.diagonal, rng)[0]
    if extra:
        force = force + extra(place(binned.time_s, binned.phase, binned.phases, closed_form_model.MOTION))
    recorded = dataclasses.replace(binned, force_n=force)
    log_posterior = LogPosterior(surrogate, recorded, noise_priors=instrument_noise(recorded))
    noise = {name: sd_n for name in NOISE if name.startswith("sd")}
    theta = {**TRUTH, **noise, "tau_noise": memory_s, "nu_noise": 60.0}
    return Fit((), log_posterior, theta, 0.0, 0.0, 1e-6 * np.eye(log_posterior.dim), np.zeros(3))


def rubbing(at: Place) -> np.ndarray:
    return 5e-3 * at.direction


def creeping(at: Place) -> np.ndarray:
    return np.where(at.kind == "hold", -8e-3 * -np.expm1(-at.since_s / 10.0), 0.0)


def drifting(at: Place) -> np.ndarray:
    return 1e-4 * at.time_s


def less_displaced(at: Place) -> np.ndarray:
    """Returns a difference [N] that looks as if the pads had slipped between the cycles."""
    return -0.8 * at.displacement_m * (at.cycle == 2)


def in_second_cycle(at: Place) -> np.ndarray:
    return 12e-3 * ((at.cycle == 2) & (at.kind == "load")) * np.sin(0.5 * at.since_s)


def test_noise_is_no_discrepancy() -> None:
    remainders = [discrepancy(known_fit(seed), closed_form_model.MOTION) for seed in range(8)]
    assert sum(remainder.noticeable for remainder in remainders) == 0
    assert all(np.all(np.abs(remainder.mean_n) <= 3.0 * remainder.sd_n + 1e-5) for remainder in remainders)
    assert all(remainder.size_n < 5e-4 for remainder in remainders)
    assert remainders[0].features == ("nothing is left beyond the noise",)


def gained(remainder: Discrepancy) -> float:
    """Nats by which a discrepancy is likelier than none."""
    return remainder.log_evidence - remainder.without_log_evidence


@pytest.mark.parametrize("memory_s", [0.1, 0.5, 2.0, 5.0, 8.0])
def test_noise_with_a_memory_is_no_discrepancy(memory_s: float) -> None:
    """Twice as large as the noise that the bins show."""
    nats = [
        gained(discrepancy(known_fit(seed, None, 2e-3, memory_s), closed_form_model.MOTION))
        for seed in range(6)
    ]
    assert np.mean(nats) < 0.0
    assert max(nats) < 4.0


@pytest.mark.parametrize("memory_s", [0.5, 2.0, 5.0])
@pytest.mark.parametrize("extra", [rubbing, creeping])
def test_a_discrepancy_is_found_in_noise_with_a_memory(extra: Extra, memory_s: float) -> None:
    remainders = [
        discrepancy(known_fit(seed, extra, 1.5e-3, memory_s), closed_form_model.MOTION) for seed in range(4)
    ]
    assert min(map(gained, remainders)) > 4.0


@pytest.mark.slow
def test_noise_is_seldom_noticed_or_given_a_form() -> None:
    """Among 200 recordings of noise, alarms are as frequent as their stated levels of 1 % and 5 %."""
    fits = [known_fit(seed) for seed in range(200)]
    assert sum(discrepancy(fit, closed_form_model.MOTION).noticeable for fit in fits) <= 6
    forms = [propose_form(fit, closed_form_model.MOTION, seed) for seed, fit in enumerate(fits)]
    assert sum(form.terms != () for form in forms) <= 20


@pytest.mark.parametrize("extra", [rubbing, creeping, drifting, less_displaced])
def test_a_discrepancy_is_found_and_its_band_holds_it(extra: Extra) -> None:
    covered = []
    for seed in range(6):
        fit = known_fit(seed, extra)
        estimate, rest = (
            discrepancy(fit, closed_form_model.MOTION),
            unexplained(fit, closed_form_model.MOTION),
        )
        truth = rest.beyond(extra(rest.at))
        covered.append(np.mean(np.abs(estimate.mean_n - truth) < 1.645 * estimate.sd_n))
        assert estimate.noticeable
        assert np.sqrt(np.mean((estimate.mean_n - truth) ** 2)) < 0.4 * np.sqrt(np.mean(truth**2))
    assert 0.75 < np.mean(covered) <= 1.0


def test_parts_shares_and_residual_add_up() -> None:
    estimate = discrepancy(known_fit(1, creeping), closed_form_model.MOTION)
    np.testing.assert_allclose(np.sum(list(estimate.parts_n.values()), axis=0), estimate.mean_n, atol=1e-15)
    assert 0.5 < sum(estimate.share.values()) < 1.0
    assert estimate.share["phase"] == max(estimate.share.values())
    changed = discrepancy(known_fit(1, less_displaced), closed_form_model.MOTION)
    assert changed.share["change"] == max(changed.share.values())
    rest = unexplained(known_fit(1, creeping), closed_form_model.MOTION)
    np.testing.assert_allclose(estimate.beyond_n + estimate.taken_n, rest.residual_n, atol=1e-15)


def test_mean_and_sd_are_those_of_a_dense_gaussian_process_with_a_flat_prior_of_parameters() -> None:
    fit = known_fit(1, creeping)
    estimate = discrepancy(fit, closed_form_model.MOTION)
    rest = dataclasses.replace(unexplained(fit, closed_form_model.MOTION), memory=estimate.memory)
    at, memory_s = rest.at, np.log1p(rest.at.since_s)
    displacement = at.displacement_m / 9e-3
    axes = {"displacement": displacement, "change": displacement, "phase": memory_s, "cycle": memory_s}
    moving, second = 0.5 + 0.5 * (at.direction[:, None] == at.direction), at.cycle == 2
    same = {
        "displacement": moving,
        "change": moving * (second[:, None] & second),
        "phase": at.kind[:, None] == at.kind,
        "cycle": at.phase[:, None] == at.phase,
    }
    kernel = np.zeros((130, 130))
    for name, x in axes.items():
        far = ((x[:, None] - x) / estimate.length_by_part[name]) ** 2
        kernel += estimate.size_by_part[name] ** 2 * same[name] * np.exp(-0.5 * far)
    free = rest.basis @ rest.basis.T
    kernel = free @ kernel @ free
    whole = kernel + rest.noise_n2 + 10.0 * (np.eye(130) - free)
    np.testing.assert_allclose(estimate.mean_n, kernel @ np.linalg.solve(whole, rest.residual_n), atol=1e-8)
    variance = np.diag(kernel - kernel @ np.linalg.solve(whole, kernel))
    np.testing.assert_allclose(estimate.sd_n, np.sqrt(variance), rtol=1e-3, atol=1e-8)
    covariance = free @ rest.noise_n2 @ free
    assert np.all(estimate.sd_n < np.sqrt(np.diag(covariance)))


def test_the_evidence_without_a_discrepancy_is_the_integral_over_the_parameters() -> None:
    """The force is linear in the parameters; their normal prior is as dense at the fit as their box."""
    fit = known_fit(1, creeping)
    rest = unexplained(fit, closed_form_model.MOTION)
    d = fit.log_posterior.surrogate.space.dim
    moves = (fit.unit[:d] > 1e-3) & (fit.unit[:d] < 1.0 - 1e-3)
    slopes = derivatives(fit.log_posterior, fit.unit)[:, moves]
    assert moves.all()
    constant = -0.5 * len(rest.residual_n) * np.log(2.0 * np.pi)
    for kernel in (None, 1e-6 * np.eye(len(rest.residual_n))):
        free = rest.basis @ rest.basis.T
        covariance = rest.noise_n2 + slopes @ slopes.T / (2.0 * np.pi)
        covariance += 0.0 if kernel is None else free @ kernel @ free
        exact = multivariate_normal(None, covariance).logpdf(rest.residual_n) - constant
        assert rest.log_evidence(kernel) == pytest.approx(exact, abs=1e-6)


def test_a_parameter_that_a_bound_holds_pays_for_the_room_that_it_does_not_use() -> None:
    """Against the integral over its prior, the others at the fit."""
    rest = unexplained(known_fit(1, creeping), closed_form_model.MOTION)
    slope = 40.0 * np.sqrt(rest.noise_n2[0, 0]) * np.linspace(-1.0, 1.0, len(rest.residual_n))
    slope *= -np.sign(slope @ rest.residual_n) or 1.0
    alone = dataclasses.replace(rest, slopes=rest.slopes[:, :0], inwards=slope[:, None])
    known = multivariate_normal(None, rest.noise_n2)
    t = np.linspace(0.0, 1.0, 4001) ** 3
    exact = logsumexp([known.logpdf(rest.residual_n - at * slope) for at in t], b=np.gradient(t))
    constant = -0.5 * len(rest.residual_n) * np.log(2.0 * np.pi)
    assert alone.log_evidence() == pytest.approx(exact - constant, abs=0.02)
    free = dataclasses.replace(alone, inwards=alone.inwards[:, :0])
    assert alone.log_evidence() < free.log_evidence() - 1.0


def test_a_discrepancy_pays_for_its_sizes_and_lengths() -> None:
    without, with_it = (
        discrepancy(known_fit(1, extra), closed_form_model.MOTION) for extra in (None, creeping)
    )
    for estimate in (without, with_it):
        cost = estimate.log_evidence - estimate.without_log_evidence - estimate.gain_nats
        assert -30.0 < cost < 0.1
    assert without.log_evidence < without.without_log_evidence + 1.0  # nothing there
    assert with_it.log_evidence > with_it.without_log_evidence + 20.0


def test_slopes_of_the_likelihood_are_its_differences() -> None:
    rest = unexplained(known_fit(1, creeping), closed_form_model.MOTION)
    given = (rest, squared_distances(rest.at), kernel_masks(rest.at))
    whole = np.log([8.0, 3.0, 2e-3, 3e-3, 4e-3, 1e-3, 0.4, 0.5, 0.7, 1.1])
    for line, of in ((whole, given), (whole[:2], given[:1])):
        for i, step in enumerate(1e-4 * np.eye(len(line))):
            difference = (
                negative_log_evidence(line + step, *of)[0] - negative_log_evidence(line - step, *of)[0]
            ) / 2e-4
            assert negative_log_evidence(line, *of)[1][i] == pytest.approx(difference, rel=1e-3)


def test_the_discrepancy_is_orthogonal_to_what_parameters_do() -> None:
    fit = known_fit(2, rubbing)
    estimate = discrepancy(fit, closed_form_model.MOTION)
    slopes = derivatives(fit.log_posterior, fit.unit)
    moving = slopes[:, np.linalg.norm(slopes, axis=0) > 1e-6]
    cosine = moving.T @ estimate.mean_n / np.linalg.norm(moving, axis=0) / np.linalg.norm(estimate.mean_n)
    np.testing.assert_allclose(cosine, 0.0, atol=1e-10)


@pytest.mark.parametrize("parameter", ["E_c", "E_s", "k_c", "k_s"])
def test_what_looks_like_a_parameter_does_not_change_the_discrepancy(parameter: str) -> None:
    fit = known_fit(2, rubbing)
    slope = derivatives(fit.log_posterior, fit.unit)[:, list(TRUTH).index(parameter)]
    binned = fit.log_posterior.binned
    shifted = dataclasses.replace(binned, force_n=binned.force_n + 0.02 * slope)
    other = dataclasses.replace(fit, log_posterior=dataclasses.replace(fit.log_posterior, binned=shifted))
    first, second = discrepancy(fit, closed_form_model.MOTION), discrepancy(other, closed_form_model.MOTION)
    assert np.linalg.norm(second.taken_n - first.taken_n) > 1e-5
    # As far as climbs to the hyperparameters end alike: a micronewton is a thousandth of the noise.
    np.testing.assert_allclose(second.mean_n, first.mean_n, atol=1e-6)
    np.testing.assert_allclose(second.sd_n, first.sd_n, atol=1e-6)


def test_a_parameter_at_its_bound_takes_up_nothing() -> None:
    """The toy's level and relaxation hang on four parameters; two at bounds leave one direction less."""
    fit = known_fit(2, rubbing)
    raised = {"E_s": TRUTH["E_s"], "k_s": TRUTH["k_s"]}
    material = ParameterSpace(
        tuple(
            dataclasses.replace(p, lower=raised.get(p.name, p.lower))
            for p in closed_form_model.SPACE.parameters
        )
    )
    at_bound = dataclasses.replace(
        fit, log_posterior=dataclasses.replace(fit.log_posterior, material=material)
    )
    width = [unexplained(near, closed_form_model.MOTION).basis.shape[1] for near in (fit, at_bound)]
    assert width == [127, 128]


def test_features_say_where_and_how_it_grows() -> None:
    words = " | ".join(discrepancy(known_fit(0, in_second_cycle), closed_form_model.MOTION).features)
    assert "while loading" in words
    assert "in holds" not in words
    assert "grows from" in words
    words = " | ".join(discrepancy(known_fit(0, drifting), closed_form_model.MOTION).features)
    assert "rises with time" in words


@pytest.mark.parametrize(
    ("extra", "name", "coefficient", "unit"),
    [
        (rubbing, "the direction of motion", 5e-3, "N"),
        (creeping, "1 − exp(−t / 10 s) in holds", -8e-3, "N"),
        (drifting, "time", 1e-4, "N/s"),
        (
            lambda at: 1.0 * at.displacement_m * at.direction,
            "displacement with the sign of motion",
            1.0,
            "N/m",
        ),
    ],
)
def test_a_form_of_the_library_is_found_with_its_coefficient(
    extra: Extra, name: str, coefficient: float, unit: str
) -> None:
    named = 0
    for seed in range(3):
        form = propose_form(known_fit(seed, extra), closed_form_model.MOTION, 0)
        first = form.terms[0]
        assert name in (first.name, *first.alike)
        assert form.r2_left_out > 0.4
        assert "in held-out phases" in form.sentence
        if first.name == name:
            named += 1
            assert first.unit == unit
            assert abs(first.coefficient - coefficient) < 0.35 * abs(coefficient)
            assert 0.0 < first.standard_error < 0.4 * abs(coefficient)
    assert named > 0


def test_noise_has_no_form_and_neither_has_what_one_phase_does_alone() -> None:
    forms = [propose_form(known_fit(seed), closed_form_model.MOTION, seed) for seed in range(8)]
    assert sum(form.terms != () for form in forms) <= 1
    assert forms[0].sentence.startswith("No form found")
    alone = propose_form(known_fit(0, in_second_cycle), closed_form_model.MOTION, 0)
    assert alone.terms == ()
    assert alone.r2_left_out == 0.0


def test_the_share_left_out_is_that_of_fits_without_each_phase() -> None:
    fit = known_fit(0, lambda at: rubbing(at) + drifting(at))
    form, rest, binned = (
        propose_form(fit, closed_form_model.MOTION, 0),
        unexplained(fit, closed_form_model.MOTION),
        fit.log_posterior.binned,
    )
    terms = {t.name: t.values for t in library(rest, binned.edges_s, binned.phases, closed_form_model.MOTION)}
    shapes = rest.beyond(np.stack([terms[term.name] for term in form.terms], axis=1))
    target, errors = rest.beyond(rest.residual_n), []
    for phase in range(len(binned.phases)):
        inside = binned.phase == phase
        value = np.linalg.lstsq(shapes[~inside], target[~inside], rcond=None)[0]
        errors.append(np.sum((target[inside] - shapes[inside] @ value) ** 2))
    assert len(form.terms) >= 2
    assert form.r2_left_out == pytest.approx(1.0 - np.sum(errors) / np.sum(target**2), rel=1e-6)
    whole = np.linalg.lstsq(shapes, target, rcond=None)[0]
    np.testing.assert_allclose([term.coefficient for term in form.terms], whole, rtol=1e-6)
    np.testing.assert_allclose(form.force_n, shapes @ whole, atol=1e-9)


def test_the_same_seed_gives_the_same_form() -> None:
    fit = known_fit(4, drifting)
    first, second = (
        propose_form(fit, closed_form_model.MOTION, 7),
        propose_form(fit, closed_form_model.MOTION, 7),
    )
    assert first.sentence == second.sentence
    np.testing.assert_array_equal(first.force_n, second.force_n)


def test_memory_of_a_ramp_and_hold_is_the_closed_form() -> None:
    motion = PadMotion(np.array([0.0, 2.0, 10.0]), np.array([0.0, 4e-3, 4e-3]))
    at_2 = 2e-3 * 3.0 * -np.expm1(-2.0 / 3.0)
    np.testing.assert_allclose(
        memory(motion, np.array([2.0, 5.0]), 3.0), [at_2, at_2 * np.exp(-1.0)], rtol=1e-12
    )


def test_terms_are_in_si_and_averaged_over_bins() -> None:
    fit = known_fit(0)
    rest, binned = unexplained(fit, closed_form_model.MOTION), fit.log_posterior.binned
    terms = {t.name: t for t in library(rest, binned.edges_s, binned.phases, closed_form_model.MOTION)}
    np.testing.assert_allclose(
        terms["displacement"].values, closed_form_model.MOTION.at(binned.time_s), atol=1e-6
    )
    np.testing.assert_allclose(terms["time"].values, binned.time_s, atol=1e-9)
    assert set(np.round(terms["speed"].values, 9)) == {-9e-4, 0.0, 9e-4}


def test_the_figure_says_what_is_unexplained() -> None:
    fit = known_fit(0, drifting)
    binned = fit.log_posterior.binned
    figure = figure_discrepancy(binned, closed_form_model.MOTION, discrepancy(fit, closed_form_model.MOTION))
    assert figure.get_suptitle().startswith("The model leaves 3.")
    assert "rises with time" in figure.get_supxlabel().replace("\n", " ")
    assert [ax.get_xlabel() for ax in figure.axes] == [
        "time [s]", "displacement [mm]", "time since the start of the phase [s]"
    ]  # fmt: skip
    nothing = figure_discrepancy(
        binned, closed_form_model.MOTION, discrepancy(known_fit(0), closed_form_model.MOTION)
    )
    assert "nothing" in nothing.get_suptitle()


def test_windows_that_were_fitted_are_all_that_is_described() -> None:
    fit = known_fit(0, drifting)
    half = dataclasses.replace(fit.log_posterior, fit_windows=((0.0, 45.0), (65.0, 105.0)))
    part = dataclasses.replace(fit, log_posterior=half)
    estimate = discrepancy(part, closed_form_model.MOTION)
    assert len(estimate.mean_n) == len(estimate.bins) == 85
    assert len(figure_discrepancy(half.binned, closed_form_model.MOTION, estimate).axes) == 3
