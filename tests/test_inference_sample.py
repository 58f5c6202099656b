"""Moves that keep their target, chains that go on bit for bit, verdicts that are earned."""

import dataclasses
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import arviz as az
import emcee
import numpy as np
import pytest
from scipy import stats
from toy_inference import NOISE, TRUTH, ToySurrogate, line_problem, toy_problem
from toys import banana

from bayeskin.errors import InputError
from bayeskin.inference import Limits, LogPosterior, SampleSettings, identifiability, load_chains, sample
from bayeskin.inference.convergence import assess, autocorrelation_steps, split_rhat
from bayeskin.inference.coordinates import MoveCoordinates
from bayeskin.inference.moves import SnookerMove, SubspaceMove, TriesMove, mixed_moves
from bayeskin.inference.proposal import Mixture, Product
from bayeskin.inference.reparametrisation import Shear, find_shear
from bayeskin.types import Array

LINE_START = {"a": 0.2, "b": -0.3, "sd_hold": 0.05002, "tau_noise": 0.0010005, "nu_noise": 1.0005e6}
SHORT = SampleSettings(ensembles=2, walkers=16, max_steps=500)


def unit_normal_variance(moves: object, dim: int, steps: int) -> tuple[float, float]:
    """Mean variance of a unit normal as the moves leave it, with its standard error from 20 batches."""
    random = np.random.RandomState(1)
    sampler = emcee.EnsembleSampler(30, dim, lambda x: -0.5 * (x**2).sum(axis=1), moves=moves, vectorize=True)
    sampler.run_mcmc(emcee.State(random.randn(30, dim), random_state=random.get_state()), steps)
    square = (sampler.get_chain()[steps // 10 :] ** 2).mean(axis=(1, 2))
    batches = [b.mean() for b in np.array_split(square, 20)]
    return float(square.mean()), float(np.std(batches, ddof=1) / np.sqrt(20))


def curved_shear(dim: int) -> Shear:
    group = np.arange(dim) < 2
    weight = np.where(group, 0.3, -np.inf)
    powers = np.zeros((1, dim), dtype=np.int64)
    powers[0, -1] = 2
    return Shear(group, weight, powers, np.array([0.7]), np.zeros(dim), np.full(dim, 2.0))


def walled(shear: Shear | None) -> MoveCoordinates:
    return MoveCoordinates(shear, np.full(5, -9.0), np.full(5, 9.0))


def learnt(shear: Shear | None) -> Product:
    """From draws of another distribution than the unit normal, so that tries are weighed."""
    rng = np.random.default_rng(3)
    draws = 0.3 + 1.2 * rng.standard_normal((3000, 5))
    return Product.of(walled(shear).forward(draws), (slice(0, 2), slice(2, 5)), rng)


@pytest.mark.parametrize(
    "moves",
    [
        SnookerMove(),
        SubspaceMove(),
        TriesMove(walled(curved_shear(5))),
        TriesMove(walled(None)),
        TriesMove(walled(None), learnt(None)),
        TriesMove(walled(curved_shear(5)), learnt(curved_shear(5))),
        mixed_moves(walled(curved_shear(5)), 30),
        mixed_moves(walled(None), 30),
        mixed_moves(walled(None), 14),
        mixed_moves(walled(curved_shear(5)), 30, learnt(curved_shear(5))),
    ],
    ids=[
        "snooker",
        "subspace",
        "tries, straightened",
        "tries, normal scores",
        "learnt tries, normal scores",
        "learnt tries, straightened",
        "all, straightened",
        "all, normal scores",
        "without tries",
        "all, learnt tries",
    ],
)
def test_a_move_keeps_a_unit_normal(moves: object) -> None:
    mean, error = unit_normal_variance(moves, 5, 2000)
    assert abs(mean - 1.0) < 4 * error + 0.005
    assert error < 0.02


def test_tries_are_made_where_the_walkers_tell_a_distribution() -> None:
    for walkers, tries in ((15, True), (14, False)):
        moves = mixed_moves(walled(None), walkers)
        assert any(isinstance(move, TriesMove) for move, _ in moves) == tries
        assert sum(share for _, share in moves) == pytest.approx(1.0)


def test_tries_keep_the_shares_of_two_modes_between_walls() -> None:
    def log_prob(x: np.ndarray) -> np.ndarray:
        low, high = (-0.5 * np.sum(((x - centre) / 0.3) ** 2, axis=1) for centre in (1.0, 3.0))
        inside = np.all((x > 0.0) & (x < 4.0), axis=1)
        return np.where(inside, np.logaddexp(np.log(0.8) + low, np.log(0.2) + high), -np.inf)

    move = TriesMove(MoveCoordinates(None, np.zeros(3), np.full(3, 4.0)))
    random = np.random.RandomState(2)
    sampler = emcee.EnsembleSampler(30, 3, log_prob, moves=move, vectorize=True)
    sampler.run_mcmc(emcee.State(random.uniform(0.0, 4.0, (30, 3)), random_state=random.get_state()), 6000)
    means = [batch.mean() for batch in np.array_split(sampler.get_chain()[600:], 20)]
    error = np.std(means, ddof=1) / np.sqrt(20)
    assert abs(np.mean(means) - 1.4) < 4 * error
    assert error < 0.01


def test_a_mixture_s_density_is_that_of_its_draws() -> None:
    """E_q[p / q] is 1 for a density p that q covers; and components follow two parts of unequal share."""
    rng = np.random.default_rng(4)
    left = rng.random(4000) < 0.3
    draws = rng.standard_normal((4000, 3)) * 0.2 + np.where(left, -2.0, 1.0)[:, None]
    mixture = Mixture.of(draws, rng)
    points = mixture.draw(40000, np.random.RandomState(5))
    ratio = np.exp(stats.multivariate_normal(np.ones(3), 0.04).logpdf(points) - mixture.log_density(points))
    assert np.mean(ratio) == pytest.approx(1.0, abs=4 * np.std(ratio) / 200)
    assert np.mean(points[:, 0] < -0.5) == pytest.approx(np.mean(left), abs=0.02)


def test_a_thin_curved_ridge_is_sampled_to_its_ends(tmp_path: Path) -> None:
    start = dict.fromkeys(banana.NAMES, 0.0) | {"b": -1.0}
    posterior = sample(banana.Banana(), tmp_path, 1, start, SampleSettings(4, 40, 500), threads=2)  # type: ignore[arg-type]
    assert posterior.convergence.verdict.trusted, posterior.convergence.verdict.reasons
    draws, error = posterior.flat, np.sqrt(banana.VARIANCE / posterior.convergence.ess)
    assert np.abs((draws.mean(axis=0) - banana.MEAN) / error).max() < 4.0
    kurtosis = ((draws - banana.MEAN) ** 4).mean(axis=0) / banana.VARIANCE**2
    spread = np.sqrt((kurtosis - 1.0) / posterior.convergence.ess)
    assert np.abs((draws.var(axis=0) / banana.VARIANCE - 1.0) / spread).max() < 4.0


def test_densities_on_file_are_the_posterior_s_at_every_step(tmp_path: Path) -> None:
    """Also at those that are drawn from a power of it."""
    problem = line_problem()
    sample(problem, tmp_path, 7, LINE_START, SHORT)
    stored = emcee.backends.HDFBackend(str(tmp_path / "ensemble_0.h5"), read_only=True)
    expected = problem.log_prob(stored.get_chain().reshape(-1, problem.dim)).reshape(500, 16)
    assert stored.get_log_prob() == pytest.approx(expected, rel=1e-10)


def test_fewer_steps_than_lead_to_the_posterior_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"sample\.max_steps.*499.*at least 500"):
        sample(line_problem(), tmp_path / "new", 7, LINE_START, dataclasses.replace(SHORT, max_steps=499))
    assert not (tmp_path / "new").exists()


def test_a_walker_on_top_of_its_anchor_stays_where_it_is() -> None:
    walkers, others = np.zeros((3, 2)), [np.zeros((4, 2))]
    with np.errstate(all="raise"):
        proposal, factor = SnookerMove().get_proposal(walkers, others, np.random.RandomState(1))
    assert np.all(proposal == walkers)
    assert np.all(factor == -np.inf)


def test_a_shear_is_undone_by_its_inverse_and_keeps_volumes_in_proportion() -> None:
    shear = curved_shear(4)
    x = np.random.default_rng(0).standard_normal((50, 4))
    assert shear.back(shear.straight(x)) == pytest.approx(x, abs=1e-12)
    step = 1e-6
    volumes = []
    for point in x[:10]:
        moved = shear.straight(point + step * np.vstack([np.eye(4), -np.eye(4)]))
        volumes.append(np.linalg.det((moved[:4] - moved[4:]) / (2 * step)))
    assert np.abs(volumes) == pytest.approx(abs(volumes[0]), rel=1e-6)


def test_the_ridge_of_the_moduli_is_straight() -> None:
    problem = toy_problem()
    shear = find_shear(problem)
    assert shear is not None
    assert [n for n, g in zip(problem.names, shear.group, strict=True) if g] == ["E_c", "E_s"]
    theta = np.tile([*TRUTH.values(), *NOISE.values()], (5, 1))
    theta[:, 1] = [2e3, 5e3, 2e4, 4e4, 5e4]
    theta[:, 0] = 1e5 + 2.6 * (2e4 - theta[:, 1])
    recorded = problem.binned.force_n
    amplitude = problem.predict(theta).mean @ recorded / (recorded @ recorded)
    x = problem.to_sampling(theta)
    assert np.ptp(x[:, 0]) > 1.0
    assert shear.straight(x)[:, 0] == pytest.approx(np.log(amplitude), abs=0.01)


def test_nothing_is_straightened_where_no_two_parameters_share_the_force() -> None:
    assert find_shear(line_problem()) is None


def test_a_linear_model_gets_its_gaussian_posterior(tmp_path: Path) -> None:
    problem = line_problem()
    settings = SampleSettings(2, 16, 3000, Limits(effective_samples=1500, lengths=40, rhat=1.02))
    posterior = sample(problem, tmp_path, 3, LINE_START, settings)
    x = problem.surrogate.columns
    covariance = 0.050025**2 * np.eye(40) + 1e-6 * np.eye(40) + 1e-4 * np.outer(x[1], x[1])
    information = x @ np.linalg.solve(covariance, x.T)
    mean = np.linalg.solve(information, x @ np.linalg.solve(covariance, problem.binned.force_n))
    sd = np.sqrt(np.diag(np.linalg.inv(information)))
    assert posterior.convergence.verdict.trusted, posterior.convergence.verdict.reasons
    assert (posterior.flat[:, :2].mean(axis=0) - mean) / sd == pytest.approx(0, abs=0.1)
    assert posterior.flat[:, :2].std(axis=0) / sd == pytest.approx(1, abs=0.07)
    assert posterior.convergence.ess.min() > 1500
    # Thinned by the autocorrelation time, rounded up: so many times fewer draws than effective samples.
    found = posterior.convergence
    rounded = found.thin / found.tau_steps.max()
    assert len(posterior.flat) == pytest.approx(found.ess.min() / rounded, rel=0.15)


def test_data_of_one_hold_cover_the_truth_and_leave_p_init_alone(tmp_path: Path) -> None:
    problem = toy_problem(windows=((15.0, 45.0),))
    start = {k: v for k, v in {**TRUTH, **NOISE}.items() if k in problem.names}
    settings = SampleSettings(2, 20, 1200, Limits(300, 12, 1.05))
    posterior = sample(problem, tmp_path, 1, start, settings)
    assert posterior.convergence.rhat.max() < 1.1
    unit = problem.space.to_unit(posterior.flat)
    place = (unit < problem.space.to_unit(list(start.values()))).mean(axis=0)
    assert ((place > 0.005) & (place < 0.995)).all()
    p_init = problem.names.index("p_init")
    independent = unit[:: max(1, len(unit) // 300), p_init]
    assert stats.kstest(independent, "uniform").pvalue > 0.001
    assert np.mean(unit[:, p_init]) == pytest.approx(0.5, abs=0.1)
    learned = identifiability(posterior.space, posterior.flat).parameters[0]
    assert learned.contraction > 0.5


def test_a_run_in_two_parts_is_the_run_in_one(tmp_path: Path) -> None:
    problem = line_problem()
    longer = dataclasses.replace(SHORT, max_steps=600, limits=Limits(effective_samples=1e9))
    whole = sample(problem, tmp_path / "one", 7, LINE_START, longer)
    sample(problem, tmp_path / "two", 7, LINE_START, SHORT)
    parts = sample(problem, tmp_path / "two", 7, LINE_START, longer)
    assert np.array_equal(whole.draws, parts.draws)
    assert np.array_equal(*(load_chains(tmp_path / part, problem, 2) for part in ("one", "two")))
    other = sample(problem, tmp_path / "three", 8, LINE_START, longer)
    assert not np.array_equal(whole.log_prob, other.log_prob)
    assert not np.array_equal(*load_chains(tmp_path / "one", problem, 2))  # ensembles are independent


def test_chains_of_more_ensembles_than_are_asked_for_are_left_alone(tmp_path: Path) -> None:
    problem = line_problem()
    sample(problem, tmp_path, 7, LINE_START, dataclasses.replace(SHORT, ensembles=3))
    further = SampleSettings(2, 16, 520, Limits(effective_samples=1e9))
    sample(problem, tmp_path, 7, LINE_START, further)
    assert load_chains(tmp_path, problem, 2).shape[:2] == (2, 520)


def test_threads_change_nothing(tmp_path: Path) -> None:
    problem = line_problem()
    settings = SampleSettings(3, 16, 600, Limits(effective_samples=1e9))
    alone = sample(problem, tmp_path / "one", 7, LINE_START, settings)
    together = sample(problem, tmp_path / "two", 7, LINE_START, settings, threads=2)
    assert np.array_equal(alone.draws, together.draws)


def test_an_error_in_a_thread_is_not_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(self: object, goal: int) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(sys.modules["bayeskin.inference.sample"]._Ensemble, "advance", fail)
    with pytest.raises(ZeroDivisionError):
        sample(line_problem(), tmp_path, 7, LINE_START, SampleSettings(2, 16, 600), threads=2)


def test_an_interrupted_run_goes_on_bit_for_bit(tmp_path: Path) -> None:
    problem = line_problem()
    settings = SampleSettings(2, 16, 750, Limits(effective_samples=1e9))
    whole = sample(problem, tmp_path / "one", 7, LINE_START, settings)

    def interrupt(_: float, text: str) -> None:
        if "ensemble 2" in text and "step 700" in text:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sample(problem, tmp_path / "two", 7, LINE_START, settings, interrupt)
    steps = [
        emcee.backends.HDFBackend(str(tmp_path / "two" / f"ensemble_{e}.h5"), read_only=True).iteration
        for e in (0, 1)
    ]
    assert steps == [750, 500]
    assert np.array_equal(whole.draws, sample(problem, tmp_path / "two", 7, LINE_START, settings).draws)


KILLED = """
import sys
from toy_inference import line_problem
from bayeskin.inference import Limits, SampleSettings, sample
start = {start!r}
sample(line_problem(), sys.argv[1], 7, start, SampleSettings(2, 16, 100000, Limits(effective_samples=1e9)))
"""


def test_a_killed_process_leaves_chains_that_go_on(tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    code = KILLED.format(start=LINE_START)
    process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path / "two")], env=environment)
    last = tmp_path / "two" / "ensemble_1.h5"
    deadline = time.monotonic() + 120
    while not last.exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    problem = line_problem()
    reached = emcee.backends.HDFBackend(str(last), read_only=True).iteration
    settings = SampleSettings(2, 16, max(500, reached + 20))
    settings = dataclasses.replace(settings, limits=Limits(effective_samples=1e9))
    whole = sample(problem, tmp_path / "one", 7, LINE_START, settings)
    assert np.array_equal(whole.draws, sample(problem, tmp_path / "two", 7, LINE_START, settings).draws)


def other_data(problem: LogPosterior) -> LogPosterior:
    force = np.array(problem.binned.force_n)
    force[3] += 1e-6
    return dataclasses.replace(problem, binned=dataclasses.replace(problem.binned, force_n=force))


def other_surrogate(problem: LogPosterior) -> LogPosterior:
    surrogate = type(problem.surrogate)()
    surrogate.columns = 1.001 * surrogate.columns  # its provenance says nothing of that
    return dataclasses.replace(problem, surrogate=surrogate)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (other_data, "another recording"),
        (other_surrogate, "another surrogate"),
        (lambda p: dataclasses.replace(p, fit_windows=((0.0, 0.5),)), "another fit windows"),
    ],
)
def test_chains_of_another_posterior_are_refused_and_kept(tmp_path: Path, change, complaint) -> None:  # type: ignore[no-untyped-def]
    problem = line_problem()
    sample(problem, tmp_path, 7, LINE_START, SHORT)
    before = (tmp_path / "ensemble_0.h5").read_bytes()
    with pytest.raises(InputError, match=complaint):
        sample(change(problem), tmp_path, 7, LINE_START, SHORT)
    assert (tmp_path / "ensemble_0.h5").read_bytes() == before


