"""Which mechanisms: forward from none, each tried with all other parameters free again.

A set's weight is its evidence times the prior of its size, every mechanism being there with the probability
`PRIOR`. A set does not count in which the surrogate's error exceeds half of what some mechanism adds, and
the noise: far from the noise an uncertain surrogate explains much by its own error. Nor does one that the
samples between which bins take means refute.

In each step the others are ordered by what they promise beside those taken (a score test), and the most
promising are tried; then each taken one is left out again, so that what a later one has made needless goes.
The first step tries all, those that promise less by one climb each. A set that was tried before is climbed
once more from a larger one's top, and from a smaller one's that is ahead of it: one path stops where another
goes on.

Of several taken ones each is at last exchanged for the most promising others, where that is asked for, and
the best set of another search is tried, where there is one: of what one path has taken first, it does not let
go by itself.

Where the noise of the best set is still as large as it may be, much is left. Then each taken one is searched
for anew, too, beside the others as they have become; and other paths are followed: from single mechanisms
that the best set does not have, and from the best set of the other search.

Probabilities are shares of weight over all sets that were tried and count: those of sets never tried count
as nothing. What the full model, fitted with some of them, says of a choice of learnt mechanisms moves the
weights of all sets with these; the best is then one that it has been fitted with.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bayeskin.inference import LogPosterior
from bayeskin.inference.straighten import find_shear
from bayeskin.mechanisms import Mechanism, with_one, without_one
from bayeskin.mismatch.fit import Fit, fit, fit_base, much_left, promised
from bayeskin.types import Array

PRIOR = 0.05  # of a mechanism to be at work, before the recording is seen
MOST = 8  # mechanisms of a set, from which on no further one is tried
SHORTLIST = 5  # mechanisms of a step that are tried thoroughly
PATHS = 2  # at most
EXCHANGES = 2  # mechanisms that are tried in another's place
GAIN = 1.0  # nats: less is no reason to go on from the same set
RIVALS = 2  # sets, the most hopeful, that the full model is asked about beside the best
UNSURE = 0.5  # of what a mechanism adds, RMS: sd of the surrogate's error in it

Build = Callable[[Sequence[str]], LogPosterior]  # the posterior with a set of mechanisms
Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class Made:
    """A fit, and whether it counts."""

    fit: Fit
    counts: bool


@dataclass
class Search:
    """All sets tried, by their names sorted, and the best of them; those that do not count are `unsure`.

    learnt : mechanisms that the surrogate knows with an error; full : weights by the full model of the sets
    that it was fitted with, where the best is one of them
    """

    fits: dict[tuple[str, ...], Fit] = field(default_factory=dict)
    unsure: dict[tuple[str, ...], Fit] = field(default_factory=dict)
    learnt: frozenset[str] = frozenset()
    full: Mapping[tuple[str, ...], float] = field(default_factory=dict)

    def add(self, made: Made) -> None:
        """Keeps a fit: of two of the same set the one that counts, else the likelier."""
        names = made.fit.names
        if made.counts:
            self.unsure.pop(names, None)
            self.fits[names] = max(made.fit, self.fits.get(names, made.fit), key=weight)
        elif names not in self.fits:
            self.unsure[names] = max(made.fit, self.unsure.get(names, made.fit), key=weight)

    @property
    def base(self) -> Fit:
        return self.fits[()]

    @property
    def best(self) -> Fit:
        if self.full:
            return self.fits[max(self.full, key=lambda names: self.full[names])]
        return max(self.fits.values(), key=weight)

    def weight(self, one: Fit) -> float:
        """Logarithm of a set's weight: by the full model, or moved as that moved the likeliest like it."""
        if one.names in self.full:
            return self.full[one.names]
        same = [names for names in self.full if self._inner(self.fits[names]) == self._inner(one)]
        if not same:
            return weight(one)
        likeliest = max(same, key=lambda names: self.full[names])
        return weight(one) + self.full[likeliest] - weight(self.fits[likeliest])

    def rivals(self, full_weight: float | None) -> list[Fit]:
        """Of each of the best's mechanisms the most hopeful set without it but with others, where that may
        have a larger weight than the best's by the full model (None: that failed); `RIVALS` of these."""
        found: dict[tuple[str, ...], Fit] = {}
        for name in self.best.names:
            others = (one for one in self.fits.values() if one.names and name not in one.names)
            rival = max(others, key=_hopeful_weight, default=None)
            if rival is not None and (full_weight is None or _hopeful_weight(rival) > full_weight):
                found[rival.names] = rival
        return sorted(found.values(), key=_hopeful_weight, reverse=True)[:RIVALS]

    def _inner(self, one: Fit) -> frozenset[str]:
        return self.learnt & set(one.names)

    def probability(self, names: Sequence[str]) -> float:
        """Share of the weight of sets with any of these mechanisms."""
        logs = np.array([self.weight(one) for one in self.fits.values()])
        share = np.exp(logs - logs.max())
        among = np.array([bool(set(names) & set(one.names)) for one in self.fits.values()])
        return float(share[among].sum() / share.sum())


