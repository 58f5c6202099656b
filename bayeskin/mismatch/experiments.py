"""Which further test would tell competing sets of mechanisms apart: each simulated with the posterior.

Of every set, a few posterior draws are run on each protocol, and the expected information gain about which
set is true is computed from the forces (`information`). The noise of the test to come is
the fitted noise of the most probable set, what it leaves unexplained with it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from bayeskin.errors import InputError
from bayeskin.inference.noise_model import KINDS, noise_chain, noise_covariance
from bayeskin.mechanisms import Mechanism, bin_means, laws, observed, solved
from bayeskin.mechanisms.mechanism import ForceOfTime
from bayeskin.mismatch import protocols as tests
from bayeskin.mismatch.fit import Fit
from bayeskin.mismatch.information import FEWEST, expected_gain
from bayeskin.mismatch.search import weight
from bayeskin.types import Array, BinnedForce, PadMotion, Simulation

DRAWS = 12  # of each hypothesis
MOST_BINS = 800  # of a protocol; longer ones have wider bins
MOST_SETS = 4  # that compete


class FullModel(Protocol):
    """One full run: `bayeskin.model.simulate.simulate` with its specification already given."""

    def __call__(self, motion: PadMotion, theta: Mapping[str, float], laws: Sequence[Any]) -> Simulation: ...


@dataclass(frozen=True)
class Experiment:
    """A further test and what it is expected to tell.

    gain_nats, standard_error: expected information about which set is true, of `possible_nats` that are to
    be had; named: the probability that the true set is expected to have afterwards; failed: runs that did
    not converge. With too many failed for an estimate the first three are NaN.
    """

    protocol: str
    sentence: str
    motion: PadMotion
    gain_nats: float
    standard_error: float
    named: float
    possible_nats: float
    failed: int


def compete(found: Sequence[Fit], names: Sequence[str], known: Mapping[str, Mechanism]) -> list[Fit]:
    """The set of these names, and the likeliest of those tried that have, in the place of some of its
    mechanisms, look-alikes: one for each choice of mechanisms that differs from it.

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
        return bool(gone) and len(gone) == len(new) and new <= groups and bool(np.isfinite(weight(other)))

    by_names = {other.names: other for other in found if alike(other)}
    return [best, *sorted(by_names.values(), key=weight, reverse=True)[: MOST_SETS - 1]]


def weigh(
    protocol: tests.Protocol,
    fits: Sequence[Fit],
    known: Mapping[str, Mechanism],
    simulate: FullModel,
    seed: int,
) -> Experiment:
    """What a protocol is expected to tell about which of the sets is true, all as probable before.

    fits : one for each hypothesis, by whose `names` mechanisms of `known` are on, the likeliest first
    simulate : called DRAWS times a hypothesis
    Raises InputError for fewer than two hypotheses.
    """
    if len(fits) < 2:
        raise InputError("hypotheses", f"{len(fits)}", "two at least, each with its fit")
    edges_s = _edges(protocol.motion, fits[0])
    forces = [_forces(one, known, protocol.motion, edges_s, simulate, seed + i) for i, one in enumerate(fits)]
    failed = sum(DRAWS - len(rows) for rows in forces)
    gain = (np.nan, np.nan, np.nan)
    if min(len(rows) for rows in forces) >= FEWEST:
        of = expected_gain(forces, noise_of(fits[0], protocol.motion, edges_s), np.ones(len(fits)), seed)
        gain = (of.nats, of.standard_error, of.named)
    possible = float(np.log(len(fits)))
    return Experiment(protocol.name, protocol.sentence, protocol.motion, *gain, possible, failed)


def ranked(found: Sequence[Experiment]) -> list[Experiment]:
    """The most informative first; those that could not be judged last."""
    return sorted(found, key=lambda one: (np.isnan(one.gain_nats), -one.gain_nats))


def _edges(motion: PadMotion, found: Fit) -> Array:
    """Edges (m+1,) of equal bins, as wide as the recording's or wider."""
    end_s = float(motion.time_s[-1])
    width_s = max(float(np.median(np.diff(found.log_posterior.binned.edges_s))), end_s / MOST_BINS)
    return np.asarray(width_s * np.arange(int(end_s / width_s + 1e-6) + 1, dtype=float))


def _forces(
    found: Fit,
    known: Mapping[str, Mechanism],
    motion: PadMotion,
    edges_s: Array,
    simulate: FullModel,
    seed: int,
) -> Array:
    """Bin means (draws, m) at posterior draws, those of failed runs left out."""
    log_posterior = found.log_posterior
    added = [known[name] for name in found.names]
    within = solved(added)
    beyond = [mechanism for mechanism in added if mechanism not in within]
    own = {p.name for mechanism in added for p in mechanism.parameters}
    along = {p.name for mechanism in within for p in mechanism.parameters}
    rows = []
    for draw in found.draws(DRAWS, seed)[:, : log_posterior.surrogate.space.dim]:
        theta = _neutral(added) | dict(zip(log_posterior.surrogate.space.names, draw.tolist(), strict=True))
        inside = {name: value for name, value in theta.items() if name not in own or name in along}
        run = simulate(motion, inside, laws(added))
        if run.status == "ok":
            values = {name: np.array([value]) for name, value in theta.items()}
            force = observed(beyond, values, motion, _force_of(run))
            rows.append(bin_means(force, motion, edges_s, beyond)[0])
    return np.array(rows).reshape(len(rows), len(edges_s) - 1)


def _force_of(run: Simulation) -> ForceOfTime:
    return lambda time_s: np.atleast_2d(run.at(time_s))


def _neutral(mechanisms: Sequence[Mechanism]) -> dict[str, float]:
    return {name: value for one in mechanisms for name, value in one.neutral.items()}


def noise_of(found: Fit, motion: PadMotion, edges_s: Array) -> Array:
    """Covariance (m, m) [N^2] of the noise expected in another test, from a fit.

    The fitted sds and correlation time, and the usual measured variance of each kind of phase, which goes
    as 1 / width of the bins. A kind that was not recorded is as the noisiest.
    """
    log_posterior = found.log_posterior
    chain, binned = log_posterior.chain, log_posterior.binned
    wider = float(edges_s[1] - edges_s[0]) / float(np.median(np.diff(binned.edges_s)))
    sd = {kind: found.theta[f"sd_{kind}"] for kind in chain.kinds}
    variance = {
        kind: float(np.median(chain.variance_n2[chain.kind == i])) / wider
        for i, kind in enumerate(chain.kinds)
    }
    phases = tests.phases_of(motion)
    middle = 0.5 * (edges_s[1:] + edges_s[:-1])
    phase = np.searchsorted([p.end_s for p in phases[:-1]], middle, side="right")
    of_bins = [phases[i].kind for i in phase]
    correlation = float(np.nanmedian(binned.correlation)) if wider < 1.5 else 0.0
    planned = BinnedForce(
        edges_s, np.zeros(len(middle)),
        np.array([variance.get(kind, max(variance.values())) for kind in of_bins]),
        np.full(len(middle) - 1, correlation), phase, phases,
    )  # fmt: skip
    ahead = noise_chain(planned)
    sds = [sd.get(kind, max(sd.values())) for kind in KINDS if kind in ahead.kinds]
    noise = np.array([*sds, found.theta["tau_noise"], np.inf])
    return noise_covariance(ahead, noise, np.zeros(len(middle)))
