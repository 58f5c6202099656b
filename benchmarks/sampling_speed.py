"""Measures how long a posterior takes with a shipped surrogate, and what the sampler's moves contribute.

The shipped settings are four ensembles of 40 walkers on two threads. They sample until R-hat across ensembles
is 1.01, and until the parameter with the fewest effective samples has 5,000 of them. For comparison emcee
samples the same density with its own default move (the stretch move of Goodman & Weare 2010), from the same
start and for the same number of steps, and is judged by the same measures.

    python benchmarks/sampling_speed.py                                          # the demo
    python benchmarks/sampling_speed.py --recording FILE.h5 --surrogate FILE.h5  # another recording

The program prints one line for each seed, and the medians.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import emcee
import numpy as np
import rows

from bayeskin import inference
from bayeskin.inference import LogPosterior, SampleSettings
from bayeskin.inference.convergence import Convergence, assess
from bayeskin.inference.ensembles import initial_walkers
from bayeskin.recordings import analyse, bin_recording, read_recording, segment
from bayeskin.shipped import shipped
from bayeskin.surrogates import load_surrogate
from bayeskin.types import Array

SETTINGS = SampleSettings(max_steps=30000)
THREADS = 2
HEADER = (
    "seed", "reading of the files [s]", "most probable point [s]", "sampling [s]", "steps",
    "fewest effective samples", "R-hat", "chains", "default move: sampling [s]",
    "default move: fewest effective samples", "default move: R-hat", "ratio of effective samples a second",
)  # fmt: skip


@dataclass(frozen=True)
class Timed:
    """Holds the wall time of one way to sample the posterior, and the convergence of its chains."""

    seconds: float
    convergence: Convergence

    @property
    def fewest(self) -> float:
        """Returns the effective samples of the parameter that has the fewest; 0 where one does not move."""
        return float(np.nan_to_num(self.convergence.ess).min())

    @property
    def highest(self) -> float:
        """Returns R-hat of the parameter that has the largest."""
        return float(self.convergence.rhat.max())


def problem(recording: Path, surrogate: Path) -> LogPosterior:
    """Returns the log-posterior of a recording by a surrogate."""
    loaded_recording, loaded_surrogate = read_recording(recording), load_surrogate(surrogate)
    phases = segment(loaded_recording)
    return LogPosterior(
        loaded_surrogate,
        bin_recording(loaded_recording, phases, loaded_surrogate.edges_s, analyse(loaded_recording, phases)),
    )


def shipped_sampler(about: LogPosterior, start: dict[str, float], seed: int) -> Timed:
    """Samples with the shipped settings."""
    with tempfile.TemporaryDirectory() as folder:
        started = time.perf_counter()
        posterior = inference.sample(about, folder, seed, start, SETTINGS, threads=THREADS)
        return Timed(time.perf_counter() - started, posterior.convergence)


def default_move(about: LogPosterior, start: dict[str, float], seed: int, steps: int) -> Timed:
    """Samples with emcee's default move, with the shipped number of ensembles and walkers."""
    origin = about.vector(start)

    def chain(own: np.random.SeedSequence) -> tuple[Array, Array]:
        rng = np.random.default_rng(own)
        walkers = initial_walkers(about, origin, SETTINGS.walkers, rng)
        sampler = emcee.EnsembleSampler(SETTINGS.walkers, about.dim, about.log_prob, vectorize=True)
        generator = np.random.RandomState(own.generate_state(8))
        sampler.run_mcmc(
            emcee.State(walkers, random_state=generator.get_state()), steps, skip_initial_state_check=True
        )
        return sampler.get_chain(), sampler.get_log_prob()

    started = time.perf_counter()
    with ThreadPoolExecutor(THREADS) as pool:
        results = list(pool.map(chain, np.random.SeedSequence(seed).spawn(SETTINGS.ensembles)))
    chains, log_prob = (np.stack(arrays) for arrays in zip(*results, strict=True))
    seconds = time.perf_counter() - started
    return Timed(seconds, assess(chains, log_prob, about.names, SETTINGS.limits))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--recording", type=Path, help="recording (default: the demo's)")
    parser.add_argument(
        "--surrogate", type=Path, help="surrogate of the recording's protocol (default: the demo's)"
    )
    parser.add_argument("--seeds", type=int, default=3, help="number of posteriors (default 3)")
    options = parser.parse_args()
    lines = []
    for seed in range(1, options.seeds + 1):
        started = time.perf_counter()
        about = problem(
            options.recording or shipped("data/demo.h5"), options.surrogate or shipped("surrogates/demo.h5")
        )
        loaded = time.perf_counter()
        best = dict(inference.find_map(about, seed).theta)
        fitted = time.perf_counter()
        ours = shipped_sampler(about, best, seed)
        peer = default_move(about, best, seed, ours.convergence.steps)
        rows.say(f"seed {seed}: {ours.fewest:.0f} effective samples in {ours.seconds:.0f} s")
        rate = (ours.fewest / ours.seconds) / (peer.fewest / peer.seconds) if peer.fewest else np.inf
        lines.append(
            [loaded - started, fitted - loaded, ours.seconds, ours.convergence.steps, ours.fewest,
             ours.highest, float(ours.convergence.verdict.trusted), peer.seconds, peer.fewest, peer.highest,
             rate]
        )  # fmt: skip
    seed_rows = [[str(seed), *told(line)] for seed, line in enumerate(lines, start=1)]
    print(rows.markdown(HEADER, [*seed_rows, ["median", *told(np.median(lines, axis=0))]]))


def told(line: list[float] | Array) -> list[str]:
    """Returns a line's numbers as formatted texts."""
    load_s, maximum_s, sample_s, steps, ess, rhat, trusted, default_s, default_ess, default_rhat, rate = line
    return [
        f"{load_s:.1f}", f"{maximum_s:.1f}", f"{sample_s:.1f}", f"{steps:.0f}", f"{ess:.0f}", f"{rhat:.4f}",
        "trusted" if trusted == 1.0 else "not trusted",
        f"{default_s:.1f}", f"{default_ess:.0f}", f"{default_rhat:.3f}", f"{rate:.1f}",
    ]  # fmt: skip


if __name__ == "__main__":
    main()
