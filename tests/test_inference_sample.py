"""Chains of known posteriors that go on bit for bit after an interruption, and refuse another's file."""

import dataclasses
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import emcee
import numpy as np
import pytest
from scipy import stats
from toys import banana
from toys.coarse_proposals import propose_coarsely
from toys.inference_problems import NOISE, TRUTH, ToySurrogate, line_problem, toy_problem

from bayeskin.errors import InputError
from bayeskin.inference import (
    Limits,
    LogPosterior,
    Posterior,
    SampleSettings,
    identifiability,
    load_chains,
    sample,
)
from bayeskin.types import Array

LINE_START = {"a": 0.2, "b": -0.3, "sd_hold": 0.05002, "tau_noise": 0.0010005, "nu_noise": 1.0005e6}
SHORT = SampleSettings(ensembles=2, walkers=16, max_steps=500)
LONGER = SampleSettings(2, 16, 750, Limits(effective_samples=1e9))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Posterior]:
    """Chains on a line that were sampled at one go, with what they gave."""
    folder = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        propose_coarsely(patch)
        return folder, sample(line_problem(), folder, 7, LINE_START, LONGER)


@pytest.fixture
def coarsely(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets the sampler propose as in the chains above."""
    propose_coarsely(monkeypatch)


@pytest.fixture
def chains(whole: tuple[Path, Posterior], tmp_path: Path) -> Path:
    """A copy of the folder with these chains."""
    return Path(shutil.copytree(whole[0], tmp_path / "chains"))


def test_a_thin_curved_ridge_is_sampled_to_its_ends(tmp_path: Path) -> None:
    start = dict.fromkeys(banana.NAMES, 0.0) | {"b": -1.0}
    posterior = sample(banana.Banana(), tmp_path, 1, start, SampleSettings(4, 40, 500), threads=2)  # type: ignore[arg-type]
    assert posterior.convergence.verdict.trusted, posterior.convergence.verdict.reasons
    draws, error = posterior.flat, np.sqrt(banana.VARIANCE / posterior.convergence.ess)
    assert np.abs((draws.mean(axis=0) - banana.MEAN) / error).max() < 4.0
    kurtosis = ((draws - banana.MEAN) ** 4).mean(axis=0) / banana.VARIANCE**2
    spread = np.sqrt((kurtosis - 1.0) / posterior.convergence.ess)
    assert np.abs((draws.var(axis=0) / banana.VARIANCE - 1.0) / spread).max() < 4.0


def test_densities_on_file_are_the_posterior_s_at_every_step(chains: Path) -> None:
    """Also at those that are drawn from a power of it."""
    problem = line_problem()
    stored = emcee.backends.HDFBackend(str(chains / "ensemble_0.h5"), read_only=True)
    expected = problem.log_prob(stored.get_chain().reshape(-1, problem.dim)).reshape(750, 16)
    assert stored.get_log_prob() == pytest.approx(expected, rel=1e-10)


def test_fewer_steps_than_lead_to_the_posterior_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"sample\.max_steps.*499.*at least 500"):
        sample(line_problem(), tmp_path / "new", 7, LINE_START, dataclasses.replace(SHORT, max_steps=499))
    assert not (tmp_path / "new").exists()


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
    convergence = posterior.convergence
    rounded = convergence.thin / convergence.tau_steps.max()
    assert len(posterior.flat) == pytest.approx(convergence.ess.min() / rounded, rel=0.15)


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


@pytest.mark.usefixtures("coarsely")
def test_a_run_in_two_parts_is_the_run_in_one(whole: tuple[Path, Posterior], tmp_path: Path) -> None:
    problem = line_problem()
    sample(problem, tmp_path / "two", 7, LINE_START, SHORT)
    parts = sample(problem, tmp_path / "two", 7, LINE_START, LONGER)
    assert np.array_equal(whole[1].draws, parts.draws)
    chains = load_chains(tmp_path / "two", problem, 2)
    assert np.array_equal(load_chains(whole[0], problem, 2), chains)
    assert not np.array_equal(*chains)  # ensembles are independent
    sample(problem, tmp_path / "three", 8, LINE_START, dataclasses.replace(SHORT, ensembles=1))
    assert not np.array_equal(load_chains(tmp_path / "three", problem, 1), chains[:1, :500])


@pytest.mark.usefixtures("coarsely")
def test_chains_of_more_ensembles_than_are_asked_for_are_left_alone(chains: Path) -> None:
    problem = line_problem()
    before = (chains / "ensemble_1.h5").read_bytes()
    further = dataclasses.replace(LONGER, ensembles=1, max_steps=770)
    sample(problem, chains, 7, LINE_START, further)
    assert load_chains(chains, problem, 1).shape[:2] == (1, 770)
    assert (chains / "ensemble_1.h5").read_bytes() == before


@pytest.mark.usefixtures("coarsely")
def test_threads_change_nothing(whole: tuple[Path, Posterior], tmp_path: Path) -> None:
    together = sample(line_problem(), tmp_path, 7, LINE_START, LONGER, threads=2)
    assert np.array_equal(whole[1].draws, together.draws)


@pytest.mark.usefixtures("coarsely")
def test_an_error_in_a_thread_is_not_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log_prob = LogPosterior.log_prob

    def fail(self: LogPosterior, vectors: Array) -> Array:
        if threading.current_thread() is not threading.main_thread():
            raise ZeroDivisionError
        return log_prob(self, vectors)

    monkeypatch.setattr(LogPosterior, "log_prob", fail)
    with pytest.raises(ZeroDivisionError):
        sample(line_problem(), tmp_path, 7, LINE_START, SampleSettings(2, 16, 600), threads=2)


@pytest.mark.usefixtures("coarsely")
def test_an_interrupted_run_goes_on_bit_for_bit(whole: tuple[Path, Posterior], tmp_path: Path) -> None:
    problem = line_problem()

    def interrupt(_: float, text: str) -> None:
        if "ensemble 2" in text and "step 700" in text:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sample(problem, tmp_path, 7, LINE_START, LONGER, interrupt)
    steps = [
        emcee.backends.HDFBackend(str(tmp_path / f"ensemble_{e}.h5"), read_only=True).iteration
        for e in (0, 1)
    ]
    assert steps == [750, 500]
    assert np.array_equal(whole[1].draws, sample(problem, tmp_path, 7, LINE_START, LONGER).draws)


KILLED = """
import sys
import pytest
from toys.coarse_proposals import propose_coarsely
from toys.inference_problems import line_problem
from bayeskin.inference import Limits, SampleSettings, sample
from bayeskin.types import Array
start = {start!r}
propose_coarsely(pytest.MonkeyPatch())
sample(line_problem(), sys.argv[1], 7, start, SampleSettings(2, 16, 100000, Limits(effective_samples=1e9)))
"""


@pytest.mark.slow
@pytest.mark.usefixtures("coarsely")
def test_a_killed_process_leaves_chains_that_go_on(whole: tuple[Path, Posterior], tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    code = KILLED.format(start=LINE_START)
    process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], env=environment)
    last = tmp_path / "ensemble_1.h5"
    deadline = time.monotonic() + 120
    while not last.exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert emcee.backends.HDFBackend(str(last), read_only=True).iteration < 750
    going_on = sample(line_problem(), tmp_path, 7, LINE_START, LONGER)
    assert np.array_equal(whole[1].draws, going_on.draws)


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
        (other_data, "other inputs .its recording"),
        (other_surrogate, "other inputs .its surrogate"),
        (
            lambda p: dataclasses.replace(p, fit_windows=((0.0, 0.5),)),
            "other inputs .its fit windows",
        ),
    ],
)
def test_chains_of_another_posterior_are_refused_and_kept(chains: Path, change, complaint) -> None:  # type: ignore[no-untyped-def]
    before = (chains / "ensemble_0.h5").read_bytes()
    with pytest.raises(InputError, match=complaint):
        sample(change(line_problem()), chains, 7, LINE_START, SHORT)
    assert (chains / "ensemble_0.h5").read_bytes() == before


def test_another_shape_seed_or_file_is_refused(chains: Path, tmp_path: Path) -> None:
    problem = line_problem()
    with pytest.raises(InputError, match=r"other inputs \(its walkers"):
        sample(problem, chains, 7, LINE_START, dataclasses.replace(SHORT, walkers=18))
    with pytest.raises(InputError, match=r"other inputs \(its seed"):
        sample(problem, chains, 0, LINE_START, SHORT)
    toy = toy_problem(surrogate=ToySurrogate())
    with pytest.raises(InputError, match="this chain has the parameters a, b"):
        sample(toy, chains, 7, {**TRUTH, **NOISE}, dataclasses.replace(SHORT, walkers=24))
    (chains / "ensemble_0.h5").write_bytes(b"half a file")
    with pytest.raises(InputError, match="cannot be read as HDF5"):
        sample(problem, chains, 7, LINE_START, SHORT)
    with pytest.raises(InputError, match="at least 12"):
        sample(problem, tmp_path / "new", 7, LINE_START, dataclasses.replace(SHORT, walkers=8))
    assert not (tmp_path / "new").exists()
