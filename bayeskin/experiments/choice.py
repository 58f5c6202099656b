"""The choice of the further test that tells competing sets of mechanisms apart, each run with its posterior.

Of every set, a few posterior draws are run on each protocol, and the expected information gain about which
set is true is computed from the forces (`information`). The noise of the test to come is the fitted noise of
the most probable set, what it leaves unexplained with it. After the variations of the recording's own test,
the most telling protocols are changed at random, and so on from what tells more.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bayeskin.errors import InputError
from bayeskin.experiments.information import FEWEST, expected_gain
from bayeskin.experiments.protocols import Limits, Protocol, changed, phases_of
from bayeskin.inference.noise_model import noise_chain, noise_covariance
from bayeskin.mechanisms import Mechanism
from bayeskin.mismatch.fit import Fit
from bayeskin.mismatch.hypotheses import weight
from bayeskin.mismatch.tasks import Ask, OtherTest
from bayeskin.types import Array, BinnedForce, PadMotion

DRAWS = 12  # of each hypothesis
BIT = float(np.log(2.0))  # nats
PARENTS, CHANGES, ROUNDS = 2, 4, 3  # protocols that are changed, how many changes of them, how often
ENOUGH = 0.02  # of what is to be had: less is no reason to go on
MOST_BINS = 800  # of a protocol; longer ones have wider bins
MOST_SETS = 4  # that compete
OPEN = 12.0  # nats of weight behind the best set, from which on the recording has ruled a set out


@dataclass(frozen=True)
class Experiment:
    """A further test and what it is expected to tell.

    gain_bits, standard_error: expected information about which set is true, of `possible_bits` that are to
    be had; named: the probability that the true set is expected to have afterwards; failed: runs that did
    not converge. With too many failed for an estimate the first three are NaN.
    """

    protocol: Protocol
    gain_bits: float
    standard_error: float
    named: float
    possible_bits: float
    failed: int


Judge = Callable[[Protocol], Experiment]


def compete(found: Sequence[Fit], names: Sequence[str], known: Mapping[str, Mechanism]) -> list[Fit]:
    """The set of these names, and the likeliest of those tried that have, in the place of some of its
    mechanisms, look-alikes, and are not far behind: one for each choice of mechanisms that differs from it.

    Raises InputError where no fit is of the set.
    """
    own = [one for one in found if one.names == tuple(names)]
    if not own:
        expected = "those that `bayeskin diagnose` left: remove the run's folder `diagnose` to make them anew"
        raise InputError("searches", f"no fit of {', '.join(names) or 'the base model'}", expected)
    best = max(own, key=weight)

    def alike(other: Fit) -> bool:
        gone, new = set(best.names) - set(other.names), set(other.names) - set(best.names)
        groups = {name for one in gone for name in known[one].group}
        is_open = weight(other) > weight(best) - OPEN
        return bool(gone) and len(gone) == len(new) and new <= groups and is_open

    by_names = {other.names: other for other in found if alike(other)}
    return [best, *sorted(by_names.values(), key=weight, reverse=True)[: MOST_SETS - 1]]


def search(judge: Judge, first: Sequence[Protocol], limits: Limits, seed: int) -> list[Experiment]:
    """Judges protocols, then changes of the most telling ones within limits; the most informative first.

    Ends where a round of changes tells no more than was told before, or all that is to be told is.
    """
    rng = np.random.default_rng(seed)
    found = ranked([judge(one) for one in first])
    for turn in range(ROUNDS):
        best = found[0]
        if np.isnan(best.gain_bits) or best.gain_bits > (1.0 - ENOUGH) * best.possible_bits:
            break
        parents = [one.protocol for one in found[:PARENTS]]
        new = [
            changed(parents[i % len(parents)], limits, f"proposal {CHANGES * turn + i + 1}", rng)
            for i in range(CHANGES)
        ]
        found = ranked([*found, *(judge(one) for one in new)])
        if found[0].gain_bits < best.gain_bits + ENOUGH * best.possible_bits:
            break
    return found


def weigh(
    protocol: Protocol, fits: Sequence[Fit], known: Mapping[str, Mechanism], ask: Ask, seed: int
) -> Experiment:
    """Returns what a protocol is expected to tell about which of the sets is true, all as probable before.

    fits : one for each hypothesis, by whose `names` mechanisms of `known` are on, the likeliest first
    ask : answers `DRAWS` tasks of another test for each hypothesis
    Raises InputError for fewer than two hypotheses.
    """
    if len(fits) < 2:
        raise InputError("hypotheses", f"{len(fits)}", "two at least, each with its fit")
    motion, edges_s = protocol.motion, _edges(protocol.motion, fits[0])
    tasks = [
        OtherTest(
            one.names, theta, tuple(motion.time_s.tolist()), tuple(motion.displacement_m.tolist()),
            tuple(edges_s.tolist()),
        )
        for i, one in enumerate(fits) for theta in _drawn(one, known, seed + i)
    ]  # fmt: skip
    answers = ask(tasks)
    forces = [
        np.array([force for force in answers[DRAWS * i : DRAWS * (i + 1)] if not isinstance(force, str)])
        for i in range(len(fits))
    ]
    gain = (np.nan, np.nan, np.nan)
    if min(len(rows) for rows in forces) >= FEWEST:
        of = expected_gain(forces, noise_of(fits[0], motion, edges_s), np.ones(len(fits)), seed)
        gain = (of.nats / BIT, of.standard_error / BIT, of.named)
    failed = sum(DRAWS - len(rows) for rows in forces)
    return Experiment(protocol, *gain, float(np.log(len(fits))) / BIT, failed)


def ranked(found: Sequence[Experiment]) -> list[Experiment]:
    """The most informative first, of those that tell equally much the shortest; unjudged ones last."""

    def place(one: Experiment) -> tuple[bool, float, float]:
        share = one.gain_bits / one.possible_bits
        return bool(np.isnan(share)), -round(share, 2), float(one.protocol.motion.time_s[-1])

    return sorted(found, key=place)


def _edges(motion: PadMotion, found: Fit) -> Array:
    """Edges (m+1,) of equal bins, as wide as the recording's or wider."""
    end_s = float(motion.time_s[-1])
    width_s = max(float(np.median(np.diff(found.log_posterior.binned.edges_s))), end_s / MOST_BINS)
    return np.asarray(width_s * np.arange(int(end_s / width_s + 1e-6) + 1, dtype=float))


