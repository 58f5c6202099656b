"""Noise laid on a known force is measured as it was laid; bin means know their own variance."""

import json
from functools import cache

import numpy as np
import pytest
from scipy.linalg import toeplitz
from toys.synthetic_recordings import (
    INTERVAL_S,
    KINDS,
    MOTION,
    TIME_S,
    article_recording,
    coloured,
    recording,
    true_force,
    with_spikes,
)

from bayeskin.errors import InputError
from bayeskin.mismatch.noise_bounds import NOISE_BOUNDS, without_swings
from bayeskin.recordings import (
    NoiseAnalysis,
    analyse,
    bin_recording,
    covered_s,
    describe,
    describe_json,
    fitting_width_s,
    jumps_of,
    phase_noise,
    segment,
    summarise,
    uniform_edges,
)
from bayeskin.recordings.correlation import (
    NoiseShape,
    expected_products,
    fit_shape,
    parabola_basis,
    residual_windows,
    weighted_covariance,
)
from bayeskin.recordings.spikes import despike, huber_sd, running_median
from bayeskin.recordings.steps import step_filter
from bayeskin.types import Phase, Recording

EDGES_S = uniform_edges(float(TIME_S[-1]))
FORCE_N = true_force()
PHASES = segment(recording(FORCE_N))
# White sd [mN], correlated sd [mN], correlation time [s]: from no correlation to most of a bin.
NOISES = [(2.0, 0.0, 0.1), (1.0, 1.0, 0.1), (1.0, 2.0, 0.05), (1.5, 1.0, 0.3)]
SEEDS = range(8)


@cache
def noisy(white_mn: float, slow_mn: float, time_s: float, seed: int) -> tuple[Recording, NoiseAnalysis]:
    rng = np.random.default_rng([seed, 77])
    noise = coloured(rng, len(TIME_S), 1e-3 * white_mn, 1e-3 * slow_mn, time_s)
    recorded = recording(FORCE_N + noise)
    return recorded, analyse(recorded, PHASES)


def true_bin_means() -> np.ndarray:
    sums = np.concatenate([[0.0], np.cumsum(0.5 * INTERVAL_S * (FORCE_N[1:] + FORCE_N[:-1]))])
    return np.diff(np.interp(EDGES_S, TIME_S, sums)) / np.diff(EDGES_S)


def test_the_parabola_takes_from_a_correlation_what_its_projector_takes() -> None:
    size, shape = 60, NoiseShape(0.3, 0.12)
    basis = parabola_basis(size)
    left = np.eye(size) - basis @ basis.T
    covariance = left @ toeplitz(shape.at(INTERVAL_S * np.arange(size))) @ left
    means = [np.mean(np.diagonal(covariance, h)) for h in range(20)]
    np.testing.assert_allclose(
        expected_products(shape.at(INTERVAL_S * np.arange(size)), 20), means, atol=1e-12
    )


def test_parabolas_leave_no_residual() -> None:
    x = np.arange(200.0)
    np.testing.assert_allclose(residual_windows(3 - 2 * x + 0.1 * x**2, 50), 0.0, atol=1e-9)


@pytest.mark.parametrize("shape", [NoiseShape(0.5, 0.1), NoiseShape(0.1, 0.3), NoiseShape(0.8, 0.05)])
def test_a_shape_is_recovered_from_its_own_expected_products(shape: NoiseShape) -> None:
    size, lags = 250, 101
    products = expected_products(shape.at(INTERVAL_S * np.arange(size)), lags)
    fitted = fit_shape(products / products[0], 10_000, INTERVAL_S, size)
    assert fitted.white_share == pytest.approx(shape.white_share, abs=0.03)
    assert fitted.time_s == pytest.approx(shape.time_s, rel=0.1)


def test_the_variance_of_a_mean_of_ar1_noise_is_the_textbooks() -> None:
    n, a = 50, np.exp(-INTERVAL_S / 0.08)
    textbook = ((1 + a) / (1 - a) - 2 * a * (1 - a**n) / (n * (1 - a) ** 2)) / n
    mean = np.full(n, 1 / n)
    correlation = NoiseShape(0.0, 0.08).at(INTERVAL_S * np.arange(n))
    assert weighted_covariance(mean, mean, correlation) == pytest.approx(textbook, rel=1e-12)


def test_the_running_median_follows_any_monotone_force_to_its_ends() -> None:
    rise = np.exp(np.linspace(0, 5, 400))
    np.testing.assert_allclose(running_median(rise, 25), rise, rtol=2e-3)
    line = np.linspace(3.0, -5.0, 400)
    np.testing.assert_allclose(running_median(line, 25), line, atol=1e-12)