def weight(found: Fit) -> float:
    """Logarithm of a set's weight."""
    return found.log_evidence + len(found.names) * float(np.log(PRIOR / (1.0 - PRIOR)))


def _hopeful_weight(found: Fit) -> float:
    """The largest that the full model may make it."""
    return weight(found) + found.hope


def search(
    build: Build,
    known: Mapping[str, Mechanism],
    seed: int,
    progress: Progress | None = None,
    done: Sequence[Made] = (),
    on_fit: Callable[[Made], None] | None = None,
    another: Callable[[], Fit | None] = lambda: None,
    refuted: Callable[[Fit], bool] = lambda one: False,
    exchanges: bool = True,
) -> Search:
    """Forward from the fit without any mechanism, then backward.

    done : what a search that was stopped had made, in order, which is not made again
    on_fit : is told each new fit
    another : the best of another search, on a part of the recording say
    refuted : whether something else that is known of the recording speaks against a fit
    exchanges : whether others are tried in the place of mechanisms that were taken
    """
    forward = _Forward(
        build, known, seed, progress or (lambda share, note: None), done, on_fit, refuted, exchanges
    )
    found = forward.found
    forward.path(forward.base(), "path 1")
    singles = sorted((one for one in found.fits.values() if len(one.names) == 1), key=weight, reverse=True)
    for count in range(2, PATHS + 1):
        starts = [one for one in singles[1:] if not set(one.names) <= set(found.best.names)]
        if not much_left(found.best.log_posterior, found.best.theta) or not starts:
            break
        singles.remove(starts[0])
        forward.path(starts[0], f"path {count}")
    if (other := another()) is not None and other.names:
        here = replace(other, theta={**found.best.theta, **other.theta})  # noise that the other knows not
        best, start = found.best, forward.tried(other.names, here)
        if start is not None and (much_left(best.log_posterior, best.theta) or start is found.best):
            forward.path(start, "path from another search")
    return found


