"""The posterior of a set of mechanisms, by an emulator that learns the force where the posterior is.

The force about one run (`tangent`) leads to the most probable skin, but a posterior reaches farther than its
force is linear: along a ridge of moduli and permeabilities it is curved. So the forward model runs at points
that are spread over draws of the posterior, a Gaussian process learns the force from all runs so far, and the
posterior is drawn anew with it. That is repeated until fresh runs agree with what the emulator says of them.
Where it says that it is unsure the posterior is taken to be zero: the next wave comes nearer. The first
points are about all maxima that are known.

The forward model has an error, which is not the same all along a ridge, and often differs from one maximum to
another by more than their forces do. Where it matters the full model runs at a few of the draws. Between the
places where it ran the error is interpolated and added to the force. How far each error is from what the
others say of it, as a sample of a covariance, is part of the likelihood.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bayeskin.inference import LogPosterior
from bayeskin.mismatch.fit import Fit, fit_near
from bayeskin.mismatch.resample import LEGS, MODES, PosteriorDraws, resample
from bayeskin.mismatch.trust_region import SetFit, within
from bayeskin.mismatch.wrapper import Wrapper, innermost
from bayeskin.types import Array, Design, ParameterSpace, Surrogate

MOST = 1500  # draws, among which a wave's points are chosen
NEARBY = 0.1  # of the unit cube: within it errors hardly change, so that an emulator can learn them
BEFORE = (60,)  # steps of the ensembles whose draws a further wave begins with

# The skin's force (m,) with the set at points (n, d) by the forward model, and at the first few by the full
# model in whose place that is; or why a run failed.
Forces = Callable[[Array, int], tuple[Sequence[Array | str], Sequence[Array | str]]]
Learn = Callable[[Design], Surrogate]  # a surrogate of a design's force, with its error


@dataclass(frozen=True)
class EmulationSettings:
    """Settings of an emulation.

    checks : runs of the full model beside that at the fit, where the forward model's error matters
    points, more, waves : runs of the first wave, of each further one, and how many waves at most
    first : of the prior's width on either side of a fit's run, from where the first points are drawn
    nearer : of that, from where the next ones are drawn, as long as the emulator is sure nowhere
    sure : sd of the emulator, RMS over bins, over the noise of a bin, up to which it is believed
    enough : RMS error of the emulator at the median of fresh runs, over the noise of a bin, with which it is
        done
    """

    checks: int = 3
    points: int = 30
    more: int = 20
    waves: int = 8
    first: float = 0.5
    nearer: float = 0.5
    sure: float = 2.0
    enough: float = 0.2


@dataclass(frozen=True)
class EmulatedPosterior:
    """The most probable point by the emulator, draws of the posterior, runs made, the emulator's RMS error.

    error_n : of the last emulator but one, at the median of the runs that followed it [N]; None for one wave
    settled : whether that is small beside the noise
    """

    fit: Fit
    draws: PosteriorDraws
    runs: int
    error_n: float | None
    settled: bool


@dataclass(frozen=True)
class _Errors:
    """Errors [N] (k, m) of the forward model at places (k, d) of the unit cube.

    Between places they are averages, each weighted by the inverse square of its distance (Shepard 1968, Proc.
    23rd ACM Nat. Conf., 517).
    """

    places: Array
    errors_n: Array

    def with_more(
        self, places: Array, forward: Sequence[Array | str], full: Sequence[Array | str]
    ) -> _Errors:
        """Returns these and those at the first few of further places, where both models ran."""
        more = [(place, b - a) for place, a, b in zip(places, forward, full, strict=False)
                if not isinstance(a, str) and not isinstance(b, str)]  # fmt: skip
        if not more:
            return self
        return _Errors(
            np.concatenate([self.places, [place for place, _ in more]]),
            np.concatenate([self.errors_n, [error for _, error in more]]),
        )

    def at(self, unit: Array) -> Array:
        """Returns the errors (n, m) at points (n, d) of the unit cube."""
        square = np.sum((unit[:, None] - self.places) ** 2, axis=2)
        weight = 1.0 / (square + NEARBY**2)
        return np.asarray((weight / weight.sum(axis=1, keepdims=True)) @ self.errors_n)

    def left(self) -> Array:
        """Returns a sample (k, m) of what is unknown of them: each less what the others say, over root k."""
        others = [_Errors(*(np.delete(one, i, axis=0) for one in (self.places, self.errors_n)))
                  for i in range(len(self.places))]  # fmt: skip
        said = [one.at(place[None])[0] for one, place in zip(others, self.places, strict=True)]
        return np.asarray((self.errors_n - said) / np.sqrt(len(said)))


def emulate(
    maxima: Sequence[SetFit], forces: Forces, learn: Learn, noise_n: float, seed: int,
    settings: EmulationSettings | None = None,
) -> EmulatedPosterior | str:  # fmt: skip
    """Returns the posterior of a set about its fits; the message of a run where all of the first wave fail.

    maxima : fits of the set, the likeliest first, each with the forward model's error at its run
    noise_n : sd of a bin's mean
    """
    settings, rng = settings or EmulationSettings(), np.random.default_rng([seed, 11])
    found = maxima[0]
    about, names = found.fit.log_posterior, found.fit.names
    space, error_n = innermost(about.surrogate).space, None
    reach = settings.first
    draws = _near(maxima, reach, seed)
    errors = _Errors(
        space.box.to_unit([one.run.theta for one in maxima]), np.array([one.correction_n for one in maxima])
    )
    design = _none(space, about.surrogate.edges_s)
    emulated: EmulatedPosterior | None = None
    for wave in range(settings.waves):
        count = settings.more if wave else settings.points
        points = _spread(space, draws[:, : space.dim], design.theta, count, rng)
        if wave == 0:
            points = np.concatenate([points[: -len(maxima)], [one.run.theta for one in maxima]])
        answers, full = forces(points, settings.checks if wave == 0 and errors.errors_n.any() else 0)
        errors = errors.with_more(space.box.to_unit(points), answers, full)
        ran = [i for i, answer in enumerate(answers) if not isinstance(answer, str)]
        if not ran:
            return str(answers[0]) if emulated is None else emulated
        if wave == 0:
            about = _allowing(about, errors)
        made = np.array([answers[i] for i in ran]) + errors.at(space.box.to_unit(points[ran]))
        fresh = _design(design, points[ran], made)
        if emulated is not None:
            said = innermost(emulated.fit.log_posterior.surrogate).predict_mean(points[ran])
            each_n = np.sqrt(np.mean((said - fresh.force_n[-len(ran) :]) ** 2, axis=1))
            error_n = float(np.median(each_n))  # the largest are where the emulator says that it is unsure
        design = fresh
        local = _posterior(about, learn(design), settings.sure * noise_n)
        best = fit_near(names, local, _likeliest(local, found.fit, design.theta))
        sure = bool(np.isfinite(best.value))
        if not sure and wave < settings.waves - 1:
            reach *= settings.nearer
            draws = _near(maxima, reach, seed)
            continue
        if not sure:  # there are no more waves: it is believed
            local = replace(local, sure_within_n=None)
            best = fit_near(names, local, _likeliest(local, found.fit, design.theta))
        done = sure and error_n is not None and error_n <= settings.enough * noise_n
        last = done or wave == settings.waves - 1
        known = [one.fit.theta for one in maxima]
        legs, modes = (LEGS, MODES) if last else (BEFORE, 0)
        drawn = resample(best, seed, legs, modes, known)
        draws, emulated = drawn.draws, EmulatedPosterior(best, drawn, len(design.theta), error_n, done)
        if done:
            break
    assert emulated is not None
    return emulated


def _near(maxima: Sequence[SetFit], reach: float, seed: int) -> Array:
    """Draws (n, D) of the posterior about each fit's run, up to so far from it, of the prior's width."""

    def near(one: SetFit) -> Array:
        about = one.fit.log_posterior
        vector = np.clip(about.vector(one.fit.theta), *about.bounds)
        held = replace(one.fit, log_posterior=within(about, vector, reach))
        return resample(held, seed, BEFORE, 0).draws

    return np.concatenate([near(one) for one in maxima])


def _allowing(about: LogPosterior, errors: _Errors) -> LogPosterior:
    """Returns the posterior that allows for what is not known of the forward model's error."""
    if len(errors.places) < 2 or about.model_error is None:
        return about
    return replace(about, model_error=replace(about.model_error, measured_n=errors.left()))