def test_the_winsorised_sd_is_consistent_and_robust() -> None:
    rng = np.random.default_rng(3)
    z = rng.normal(size=200_000)
    assert huber_sd(z, 3.0) == pytest.approx(1.0, rel=0.01)
    z[:2000] += 30.0
    assert huber_sd(z, 1.0) == pytest.approx(1.0, rel=0.05)


@pytest.mark.parametrize("noise", NOISES)
def test_sd_and_correlation_are_found(noise: tuple[float, float, float]) -> None:
    white, slow, time_s = noise
    analyses = [noisy(*noise, seed)[1] for seed in SEEDS]
    sds = [p.sd_n for a in analyses for p in summarise(a, PHASES)]
    true_sd = 1e-3 * np.hypot(np.hypot(white, slow), 1 / np.sqrt(12.0))  # the rounding to 1 mN is noise too
    assert np.mean(sds) == pytest.approx(true_sd, rel=0.07)
    holds = [a.shapes["hold"] for a in analyses]
    slow_share = np.mean([1 - shape.white_share for shape in holds])
    assert slow_share == pytest.approx(slow**2 / (1e3 * true_sd) ** 2, abs=0.06)
    if slow:
        assert np.median([shape.time_s for shape in holds]) == pytest.approx(time_s, rel=0.35)


@pytest.mark.parametrize("noise", NOISES)
def test_bin_means_know_their_variance_and_their_neighbours(noise: tuple[float, float, float]) -> None:
    truth = true_bin_means()
    z, stated = [], []
    for seed in SEEDS:
        recorded, analysis = noisy(*noise, seed)
        binned = bin_recording(recorded, PHASES, EDGES_S, analysis)
        z.append((binned.force_n - truth) / np.sqrt(binned.variance_n2))
        stated.append(binned.correlation)
    assert np.mean(np.square(z)) == pytest.approx(1.0, abs=0.13)
    neighbours = np.mean([np.mean(row[1:] * row[:-1]) / np.mean(row**2) for row in z])
    assert neighbours == pytest.approx(np.mean(stated), abs=0.06)


def test_bin_means_of_gaussian_noise_are_as_good_as_plain_means() -> None:
    truth, robust, plain = true_bin_means(), [], []
    for seed in SEEDS:
        recorded, analysis = noisy(*NOISES[0], seed)
        robust.append(bin_recording(recorded, PHASES, EDGES_S, analysis).force_n - truth)
        plain.append(
            recorded.force_n[:-1].reshape(-1, 50).mean(axis=1) + 0.5 * np.diff(FORCE_N[::50]) / 50 - truth
        )
    assert np.var(plain) / np.var(robust) > 0.95


def test_bin_means_of_straight_forces_are_exact_over_corners_and_between_samples() -> None:
    recorded = Recording(TIME_S, MOTION.at(TIME_S), 40.0 * MOTION.at(TIME_S), "made", "")
    edges = np.arange(0.0037, 129.0, 0.5)
    fine = np.unique(np.concatenate([edges, MOTION.time_s]))
    f = 40.0 * MOTION.at(fine)
    sums = np.concatenate([[0.0], np.cumsum(0.5 * (f[1:] + f[:-1]) * np.diff(fine))])
    exact = np.diff(np.interp(edges, fine, sums)) / 0.5
    np.testing.assert_allclose(bin_recording(recorded, PHASES, edges).force_n, exact, atol=1e-12)


def test_spikes_are_counted_and_leave_the_means_alone() -> None:
    rng = np.random.default_rng(11)
    starts = np.sort(rng.choice(np.arange(100, 12900, 20), 150, replace=False))
    noise = coloured(rng, len(TIME_S), 1e-3, 1e-3, 0.1)
    clean, spiked = recording(FORCE_N + noise), recording(with_spikes(rng, FORCE_N + noise, starts, 0.02))
    measured = phase_noise(spiked, PHASES)
    assert sum(p.spikes for p in measured) == pytest.approx(150, abs=6)
    assert sum(p.spikes_above for p in measured) >= sum(p.spikes for p in measured) - 2
    assert [p.spike_threshold_n for p in measured] == pytest.approx([4.6 * 1.3e-3] * 9, rel=0.3)
    assert np.mean([p.sd_n for p in measured]) == pytest.approx(np.sqrt(2.08e-6), rel=0.12)
    means = [bin_recording(r, PHASES, EDGES_S).force_n for r in (clean, spiked)]
    raw_bias = np.mean(spiked.force_n - clean.force_n)
    assert raw_bias > 5e-4
    assert abs(np.mean(means[1] - means[0])) < 0.05 * raw_bias
    assert np.sqrt(np.mean((means[1] - means[0]) ** 2)) < 3e-4