class _Forward:
    """The sets `found` so far, and steps from one to the next; fits that an earlier search made are taken."""

    def __init__(
        self, build: Build, known: Mapping[str, Mechanism], seed: int, progress: Progress,
        done: Sequence[Made], on_fit: Callable[[Made], None] | None, refuted: Callable[[Fit], bool],
        exchanges: bool,
    ) -> None:  # fmt: skip
        self.found = Search()
        self._build, self._known, self._seed = build, known, seed
        self._progress, self._on_fit, self._refuted = progress, on_fit, refuted
        self._exchanges = exchanges
        self._made = {made.fit.names: [m for m in done if m.fit.names == made.fit.names] for made in done}
        self._alone = build(())
        self._straight = find_shear(self._alone)
        self._climbed: set[tuple[tuple[str, ...], tuple[str, ...], float]] = set()  # what, and from where
        self._neutral = {name: value for m in known.values() for name, value in m.neutral.items()}

    def base(self) -> Fit:
        """The fit without any mechanism."""
        found = self._kept((), lambda: fit_base(self._alone, self._seed, self._straight))
        assert found is not None
        return found

    def path(self, ahead: Fit, label: str) -> None:
        """From a set forward and back, as long as that gains weight."""
        current = None
        while ahead is not current:
            current = ahead
            while len(current.names) > 1 and (leaner := self._leaner(current)) is not None:
                current = leaner
            ahead = current
            if len(current.names) < MOST:
                ahead = self._step(current, f"{label}, mechanism {len(current.names) + 1}")
            if ahead is current and self._exchanges:
                ahead = self._renewed(current, label)

    def tried(
        self, names: Sequence[str], start: Fit, thorough: bool = True, again: bool = False
    ) -> Fit | None:
        """The fit of a set from that of another, None where it does not count.

        One made before is made `again` where that is asked for or may gain, but not twice from one start.
        """
        key = tuple(sorted(names))
        climb = (key, start.names, start.value)
        anew = climb not in self._climbed and (again or _may_gain(self.found.fits.get(key), key, start))
        self._climbed.add(climb)

        def make() -> Fit:
            wide = self._build(key)
            shear = self._straight.among(self._alone.names, wide.names) if self._straight else None
            new = _new(self._known, key, start.names) if thorough else []
            return fit(key, wide, start.theta, self._neutral, self._seed, shear, new)

        return self._kept(key, make, anew)

    def _kept(self, key: tuple[str, ...], make: Callable[[], Fit], anew: bool = False) -> Fit | None:
        """The fit of a set, made where it was not yet, None where it does not count."""
        if anew or (key not in self.found.fits and key not in self.found.unsure):
            if self._made.get(key):
                made = self._made[key].pop(0)
            else:
                one = make()
                made = Made(one, sure(one, self._build, self._known) and not self._refuted(one))
                if self._on_fit:
                    self._on_fit(made)
            self.found.add(made)
        return self.found.fits.get(key)

    def _step(self, current: Fit, label: str) -> Fit:
        """The best of the sets with one mechanism more, or `current` where none has more weight."""
        order = self._by_promise(current, current.names)
        tries = order if not current.names else order[:SHORTLIST]
        fits = [current]
        for count, (name, names) in enumerate(tries):
            one = self.tried(names, current, count < SHORTLIST)
            fits += [] if one is None else [one]
            nats = "does not count" if one is None else f"{one.log_evidence - current.log_evidence:+.1f} nats"
            self._progress((count + 1) / len(tries), f"{label}: {name}: {nats}")
        return max(fits, key=weight)

    def _renewed(self, current: Fit, label: str) -> Fit:
        """The best set that is reached with another in the place of each mechanism of several; where much is
        left, by searching for each anew, too."""
        best, anew = current, much_left(current.log_posterior, current.theta)
        for count, name in enumerate(current.names if anew or len(current.names) > 1 else ()):
            if name in best.names and (rest := self._leaving(best, name)) is not None:
                fits = [self.tried(best.names, rest, again=True)] if anew else []
                others = self._by_promise(rest, best.names)[:EXCHANGES]
                fits += [self.tried(names, rest) for _, names in others]
                best = max([best, *(one for one in fits if one is not None)], key=weight)
            gain = weight(best) - weight(current)
            self._progress((count + 1) / len(current.names), f"{label}, {name} anew: {gain:+.1f} nats")
        return best if weight(best) > weight(current) + GAIN else current

    def _leaving(self, best: Fit, name: str) -> Fit | None:
        """The set with one mechanism fewer."""
        return self.tried(without_one(best.names, name, self._known), best)

    def _leaner(self, best: Fit) -> Fit | None:
        """The best of the sets with one mechanism fewer, where that has more weight."""
        fewer = [one for name in best.names if (one := self._leaving(best, name)) is not None]
        leanest = max(fewer, key=weight, default=best)
        return leanest if weight(leanest) > weight(best) else None

    def _by_promise(self, current: Fit, but: Sequence[str]) -> list[tuple[str, tuple[str, ...]]]:
        """All mechanisms but some, and the set with each, the most promising beside `current` first."""
        sets = [(name, with_one(current.names, name, self._known)) for name in self._known if name not in but]
        promises = {name: self._promised(names, current) for name, names in sets}
        return sorted(sets, key=lambda one: -promises[one[0]])

    def _promised(self, names: Sequence[str], current: Fit) -> float:
        new = _new(self._known, names, current.names)
        return promised(self._build(names), current.theta, self._neutral, new, self._seed)


def _may_gain(before: Fit | None, names: Sequence[str], start: Fit) -> bool:
    """Whether another climb of a set is worth it: from no smaller set, or from one that is ahead."""
    smaller = set(start.names) < set(names)
    return not smaller or (before is not None and before.log_likelihood < start.log_likelihood)


def _new(
    known: Mapping[str, Mechanism], names: Sequence[str], before: Sequence[str]
) -> list[tuple[str, ...]]:
    """Parts of the mechanisms that an earlier set does not have."""
    return [part for name in names if name not in before for part in known[name].whole_or_parts]


def sure(found: Fit, build: Build, known: Mapping[str, Mechanism]) -> bool:
    """Whether the surrogate knows of each mechanism at least half of what it adds, or all but the noise.

    Not where all that was tried is impossible, as skins may be that were well with a mechanism more.
    """
    if not np.isfinite(found.value):
        return False
    whole = found.log_posterior
    noise_n = max(found.theta[name] for name in whole.names if name.startswith("sd_"))
    mean, variance = _predicted(whole, found)
    for name in found.names:
        without = build(without_one(found.names, name, known))
        its_mean, its_variance = _predicted(without, found)
        added = float(np.sqrt(np.mean((mean - its_mean) ** 2)))
        unsure = float(np.sqrt(max(float(np.mean(variance - its_variance)), 0.0)))
        if unsure > max(UNSURE * added, noise_n):
            return False
    return True


def _predicted(log_posterior: LogPosterior, found: Fit) -> tuple[Array, Array]:
    """Mean (m,) and variance (m,) of the force at a fit's values, as far as a posterior knows them."""
    values = log_posterior.from_sampling(log_posterior.vector(found.theta))
    prediction = log_posterior.predict(values)
    return prediction.mean[0], prediction.sd()[0] ** 2
