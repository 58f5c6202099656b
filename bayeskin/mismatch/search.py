"""A search for mechanisms in which the forward model solves all mechanisms of a set together.

The search goes forward from the fit without any mechanism. A score test of every other mechanism beside the
set at hand orders them. The most promising are fitted, each with all other parameters free again, and the
likeliest is taken if its weight is larger. A mechanism with a shortcut for the force is tested, and its
values are searched for, on the tangent of the set's last run. One that only the model can solve is tested by
a few runs. The sets that gain most are fitted from other skins, too, since a missing mechanism leads the
skin astray; then each mechanism of the best is left out in turn. Where nothing more is gained, each mechanism
of the best is exchanged: left out, and every other one tried beside the rest.

A mechanism that is not in the catalogue is imitated by several that are, each of which gains. So the search
goes on from a larger set only if this is likelier than the smaller one with something smooth beside it that
has no name, or with the same beside itself.

A run of the full model at a set's fit says by how much the forward model is off there. Where that is too much
the set is fitted again, with the difference added to the force. Sets that gain much are checked in this way
before the search goes on from one, and all likely sets at the end, so that they are compared by forces as
exact as the noise asks for. A set's weight is its evidence times the prior of its mechanisms.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.stats import qmc

from bayeskin.errors import InputError
from bayeskin.inference.gauss_newton import promise
from bayeskin.mechanisms import Mechanism, with_one, without_one
from bayeskin.mechanisms.mechanism import Tissue
from bayeskin.mismatch.fit import soft_on_stiff
from bayeskin.mismatch.hypotheses import ODDS, Evidences, Family, hypotheses_of, weight
from bayeskin.mismatch.tasks import Ask, Climb, FullProbe, Join, Probe, Promise, Task, Weigh
from bayeskin.mismatch.trust_region import JointFit, as_json
from bayeskin.mismatch.wrapper import innermost
from bayeskin.types import Array, BinnedForce, ParameterSpace


@dataclass(frozen=True)
class SearchSettings:
    """Settings of a search.

    skins : runs of the base model over its prior, from which fits set out
    starts, best : fits of the base model from the nearest of these, and how many go on after their first runs
    first, runs : of a fit, before those far behind are given up, and after
    behind : nats of weight behind the likeliest set, from which on a fit is given up
    close : nats behind it, up to which a set is checked by the full model
    probes : runs of each part of a mechanism that the model solves, and how far off neutral, of the prior
    shortlist, promised : mechanisms that are fitted beside a set, and nats that each must promise, which a
        skin led astray makes too few; where nothing but noise is left, each must promise to be likely
    astray : nats of weight gained, from which on a set may have led the smaller one to another skin
    near, alike : share of the best gain from which on sets are fitted from other skins; how many at most
    again : shares of the strength of a finished run, with which fits begin that fail otherwise
    others, tried : skins that a set is run with, and how many of them it is fitted from
    left : RMS residual over the noise's, from which on that is done, and more than noise is left
    gain : nats of weight, less is no reason to go on; most : mechanisms of a set
    compared : sets that are checked by the full model; checks : rounds of them
    weighed : sets, the likeliest and that without mechanisms, whose hypotheses are compared
    exact : error of the forward model, RMS over bins, over that of the noise, that needs no correction
    shapes : of each part of a mechanism that the model solves, from which further maxima are sought
    ends : of the prior's width, where a permeability sets out for these
    ratios : of a modulus to the first one, which are tried there
    maxima : further ones that are kept
    alike_by : of the prior's width: fits whose runs differ by less share a check, and have one maximum
    """

    skins: int = 32
    starts: int = 4
    best: int = 2
    first: int = 4
    runs: int = 9
    behind: float = 12.0
    close: float = 6.0
    probes: int = 3
    off: float = 0.25
    shortlist: int = 4
    promised: float = 1.0
    astray: float = 10.0
    near: float = 0.8
    alike: int = 3
    again: tuple[float, ...] = (1.0, 0.2)
    others: int = 16
    tried: int = 2
    left: float = 1.1
    gain: float = 1.0
    most: int = 6
    compared: int = 6
    checks: int = 4
    weighed: int = 6
    exact: float = 0.05
    shapes: int = 2
    ends: tuple[float, float] = (0.1, 0.9)
    ratios: tuple[float, ...] = (0.05, 0.2, 0.6, 1.5)
    maxima: int = 3
    alike_by: float = 0.1


RARITY = -ODDS  # nats that a mechanism must explain to be as likely as none
Tell = Callable[[str], None]


@dataclass(frozen=True)
class Check:
    """A run of the full model that checks a fit: its force (m,) of the skin, or why it failed.

    theta : its values, those of the fit's own run or of another set's with the same mechanisms of the tissue
    off : by how much the forward model is off there, beyond what was added to it, RMS over bins [N]; infinite
        where the run failed
    """

    theta: Array
    full_n: Array | str
    off: float


@dataclass
class Search:
    """All sets fitted, by their names sorted: of each the likeliest fit, and the last check of one.

    evidences : of the sets whose hypotheses are compared
    others : further maxima of the likeliest of these, and of a part of it, less likely than those in `fits`
    """

    fits: dict[tuple[str, ...], JointFit] = field(default_factory=dict)
    checks: dict[tuple[str, ...], Check] = field(default_factory=dict)
    evidences: dict[tuple[str, ...], Evidences] = field(default_factory=dict)
    others: list[JointFit] = field(default_factory=list)

    def add(self, found: object) -> None:
        """Keeps a fit where it is the likeliest of its set; answers of another kind are failures."""
        if isinstance(found, JointFit) and np.isfinite(found.fit.value):
            names = found.fit.names
            if names not in self.fits or weight(found.fit) > weight(self.fits[names].fit):
                self.fits[names] = found

    @property
    def best(self) -> JointFit:
        """The set with the largest weight."""
        return max(self.fits.values(), key=lambda one: weight(one.fit))

    @property
    def family(self) -> Family:
        """The hypotheses that are compared."""
        return Family([one for names, said in self.evidences.items() for one in hypotheses_of(names, said)])

    def others_of(self, names: tuple[str, ...]) -> list[JointFit]:
        """Returns further maxima of a set."""
        return [one for one in self.others if one.fit.names == names]

    @property
    def chosen(self) -> tuple[str, ...]:
        """The likeliest of the sets that are compared, with or without something beside it."""
        return max(self.evidences, key=self.family.probability_of_set)

    def likeliest(self, count: int) -> list[JointFit]:
        """Returns so many of the sets with the largest weights, that without mechanisms always among them."""
        order = sorted(self.fits.values(), key=lambda one: -weight(one.fit))
        others = [one for one in order if one.fit.names]
        chosen = [*others[: count - 1], self.fits[()]]
        return sorted(chosen, key=lambda one: -weight(one.fit))


def search(
    ask: Ask, binned: BinnedForce, base: ParameterSpace, known: Mapping[str, Mechanism],
    solves: Collection[str], noise: Mapping[str, float], seed: int, tell: Tell,
    settings: SearchSettings | None = None,
) -> Search:  # fmt: skip
    """Returns the fits of all sets that a search comes by.

    base : the base model's priors; solves : names of known mechanisms that the forward model solves
    noise : values of the noise's parameters to begin with
    Raises InputError where the model runs with no skin of these priors.
    """
    searcher = _Searcher(ask, binned, base, known, solves, noise, seed, tell, settings or SearchSettings())
    searcher.base()
    searcher.search()
    searcher.weigh()
    if searcher.found.evidences:
        searcher.other_maxima()
    return searcher.found


class _Searcher:
    def __init__(
        self, ask: Ask, binned: BinnedForce, base: ParameterSpace, known: Mapping[str, Mechanism],
        solves: Collection[str], noise: Mapping[str, float], seed: int, tell: Tell, settings: SearchSettings,
    ) -> None:  # fmt: skip
        self.found = Search()
        self._ask, self._binned, self._base, self._known = ask, binned, base, known
        self._noise, self._seed, self._tell, self._settings = noise, seed, tell, settings
        self._solves = frozenset(solves)
        self._neutral = {name: value for m in known.values() for name, value in m.neutral.items()}
        self._skins: list[dict[str, float]] = []
        self._expanded: set[tuple[str, ...]] = set()
        self._weighed: dict[tuple[str, ...], JointFit] = {}  # fits that the evidences are of
        self._shapes: dict[str, Mapping[str, float]] = {}  # by the strength: values that promised most

    def base(self) -> None:
        """Fits the model without mechanisms. Raises InputError where no skin runs."""
        settings = self._settings
        rows = self._base.from_unit(qmc.Sobol(self._base.dim, rng=self._seed).random(settings.skins))
        rows = rows[~soft_on_stiff(self._base, rows)]
        drawn = [dict(zip(self._base.names, map(float, row), strict=True)) for row in rows]
        self._skins = self._nearest((), drawn, {})
        starts = [Climb((), {**self._noise, **skin}, settings.first)
                  for skin in self._skins[: settings.starts]]  # fmt: skip
        answers = self._ask(starts)
        self._finish(answers)
        if not self.found.fits:
            why = next((f": {one}" for one in answers if isinstance(one, str)), "")
            expected = "skins that the model runs, whose E_s is at most twice E_c"
            raise InputError("priors", f"no skin that runs{why}", expected)

    def search(self) -> None:
        """Adds, leaves out and exchanges mechanisms as long as that gains weight."""
        for _ in range(2 * self._settings.most):
            current = self._exact()
            if current.fit.names not in self._expanded and len(current.fit.names) < self._settings.most:
                self._forward(current)
                if self._gains(current) and not self._beats_smooth(current.fit.names):
                    self._check_all()
                    return
            if not self._gains(current):
                self._exchange(current)
            if not self._gains(current):
                self._check_all()
            if not self._gains(current):
                return

    def weigh(self) -> None:
        """Weighs the hypotheses of the likeliest sets, and of those that the search stopped at."""
        before = list(self.found.evidences)
        sets = [one.fit.names for one in self.found.likeliest(self._settings.weighed)]
        self._weigh(dict.fromkeys([*sets, *before]))
        for _ in range(self._settings.checks):
            if not self.found.evidences or self.found.chosen in self.found.checks:
                return
            names = self.found.chosen
            self._check([self.found.fits[names]])
            self._weigh([names])

    def _weigh(self, sets: Iterable[tuple[str, ...]]) -> None:
        """Weighs hypotheses of sets, those again whose fit is another now; one that fails has no evidence."""
        new = [names for names in sets if self._weighed.get(names) is not self.found.fits[names]]
        answers = self._ask([Weigh(as_json(self.found.fits[names])) for names in new])
        for names, said in zip(new, answers, strict=True):
            self.found.evidences.pop(names, None)
            self._weighed[names] = self.found.fits[names]
            if isinstance(said, Evidences):
                self.found.evidences[names] = said
            else:
                self._tell(f"{', '.join(names) or 'no mechanism'} could not be weighed: {said}")

    def _beats_smooth(self, names: tuple[str, ...]) -> bool:
        """Returns whether the likeliest set is likelier than another with something smooth beside it."""
        best = self.found.best.fit.names
        self._weigh([names, best])
        if not {names, best} <= set(self.found.evidences):
            return True
        family = self.found.family
        gained = family.likeliest(best) - family.likeliest(names)
        if gained < self._settings.gain:
            said = ", ".join(names) or "no mechanism"
            self._tell(
                f"{said}, with something smooth that has no name, is as likely as {', '.join(best)}, "
                f"alone or with the same: {-gained:+.1f} nats"
            )
        return gained >= self._settings.gain

    def other_maxima(self) -> None:
        """Climbs to further maxima of the likeliest set, from values that the force says little of.

        Before it that is done for the likeliest of its parts, if this is not far behind: a mechanism may have
        gained on a maximum that is not the highest.
        """
        family, names = self.found.family, self.found.chosen
        gap = {one: family.likeliest(names) - family.likeliest(one) for one in self.found.evidences}
        parts = [one for one in gap if set(one) < set(names) and gap[one] < self._settings.behind]
        if parts:
            self._further_maxima(min(parts, key=lambda one: gap[one]))
        self._further_maxima(self.found.chosen)

    def _further_maxima(self, names: tuple[str, ...]) -> None:
        """Keeps further maxima of a set; their forces differ by so little that each needs a full run."""
        if self.found.others_of(names):
            return
        best = self.found.fits[names]
        there = self._climbed_elsewhere(best)
        full = self._ask([FullProbe(self._solved(names), self._solved_values(one)) for one in there])
        said = ", ".join(names) or "no mechanism"
        maxima, checks = [best], list[Check]()
        for one, full_n in zip(there, full, strict=True):
            if isinstance(full_n, str):
                continue
            off_n = _error_at(one, full_n)
            check, corrected = Check(one.run.theta, np.asarray(full_n), self._rms(off_n - one.off_n)), one
            if check.off > self._settings.exact * noise_of(self._binned):
                again = Climb(names, one.fit.theta, self._settings.runs, tuple(off_n.tolist()))
                (corrected,) = self._ask([again])  # type: ignore[assignment]
            for maximum in self._distinct([corrected], maxima, self._settings.close):
                self._tell(f"another maximum of {said}: {self._gained(maximum, best):+.1f} nats")
                maxima.append(maximum)
                checks.append(check)
        top = int(np.argmax([weight(one.fit) for one in maxima]))
        self.found.others += [*maxima[:top], *maxima[top + 1 :]]
        if top:
            self.found.fits[names], self.found.checks[names] = maxima[top], checks[top - 1]
            self._fit_larger(maxima[top])
            self.weigh()

    def _fit_larger(self, best: JointFit) -> None:
        """Fits the compared sets that contain one anew from its new maximum; all are to be compared there."""
        larger = [names for names in self.found.evidences if set(best.fit.names) < set(names)]
        starts = [{**self.found.fits[names].fit.theta, **best.fit.theta} for names in larger]
        runs, off_n = self._settings.runs, added(best)
        climbs = [Climb(names, start, runs, off_n) for names, start in zip(larger, starts, strict=True)]
        for names, answer in zip(larger, self._ask(climbs), strict=True):
            before = self.found.fits[names]
            self.found.add(answer)
            if self.found.fits[names] is not before:
                self.found.checks.pop(names, None)

    def _climbed_elsewhere(self, best: JointFit) -> list[JointFit]:
        """Returns fits of the likeliest set that are elsewhere and not far behind, the likeliest first."""
        settings, names = self._settings, best.fit.names
        climbs = [Climb(names, start, settings.first, added(best)) for start in self._elsewhere(best)]
        first = self._distinct(self._ask(climbs), [best], settings.behind)
        rest = settings.runs - settings.first
        again = self._ask([Climb(names, one.fit.theta, rest, added(best)) for one in first
                           if not one.settled])  # fmt: skip
        ended = [*(one for one in first if one.settled), *again]
        return self._distinct(ended, [best], settings.close)[: settings.maxima]

    def _distinct(
        self, answers: Sequence[object], known: Sequence[JointFit], behind: float
    ) -> list[JointFit]:
        """Returns the fits among answers that are no known maximum, the likeliest of each other one.

        known : fits, the first of which no other is to be farther behind than so many nats
        """
        fits = sorted((one for one in answers if isinstance(one, JointFit)), key=lambda one: -weight(one.fit))
        kept = list(known)
        for one in fits:
            apart = not any(self._is_alike(one, other.run.theta) for other in kept)
            if apart and self._gained(known[0], one) <= behind:
                kept.append(one)
        return kept[len(known) :]

    def _elsewhere(self, best: JointFit) -> list[dict[str, float]]:
        """Returns values from which further maxima may be reached.

        A force hardly tells which layer drains while it is watched, and of the other one whether that drains
        at once or not at all. So permeabilities are equal or exchanged, or one of them is near an end of its
        prior, each with the moduli that suit the recording best. Or a mechanism that the model solves has
        another shape.
        """
        theta = best.fit.theta
        limits = {p.name: (p.lower, p.upper) for p in self._base.parameters}
        flow = ParameterSpace(tuple(p for p in self._base.parameters if p.stress_power < 0))
        others: list[dict[str, float]] = []
        if flow.dim:
            middle = float(np.exp(np.mean([np.log(theta[name]) for name in flow.names])))
            exchanged = {name: theta[other] for name, other in zip(flow.names, flow.names[::-1], strict=True)}
            others = [dict.fromkeys(flow.names, middle), exchanged]
            for share in self._settings.ends:
                at_end = flow.from_unit(np.full(flow.dim, share))
                others += [{name: float(value)} for name, value in zip(flow.names, at_end, strict=True)]
        others = [{name: float(np.clip(value, *limits[name])) for name, value in one.items()}
                  for one in others]  # fmt: skip
        others = [self._with_moduli({**theta, **one}, best) for one in others]
        for name in self._solved(best.fit.names):
            mechanism = self._known[name]
            for _, *shapes in mechanism.whole_or_parts:
                others += _shapes_of(mechanism, shapes, self._settings.shapes) if shapes else []
        return [{**theta, **values} for values in others]

    def _with_moduli(self, theta: Mapping[str, float], best: JointFit) -> dict[str, float]:
        """Returns the base's parameters with the ratio of moduli and the stiffness whose force is nearest."""
        skin = {name: theta[name] for name in self._base.names}
        first, *rest = (p for p in self._base.parameters if p.stress_power > 0)
        others = [
            {**skin, p.name: float(np.clip(ratio * skin[first.name], p.lower, p.upper))}
            for p in rest for ratio in self._settings.ratios
        ]  # fmt: skip
        return next(iter(self._nearest(best.fit.names, [skin, *others], theta)), skin)

    def _exact(self) -> JointFit:
        """The likeliest set, checked if it has mechanisms of the tissue: what the reduced model leaves out of
        these would pass for further mechanisms."""
        for _ in range(self._settings.checks):
            best = self.found.best
            if not self._solved(best.fit.names) or self._is_checked_nearby(best):
                break
            self._check([best])
        return self.found.best

    def _gains(self, current: JointFit) -> bool:
        """Returns whether another set than the one at hand is better by enough to go on from it."""
        before = self.found.fits[current.fit.names]
        return self._gained(self.found.best, before) >= self._settings.gain

    def _forward(self, current: JointFit) -> None:
        """Fits sets with one mechanism more, and those that gain most from other skins and without others.

        Where they gain much the set at hand is fitted again from their skins, and they from that of the best:
        maybe they have found a better skin, and no mechanism. Then they are checked by the full model, since
        the reduced model may be far off with one of them.
        """
        sets = self._beside(current)
        if self._gains(current):
            hopeful = self._hopeful(sets, current)
            starts = [(current, one.fit.theta) for one in hopeful]
            starts += [(one, {**one.fit.theta, **self._base_values(hopeful[0])}) for one in hopeful[1:]]
            self._finish(self._ask([
                Climb(one.fit.names, theta, self._settings.first, added(one))
                for one, theta in starts
            ]))  # fmt: skip
            best = self.found.fits[hopeful[0].fit.names] if hopeful else current
            if self._leaves_more_than_noise(best):
                self._from_other_skins(best)
            self._check([
                now for one in hopeful
                if self._solved(one.fit.names)
                and not self._is_checked_nearby(now := self.found.fits[one.fit.names])
            ])  # fmt: skip
            self._leaner(self.found.best)

    def _exchange(self, current: JointFit) -> None:
        """Fits sets with another mechanism in the place of each of those at hand."""
        if len(current.fit.names) > 1:
            for name in current.fit.names:
                rest = self.found.fits.get(without_one(current.fit.names, name, self._known))
                if rest is not None and rest.fit.names not in self._expanded:
                    self._beside(rest)

    def _check_all(self) -> None:
        """Compares the likeliest sets by forces that are as exact as the noise asks for."""
        for _ in range(self._settings.checks):
            if not (unchecked := self._unchecked()):
                return
            self._check(unchecked)

    def _unchecked(self) -> list[JointFit]:
        """The sets to check: likely ones, parts of the likeliest of the same tissue, and this if it moved."""
        order = self.found.likeliest(len(self.found.fits))
        best = order[0]
        near = [one for one in order[: self._settings.compared]
                if self._gained(best, one) <= self._settings.close]  # fmt: skip
        solved = self._solved(best.fit.names)
        parts = [
            one for one in order
            if set(one.fit.names) < set(best.fit.names) and self._solved(one.fit.names) == solved
        ]  # fmt: skip
        found = {
            one.fit.names: one for one in (*near, *parts)
            if one.fit.names not in self.found.checks and not self._is_checked_nearby(one)
        }  # fmt: skip
        check = self.found.checks.get(best.fit.names)
        is_checked = check is not None and np.array_equal(check.theta, best.run.theta)
        return list(found.values() if is_checked else {best.fit.names: best, **found}.values())

    def _is_checked_nearby(self, one: JointFit) -> bool:
        """Returns whether the full model was run near a fit, with the same mechanisms of the tissue."""
        solved = self._solved(one.fit.names)
        return any(
            self._solved(names) == solved and self._is_alike(one, check.theta)
            for names, check in self.found.checks.items()
        )

    def _is_alike(self, one: JointFit, theta: Array) -> bool:
        """Returns whether a fit's run is near other values of the parameters that the model solves."""
        space = innermost(one.fit.log_posterior.surrogate).space
        apart = space.to_unit(one.run.theta) - space.to_unit(theta)
        return bool(np.abs(apart).max() <= self._settings.alike_by)

    def _check(self, sets: Sequence[JointFit]) -> None:
        """Runs the full model at fits, and fits those again at which the reduced model is too far off."""
        groups: dict[tuple[str, ...], list[JointFit]] = {}
        for one in sets:
            groups.setdefault(self._solved(one.fit.names), []).append(one)
        first = [members[0] for members in groups.values()]
        full = self._ask([FullProbe(names, self._solved_values(one))
                          for names, one in zip(groups, first, strict=True)])  # fmt: skip
        again: list[Climb] = []
        for one, members, full_n in zip(first, groups.values(), full, strict=True):
            again += self._corrected(one, members, full_n)
        for task, answer in zip(again, self._ask(again), strict=True):
            if isinstance(answer, JointFit):
                self.found.fits[task.names] = answer

    def _corrected(self, first: JointFit, members: Sequence[JointFit], full_n: object) -> list[Climb]:
        """Notes how a run of the full model at the first of some fits checks them; the fits that it asks for.

        All have the same mechanisms of the tissue, so the forward model is taken to be off by the same.
        """
        tasks = []
        for one in members:
            said = ", ".join(one.fit.names) or "no mechanism"
            if isinstance(full_n, str):
                self.found.checks[one.fit.names] = Check(first.run.theta, full_n, np.inf)
                self._tell(f"{said}: the full model fails there: {full_n}")
                continue
            off_n = _error_at(first, full_n)
            off = self._rms(off_n - one.off_n)
            self.found.checks[one.fit.names] = Check(first.run.theta, np.asarray(full_n), off)
            if off > self._settings.exact * noise_of(self._binned):
                tasks.append(Climb(one.fit.names, one.fit.theta, self._settings.runs, tuple(off_n.tolist())))
                self._tell(f"{said}: a full run differs by {1e3 * off:.1f} mN; it is fitted with that added")
        return tasks

    def _base_values(self, one: JointFit) -> dict[str, float]:
        """The base model's parameters of a fit."""
        return {name: one.fit.theta[name] for name in self._base.names}

    def _solved(self, names: Sequence[str]) -> tuple[str, ...]:
        """Those of a set that the forward model solves."""
        return tuple(name for name in sorted(names) if name in self._solves)

    def _solved_values(self, one: JointFit) -> dict[str, float]:
        """The parameters that the forward model solves, at a fit's run."""
        names = innermost(one.fit.log_posterior.surrogate).space.names
        return dict(zip(names, map(float, one.run.theta), strict=True))

    def _rms(self, force_n: Array) -> float:
        """RMS over the bins that were recorded."""
        return float(np.sqrt(np.mean(np.square(force_n[np.isfinite(self._binned.force_n)]))))

    def _leaves_more_than_noise(self, one: JointFit) -> bool:
        left_n = self._rms(self._binned.force_n - one.fit.force_n)
        return left_n > self._settings.left * noise_of(self._binned)

    def _gained(self, one: JointFit, before: JointFit) -> float:
        return weight(one.fit) - weight(before.fit)

    def _hopeful(self, sets: Sequence[tuple[str, ...]], current: JointFit) -> list[JointFit]:
        """The sets that gain most on the one at hand, if so much that this may have had another skin."""
        fits = [self.found.fits[names] for names in sets if names in self.found.fits]
        fits.sort(key=lambda one: -weight(one.fit))
        least = max(self._settings.near * self._gained(fits[0], current), self._settings.astray)
        return [one for one in fits[: self._settings.alike] if self._gained(one, current) >= least]

    def _nearest(
        self, names: tuple[str, ...], skins: Sequence[Mapping[str, float]], values: Mapping[str, float]
    ) -> list[dict[str, float]]:
        """Skins, those whose force comes nearest to the recorded one first, each as stiff as suits it best.

        With all moduli c times and all permeabilities 1/c times what they were the force is c times as large.
        """
        usable = np.isfinite(self._binned.force_n)
        recorded, rows = self._binned.force_n[usable], []
        answers = self._ask([Probe(names, {**values, **skin}) for skin in skins])
        for skin, force_n in zip(skins, answers, strict=True):
            if isinstance(force_n, str):
                continue
            force = np.asarray(force_n)[usable]
            powers = {p.name: p.stress_power for p in self._base.parameters if p.stress_power}
            least, most = self._room(skin, powers)
            factor = float(np.clip(force @ recorded / (force @ force), least, most))
            scaled = {name: value * factor ** powers.get(name, 0) for name, value in skin.items()}
            rows.append((float(np.sum((recorded - factor * force) ** 2)), scaled))
        return [skin for _, skin in sorted(rows, key=lambda row: row[0])]

    def _room(self, skin: Mapping[str, float], powers: Mapping[str, int]) -> tuple[float, float]:
        """Factors between which all scaled parameters stay within their priors."""
        least, most = 0.0, np.inf
        for p in self._base.parameters:
            if power := powers.get(p.name, 0):
                ends = sorted((end / skin[p.name]) ** (1.0 / power) for end in (p.lower, p.upper))
                least, most = max(least, ends[0] * 1.001), min(most, ends[1] / 1.001)
        return min(least, 1.0), max(most, 1.0)

    def _beside(self, current: JointFit) -> list[tuple[str, ...]]:
        """Fits the sets with one mechanism more that promise most, as far as they are new, and returns these.

        One that fails, or ends below the fit without the mechanism, begins again there, with the values of a
        run that was finished, and then with a weaker mechanism.
        """
        names, settings = current.fit.names, self._settings
        self._expanded.add(names)
        off_n = added(current)  # of the same tissue
        others = [
            name for name in self._known
            if name not in names and with_one(names, name, self._known) not in self.found.fits
        ]  # fmt: skip
        solved = [name for name in others if isinstance(self._known[name].act, Tissue)]
        quick = [name for name in others if name not in solved]
        probes = [(name, values) for name in solved for values in self._probes(self._known[name])]
        theta = {**self._neutral, **current.fit.theta}
        tasks: list[Task] = [
            Probe(with_one(names, name, self._known), {**theta, **values}) for name, values in probes
        ]
        answers = self._ask(
            [*tasks, *(Promise(names, current.fit.theta, current.run, name, off_n) for name in quick)]
        )
        promised: dict[str, float] = {}
        tested: dict[str, float] = {}
        starts: dict[str, Mapping[str, float]] = {}
        ran: dict[str, Mapping[str, float]] = {}  # where the model is known to run with a mechanism
        for (name, values), force_n in zip(probes, answers, strict=False):
            if isinstance(force_n, str):
                continue
            gain, start = self._score(current, name, values, np.asarray(force_n) + current.off_n)
            strength = next(iter(values))
            if gain > tested.get(strength, -1.0):
                tested[strength], self._shapes[strength] = gain, values
            if gain > promised.get(name, 0.0):
                promised[name], starts[name], ran[name] = gain, start, values
        for name, nats in zip(quick, answers[len(probes) :], strict=True):
            if isinstance(nats, float):
                promised[name] = nats
        order = sorted(promised, key=lambda name: -promised[name])
        least = settings.promised if self._leaves_more_than_noise(current) else settings.gain + RARITY
        chosen = [name for name in order if promised[name] > least][: settings.shortlist]
        self._tell("promised: " + ", ".join(f"{name} {promised[name]:.0f} nats" for name in order[:5]))
        fits = self._ask([
            Climb(with_one(names, name, self._known), starts[name], settings.first) if name in starts
            else Join(Promise(names, current.fit.theta, current.run, name, off_n), settings.first)
            for name in chosen
        ])  # fmt: skip
        better = {name: _better(one, current) for name, one in zip(chosen, fits, strict=True)}
        for share in settings.again:
            worse = [name for name in chosen if not better[name]]
            more = self._ask([
                Climb(with_one(names, name, self._known),
                      {**theta, **self._weaker(name, ran.get(name, {}), share)}, settings.first,
                      () if name in starts else off_n)
                for name in worse
            ])  # fmt: skip
            better |= {name: _better(one, current) for name, one in zip(worse, more, strict=True)}
            fits += more
        self._finish(fits, current)
        sets = [with_one(names, name, self._known) for name in chosen]
        for name, its in zip(chosen, sets, strict=True):
            fitted = self.found.fits.get(its)
            gained = "no fit" if fitted is None else f"{self._gained(fitted, current):+.1f} nats"
            self._tell(f"{', '.join((*names, name))}: {gained}")
        return sets

    def _probes(self, mechanism: Mechanism) -> list[dict[str, float]]:
        """Values of each part of a mechanism, at which the model is run: of several shapes at first, later of
        that which promised most."""
        by_name, rows = {p.name: p for p in mechanism.parameters}, []
        for strength, *shapes in mechanism.whole_or_parts:
            space = ParameterSpace((by_name[strength],))
            neutral = float(space.to_unit([mechanism.neutral[strength]])[0])
            side = 1.0 if neutral <= 0.5 else -1.0
            off = {strength: float(space.from_unit([neutral + side * self._settings.off])[0])}
            if not shapes or strength in self._shapes:
                rows.append({**off, **self._shapes.get(strength, {})})
                continue
            rows += [{**off, **values} for values in _shapes_of(mechanism, shapes, self._settings.probes)]
        return rows

    def _weaker(self, name: str, values: Mapping[str, float], share: float) -> dict[str, float]:
        """Values of a mechanism that are so near to neutral, of the way that its strength is from there."""
        found = dict(values)
        for strength in list(values)[:1]:
            neutral = self._known[name].neutral[strength]
            found[strength] = neutral + share * (values[strength] - neutral)
        return found

    def _score(
        self, current: JointFit, name: str, values: Mapping[str, float], force_n: Array
    ) -> tuple[float, dict[str, float]]:
        """Nats that a mechanism promises along the change of force that a run shows, and where it would be.

        The change of the skin's force counts as that of the reported one.
        """
        about, mechanism = current.fit.log_posterior, self._known[name]
        low, high = about.bounds
        vector = np.clip(about.vector(current.fit.theta), low, high)
        skin = innermost(about.surrogate)
        here = skin.predict_mean(np.array([current.fit.theta[one] for one in skin.space.names]))
        mean = about.predict_mean(about.from_sampling(vector)) + (force_n - here)
        free = np.full(len(vector), True)
        ((_, gain, multiple, moved),) = promise(about, vector, vector[None], free, 1, mean)
        strength = next(iter(values))
        parameter = next(p for p in mechanism.parameters if p.name == strength)
        neutral = mechanism.neutral[strength]
        wanted = neutral + multiple * (values[strength] - neutral)
        inside = float(np.clip(wanted, parameter.lower, parameter.upper))
        if (inside - neutral) * (wanted - neutral) <= 0.0:  # the other way than its prior allows
            return 0.0, {}
        named = about.named(about.from_sampling(np.clip(moved, low, high)))
        return gain, {**self._neutral, **named, **values, strength: inside}

    def _from_other_skins(self, current: JointFit) -> None:
        """Fits a set from other skins, with its mechanisms as they are."""
        settings = self._settings
        skins = self._nearest(current.fit.names, self._skins[: settings.others], current.fit.theta)
        off_n = added(current)
        self._finish(self._ask([
            Climb(current.fit.names, {**current.fit.theta, **skin}, settings.first, off_n)
            for skin in skins[: settings.tried]
        ]))  # fmt: skip
        names = current.fit.names
        gained = self._gained(self.found.fits[names], current)
        self._tell(f"{', '.join(names)} from other skins: {gained:+.1f} nats")

    def _finish(self, answers: Sequence[object], since: JointFit | None = None) -> None:
        """Keeps fits, and goes on with those that are not settled: the best, and others not far behind.

        since : a fit on which they gain; those that have gained a good part of what the best has are not far
        """
        fits = sorted((one for one in answers if isinstance(one, JointFit)), key=lambda one: -weight(one.fit))
        for one in fits:
            self.found.add(one)
        settings, behind = self._settings, self._settings.behind
        if since is not None and fits:
            behind = max(behind, (1.0 - settings.near) * self._gained(fits[0], since))
        for again in self._ask([
            Climb(one.fit.names, one.fit.theta, settings.runs - settings.first, added(one))
            for i, one in enumerate(fits)
            if not one.settled and not self._is_known(one)
            and (i < settings.best or self._gained(self.found.best, one) <= behind)
        ]):  # fmt: skip
            self.found.add(again)

    def _is_known(self, one: JointFit) -> bool:
        """Returns whether another fit of the same set is near and likelier: both climb to one maximum."""
        best = self.found.fits.get(one.fit.names)
        return best is not None and best is not one and self._is_alike(one, best.run.theta)

    def _leaner(self, current: JointFit) -> None:
        """Fits the sets with one mechanism fewer that were not fitted yet."""
        names = current.fit.names
        fewer = {without_one(names, name, self._known) for name in names} - {()}
        self._finish(self._ask([
            Climb(one, current.fit.theta, self._settings.first)
            for one in sorted(fewer) if one not in self.found.fits
        ]))  # fmt: skip