def test_noise_alone_shows_next_to_no_spikes_and_no_steps() -> None:
    summaries = [summarise(noisy(*noise, seed)[1], PHASES) for noise in NOISES for seed in SEEDS]
    assert sum(p.spikes for phases in summaries for p in phases) <= 8
    assert sum(len(p.step_times_s) for phases in summaries for p in phases) == 0


def test_the_step_filter_reads_a_step_and_is_blind_to_lines() -> None:
    weights = step_filter(INTERVAL_S)
    at = np.arange(len(weights)) - len(weights) // 2
    assert weights @ np.ones(len(at)) == pytest.approx(0.0, abs=1e-12)
    assert weights @ at == pytest.approx(0.0, abs=1e-9)
    assert weights @ (at >= 0) == pytest.approx(1.0)


def test_steps_are_found_with_their_times_and_sizes() -> None:
    errors, ratios = [], []
    for seed in range(4):
        rng = np.random.default_rng([seed, 5])
        times = np.array([2.6, 25.0, 35.0, 85.0, 122.0]) + rng.uniform(-0.4, 0.4, 5)
        sizes = 0.015 * np.array([1, -1, 1.5, 1, -2])
        force = FORCE_N + coloured(rng, len(TIME_S), 1e-3, 1e-3, 0.1)
        recorded = recording(
            force + sum(b * np.clip((TIME_S - a) / 0.03, 0, 1) for a, b in zip(times, sizes, strict=True))
        )
        noise = phase_noise(recorded, PHASES)
        np.testing.assert_allclose(np.mean([p.sd_n for p in noise]), np.sqrt(2.08e-6), rtol=0.1)
        at = np.concatenate([p.step_times_s for p in noise])
        assert len(at) == 5
        errors.append(at - times - 0.015)
        ratios.append(np.concatenate([p.step_sizes_n for p in noise]) / sizes)
    assert np.max(np.abs(errors)) < 0.03
    np.testing.assert_allclose(ratios, 1.0, atol=0.3)
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.06)


@pytest.mark.parametrize("interval_s", [0.002, 0.01, 0.05])
@pytest.mark.parametrize("slow_mn", [0.0, 1.0, 3.0])
@pytest.mark.parametrize("lasts_s", [0.0, 0.03, 0.05])
def test_jumps_that_are_there_are_allowed_and_others_are_refuted(
    interval_s: float, slow_mn: float, lasts_s: float
) -> None:
    refuted, time_s = [], interval_s * np.arange(round(130.0 / interval_s) + 1)
    for seed in range(1 if interval_s < 0.01 else 3):  # the finest recordings take longest
        rng = np.random.default_rng([seed, 6])
        times = np.array([25.0, 35.0, 85.0]) + rng.uniform(-0.4, 0.4, 3)
        sizes = np.array([0.015, -0.015, 0.03])
        force = true_force(time_s) + coloured(rng, len(time_s), 1e-3, 1e-3 * slow_mn, 0.3 * interval_s / 0.01)
        for at_s, size_n in zip(times, sizes, strict=True):
            force += size_n * np.clip((time_s - at_s) / max(lasts_s, 1e-9), 0.0, 1.0)
        jumps = jumps_of(recording(force, MOTION, time_s), PHASES)
        for off_s in (-0.3, 0.0, 0.3):  # a fit to bins knows a moment no better
            assert not jumps.refute(times + off_s, sizes).any()
        refuted += [
            jumps.refute(np.array([28.0, 33.0, 88.0]), 2.0 * sizes),
            jumps.refute(times, -2.0 * sizes),
        ]
        corners = np.array([phase.start_s for phase in PHASES[1:]])
        assert not jumps.refute(corners, np.full(len(corners), 1.0)).any()
        assert not jumps.until(30.0).refute(np.array([33.0]), np.array([1.0])).any()
    assert np.mean(refuted) > (0.8 if slow_mn < 3.0 else 0.5)


