"""Compares models of the noise by how well each predicts whole phases of a recording from all other phases.

The shipped model of the noise (`bayeskin.inference.noise_model`) is correlated and heavy-tailed, and has a sd
for each kind of phase; spikes are removed from the bins. It is compared with versions that lack one of these
properties. Each version is sampled, and scored by the log density of each phase given the others
(`block_log_likelihood`). This is leave-one-phase-out cross-validation by Pareto-smoothed importance sampling,
as in `az.loo` (Vehtari, Gelman & Gabry 2017, Statistics and Computing 27:1413). All versions are scored on
the same bins: where spikes are left in the bins, the phase that is left out is still scored without them.

    python benchmarks/noise_models.py                                            # the demo
    python benchmarks/noise_models.py --recording FILE.h5 --surrogate FILE.h5    # another recording

The program prints the table. For the demo it also writes it between its markers of docs/calibration.md.
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

DOCS = Path(__file__).parents[1] / "docs" / "calibration.md"
SETTINGS = SampleSettings(2, 40, 8000, Limits(effective_samples=1000.0))
SHIPPED = "as shipped"
GOOD_K = 0.7  # a score with a larger Pareto k is not reliable
SEED = 1
HEADER = (
    "noise model", "score minus the shipped model's [nats]", "phases with Pareto k above 0.7",
    "largest Pareto k", "p-value, distribution", "p-value, autocorrelation", "chains",
)  # fmt: skip


@dataclass(frozen=True)
class Score:
    """Holds the scores of one model of the noise.

    phases : log density of each phase given the others (b,) [nats]
    pareto_k : Pareto's k of each phase (b,)
    left : check of the residuals that the fit leaves
    trusted : True if the chains of the fit are trusted
    """

    phases: Array
    pareto_k: Array
    left: ResidualCheck
    trusted: bool


def models(recording: Path, surrogate: Path) -> dict[str, LogPosterior]:
    """Returns the posterior of a recording under each model of its noise, the shipped model first."""
    loaded_recording, loaded_surrogate = read_recording(recording), load_surrogate(surrogate)
    phases = segment(loaded_recording)
    analysis = analyse(loaded_recording, phases)
    binned = bin_recording(loaded_recording, phases, loaded_surrogate.edges_s, analysis)
    with_spikes = replace(
        analysis.despiked, force_n=loaded_recording.force_n, spike=np.zeros_like(analysis.despiked.spike)
    )
    spiked_bins = bin_recording(
        loaded_recording, phases, loaded_surrogate.edges_s, replace(analysis, despiked=with_spikes)
    )
    reference = LogPosterior(loaded_surrogate, binned)
    return {
        SHIPPED: reference,
        "Gaussian": replace(reference, noise_priors=NoisePriors(nu=(1e5, 1.01e5))),
        "white": replace(reference, noise_priors=NoisePriors(tau_s=(1e-3, 1.01e-3))),
        "one sd for all phases": replace(reference, binned=of_one_kind(binned)),
        "spikes left in the bins": replace(reference, binned=spiked_bins),
    }


def of_one_kind(binned: BinnedForce) -> BinnedForce:
    """Returns the bins with all phases of the same kind, so that they share a sd."""
    return replace(binned, phases=tuple(replace(phase, kind="hold") for phase in binned.phases))


def scored(about: LogPosterior, force_n: Array, settings: SampleSettings = SETTINGS) -> Score:
    """Samples a model of the noise, and returns its score on the phases of force_n (m,)."""
    best = inference.find_map(about, SEED, starts=3, evaluations=2000).theta
    with tempfile.TemporaryDirectory() as folder:
        posterior = inference.sample(about, folder, SEED, best, settings)
    best_draw = about.to_sampling(posterior.flat[int(np.argmax(posterior.log_prob))])
    residuals = inference.check_residuals(about, best_draw)
    return Score(*predicted(about, posterior.flat, force_n), residuals, posterior.convergence.verdict.trusted)


def predicted(about: LogPosterior, theta: Array, force_n: Array) -> tuple[Array, Array]:
    """Returns for each phase of force_n (m,) its log density given the others (b,), and Pareto's k (b,).

    theta (n, D) : draws of the posterior of all phases of `about`; importance weights replace it by the
    posterior of all phases but one
    """
    log_likelihood = about.block_log_likelihood(theta)
    weights, pareto_k = az.psislw(-log_likelihood.T)
    phase_density = log_likelihood
    if not np.array_equal(force_n, about.binned.force_n):
        phase_density = np.column_stack(
            [
                with_phase_of(about, phase, force_n).block_log_likelihood(theta)[:, column]
                for column, phase in enumerate(about.blocks)
            ]
        )
    return np.asarray(logsumexp(np.asarray(weights) + phase_density.T, axis=1)), np.asarray(pareto_k)


def with_phase_of(about: LogPosterior, phase: int, force_n: Array) -> LogPosterior:
    """Returns the posterior with the bins of one phase taken from force_n (m,)."""
    mixed = np.where(about.binned.phase == phase, force_n, about.binned.force_n)
    return replace(about, binned=replace(about.binned, force_n=mixed))


def table(scores: Mapping[str, Score]) -> str:
    """Returns a table of the models, the best first, with their scores relative to the shipped model's."""
    reference = scores[SHIPPED].phases
    lines = []
    for name, score in sorted(scores.items(), key=lambda item: -item[1].phases.sum()):
        lines.append(
            [
                name, "" if name == SHIPPED else difference(score.phases, reference),
                f"{np.sum(score.pareto_k > GOOD_K)} of {len(score.pareto_k)}", f"{score.pareto_k.max():.2f}",
                f"{score.left.p_law:.2g}", f"{score.left.p_correlation:.2g}",
                "trusted" if score.trusted else "not trusted",
            ]
        )  # fmt: skip
    return rows.markdown(HEADER, lines)


def difference(phases: Array, reference: Array) -> str:
    """Returns the difference of the summed scores of phases (b,), with its standard error, as text."""
    differences = phases - reference
    return f"{differences.sum():+.1f} ± {np.sqrt(len(differences) * differences.var(ddof=1)):.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--recording", type=Path, help="recording (default: the demo's)")
    parser.add_argument(
        "--surrogate", type=Path, help="surrogate of the recording's protocol (default: the demo's)"
    )
    options = parser.parse_args()
    recording = options.recording or shipped("data/demo.h5")
    posteriors = models(recording, options.surrogate or shipped("surrogates/demo.h5"))
    scores = {}
    for name, posterior in posteriors.items():
        started = time.process_time()
        scores[name] = scored(posterior, posteriors[SHIPPED].binned.force_n)
        rows.say(f"{name}: {time.process_time() - started:.0f} CPU s; {scores[name].left.sentence}")
    block = table(scores)
    print(block)
    if options.recording is None:
        rows.into_docs(DOCS, "noise models", block)


if __name__ == "__main__":
    main()