def _shapes_of(mechanism: Mechanism, names: Sequence[str], count: int) -> list[dict[str, float]]:
    """Returns so many values of some of a mechanism's parameters, spread over their priors."""
    by_name = {p.name: p for p in mechanism.parameters}
    space = ParameterSpace(tuple(by_name[name] for name in names))
    unit = qmc.Halton(space.dim, scramble=False).random(count + 1)[1:]
    return [dict(zip(space.names, map(float, row), strict=True)) for row in space.from_unit(unit)]


def noise_of(binned: BinnedForce) -> float:
    """Returns the sd [N] of the noise in a bin's mean, RMS over bins."""
    return float(np.sqrt(np.nanmean(binned.variance_n2)))


def added(one: JointFit) -> tuple[float, ...]:
    """Returns the force that a fit has added to its runs, as tasks have it; empty for none."""
    return tuple(one.off_n.tolist()) if one.off_n.any() else ()


def _error_at(one: JointFit, full_n: object) -> Array:
    """Returns by how much the forward model is off at a fit's run (m,), without what was added to it."""
    return np.asarray(full_n) - (one.run.force_n - one.off_n)


def _better(one: object, current: JointFit) -> bool:
    """Returns whether an answer is a fit that is not below another."""
    return isinstance(one, JointFit) and one.fit.log_likelihood >= current.fit.log_likelihood