def test_a_slow_swing_is_no_quick_noise() -> None:
    """It swings in holds only; loads are noisier, and stay so."""
    rng = np.random.default_rng(3)
    kinds = np.array([p.kind for p in PHASES])[
        np.searchsorted([p.start_s for p in PHASES], TIME_S, side="right") - 1
    ]
    louder = np.where(kinds == "load", 4.0, 1.0)
    plain = FORCE_N + louder * coloured(rng, len(TIME_S), 1e-3, 1e-3, 0.1)
    swinging = plain + np.where(kinds == "hold", 0.1 * FORCE_N * np.sin(2.0 * np.pi * TIME_S / 4.1), 0.0)
    of = {}
    for name, force in (("plain", plain), ("swinging", swinging)):
        recorded = recording(force)
        whole = bin_recording(recorded, PHASES, EDGES_S)
        quick = bin_recording(recorded, PHASES, EDGES_S, analyse(recorded, PHASES, NOISE_BOUNDS.quick_s))
        holds = np.array([PHASES[i].kind == "hold" for i in whole.phase])
        less = without_swings(whole, quick.variance_n2)
        kept = less.variance_n2[~holds] / whole.variance_n2[~holds]
        assert kept.min() > (0.99 if name == "plain" else 0.25)
        of[name] = [np.median(noise.variance_n2[holds]) for noise in (whole, less)]
    assert of["plain"][0] == of["plain"][1]
    assert of["swinging"][0] > 16.0 * of["plain"][0]
    assert of["swinging"][1] < min(15.0 * of["plain"][0], 0.5 * of["swinging"][0])


def test_a_step_is_no_spike_and_stays_in_the_means() -> None:
    step = 0.05 * (TIME_S >= 30.2)
    rng = np.random.default_rng(2)
    noise = coloured(rng, len(TIME_S), 1e-3, 0.0, 0.1)
    means = bin_recording(recording(FORCE_N + step + noise), PHASES, EDGES_S).force_n - true_bin_means()
    np.testing.assert_allclose(means[60], 0.03, atol=1.5e-3)  # the bin 30.0-30.5 s has it for 0.3 s
    np.testing.assert_allclose(means[61:80].mean(), 0.05, atol=5e-4)


def test_a_recording_of_any_sampling_is_analysed() -> None:
    for interval_s in (0.002, 0.05):
        time_s = interval_s * np.arange(int(130 / interval_s) + 1)
        noise = 2e-3 * np.random.default_rng(8).normal(size=len(time_s))
        recorded = recording(true_force(time_s) + noise, MOTION, time_s)
        phases = segment(recorded)
        assert [p.kind for p in phases] == KINDS
        sds = [p.sd_n for p in phase_noise(recorded, phases)]
        assert np.median(sds) == pytest.approx(2e-3, rel=0.1)


def test_despiking_never_crosses_a_break() -> None:
    jump = np.where(np.arange(400) < 203, 0.0, 1.0)
    out = despike(INTERVAL_S * np.arange(400), jump, [0, 203, 400])
    np.testing.assert_array_equal(out.force_n, jump)


@pytest.mark.parametrize(
    ("edges", "said"),
    [
        (np.array([0.0, 0.0, 1.0]), "the edges do not increase"), (np.array([0.0, 140.0]), "0 to 140 s"),
        (np.array([-1.0, 1.0]), "-1 to 1 s"), (np.array([0.0, 1.0, 1.005]), "from 1 to 1.005 s"),
    ],
)  # fmt: skip
def test_edges_that_do_not_fit_are_refused(edges: np.ndarray, said: str) -> None:
    with pytest.raises(InputError, match=said):
        bin_recording(recording(FORCE_N), PHASES, edges)


def test_uniform_edges_are_whole_bins_from_zero() -> None:
    np.testing.assert_allclose(uniform_edges(2.3), [0, 0.5, 1.0, 1.5, 2.0])
    assert len(uniform_edges(0.3, 0.1)) == 4
    assert uniform_edges(recording(FORCE_N))[-1] == 130.0


def test_a_force_that_never_changes_has_no_noise_to_measure() -> None:
    flat = recording(np.full_like(FORCE_N, 0.25))
    with pytest.raises(InputError, match=r"force: it is 0.25 N throughout"):
        phase_noise(flat, PHASES)


@pytest.mark.parametrize("interval_s", [0.13, 0.2, 0.5, 1.0])
def test_the_noise_of_few_samples_is_measured(interval_s: float) -> None:
    time_s = np.arange(0.0, 130.0, interval_s)
    estimates = []
    for seed in range(8):
        noise_n = 0.002 * np.random.default_rng(seed).standard_normal(len(time_s))
        recorded = recording(true_force(time_s) + noise_n, MOTION, time_s)
        noise = phase_noise(recorded, segment(recorded))
        estimates.append([p.sd_n for p in noise if p.kind in ("hold", "rest")])
    assert np.mean(estimates) == pytest.approx(0.002, rel=0.1)


