"""Samples the posterior of a set of mechanisms with an emulator that learns the force where the posterior is.

The linear force near one run (`tangent`) leads to the most probable tissue. But the posterior extends beyond
the region where the force is linear, because it is curved along a ridge of moduli and permeabilities.
Therefore the forward model runs at points that are spread over draws of the posterior. A Gaussian process
learns the force from all runs so far, and the posterior is sampled again with this emulator. This is repeated
until new runs agree with the emulator's predictions. The posterior is taken to be zero where the emulator
states a large uncertainty, so that the next wave of points lies nearer to earlier runs. The first points lie
near all known maxima.

The forward model has an error, which varies along a ridge. From one maximum to another it often differs by
more than their forces do. Where this error matters, the full model runs at a few of the draws. The error is
interpolated between these points and added to the force. The difference between each error and its
interpolation from the others is a sample of the remaining uncertainty, which enters the likelihood as a
covariance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bayeskin.inference import LogPosterior
from bayeskin.mismatch.fit import Fit, fit_near
from bayeskin.mismatch.resample import PosteriorDraws, ResampleSettings, resample
from bayeskin.mismatch.trust_region import SetFit, within
from bayeskin.mismatch.wrapper import Wrapper, innermost
from bayeskin.types import Array, Design, ParameterSpace, Surrogate

# Returns the skin's forces (m,) [N] with the set at points (n, d): by the forward model at all points, and by
# the full model at the given number of first points. A run that failed has its message instead.
Forces = Callable[[Array, int], tuple[Sequence[Array | str], Sequence[Array | str]]]
Learn = Callable[[Design], Surrogate]  # returns a surrogate of a design's force, which states its own error


@dataclass(frozen=True)
class EmulationSettings:
    """Settings of an emulation.

    checks : number of runs of the full model, in addition to the runs at the fits, where the forward model's
        error matters
    points, further_points, waves : number of runs of the first wave and of each further wave; largest number
        of waves
    candidates : largest number of draws among which the points of a wave are chosen
    steps : numbers of steps of the ensembles whose draws give the points of a further wave
    first : the first points are drawn within this distance of a fit's run, on either side, as a share of the
        prior's width
    nearer : factor on this distance for the next points, as long as the emulator is too uncertain everywhere
    sure : largest sd of the emulator, RMS over bins, with which it is used; in units of the noise of a bin
    enough : RMS error of the emulator, as the median over the new runs, with which the emulation ends; in
        units of the noise of a bin
    nearby : distance in the unit cube within which errors hardly change, so that an emulator can learn them
    """

    checks: int = 3
    points: int = 30
    further_points: int = 20
    waves: int = 8
    candidates: int = 1500
    steps: tuple[int, ...] = (60,)
    first: float = 0.5
    nearer: float = 0.5
    sure: float = 2.0
    enough: float = 0.2
    nearby: float = 0.1


@dataclass(frozen=True)
class EmulatedPosterior:
    """The posterior of a set that an emulator has learnt.

    fit : the most probable point by the emulator
    draws : draws of the posterior; runs : number of runs of the forward model
    error_n : RMS error [N] of the last emulator but one, as the median over the runs that followed it; None
        after a single wave
    settled : whether this error is small compared with the noise
    """

    fit: Fit
    draws: PosteriorDraws
    runs: int
    error_n: float | None
    settled: bool


@dataclass(frozen=True)
class _ForwardErrors:
    """Errors (k, m) [N] of the forward model at places (k, d) of the unit cube.

    Between the places the error is an average of all errors, each weighted by the inverse square of its
    distance (Shepard 1968, Proc. 23rd ACM Nat. Conf., 517).

    nearby : distance within which errors hardly change
    """

    places: Array
    errors_n: Array
    nearby: float

    def with_more(
        self, places: Array, forward: Sequence[Array | str], full: Sequence[Array | str]
    ) -> _ForwardErrors:
        """Returns these errors and those at further places (n, d), where both models ran."""
        new = [(place, full_n - forward_n)
               for place, forward_n, full_n in zip(places, forward, full, strict=False)
               if not isinstance(forward_n, str) and not isinstance(full_n, str)]  # fmt: skip
        if not new:
            return self
        return _ForwardErrors(
            np.concatenate([self.places, [place for place, _ in new]]),
            np.concatenate([self.errors_n, [error for _, error in new]]),
            self.nearby,
        )

    def at(self, unit: Array) -> Array:
        """Returns the interpolated errors (n, m) [N] at points (n, d) of the unit cube."""
        square_distance = np.sum((unit[:, None] - self.places) ** 2, axis=2)
        weight = 1.0 / (square_distance + self.nearby**2)
        return np.asarray((weight / weight.sum(axis=1, keepdims=True)) @ self.errors_n)

    def left(self) -> Array:
        """Returns a sample (k, m) [N] of the errors' uncertainty.

        Each row is an error minus its interpolation from the other errors, divided by the root of k.
        """
        without = [
            replace(
                self, places=np.delete(self.places, i, axis=0), errors_n=np.delete(self.errors_n, i, axis=0)
            )
            for i in range(len(self.places))
        ]
        predicted = [errors.at(place[None])[0] for errors, place in zip(without, self.places, strict=True)]
        return np.asarray((self.errors_n - predicted) / np.sqrt(len(predicted)))


def emulate(
    maxima: Sequence[SetFit], forces: Forces, learn: Learn, noise_n: float, seed: int,
    settings: EmulationSettings = EmulationSettings(),
) -> EmulatedPosterior | str:  # fmt: skip
    """Returns the posterior of a set near its fits; if all runs of the first wave fail, a run's message.

    maxima : fits of the set, the likeliest first, each with the forward model's error at its run
    forces : runs the forward model and the full model; learn : makes an emulator from a design
    noise_n : sd of the noise in a bin's mean [N]
    """
    first, rng = maxima[0], np.random.default_rng([seed, 11])
    posterior, names = first.fit.log_posterior, first.fit.names
    space, error_n = innermost(posterior.surrogate).space, None
    reach, before = settings.first, ResampleSettings(legs=settings.steps, modes=0)
    draws = _draws_near(maxima, reach, seed, before)
    errors = _ForwardErrors(
        space.box.to_unit([maximum.run.theta for maximum in maxima]),
        np.array([maximum.correction_n for maximum in maxima]),
        settings.nearby,
    )
    design = _empty_design(space, posterior.surrogate.edges_s)
    emulated: EmulatedPosterior | None = None
    for wave in range(settings.waves):
        count = settings.further_points if wave else settings.points
        rows = rng.choice(len(draws), min(len(draws), settings.candidates), replace=False)
        points = _spread(space, draws[:, : space.dim][rows], design.theta, count)
        if wave == 0:
            points = np.concatenate([points[: -len(maxima)], [maximum.run.theta for maximum in maxima]])
        answers, full = forces(points, settings.checks if wave == 0 and errors.errors_n.any() else 0)
        errors = errors.with_more(space.box.to_unit(points), answers, full)
        finished = [i for i, answer in enumerate(answers) if not isinstance(answer, str)]
        if not finished:
            return str(answers[0]) if emulated is None else emulated
        if wave == 0:
            posterior = _with_uncertain_errors(posterior, errors)
        forces_n = np.array([answers[i] for i in finished]) + errors.at(space.box.to_unit(points[finished]))
        enlarged = _enlarged_design(design, points[finished], forces_n)
        if emulated is not None:
            predicted = innermost(emulated.fit.log_posterior.surrogate).predict_mean(points[finished])
            rms_n = np.sqrt(np.mean((predicted - enlarged.force_n[-len(finished) :]) ** 2, axis=1))
            error_n = float(np.median(rms_n))  # the largest errors are where the emulator states a large sd
        design = enlarged
        local = _emulated_posterior(posterior, learn(design), settings.sure * noise_n)
        best = fit_near(names, local, _likeliest_run(local, first.fit, design.theta))
        is_sure = bool(np.isfinite(best.value))
        if not is_sure and wave < settings.waves - 1:
            reach *= settings.nearer
            draws = _draws_near(maxima, reach, seed, before)
            continue
        if not is_sure:  # after the last wave the emulator is used where it is uncertain too
            local = replace(local, sure_within_n=None)
            best = fit_near(names, local, _likeliest_run(local, first.fit, design.theta))
        done = is_sure and error_n is not None and error_n <= settings.enough * noise_n
        last = done or wave == settings.waves - 1
        known = [maximum.fit.theta for maximum in maxima]
        drawn = resample(best, seed, ResampleSettings() if last else before, known)
        draws, emulated = drawn.draws, EmulatedPosterior(best, drawn, len(design.theta), error_n, done)
        if done:
            break
    assert emulated is not None
    return emulated


def _draws_near(maxima: Sequence[SetFit], reach: float, seed: int, settings: ResampleSettings) -> Array:
    """Returns draws (n, D) of the posterior near each fit's run.

    reach : largest distance from the run on either side, as a share of the prior's width
    """

    def near(fit: SetFit) -> Array:
        posterior = fit.fit.log_posterior
        vector = np.clip(posterior.vector(fit.fit.theta), *posterior.bounds)
        limited = replace(fit.fit, log_posterior=within(posterior, vector, reach))
        return resample(limited, seed, settings).draws

    return np.concatenate([near(fit) for fit in maxima])


def _with_uncertain_errors(posterior: LogPosterior, errors: _ForwardErrors) -> LogPosterior:
    """Returns the posterior whose likelihood allows for the uncertainty of the forward model's error."""
    if len(errors.places) < 2 or posterior.model_error is None:
        return posterior
    return replace(posterior, model_error=replace(posterior.model_error, measured_n=errors.left()))