def test_another_shape_seed_or_file_is_refused(tmp_path: Path) -> None:
    problem = line_problem()
    sample(problem, tmp_path, 7, LINE_START, SHORT)
    with pytest.raises(InputError, match="another walkers"):
        sample(problem, tmp_path, 7, LINE_START, dataclasses.replace(SHORT, walkers=18))
    with pytest.raises(InputError, match="another seed"):
        sample(problem, tmp_path, 0, LINE_START, SHORT)
    toy = toy_problem(surrogate=ToySurrogate())
    with pytest.raises(InputError, match="a chain of a, b"):
        sample(toy, tmp_path, 7, {**TRUTH, **NOISE}, dataclasses.replace(SHORT, walkers=24))
    (tmp_path / "ensemble_0.h5").write_bytes(b"half a file")
    with pytest.raises(InputError, match="not readable as HDF5"):
        sample(problem, tmp_path, 7, LINE_START, SHORT)
    with pytest.raises(InputError, match="at least 12"):
        sample(problem, tmp_path / "new", 7, LINE_START, dataclasses.replace(SHORT, walkers=8))
    assert not (tmp_path / "new").exists()


def autoregressive(shape: tuple[int, ...], phi: float, rng: np.random.Generator) -> Array:
    """Chains (E, n, W, D) whose autocorrelation time is (1 + phi) / (1 - phi) steps."""
    noise = rng.standard_normal(shape)
    out = np.empty(shape)
    out[:, 0] = noise[:, 0]
    for i in range(1, shape[1]):
        out[:, i] = phi * out[:, i - 1] + np.sqrt(1 - phi**2) * noise[:, i]
    return out


