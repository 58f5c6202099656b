"""Chooses the further test that best distinguishes between competing sets of mechanisms.

For every set, a few posterior draws are simulated with each protocol. The forces give the expected
information gain about which set is true (`information`). The noise of the future test is the fitted noise of
the most probable set, which includes what this set leaves unexplained. The search first judges variations of
the recorded test. It then changes the most informative protocols at random, and continues from the best ones.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bayeskin.errors import InputError
from bayeskin.experiments.information import GainSettings, expected_gain
from bayeskin.experiments.protocols import Limits, Protocol, changed, phases_of
from bayeskin.inference.noise_model import noise_chain, noise_covariance
from bayeskin.mechanisms import Mechanism
from bayeskin.mismatch.fit import Fit
from bayeskin.mismatch.hypotheses import weight
from bayeskin.mismatch.tasks import AnswerTasks, OtherProtocolTask
from bayeskin.types import Array, BinnedForce, PadMotion

BIT = float(np.log(2.0))  # nats


@dataclass(frozen=True)
class ChoiceSettings:
    """Settings of the choice of a further test.

    open, most_sets : the recording has ruled out a set whose log weight is `open` [nats] below the best
        set's; largest number of competing sets
    draws : number of posterior draws of each hypothesis
    most_bins : largest number of bins of a protocol; longer protocols have wider bins
    rounds, parents, changes : in each of `rounds` rounds, the best `parents` protocols give `changes` changed
        protocols
    enough : the search stops if a round can add or has added less than this share of the possible gain
    """

    open: float = 12.0
    most_sets: int = 4
    draws: int = 12
    most_bins: int = 800
    rounds: int = 3
    parents: int = 2
    changes: int = 4
    enough: float = 0.02


@dataclass(frozen=True)
class Experiment:
    """A further test and the information that it is expected to give.

    gain_bits, standard_error : expected information about which set is true, and its standard error [bits]
    named : probability that the true set is expected to have after the test
    possible_bits : the information that would determine the true set with certainty [bits]
    failed : number of runs that did not converge. If too many runs fail for an estimate, `gain_bits`,
        `standard_error` and `named` are NaN.
    """

    protocol: Protocol
    gain_bits: float
    standard_error: float
    named: float
    possible_bits: float
    failed: int


Judge = Callable[[Protocol], Experiment]


def compete(
    fits: Sequence[Fit], names: Sequence[str], known: Mapping[str, Mechanism],
    settings: ChoiceSettings = ChoiceSettings(),
) -> list[Fit]:  # fmt: skip
    """Returns the best fit of the set with these names, followed by the most probable competing sets.

    A competing set was tried, has look-alikes in place of some mechanisms of the set, and its log weight is
    less than `open` below the best fit's. Each competing choice of mechanisms appears once. At most
    `most_sets` fits are returned.

    Raises InputError if no fit has exactly these names.
    """
    fits_of_set = [fit for fit in fits if fit.names == tuple(names)]
    if not fits_of_set:
        remedy = "remove the run's folder `diagnose`, so that `bayeskin diagnose` makes it"
        raise InputError("searches", f"there is no fit of {', '.join(names) or 'the base model'}", remedy)
    best = max(fits_of_set, key=weight)

    def competes(fit: Fit) -> bool:
        removed, added = set(best.names) - set(fit.names), set(fit.names) - set(best.names)
        groups = {name for mechanism in removed for name in known[mechanism].group}
        is_open = weight(fit) > weight(best) - settings.open
        return bool(removed) and len(removed) == len(added) and added <= groups and is_open

    by_names = {fit.names: fit for fit in fits if competes(fit)}
    return [best, *sorted(by_names.values(), key=weight, reverse=True)[: settings.most_sets - 1]]


def search(
    judge: Judge, first: Sequence[Protocol], limits: Limits, seed: int,
    settings: ChoiceSettings = ChoiceSettings(),
) -> list[Experiment]:  # fmt: skip
    """Returns the judged protocols, the most informative first.

    The search judges the protocols in `first`, then random changes of the most informative ones within the
    limits. It ends if a round brings hardly more information, if the best protocol already gives almost all
    of it, and after `rounds` rounds at the latest.
    """
    rng, count = np.random.default_rng(seed), settings.changes
    experiments = ranked([judge(protocol) for protocol in first])
    for turn in range(settings.rounds):
        best = experiments[0]
        if np.isnan(best.gain_bits) or best.gain_bits > (1.0 - settings.enough) * best.possible_bits:
            break
        parents = [experiment.protocol for experiment in experiments[: settings.parents]]
        new = [
            changed(parents[i % len(parents)], limits, f"proposal {count * turn + i + 1}", rng)
            for i in range(count)
        ]
        experiments = ranked([*experiments, *(judge(protocol) for protocol in new)])
        if experiments[0].gain_bits < best.gain_bits + settings.enough * best.possible_bits:
            break
    return experiments


def weigh(
    protocol: Protocol, fits: Sequence[Fit], known: Mapping[str, Mechanism], ask: AnswerTasks, seed: int,
    settings: ChoiceSettings = ChoiceSettings(),
) -> Experiment:  # fmt: skip
    """Returns the information that a protocol is expected to give about which of the sets is true.

    All sets have the same probability before the test.

    fits : the fit of each hypothesis, the most probable one first. Its `names` are the mechanisms of `known`
        that are active.
    ask : answers the tasks; each hypothesis has `draws` tasks that simulate the test

    Raises InputError for fewer than two hypotheses.
    """
    if len(fits) < 2:
        raise InputError(
            "hypotheses",
            f"the number of hypotheses is {len(fits)}",
            "it must be at least two, each with its fit",
        )
    draws, motion = settings.draws, protocol.motion
    edges_s = _bin_edges(motion, fits[0], settings.most_bins)
    tasks = [
        OtherProtocolTask(
            fit.names, theta, tuple(motion.time_s.tolist()), tuple(motion.displacement_m.tolist()),
            tuple(edges_s.tolist()),
        )
        for i, fit in enumerate(fits) for theta in _posterior_draws(fit, known, draws, seed + i)
    ]  # fmt: skip
    answers = ask(tasks)
    forces = [
        np.array([force for force in answers[draws * i : draws * (i + 1)] if not isinstance(force, str)])
        for i in range(len(fits))
    ]
    gain = (np.nan, np.nan, np.nan)
    if min(len(rows) for rows in forces) >= GainSettings().fewest:
        expected = expected_gain(forces, noise_of(fits[0], motion, edges_s), np.ones(len(fits)), seed)
        gain = (expected.nats / BIT, expected.standard_error / BIT, expected.named)
    failed = sum(draws - len(rows) for rows in forces)
    return Experiment(protocol, *gain, float(np.log(len(fits))) / BIT, failed)


def ranked(experiments: Sequence[Experiment]) -> list[Experiment]:
    """Returns the experiments in order, the most informative first.

    Among experiments with nearly the same information, the shortest test comes first. Experiments without an
    estimate come last.
    """

    def place(experiment: Experiment) -> tuple[bool, float, float]:
        share = experiment.gain_bits / experiment.possible_bits
        return bool(np.isnan(share)), -round(share, 2), float(experiment.protocol.motion.time_s[-1])

    return sorted(experiments, key=place)


def _bin_edges(motion: PadMotion, fit: Fit, most_bins: int) -> Array:
    """Returns the edges (m+1,) of equal bins that are as wide as the recording's bins or wider."""
    end_s = float(motion.time_s[-1])
    width_s = max(float(np.median(np.diff(fit.log_posterior.binned.edges_s))), end_s / most_bins)
    return np.asarray(width_s * np.arange(int(end_s / width_s + 1e-6) + 1, dtype=float))


