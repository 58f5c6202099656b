"""Provides the recording, the models and the record to all parts of a search."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bayeskin.mechanisms import Mechanism
from bayeskin.mismatch.hypotheses import weight
from bayeskin.mismatch.search_record import Names, SearchRecord
from bayeskin.mismatch.search_settings import SearchSettings
from bayeskin.mismatch.tasks import AnswerTasks, FitTask
from bayeskin.mismatch.trust_region import SetFit
from bayeskin.mismatch.wrapper import innermost
from bayeskin.types import Array, BinnedForce, ParameterSpace

Tell = Callable[[str], None]


@dataclass(frozen=True)
class SearchContext:
    """The inputs of a search, its record, and the comparisons that every part of the search makes.

    ask : answers tasks by running the models; tell : receives lines of progress
    base : priors of the base model; known : mechanisms by name; solves : names of the mechanisms that the
        forward model solves; noise : values of the noise parameters from which fits start
    """

    ask: AnswerTasks
    binned: BinnedForce
    base: ParameterSpace
    known: Mapping[str, Mechanism]
    solves: Collection[str]
    noise: Mapping[str, float]
    seed: int
    tell: Tell
    settings: SearchSettings
    record: SearchRecord = field(default_factory=SearchRecord)

    @property
    def neutral(self) -> dict[str, float]:
        """Returns the neutral values of all mechanisms' parameters."""
        return {name: value for m in self.known.values() for name, value in m.neutral.items()}

    def solved(self, names: Sequence[str]) -> Names:
        """Returns the names of a set's mechanisms that the forward model solves, sorted."""
        return tuple(name for name in sorted(names) if name in self.solves)

    def solved_values(self, fit: SetFit) -> dict[str, float]:
        """Returns the values of the forward model's parameters at a fit's run, by name."""
        names = innermost(fit.fit.log_posterior.surrogate).space.names
        return dict(zip(names, map(float, fit.run.theta), strict=True))

    def base_values(self, fit: SetFit) -> dict[str, float]:
        """Returns a fit's values of the base model's parameters, by name."""
        return {name: fit.fit.theta[name] for name in self.base.names}

    def rms(self, force_n: Array) -> float:
        """Returns the RMS [N] of a force (m,) over the bins that have a recorded force."""
        return float(np.sqrt(np.mean(np.square(force_n[np.isfinite(self.binned.force_n)]))))

    def leaves_more_than_noise(self, fit: SetFit) -> bool:
        """Returns whether the residual of a fit is larger than noise explains."""
        residual_n = self.rms(self.binned.force_n - fit.fit.force_n)
        return residual_n > self.settings.left * noise_of(self.binned)

    def is_alike(self, fit: SetFit, theta: Array) -> bool:
        """Returns whether a fit's run is near other values (d,) of the forward model's parameters."""
        space = innermost(fit.fit.log_posterior.surrogate).space
        apart = space.to_unit(fit.run.theta) - space.to_unit(theta)
        return bool(np.abs(apart).max() <= self.settings.alike_by)

    def keep(self, answers: Sequence[object], since: SetFit | None = None) -> None:
        """Records fits, and continues those that have not settled: the best ones, and others not far behind.

        since : a fit with which they are compared; a fit that gains over it a large share of what the best
            fit gains is not far behind
        """
        fits = sorted((a for a in answers if isinstance(a, SetFit)), key=lambda fit: -weight(fit.fit))
        for fit in fits:
            self.record.add(fit)
        settings, behind = self.settings, self.settings.behind
        if since is not None and fits:
            behind = max(behind, (1.0 - settings.near) * gained(fits[0], since))
        for continued in self.ask([
            fit_again(fit, settings.runs - settings.first, fit.correction_n)
            for i, fit in enumerate(fits)
            if not fit.settled and not self._is_recorded(fit)
            and (i < settings.best or gained(self.record.best, fit) <= behind)
        ]):  # fmt: skip
            self.record.add(continued)

    def _is_recorded(self, fit: SetFit) -> bool:
        """Returns whether a likelier fit of the same set lies near, so that both lead to the same maximum."""
        best = self.record.fits.get(fit.fit.names)
        return best is not None and best is not fit and self.is_alike(fit, best.run.theta)


def gained(fit: SetFit, before: SetFit) -> float:
    """Returns the gain in weight [nats] of one fit over another."""
    return weight(fit.fit) - weight(before.fit)


def noise_of(binned: BinnedForce) -> float:
    """Returns the sd [N] of the noise in a bin's mean, RMS over bins."""
    return float(np.sqrt(np.nanmean(binned.variance_n2)))


def correction(fit: SetFit) -> tuple[float, ...]:
    """Returns the force [N] that a fit has added to its runs, in the form for tasks; empty for none."""
    return for_task(fit.correction_n)


def for_task(correction_n: Array) -> tuple[float, ...]:
    """Returns a correction (m,) [N] in the form for tasks; empty for none."""
    return tuple(correction_n.tolist()) if correction_n.any() else ()


def fit_again(fit: SetFit, runs: int, correction_n: Array, until_s: float | None = None) -> FitTask:
    """Returns the task of a fit that starts where another fit of the set has ended, from its run.

    runs : largest number of model runs, with the existing one
    correction_n (m,) : force [N] that is added to every run
    until_s : end of the part of the recording that is fitted [s]; None for the whole recording
    """
    run = replace(fit.run, force_n=fit.run.force_n - fit.correction_n)
    return FitTask(fit.fit.names, fit.fit.theta, runs, for_task(correction_n), until_s, first=run)


def title(names: Sequence[str]) -> str:
    """Returns a set's name for a line of progress."""
    return ", ".join(names) or "no mechanism"
