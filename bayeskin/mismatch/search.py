"""Which mechanisms: forward from none, each tried with all other parameters free again.

A set's weight is its evidence times the prior of its size, every mechanism being there with the probability
`PRIOR`. After each step all but the least promising are tried beside those taken; then each taken one is left
out again, so that what a later one has made needless goes. Probabilities are shares of weight over all sets
that were tried: those of sets never tried count as nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from bayeskin.inference import LogPosterior
from bayeskin.inference.straighten import find_shear
from bayeskin.mechanisms import Mechanism
from bayeskin.mismatch.fit import Fit, fit, fit_base

PRIOR = 0.05  # of a mechanism to be at work, before the recording is seen
MOST = 5  # mechanisms of one set
TRIED_AGAIN = 8  # candidates of a round that the next one tries
ONLY_WITH = {"friction-creep": "device-friction"}

Build = Callable[[Sequence[str]], LogPosterior]  # the posterior with a set of mechanisms
Progress = Callable[[float, str], None]


@dataclass
class Search:
    """All sets tried, by their names sorted, and the best of them."""

    fits: dict[tuple[str, ...], Fit] = field(default_factory=dict)

    @property
    def base(self) -> Fit:
        return self.fits[()]

    @property
    def best(self) -> Fit:
        return max(self.fits.values(), key=weight)

    def probability(self, names: Sequence[str]) -> float:
        """Share of the weight of sets with any of these mechanisms."""
        logs = np.array([weight(one) for one in self.fits.values()])
        share = np.exp(logs - logs.max())
        among = np.array([bool(set(names) & set(one.names)) for one in self.fits.values()])
        return float(share[among].sum() / share.sum())


def weight(found: Fit) -> float:
    """Logarithm of a set's weight."""
    return found.log_evidence + len(found.names) * float(np.log(PRIOR / (1.0 - PRIOR)))


def search(
    build: Build, known: Mapping[str, Mechanism], seed: int, progress: Progress | None = None
) -> Search:
    """Forward from the fit without any mechanism, then backward."""
    alone = build(())
    straight = find_shear(alone)
    base = fit_base(alone, seed, straight)
    found = Search({(): base})
    neutral = {name: value for m in known.values() for name, value in m.neutral.items()}
    candidates = list(known)

    def tried(names: Sequence[str], start: Fit, before: Fit | None = None) -> Fit:
        key = tuple(sorted(names))
        if key not in found.fits:
            wide = build(key)
            shear = straight.among(base.log_posterior.names, wide.names) if straight else None
            earlier = before.theta if before else None
            found.fits[key] = fit(key, wide, start.theta, neutral, seed, shear, earlier)
        return found.fits[key]

    last: dict[str, Fit] = {}  # the latest fit with a candidate
    for size in range(MOST):
        current = found.best
        gains: dict[str, float] = {}
        for done, name in enumerate(candidates):
            if name in current.names:
                continue
            names = {*current.names, name, *([ONLY_WITH[name]] if name in ONLY_WITH else [])}
            one = tried(sorted(names), current, last.get(name))
            last[name] = one
            gains[name] = weight(one) - weight(current)
            if progress:
                note = f"{name}: {one.log_evidence - current.log_evidence:+.1f} nats"
                progress((done + 1) / len(candidates), f"mechanism {size + 1}: {note}")
        if found.best is current:
            break
        candidates = sorted(gains, key=lambda name: -gains[name])[:TRIED_AGAIN]
    for name in found.best.names:
        rest = [other for other in found.best.names if other != name]
        tried([n for n in rest if ONLY_WITH.get(n, n) in rest or n not in ONLY_WITH], found.best)
    return found