def _posterior_draws(
    fit: Fit, known: Mapping[str, Mechanism], count: int, seed: int
) -> list[dict[str, float]]:
    """Returns posterior draws of all parameters that determine the force of a set of mechanisms."""
    names = fit.log_posterior.surrogate.space.names
    neutral = {name: value for mechanism in fit.names for name, value in known[mechanism].neutral.items()}
    return [
        neutral | dict(zip(names, draw.tolist(), strict=True))
        for draw in fit.draws(count, seed)[:, : len(names)]
    ]


def noise_of(fit: Fit, motion: PadMotion, edges_s: Array) -> Array:
    """Returns the covariance (m, m) [N^2] of the noise that is expected in another test, from a fit.

    The noise has the fitted sds and correlation time. It also has the median measured variance of each kind
    of phase, which is proportional to 1 / width of the bins. A kind of phase that was not recorded has the
    noise of the noisiest kind.
    """
    log_posterior = fit.log_posterior
    chain, binned = log_posterior.chain, log_posterior.binned
    wider = float(edges_s[1] - edges_s[0]) / float(np.median(np.diff(binned.edges_s)))
    sd = {kind: fit.theta[f"sd_{kind}"] for kind in chain.kinds}
    recorded = np.array([binned.phases[p].kind for p in binned.phase[chain.bins]])
    variance = {
        str(kind): float(np.median(chain.variance_n2[recorded == kind])) / wider
        for kind in np.unique(recorded)
    }
    phases = phases_of(motion)
    middle = 0.5 * (edges_s[1:] + edges_s[:-1])
    phase = np.searchsorted([p.end_s for p in phases[:-1]], middle, side="right")
    of_bins = [phases[i].kind for i in phase]
    correlation = float(np.nanmedian(binned.correlation)) if wider < 1.5 else 0.0
    planned = BinnedForce(
        edges_s, np.zeros(len(middle)),
        np.array([variance.get(kind, max(variance.values())) for kind in of_bins]),
        np.full(len(middle) - 1, correlation), phase, phases,
    )  # fmt: skip
    future = noise_chain(planned, by_kind=log_posterior.noise_priors.by_kind)
    sds = [sd.get(kind, max(sd.values())) for kind in future.kinds]
    noise = np.array([*sds, fit.theta["tau_noise"], np.inf])
    return noise_covariance(future, noise, np.zeros(len(middle)))
