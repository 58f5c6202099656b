"""The likelihood against exact normals, numerical integration and its own noise."""

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import optimize, stats
from toys.inference_problems import NOISE, TRUTH, empty_recording, toy_problem

from bayeskin.errors import InputError
from bayeskin.inference.likelihood import ERROR_PRIOR, log_likelihood
from bayeskin.inference.noise_model import (
    NoiseChain,
    bins_in_windows,
    draw_noise,
    innovations,
    noise_chain,
    noise_covariance,
    noise_space,
)
from bayeskin.types import Array, BinnedForce, Prediction


def irregular_recording(bins: int, rng: np.random.Generator) -> BinnedForce:
    """Unequal bins through all four kinds of phase, with variance and correlation of their own."""
    base = empty_recording()
    edges = np.cumsum(rng.uniform(0.3, 0.9, bins + 1))
    phase = np.repeat(np.arange(5), -(-bins // 5))[:bins]
    return BinnedForce(
        edges, 0.01 * rng.standard_normal(bins), rng.uniform(0, 2e-5, bins),
        rng.uniform(-0.2, 0.6, bins - 1), phase, base.phases,
    )  # fmt: skip


def prediction_of(bins: int, rank: int, rng: np.random.Generator, points: int = 3) -> Prediction:
    time = np.linspace(0, 1, bins)
    modes = np.stack([np.cos(np.pi * a * time) for a in range(rank)], -1) if rank else np.zeros((bins, 0))
    mean = 0.01 * rng.standard_normal((points, 1)) * np.sin(5 * time)
    factor = 0.01 * rng.uniform(0.5, 1.5, (points, 1, rank)) * modes
    return Prediction(mean, factor, rng.uniform(0, 1e-5, (points, bins)))


def noise_vectors(kinds: int, nu: float, rng: np.random.Generator, points: int = 3) -> Array:
    sd = 10 ** rng.uniform(-2.5, -1.5, (points, kinds))
    return np.column_stack([sd, rng.uniform(0.2, 8.0, points), np.full(points, nu)])


def covariance(chain: NoiseChain, noise: Array, diagonal: Array) -> Array:
    """Returns the covariance of noise with a memory, quicker noise and white noise, entry by entry."""
    k, sd = len(chain.bins), noise[chain.kind]
    time_s, out = np.cumsum(chain.gap_s), np.diag(diagonal[chain.bins])
    for a in range(k):
        for b in range(a, k):
            apart = chain.starts[a + 1 : b + 1].any()
            memory = 0.0 if apart else np.exp(-(time_s[b] - time_s[a]) / noise[-2])
            quick = 0.0 if apart else np.prod(chain.correlation[a + 1 : b + 1])
            both = sd[a] * sd[b] * memory + quick * np.sqrt(chain.variance_n2[a] * chain.variance_n2[b])
            out[a, b] += both
            out[b, a] = out[a, b]
    return out


def drawn(binned: BinnedForce, prediction: Prediction, noise: Array, rng: np.random.Generator) -> BinnedForce:
    """The recording with a force drawn from the model at the first point."""
    error = draw_noise(noise_chain(binned), noise[:1], prediction.diagonal[:1], rng)[0]
    latent = prediction.factor[0] @ rng.standard_normal(prediction.factor.shape[2])
    return dataclasses.replace(binned, force_n=prediction.mean[0] + latent + error)


@pytest.mark.parametrize("rank", [0, 1, 6])
@pytest.mark.parametrize("windows", [None, [(3.0, 12.0), (12.0, 20.0), (25.0, 40.0)]])
def test_with_gaussian_tails_it_is_the_multivariate_normal(
    rank: int, windows: list[tuple[float, float]] | None
) -> None:
    rng = np.random.default_rng(rank)
    binned = irregular_recording(70, rng)
    chain = noise_chain(binned, windows)
    prediction, noise = prediction_of(70, rank, rng), noise_vectors(len(chain.kinds), np.inf, rng)
    got = log_likelihood(chain, prediction, noise)
    for i in range(3):
        factor = prediction.factor[i, chain.bins]
        total = covariance(chain, noise[i], prediction.diagonal[i]) + factor @ factor.T
        exact = stats.multivariate_normal(prediction.mean[i, chain.bins], total).logpdf(chain.force_n)
        assert got[i] == pytest.approx(exact, rel=1e-8)


def test_one_sd_for_all_phases_is_the_same_sd_for_each() -> None:
    rng = np.random.default_rng(3)
    binned, windows = irregular_recording(60, rng), [(2.0, 14.0), (15.0, 30.0)]
    each, together = noise_chain(binned, windows), noise_chain(binned, windows, by_kind=False)
    prediction, noise = prediction_of(60, 2, rng), noise_vectors(1, 8.0, rng)
    repeated = np.column_stack([np.repeat(noise[:, :1], len(each.kinds), axis=1), noise[:, 1:]])
    got = log_likelihood(together, prediction, noise)
    assert got == pytest.approx(log_likelihood(each, prediction, repeated), rel=1e-12)
    assert noise_space(together.kinds).names == ("sd_noise", "tau_noise", "nu_noise")


def test_neighbours_covary_as_both_noises_say() -> None:
    rng = np.random.default_rng(1)
    binned = irregular_recording(30, rng)
    chain = noise_chain(binned)
    noise = noise_vectors(len(chain.kinds), 5.0, rng)[0]
    got = covariance(chain, noise, np.zeros(30))
    sd = noise[chain.kind]
    assert np.diag(got) == pytest.approx(sd**2 + binned.variance_n2)
    own = binned.correlation * np.sqrt(binned.variance_n2[1:] * binned.variance_n2[:-1])
    sampled = sd[1:] * sd[:-1] * np.exp(-np.diff(binned.time_s) / noise[-2])
    assert np.diag(got, 1) == pytest.approx(own + sampled)
    assert noise_covariance(chain, noise, np.zeros(30)) == pytest.approx(got)


def test_innovations_of_the_noise_are_independent() -> None:
    """They are the noise by the inverse of its covariance's Cholesky factor."""
    rng = np.random.default_rng(8)
    chain = noise_chain(irregular_recording(40, rng), [(0.0, 9.0), (9.0, 30.0)])
    noise, diagonal = noise_vectors(len(chain.kinds), 5.0, rng)[0], rng.uniform(0, 1e-5, 40)
    root = np.linalg.cholesky(covariance(chain, noise, diagonal))
    columns = rng.standard_normal((len(chain.bins), 3))
    own = diagonal[chain.bins]
    assert innovations(chain, noise, own, columns) == pytest.approx(np.linalg.solve(root, columns))


def test_an_omitted_bin_is_a_marginalised_bin() -> None:
    rng = np.random.default_rng(2)
    binned = irregular_recording(40, rng)
    force = np.array(binned.force_n)
    force[[7, 8, 20]] = np.nan
    holed = dataclasses.replace(binned, force_n=force)
    noise = noise_vectors(4, 5.0, rng)[0]
    chain = noise_chain(holed)
    whole = covariance(noise_chain(binned), noise, np.zeros(40))
    assert covariance(chain, noise, np.zeros(40)) == pytest.approx(whole[np.ix_(chain.bins, chain.bins)])


def test_fit_windows_share_nothing_but_the_surrogate_error() -> None:
    rng = np.random.default_rng(3)
    binned = irregular_recording(60, rng)
    windows = [(2.0, 15.0), (15.0, 30.0)]
    prediction = prediction_of(60, 0, rng)
    both = noise_chain(binned, windows)
    noise = noise_vectors(len(both.kinds), 4.0, rng)
    parts = 0.0
    for window in windows:
        chain = noise_chain(binned, [window])
        columns = [both.kinds.index(kind) for kind in chain.kinds]
        parts = parts + log_likelihood(chain, prediction, noise[:, [*columns, -2, -1]])
    assert log_likelihood(both, prediction, noise) == pytest.approx(parts, rel=1e-12)


def heights_over(binned: BinnedForce, prediction: Prediction, noise: Array, i: int, z: Array) -> Array:
    """log of likelihood times prior of the latents z (n, r), by the rank-0 likelihood of shifted means."""
    n, bins = len(z), prediction.mean.shape[1]
    shifted = Prediction(
        prediction.mean[i] + z @ prediction.factor[i].T, np.zeros((n, bins, 0)),
        np.repeat(prediction.diagonal[i : i + 1], n, axis=0),
    )  # fmt: skip
    repeated = np.repeat(noise[i : i + 1], n, axis=0)
    return log_likelihood(noise_chain(binned), shifted, repeated) + stats.norm.logpdf(z).sum(axis=1)


@pytest.mark.parametrize("nu", [2.0, 4.0, 15.0, 100.0])
@pytest.mark.parametrize(("rank", "grid"), [(1, 4001), (2, 81)])
def test_with_heavy_tails_it_is_the_integral_over_the_latents(nu: float, rank: int, grid: int) -> None:
    rng = np.random.default_rng(int(nu) + rank)
    base = irregular_recording(80, rng)
    prediction, noise = prediction_of(80, rank, rng), noise_vectors(4, nu, rng)
    binned = drawn(base, prediction, noise, rng)
    line = np.linspace(-7.0, 7.0, grid)
    z = np.stack(np.meshgrid(*[line] * rank, indexing="ij"), -1).reshape(-1, rank)
    got = log_likelihood(noise_chain(binned), prediction, noise)
    height = heights_over(binned, prediction, noise, 0, z)
    exact = np.logaddexp.reduce(height) + rank * np.log(line[1] - line[0])
    assert got[0] == pytest.approx(exact, abs=0.05 if nu < 10 else 0.01)


def test_heavy_tails_become_gaussian_ones() -> None:
    rng = np.random.default_rng(4)
    binned = irregular_recording(50, rng)
    prediction, noise = prediction_of(50, 3, rng), noise_vectors(4, 1e9, rng)
    gaussian = noise.copy()
    gaussian[:, -1] = np.inf
    chain = noise_chain(binned)
    assert log_likelihood(chain, prediction, noise) == pytest.approx(
        log_likelihood(chain, prediction, gaussian), abs=1e-3
    )


def test_the_latent_mode_is_found_beside_outliers() -> None:
    """Twenty bins thrown off by a newton move the latents less than their posterior sd."""
    rng = np.random.default_rng(6)
    base = irregular_recording(120, rng)
    prediction, noise = prediction_of(120, 1, rng), noise_vectors(4, 3.0, rng)
    binned = drawn(base, prediction, noise, rng)
    force = np.array(binned.force_n)
    force[rng.choice(120, 20, replace=False)] += 1.0
    binned = dataclasses.replace(binned, force_n=force)
    z = np.linspace(-7, 7, 4001)[:, None]
    exact = np.logaddexp.reduce(heights_over(binned, prediction, noise, 0, z)) + np.log(z[1, 0] - z[0, 0])
    assert log_likelihood(noise_chain(binned), prediction, noise)[0] == pytest.approx(exact, abs=0.05)


@pytest.mark.parametrize(("far", "seed"), [(4.0, 0), (8.0, 1), (30.0, 2), (100.0, 9)])
def test_latents_beyond_what_a_surrogate_denies_are_found_as_by_a_general_optimiser(
    far: float, seed: int
) -> None:
    """With the last seed a whole step goes too far."""
    rng = np.random.default_rng(seed)
    base = irregular_recording(100, rng)
    prediction, noise = prediction_of(100, 4, rng, points=1), noise_vectors(4, 60.0, rng, points=1)
    latent = far * rng.standard_normal(4)
    shift = prediction.factor[0] @ latent
    binned = dataclasses.replace(base, force_n=prediction.mean[0] + shift)
    chain, nu = noise_chain(binned), noise[0, -1]
    columns = np.column_stack([shift, prediction.factor[0]])[chain.bins]
    white = innovations(chain, noise[0], prediction.diagonal[0, chain.bins], columns)

    def energy(z: Array) -> float:
        beyond = np.maximum(np.abs(z) - ERROR_PRIOR.farthest, 0.0)
        logs = np.log1p((white[:, 0] - white[:, 1:] @ z) ** 2 / nu)
        return 0.5 * float(z @ z + ERROR_PRIOR.stiff * beyond @ beyond) + 0.5 * (nu + 1.0) * float(logs.sum())

    tops = [optimize.minimize(energy, share * latent, tol=1e-10) for share in (0.0, 0.2, 1.0)]
    z = min(tops, key=lambda top: top.fun).x
    square = (white[:, 0] - white[:, 1:] @ z) ** 2
    bend = (nu + 1.0) * (nu - square) / (nu + square) ** 2
    stiff = ERROR_PRIOR.stiff * (np.abs(z) > ERROR_PRIOR.farthest)
    curvature = (white[:, 1:].T * bend) @ white[:, 1:] + np.diag(1.0 + stiff)
    scale = np.diag(np.linalg.cholesky(covariance(chain, noise[0], prediction.diagonal[0])))
    density = len(white) * stats.t.logpdf(0.0, nu) - np.log(scale).sum()
    expected = density - energy(z) - 0.5 * np.linalg.slogdet(curvature)[1]
    assert log_likelihood(chain, prediction, noise)[0] == pytest.approx(expected, rel=1e-6, abs=1e-3)


def test_drawn_noise_has_the_chain_s_covariance() -> None:
    rng = np.random.default_rng(7)
    binned = irregular_recording(12, rng)
    chain = noise_chain(binned, [(0.0, 4.0), (4.0, 20.0)])
    noise = noise_vectors(len(chain.kinds), 1e6, rng)[0]
    diagonal = np.full(12, 1e-5)
    n = 40000
    draws = draw_noise(chain, np.tile(noise, (n, 1)), np.tile(diagonal[chain.bins], (n, 1)), rng)
    exact = covariance(chain, noise, diagonal)
    sd = np.sqrt(np.diag(exact))
    assert np.cov(draws.T) / np.outer(sd, sd) == pytest.approx(exact / np.outer(sd, sd), abs=0.03)


def test_a_block_is_scored_given_the_others() -> None:
    """The score of Gaussian tails is the conditional normal density of the block."""
    problem = toy_problem()
    quiet = problem.binned
    problem.surrogate.predict = _without_diagonal(problem.surrogate.predict)
    theta = np.array([[*TRUTH.values(), *NOISE.values()]])
    theta[0, -1] = np.inf
    prediction = problem.predict(theta)
    total = covariance(problem.chain, theta[0, 5:], prediction.diagonal[0])
    total = total + prediction.factor[0] @ prediction.factor[0].T
    residual = quiet.force_n - prediction.mean[0]
    inside = quiet.phase == problem.blocks[2]
    gain = np.linalg.solve(total[np.ix_(~inside, ~inside)], total[np.ix_(~inside, inside)]).T
    rest = total[np.ix_(inside, inside)] - gain @ total[np.ix_(~inside, inside)]
    exact = stats.multivariate_normal(gain @ residual[~inside], rest, allow_singular=True)
    got = problem.block_log_likelihood(theta)
    assert got.shape == (1, 9)
    assert got[0, 2] == pytest.approx(exact.logpdf(residual[inside]), rel=1e-6)


def _without_diagonal(predict):  # type: ignore[no-untyped-def]
    def bare(theta: Array) -> Prediction:
        return dataclasses.replace(predict(theta), diagonal=np.zeros((len(np.atleast_2d(theta)), 130)))

    return bare


def test_outside_the_box_and_without_a_number_the_density_is_zero() -> None:
    problem = toy_problem()
    low, high = problem.bounds
    inside = 0.5 * (low + high)
    outside = np.where(np.arange(problem.dim) == 3, high + 1e-6, inside)
    nan = np.where(np.arange(problem.dim) == 0, np.nan, inside)
    got = problem.log_prob([inside, outside, nan, low, high])
    assert np.isfinite(got[[0, 3, 4]]).all()
    assert (got[[1, 2]] == -np.inf).all()


def test_priors_are_uniform_in_sampling_coordinates() -> None:
    problem = toy_problem()
    low, high = problem.bounds
    theta = problem.from_sampling(np.random.default_rng(0).uniform(low, high, (5, problem.dim)))
    expected = problem.log_likelihood(theta) - np.log(high - low).sum()
    assert problem.log_prob(problem.to_sampling(theta)) == pytest.approx(expected, rel=1e-10)
    assert problem.names[5:] == tuple(NOISE)


def test_only_bins_wholly_inside_a_window_are_fitted() -> None:
    binned = empty_recording()
    assert np.flatnonzero(bins_in_windows(binned, [(3.5, 7.9)]) == 0).tolist() == [4, 5, 6]
    for bad in ([(5.0, 3.0)], [(0.0, 10.0), (5.0, 20.0)]):
        with pytest.raises(InputError, match="windows must be in order"):
            bins_in_windows(binned, bad)
    with pytest.raises(InputError, match="no bin"):
        noise_chain(binned, [(3.1, 3.9)])


def test_a_surrogate_of_other_bins_or_a_wider_prior_is_refused() -> None:
    problem = toy_problem()
    coarse = empty_recording(np.arange(0.0, 131.0, 2.0))
    with pytest.raises(InputError, match="130 bins"):
        dataclasses.replace(problem, binned=coarse)
    wide = dataclasses.replace(problem.space.parameters[0], upper=1e9)
    material = dataclasses.replace(problem.surrogate.space, parameters=(wide, *problem.space.parameters[1:5]))
    with pytest.raises(InputError, match="prior of E_c"):
        dataclasses.replace(problem, material=material)


def test_windows_are_the_same_as_lists_and_as_tuples() -> None:
    problem = toy_problem(windows=((15.0, 45.0),))
    other = dataclasses.replace(problem, fit_windows=[[15, 45]])
    assert problem.identity == other.identity


SCRIPT = """
import hashlib
import numpy as np
from toys.inference_problems import toy_problem
posterior = toy_problem()
low, high = posterior.bounds
values = posterior.log_prob(np.random.default_rng(1).uniform(low, high, (200, posterior.dim)))
print(hashlib.sha256(values.tobytes()).hexdigest())
"""


@pytest.mark.slow  # compiles
def test_it_is_the_same_to_the_last_bit_whether_just_compiled_or_loaded(tmp_path: Path) -> None:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(Path(__file__).parent)}
    hashes = [
        subprocess.run(
            [sys.executable, "-c", SCRIPT], env=environment, check=True, capture_output=True, text=True
        ).stdout
        for _ in range(2)
    ]
    assert hashes[0] == hashes[1] != ""