def test_the_autocorrelation_time_is_that_of_the_process() -> None:
    chains = autoregressive((2, 3000, 20, 2), 0.8, np.random.default_rng(0))
    assert autocorrelation_steps(chains) == pytest.approx(9.0, rel=0.15)


def test_a_walker_that_moves_in_some_coordinates_counts_in_these() -> None:
    """A move in a subspace leaves the other coordinates as they are."""
    chains = autoregressive((1, 3000, 20, 2), 0.8, np.random.default_rng(3))
    chains[0, :, 0, 1] = 0.3
    assert autocorrelation_steps(chains) == pytest.approx(9.0, rel=0.2)


@pytest.mark.parametrize("shift", [0.0, 0.5])
def test_rhat_is_arviz_s(shift: float) -> None:
    draws = np.random.default_rng(0).standard_normal((4, 501)) ** 3
    draws[0] += shift
    assert split_rhat(draws) == pytest.approx(float(az.rhat(draws, method="rank")), abs=2e-4)


def judged(chains: Array, log_prob: Array | None = None) -> tuple[bool, str]:
    names = tuple("abc"[: chains.shape[3]])
    log_prob = -0.5 * (chains**2).sum(axis=3) if log_prob is None else log_prob
    verdict = assess(chains, log_prob, names, Limits()).verdict
    return verdict.trusted, verdict.reasons[0]


