"""Tests every mechanism that could be added to a set with a score test, and fits the most promising ones.

A mechanism that acts on the force alone is tested on the tangent of the set's last run, and its values are
searched for there. A mechanism of the tissue is tested by a few runs of the forward model off its neutral
value.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.stats import qmc

from bayeskin.inference.score_test import promise
from bayeskin.mechanisms import Mechanism, with_one
from bayeskin.mechanisms.mechanism import Tissue
from bayeskin.mismatch.hypotheses import VerdictSettings
from bayeskin.mismatch.search_context import SearchContext, correction, gained
from bayeskin.mismatch.search_record import Names
from bayeskin.mismatch.tasks import FitTask, FitWithAddedTask, RunTask, ScoreTestTask, Task
from bayeskin.mismatch.trust_region import SetFit
from bayeskin.mismatch.wrapper import innermost
from bayeskin.types import Array, ParameterSpace

Values = Mapping[str, float]


class Candidates:
    """Finds the mechanisms that are worth adding to a set.

    It remembers the most promising shape of each mechanism, and in `expanded` the sets to which it has
    already added mechanisms.
    """

    def __init__(self, context: SearchContext) -> None:
        self._context = context
        self._shapes: dict[str, Values] = {}  # the keys are names of strength parameters
        self.expanded: set[Names] = set()

    def fit_beside(self, current: SetFit) -> list[Names]:
        """Fits the most promising of the new sets that have one mechanism more, and returns these sets.

        A fit may fail, or end below the fit without the mechanism. It then starts again from the fit without
        the mechanism: with the mechanism's values of a run that finished, and then with a weaker mechanism.
        """
        context, names, settings = self._context, current.fit.names, self._context.settings
        self.expanded.add(names)
        correction_n = correction(current)  # valid for sets with the same mechanisms of the tissue
        promised, starts, finished = self._score_tests(current)
        order = sorted(promised, key=lambda name: -promised[name])
        least = settings.gain - VerdictSettings().log_odds  # a gain in evidence makes up for the odds
        if context.leaves_more_than_noise(current):
            least = settings.promised
        chosen = [name for name in order if promised[name] > least][: settings.shortlist]
        context.tell(
            "predicted gains: " + ", ".join(f"{name} {promised[name]:.0f} nats" for name in order[:5])
        )
        sets = {name: with_one(names, name, context.known) for name in chosen}
        fits = context.ask([
            FitTask(sets[name], starts[name], settings.first) if name in starts
            else FitWithAddedTask(self._score_test(current, name), settings.first)
            for name in chosen
        ])  # fmt: skip
        better = {name: _is_better(fit, current) for name, fit in zip(chosen, fits, strict=True)}
        theta = {**context.neutral, **current.fit.theta}
        for share in settings.again:
            worse = [name for name in chosen if not better[name]]
            repeated = context.ask([
                FitTask(sets[name], {**theta, **self._weaker(name, finished.get(name, {}), share)},
                      settings.first, () if name in starts else correction_n)
                for name in worse
            ])  # fmt: skip
            better |= {name: _is_better(fit, current) for name, fit in zip(worse, repeated, strict=True)}
            fits += repeated
        context.keep(fits, current)
        for name, with_name in sets.items():
            fit = context.record.fits.get(with_name)
            gain = "no fit" if fit is None else f"{gained(fit, current):+.1f} nats"
            context.tell(f"{', '.join((*names, name))}: {gain}")
        return list(sets.values())

    def _score_tests(self, current: SetFit) -> tuple[dict[str, float], dict[str, Values], dict[str, Values]]:
        """Returns the gain [nats] that the score test promises for each mechanism that is not in the set.

        For mechanisms of the tissue it also returns the values from which a fit would start, and values of
        the mechanism with which the forward model runs.
        """
        context, names = self._context, current.fit.names
        untried = [
            name for name in context.known
            if name not in names and with_one(names, name, context.known) not in context.record.fits
        ]  # fmt: skip
        solved = [name for name in untried if isinstance(context.known[name].act, Tissue)]
        quick = [name for name in untried if name not in solved]
        probes = [(name, values) for name in solved for values in self._probes(context.known[name])]
        theta = {**context.neutral, **current.fit.theta}
        tasks: list[Task] = [
            RunTask(with_one(names, name, context.known), {**theta, **values}) for name, values in probes
        ]
        tasks += [self._score_test(current, name) for name in quick]
        answers = context.ask(tasks)
        promised: dict[str, float] = {}
        tested: dict[str, float] = {}
        starts: dict[str, Values] = {}
        finished: dict[str, Values] = {}
        for (name, values), force_n in zip(probes, answers, strict=False):
            if isinstance(force_n, str):
                continue
            gain, start = self._score(current, name, values, np.asarray(force_n) + current.correction_n)
            strength = next(iter(values))
            if gain > tested.get(strength, -1.0):
                tested[strength], self._shapes[strength] = gain, values
            if gain > promised.get(name, 0.0):
                promised[name], starts[name], finished[name] = gain, start, values
        for name, nats in zip(quick, answers[len(probes) :], strict=True):
            if isinstance(nats, float):
                promised[name] = nats
        return promised, starts, finished

    def _score_test(self, current: SetFit, name: str) -> ScoreTestTask:
        """Returns the task of a score test: a mechanism that acts on the force is added to a set."""
        return ScoreTestTask(current.fit.names, current.fit.theta, current.run, name, correction(current))

    def _probes(self, mechanism: Mechanism) -> list[dict[str, float]]:
        """Returns values of each part of a mechanism, off the neutral value, with which the model is run.

        The first test of a mechanism uses several shapes. Later tests use the most promising shape.
        """
        settings = self._context.settings
        by_name, rows = {p.name: p for p in mechanism.parameters}, []
        for strength, *shapes in mechanism.whole_or_parts:
            space = ParameterSpace((by_name[strength],))
            neutral = float(space.to_unit([mechanism.neutral[strength]])[0])
            side = 1.0 if neutral <= 0.5 else -1.0
            off = {strength: float(space.from_unit([neutral + side * settings.off])[0])}
            if not shapes or strength in self._shapes:
                rows.append({**off, **self._shapes.get(strength, {})})
                continue
            rows += [{**off, **values} for values in shapes_of(mechanism, shapes, settings.probes)]
        return rows

    def _weaker(self, name: str, values: Values, share: float) -> dict[str, float]:
        """Returns values of a mechanism whose strength is only `share` as far from its neutral value."""
        weaker = dict(values)
        for strength in list(values)[:1]:
            neutral = self._context.known[name].neutral[strength]
            weaker[strength] = neutral + share * (values[strength] - neutral)
        return weaker

    def _score(
        self, current: SetFit, name: str, values: Values, force_n: Array
    ) -> tuple[float, dict[str, float]]:
        """Returns the gain [nats] that a score test promises for a mechanism, and the values that reach it.

        The test uses the change of force that a run with the mechanism shows. The change of the skin's force
        is taken as the change of the reported force.
        """
        posterior, mechanism = current.fit.log_posterior, self._context.known[name]
        low, high = posterior.bounds
        vector = np.clip(posterior.vector(current.fit.theta), low, high)
        skin = innermost(posterior.surrogate)
        skin_n = skin.predict_mean(np.array([current.fit.theta[p] for p in skin.space.names]))
        mean = posterior.predict_mean(posterior.from_sampling(vector)) + (force_n - skin_n)
        free = np.full(len(vector), True)
        ((_, gain, multiple, moved),) = promise(posterior, vector, vector[None], free, 1, mean)
        strength = next(iter(values))
        parameter = next(p for p in mechanism.parameters if p.name == strength)
        neutral = mechanism.neutral[strength]
        wanted = neutral + multiple * (values[strength] - neutral)
        inside = float(np.clip(wanted, parameter.lower, parameter.upper))
        if (inside - neutral) * (wanted - neutral) <= 0.0:  # the prior does not allow this direction
            return 0.0, {}
        named = posterior.named(posterior.from_sampling(np.clip(moved, low, high)))
        return gain, {**self._context.neutral, **named, **values, strength: inside}


def shapes_of(mechanism: Mechanism, names: Sequence[str], count: int) -> list[dict[str, float]]:
    """Returns `count` points of some of a mechanism's parameters, spread over their priors."""
    by_name = {p.name: p for p in mechanism.parameters}
    space = ParameterSpace(tuple(by_name[name] for name in names))
    unit = qmc.Halton(space.dim, scramble=False).random(count + 1)[1:]
    return [dict(zip(space.names, map(float, row), strict=True)) for row in space.from_unit(unit)]


def _is_better(answer: object, current: SetFit) -> bool:
    """Returns whether an answer is a fit whose log-likelihood is at least that of the current fit."""
    return isinstance(answer, SetFit) and answer.fit.log_likelihood >= current.fit.log_likelihood