def _emulated_posterior(posterior: LogPosterior, emulator: Surrogate, unsure_n: float) -> LogPosterior:
    """Returns the posterior with the skin's force from an emulator.

    unsure_n : sd of the emulator [N], RMS over bins, above which the posterior is zero
    """
    surrogate = posterior.surrogate
    wrapped = replace(surrogate, inner=emulator) if isinstance(surrogate, Wrapper) else emulator
    return replace(posterior, surrogate=wrapped, sure_within_n=unsure_n)


def _likeliest_run(posterior: LogPosterior, fit: Fit, theta: Array) -> dict[str, float]:
    """Returns the values at the most probable of the runs (n, d), with all other parameters as in the fit."""
    rows = np.repeat(posterior.from_sampling(posterior.vector(fit.theta))[None], len(theta), axis=0)
    rows[:, : theta.shape[1]] = theta
    return posterior.named(rows[int(np.argmax(posterior.log_prob(posterior.to_sampling(rows))))])


def _spread(space: ParameterSpace, candidates: Array, before: Array, count: int) -> Array:
    """Returns `count` of candidates (n, d), each as far as possible from earlier points, in sd of candidates.

    before : parameters (k, d) of earlier runs
    """
    unit = space.box.to_unit(candidates)
    scale = unit.std(axis=0) + 1e-9
    unit = unit / scale
    chosen_before = space.box.to_unit(before) / scale if len(before) else unit.mean(axis=0)[None]
    nearest = np.min([np.sum((unit - point) ** 2, axis=1) for point in chosen_before], axis=0)
    chosen = []
    for _ in range(min(count, len(candidates))):
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.sum((unit - unit[chosen[-1]]) ** 2, axis=1))
    return np.asarray(candidates[chosen])


def _empty_design(space: ParameterSpace, edges_s: Array) -> Design:
    """Returns a design without runs."""
    bins = len(edges_s) - 1
    return Design(
        space=space.box, theta=np.empty((0, space.dim)), edges_s=edges_s, force_n=np.empty((0, bins)),
        wave=np.empty(0, dtype=np.int64), held_out=np.empty(0, dtype=bool), ok=np.empty(0, dtype=bool),
        messages=(), seconds=np.empty(0), seed=0, model_hash="",
    )  # fmt: skip


def _enlarged_design(before: Design, theta: Array, force_n: Array) -> Design:
    """Returns a design with further runs, all of which an emulator learns from."""
    count = len(before.theta) + len(theta)
    return replace(
        before, theta=np.concatenate([before.theta, theta]),
        force_n=np.concatenate([before.force_n, force_n]),
        wave=np.zeros(count, dtype=np.int64), held_out=np.zeros(count, dtype=bool),
        ok=np.ones(count, dtype=bool), messages=("",) * count, seconds=np.zeros(count),
    )  # fmt: skip
