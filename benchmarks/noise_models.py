"""Which model of the noise predicts a recording best: whole phases, each by a fit to all others.

The shipped model of the noise (`bayeskin.inference.noise_model`: correlated, heavy-tailed, a sd for each
kind of phase, spikes taken out of the bins) against it without one of these. Each is sampled, and scored by
the log density of each phase given the others (`block_log_likelihood`), leave-one-phase-out by
Pareto-smoothed importance sampling as `az.loo` has it (Vehtari, Gelman & Gabry 2017, Statistics and Computing
27:1413). All are scored on the same bins: where spikes are left in the bins, those of the left-out phase are
without them.

    python benchmarks/noise_models.py                                            # the demo
    python benchmarks/noise_models.py --recording FILE.h5 --surrogate FILE.h5    # another

Prints the table; of the demo, writes it between its markers of docs/inference.md.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import arviz as az
import numpy as np
import rows
from scipy.special import logsumexp

from bayeskin import inference
from bayeskin.inference import Limits, LogPosterior, NoisePriors, ResidualCheck, SampleSettings
from bayeskin.recordings import analyse, bin_recording, read_recording, segment
from bayeskin.shipped import shipped
from bayeskin.surrogates import load_surrogate
from bayeskin.types import Array, BinnedForce

DOCS = Path(__file__).parents[1] / "docs" / "inference.md"
SETTINGS = SampleSettings(2, 40, 8000, Limits(effective_samples=1000.0))
SHIPPED = "as shipped"
GOOD_K = 0.7  # of Pareto's k, beyond which a score is not to be relied on
SEED = 1
HEADER = (
    "noise", "score against the shipped one's [nats]", "phases with k above 0.7", "largest k",
    "p of its law", "p of its correlation", "chains",
)  # fmt: skip


@dataclass(frozen=True)
class Score:
    """Log density [nats] of each phase given the others (b,), Pareto's k of each, what the fit leaves."""

    phases: Array
    pareto_k: Array
    left: ResidualCheck
    trusted: bool


def models(recording: Path, surrogate: Path) -> dict[str, LogPosterior]:
    """The posterior of a recording under each model of its noise, the shipped one first."""
    recorded, knows = read_recording(recording), load_surrogate(surrogate)
    phases = segment(recorded)
    analysis = analyse(recorded, phases)
    binned = bin_recording(recorded, phases, knows.edges_s, analysis)
    raw = replace(analysis.despiked, force_n=recorded.force_n, spike=np.zeros_like(analysis.despiked.spike))
    spiked = bin_recording(recorded, phases, knows.edges_s, replace(analysis, despiked=raw))
    shipped_one = LogPosterior(knows, binned)
    return {
        SHIPPED: shipped_one,
        "Gaussian": replace(shipped_one, noise_priors=NoisePriors(nu=(1e5, 1.01e5))),
        "white": replace(shipped_one, noise_priors=NoisePriors(tau_s=(1e-3, 1.01e-3))),
        "one sd for all phases": replace(shipped_one, binned=of_one_kind(binned)),
        "spikes left in the bins": replace(shipped_one, binned=spiked),
    }


def of_one_kind(binned: BinnedForce) -> BinnedForce:
    """The bins with all phases called by one name, so that they share a sd."""
    return replace(binned, phases=tuple(replace(phase, kind="hold") for phase in binned.phases))


def scored(about: LogPosterior, force_n: Array, settings: SampleSettings = SETTINGS) -> Score:
    """A model of the noise sampled, and its prediction of the phases of force_n (m,)."""
    best = inference.find_map(about, SEED, starts=3, evaluations=2000).theta
    with tempfile.TemporaryDirectory() as folder:
        posterior = inference.sample(about, folder, SEED, best, settings)
    top = about.to_sampling(posterior.flat[int(np.argmax(posterior.log_prob))])
    left = inference.check_residuals(about, top)
    return Score(*predicted(about, posterior.flat, force_n), left, posterior.convergence.verdict.trusted)


def predicted(about: LogPosterior, theta: Array, force_n: Array) -> tuple[Array, Array]:
    """Of each phase of force_n (m,) its log density given the others (b,), and Pareto's k (b,).

    theta (n, D): draws of the posterior of all phases of `about`, which stands for the others' too.
    """
    own = about.block_log_likelihood(theta)
    weights, pareto_k = az.psislw(-own.T)
    density = own
    if not np.array_equal(force_n, about.binned.force_n):
        density = np.column_stack(
            [
                with_phase_of(about, phase, force_n).block_log_likelihood(theta)[:, column]
                for column, phase in enumerate(about.blocks)
            ]
        )
    return np.asarray(logsumexp(np.asarray(weights) + density.T, axis=1)), np.asarray(pareto_k)


def with_phase_of(about: LogPosterior, phase: int, force_n: Array) -> LogPosterior:
    """With the bins of one phase taken from force_n (m,)."""
    mixed = np.where(about.binned.phase == phase, force_n, about.binned.force_n)
    return replace(about, binned=replace(about.binned, force_n=mixed))


def table(found: Mapping[str, Score]) -> str:
    """By model: the difference of its score with its standard error over phases; the best first."""
    reference = found[SHIPPED].phases
    lines = []
    for name, one in sorted(found.items(), key=lambda item: -item[1].phases.sum()):
        lines.append(
            [
                name, "" if name == SHIPPED else difference(one.phases, reference),
                f"{np.sum(one.pareto_k > GOOD_K)} of {len(one.pareto_k)}", f"{one.pareto_k.max():.2f}",
                f"{one.left.p_law:.2g}", f"{one.left.p_correlation:.2g}",
                "trusted" if one.trusted else "not trusted",
            ]
        )  # fmt: skip
    return rows.markdown(HEADER, lines)


def difference(phases: Array, reference: Array) -> str:
    """Of the scores of phases (b,), summed, with the standard error that so few phases leave."""
    apart = phases - reference
    return f"{apart.sum():+.1f} ± {np.sqrt(len(apart) * apart.var(ddof=1)):.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--recording", type=Path, help="default: the demo's")
    parser.add_argument("--surrogate", type=Path, help="that knows its protocol; default: the demo's")
    asked = parser.parse_args()
    recording = asked.recording or shipped("data/demo.h5")
    about = models(recording, asked.surrogate or shipped("surrogates/demo.h5"))
    found = {}
    for name, one in about.items():
        started = time.process_time()
        found[name] = scored(one, about[SHIPPED].binned.force_n)
        rows.say(f"{name}: {time.process_time() - started:.0f} CPU s; {found[name].left.sentence}")
    block = table(found)
    print(block)
    if asked.recording is None:
        rows.into_docs(DOCS, "noise models", block)


if __name__ == "__main__":
    main()