def test_phases_too_short_to_tell_noise_are_refused() -> None:
    time_s = np.arange(0.0, 130.0, 1.0)
    recorded = recording(true_force(time_s), MOTION, time_s)
    phases = tuple(Phase("hold", 1, a, a + 10.0) for a in np.arange(0.0, 130.0, 10.0))
    with pytest.raises(InputError, match="longest phase is 10; at least 15"):
        phase_noise(recorded, phases)


@pytest.mark.parametrize(
    ("interval_s", "width_s"), [(0.01, 0.5), (0.25, 0.5), (0.26, 1.0), (0.5, 1.0), (1.0, 2.0), (2.0, 5.0)]
)
def test_bins_are_wide_enough_for_two_samples(interval_s: float, width_s: float) -> None:
    time_s = np.arange(0.0, 130.0, interval_s)
    recorded = recording(true_force(time_s), MOTION, time_s)
    assert fitting_width_s(recorded) == width_s
    assert np.diff(np.searchsorted(time_s + 1e-9, uniform_edges(float(time_s[-1]), width_s))).min() >= 2


def test_the_description_says_what_a_recording_cannot_tell() -> None:
    time_s = np.arange(0.0, 60.0, 0.5)
    recorded = Recording(time_s, 1e-4 * time_s, 4e-3 * time_s + 1e-3 * np.sin(31 * time_s), "pull", "")
    phases = segment(recorded)
    noise = phase_noise(recorded, phases)
    said = describe_json(recorded, phases, noise)["cannot_tell"]
    assert [sentence.split(",")[0] for sentence in said] == [
        "There is no hold", "There is no unloading", "Samples are 0.5 s apart. Spikes and steps of the force "
        "can hardly be told from noise. Bins need a width of 1 s (fit.bin_width_s).",
    ]  # fmt: skip
    assert all(sentence in describe(recorded, phases, noise) for sentence in said)


def test_the_description_says_what_was_found() -> None:
    recorded, analysis = noisy(*NOISES[1], 0)
    noise = summarise(analysis, PHASES)
    text = describe(recorded, PHASES, noise)
    assert "13001 samples at 100 Hz" in text
    assert text.count("\n   load ") + text.count("\n unload ") == 4
    facts = describe_json(recorded, PHASES, noise)
    assert json.loads(json.dumps(facts)) == facts
    assert facts["cannot_tell"] == []
    assert [p["kind"] for p in facts["phases"]] == KINDS


def test_the_articles_recording_has_one_sided_spikes_and_steps_of_its_zero() -> None:
    real = article_recording()
    phases = segment(real)
    analysis = analyse(real, phases)
    noise = summarise(analysis, phases)
    still = [p for p in noise if p.kind in ("rest", "hold")]
    assert sum(p.spikes for p in still) > 150
    assert sum(p.spikes_above for p in still) > 0.95 * sum(p.spikes for p in still)
    assert all(1e-3 < p.sd_n < 6e-3 for p in still)
    steps = {
        round(float(t)): float(s) for p in noise for t, s in zip(p.step_times_s, p.step_sizes_n, strict=True)
    }
    assert {3, 66, 231, 287, 319} <= set(steps)
    assert steps[3] > 0 > steps[66]
    binned = bin_recording(real, phases, uniform_edges(real), analysis)
    assert len(binned.force_n) == 694
    raw = real.force_n[:34700].reshape(694, 50)
    assert np.median(np.abs(binned.force_n - raw.mean(axis=1))) < 1e-3
    assert (binned.variance_n2 > 0).all()
    assert (np.abs(binned.correlation) < 1).all()


def test_the_last_sample_stands_for_an_interval() -> None:
    """A recording at 20 Hz up to 129.95 s has as many bins as one to 130 s."""
    time_s = 0.05 * np.arange(2600)
    recorded = recording(true_force(time_s), MOTION, time_s)
    assert uniform_edges(covered_s(recorded, MOTION))[-1] == EDGES_S[-1] == 130.0
    means = bin_recording(recorded, segment(recorded), EDGES_S).force_n
    np.testing.assert_allclose(means[-1], true_bin_means()[-1], atol=5e-4)
    assert covered_s(recording(FORCE_N), MOTION) == 130.0
    with pytest.raises(InputError, match=r"within 0 to 130 s"):
        bin_recording(recorded, segment(recorded), np.append(EDGES_S, 130.5))