def test_a_verdict_is_trust_only_if_every_criterion_holds() -> None:
    rng = np.random.default_rng(1)
    good = autoregressive((4, 2000, 20, 2), 0.8, rng)
    assert judged(good)[0]
    trusted, reason = judged(good[:, :400])
    assert (trusted, "autocorrelation lengths" in reason) == (False, True)
    trusted, reason = judged(good[:, :, :2])
    assert (trusted, "effective samples" in reason) == (False, True)
    apart = good + np.array([0.6, 0, 0, 0])[:, None, None, None] * np.array([0.0, 1.0])
    trusted, reason = judged(apart)
    assert (trusted, "R-hat across 4 ensembles" in reason, "of b" in reason) == (False, True, True)
    assert not judged(good[:1])[0]
    assert not judged(np.where(np.arange(2) == 1, 1.0, good))[0]  # a parameter that does not move


def test_walkers_of_one_ensemble_do_not_hide_that_ensembles_disagree() -> None:
    """Each walker explores only its ensemble's mode: all agree within an ensemble, and none across."""
    chains = autoregressive((2, 2000, 20, 1), 0.5, np.random.default_rng(2))
    chains[1] += 3.0
    assert not judged(chains)[0]


def test_stuck_walkers_are_named() -> None:
    chains = autoregressive((2, 2000, 20, 2), 0.5, np.random.default_rng(3))
    chains[1, :, 4] = chains[1, 0, 4]
    low = -0.5 * (chains**2).sum(axis=3)
    low[0, :, 7] -= 40.0
    found = assess(chains, low, ("a", "b"), Limits())
    assert found.stuck == ((0, 7), (1, 4))
    assert "2 stuck walkers, ensemble 0 walker 7" in found.verdict.reasons[0]


def test_burn_in_leaves_the_start_behind() -> None:
    chains = autoregressive((2, 3000, 20, 1), 0.9, np.random.default_rng(4))
    chains += 30 * np.exp(-np.arange(3000) / 20.0)[:, None, None]
    found = assess(chains, -0.5 * (chains**2).sum(axis=3), ("a",), Limits())
    assert 100 < found.burn_in < 600
    assert found.rhat[0] < 1.01