def _drawn(found: Fit, known: Mapping[str, Mechanism], seed: int) -> list[dict[str, float]]:
    """Values of all parameters of a set's force at posterior draws."""
    names = found.log_posterior.surrogate.space.names
    neutral = {name: value for one in found.names for name, value in known[one].neutral.items()}
    return [
        neutral | dict(zip(names, draw.tolist(), strict=True))
        for draw in found.draws(DRAWS, seed)[:, : len(names)]
    ]


def noise_of(found: Fit, motion: PadMotion, edges_s: Array) -> Array:
    """Covariance (m, m) [N^2] of the noise expected in another test, from a fit.

    The fitted sds and correlation time, and the usual measured variance of each kind of phase, which goes
    as 1 / width of the bins. A kind that was not recorded is as the noisiest.
    """
    log_posterior = found.log_posterior
    chain, binned = log_posterior.chain, log_posterior.binned
    wider = float(edges_s[1] - edges_s[0]) / float(np.median(np.diff(binned.edges_s)))
    sd = {kind: found.theta[f"sd_{kind}"] for kind in chain.kinds}
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
    ahead = noise_chain(planned, by_kind=log_posterior.noise_priors.by_kind)
    sds = [sd.get(kind, max(sd.values())) for kind in ahead.kinds]
    noise = np.array([*sds, found.theta["tau_noise"], np.inf])
    return noise_covariance(ahead, noise, np.zeros(len(middle)))