def _posterior(about: LogPosterior, emulator: Surrogate, unsure_n: float) -> LogPosterior:
    """The posterior with the skin's force by an emulator."""
    seen = about.surrogate
    surrogate = replace(seen, inner=emulator) if isinstance(seen, Wrapper) else emulator
    return replace(about, surrogate=surrogate, sure_within_n=unsure_n)


def _likeliest(local: LogPosterior, fit: Fit, theta: Array) -> dict[str, float]:
    """Values at the most probable of the runs (n, d), with all else as it was fitted."""
    rows = np.repeat(local.from_sampling(local.vector(fit.theta))[None], len(theta), axis=0)
    rows[:, : theta.shape[1]] = theta
    return local.named(rows[int(np.argmax(local.log_prob(local.to_sampling(rows))))])


def _spread(
    space: ParameterSpace, draws: Array, before: Array, count: int, rng: np.random.Generator
) -> Array:
    """Returns some of draws (n, d), each as far as possible from those before it, in sd of the draws."""
    some = draws[rng.choice(len(draws), min(len(draws), MOST), replace=False)]
    unit = space.box.to_unit(some)
    scale = unit.std(axis=0) + 1e-9
    unit = unit / scale
    taken = space.box.to_unit(before) / scale if len(before) else unit.mean(axis=0)[None]
    nearest = np.min([np.sum((unit - one) ** 2, axis=1) for one in taken], axis=0)
    chosen = []
    for _ in range(min(count, len(some))):
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.sum((unit - unit[chosen[-1]]) ** 2, axis=1))
    return np.asarray(some[chosen])


def _none(space: ParameterSpace, edges_s: Array) -> Design:
    """A design without runs."""
    bins = len(edges_s) - 1
    return Design(
        space=space.box, theta=np.empty((0, space.dim)), edges_s=edges_s, force_n=np.empty((0, bins)),
        wave=np.empty(0, dtype=np.int64), held_out=np.empty(0, dtype=bool), ok=np.empty(0, dtype=bool),
        messages=(), seconds=np.empty(0), seed=0, model_hash="",
    )  # fmt: skip


def _design(before: Design, theta: Array, force_n: Array) -> Design:
    """A design with further runs, all to learn from."""
    count = len(before.theta) + len(theta)
    return replace(
        before, theta=np.concatenate([before.theta, theta]),
        force_n=np.concatenate([before.force_n, force_n]),
        wave=np.zeros(count, dtype=np.int64), held_out=np.zeros(count, dtype=bool),
        ok=np.ones(count, dtype=bool), messages=("",) * count, seconds=np.zeros(count),
    )  # fmt: skip
