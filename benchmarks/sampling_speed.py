"""How long a posterior takes from a shipped surrogate, and what of that is the moves' doing.

The shipped settings: four ensembles of 40 walkers on two threads, until the parameter that has fewest has
5,000 effective samples and R-hat across ensembles is 1.01. Beside it emcee with its own default move (the
stretch move of Goodman & Weare 2010) on the same density, from the same start, for the same number of steps,
judged by the same measures.

    python benchmarks/sampling_speed.py                                          # the demo
    python benchmarks/sampling_speed.py --recording FILE.h5 --surrogate FILE.h5  # another

Prints one line a seed and the medians.
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
from bayeskin.inference.sample import initial_walkers
from bayeskin.recordings import analyse, bin_recording, read_recording, segment
from bayeskin.shipped import shipped
from bayeskin.surrogates import load_surrogate
from bayeskin.types import Array

SETTINGS = SampleSettings(max_steps=30000)
THREADS = 2
HEADER = (
    "seed", "recording and surrogate [s]", "most probable point [s]", "sampling [s]", "steps",
    "fewest effective samples", "R-hat", "chains", "default move [s]", "fewest effective samples", "R-hat",
    "effective samples a second, ratio",
)  # fmt: skip


@dataclass(frozen=True)
class Timed:
    """Wall time of one way to draw the posterior, and what its chains are worth."""

    seconds: float
    found: Convergence

    @property
    def fewest(self) -> float:
        """Effective samples of the parameter that has fewest; 0 where one does not move."""
        return float(np.nan_to_num(self.found.ess).min())

    @property
    def highest(self) -> float:
        return float(self.found.rhat.max())


def problem(recording: Path, surrogate: Path) -> LogPosterior:
    recorded, knows = read_recording(recording), load_surrogate(surrogate)
    phases = segment(recorded)
    return LogPosterior(knows, bin_recording(recorded, phases, knows.edges_s, analyse(recorded, phases)))


def shipped_sampler(about: LogPosterior, start: dict[str, float], seed: int) -> Timed:
    with tempfile.TemporaryDirectory() as folder:
        started = time.perf_counter()
        posterior = inference.sample(about, folder, seed, start, SETTINGS, threads=THREADS)
        return Timed(time.perf_counter() - started, posterior.convergence)


def default_move(about: LogPosterior, start: dict[str, float], seed: int, steps: int) -> Timed:
    """emcee as it comes, so many steps of as many ensembles and walkers."""
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
        made = list(pool.map(chain, np.random.SeedSequence(seed).spawn(SETTINGS.ensembles)))
    chains, log_prob = (np.stack(part) for part in zip(*made, strict=True))
    seconds = time.perf_counter() - started
    return Timed(seconds, assess(chains, log_prob, about.names, SETTINGS.limits))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--recording", type=Path, help="default: the demo's")
    parser.add_argument("--surrogate", type=Path, help="that knows its protocol; default: the demo's")
    parser.add_argument("--seeds", type=int, default=3, help="posteriors sampled (default 3)")
    asked = parser.parse_args()
    lines = []
    for seed in range(1, asked.seeds + 1):
        started = time.perf_counter()
        about = problem(
            asked.recording or shipped("data/demo.h5"), asked.surrogate or shipped("surrogates/demo.h5")
        )
        opened = time.perf_counter()
        best = dict(inference.find_map(about, seed).theta)
        climbed = time.perf_counter()
        own = shipped_sampler(about, best, seed)
        peer = default_move(about, best, seed, own.found.steps)
        rows.say(f"seed {seed}: {own.fewest:.0f} effective samples in {own.seconds:.0f} s")
        rate = (own.fewest / own.seconds) / (peer.fewest / peer.seconds) if peer.fewest else np.inf
        lines.append(
            [opened - started, climbed - opened, own.seconds, own.found.steps, own.fewest, own.highest,
             float(own.found.verdict.trusted), peer.seconds, peer.fewest, peer.highest, rate]
        )  # fmt: skip
    body = [[str(seed), *told(line)] for seed, line in enumerate(lines, start=1)]
    print(rows.markdown(HEADER, [*body, ["median", *told(np.median(lines, axis=0))]]))


def told(line: list[float] | Array) -> list[str]:
    """A line's numbers as they are printed."""
    opened, climbed, sampled, steps, ess, rhat, trusted, seconds, others, other_rhat, rate = line
    return [
        f"{opened:.1f}", f"{climbed:.1f}", f"{sampled:.1f}", f"{steps:.0f}", f"{ess:.0f}", f"{rhat:.4f}",
        "trusted" if trusted == 1.0 else "not trusted",
        f"{seconds:.1f}", f"{others:.0f}", f"{other_rhat:.3f}", f"{rate:.1f}",
    ]  # fmt: skip


if __name__ == "__main__":
    main()
