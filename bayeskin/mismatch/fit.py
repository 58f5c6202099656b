"""A set of mechanisms refitted with everything else free, and its evidence.

The evidence is Laplace's in coordinates u of the unit cube, in which every prior is uniform. With the
expected information I of the likelihood at the best point u*, its eigenvalues l joined by the prior's own,

    log Z = log p(y | u*) + sum 1/2 log(2 pi / (l + 2 pi)) ,

so that a direction that the data does not inform costs nothing, and one that they do costs the share of the
prior that they leave (Tierney & Kadane 1986, JASA 81:82; what follows where l = 0 is exact). A coordinate
on its bound, toward which the density rises by g, has int_0^1 exp(-g t - l t^2 / 2) dt instead. Where the
density along a coordinate, the others held, has less room than the Gaussian of its information says (a step
whose moment falls between two bins; a bound near by), both evidence and covariance shrink by that share.

The noise of a diagnosis is what an instrument does from moment to moment: its sd is bounded by what the
recording shows within bins, and it forgets within ten seconds. What is larger or lasts longer is for physics
to explain; noise that could take it up would leave nothing to find. So swings of the force that are slower
than a second, as a breath's, are not to pass for noise within bins.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayeskin.inference import LogPosterior, NoisePriors
from bayeskin.inference.gauss_newton import Top, gauss_newton, promise, with_less_noise
from bayeskin.mismatch.wrapper import skins
from bayeskin.types import Array, BinnedForce, ParameterSpace

NOISE_SHARE = 3.0  # sd of the noise with a memory, at most, of the median sd of a bin's own mean
QUICK_S, QUICK_TIMES = 1.0, 2.5  # that sd is at most so many times what noise quicker than this makes it
FEWEST_TAILS = 50.0  # of the tail index: nearly normal, since spikes are gone from robust means of bins
STIFFEST_BELOW = 2.0  # the subcutis over the cutis: on a stiffer one a cutis folds, and fat is the softer
DRAWS = 96  # of the prior for each new parameter, from which climbs start
RANKED = 32  # of these, for the order in which mechanisms are tried
SKINS, SKIN_STARTS = 192, 4  # draws of what the skin is made of, and climbs from the best of them
APART = 0.1  # of the prior's width, in some parameter: tops that are nearer are the same
STARTS = 2  # of the draws of a part's parameters, the most promising, which are climbed from
NEAREST = 8  # trials that are weighed for each that is climbed from
REDRAWN = 1  # times that the parameters of a part are drawn anew, about the best so far
FIRST_ROUNDS, FIRST_KEPT = (2, 4), 3  # of climbs: of every one, then of so many that are ahead
ROUNDS = 25  # of the one that is then ahead
FAR, NEAR, NEXT = 5.0, 1e-4, 1.6  # sd on either side of a top, of the prior's width, and from place to place
EDGE = 1e-6  # of the unit cube: on a bound


def without_swings(binned: BinnedForce, quick_n2: Array) -> BinnedForce:
    """Bins whose means have no more noise, over each kind of phase, than is quick.

    They stay as they are where most have little that is slower.

    quick_n2 (m,) : variance of the means by noise that is quicker than `QUICK_S`
    """
    variance, kinds = binned.variance_n2.copy(), np.array([binned.phases[i].kind for i in binned.phase])

    def share(own: NDArray[np.bool_]) -> float:
        usual, quick = float(np.median(variance[own])), float(np.median(quick_n2[own]))
        return min(1.0, QUICK_TIMES**2 * quick / usual) if usual > 0.0 else 1.0

    if share(np.full(len(kinds), True)) < 1.0:
        for own in (kinds == kind for kind in np.unique(kinds)):
            variance[own] *= share(own)
    return replace(binned, variance_n2=variance)


def instrument_noise(binned: BinnedForce) -> NoisePriors:
    """Bounds of the noise of a diagnosis, from the scatter within the recording's own bins."""
    typical = float(np.sqrt(np.nanmedian(binned.variance_n2)))
    lowest = NoisePriors().sd_n[0]
    return NoisePriors(
        sd_n=(lowest, max(NOISE_SHARE * typical, 2.0 * lowest)),
        nu=(FEWEST_TAILS, NoisePriors().nu[1]),
    )


def subcutis_too_stiff(space: ParameterSpace, theta: Array) -> NDArray[np.bool_]:
    """Returns where (n, d) the subcutis is more than `STIFFEST_BELOW` times as stiff as the cutis, (n,)."""
    names = space.names
    if not {"E_c", "E_s"} <= set(names):
        return np.zeros(len(theta), dtype=bool)
    return np.asarray(theta[:, names.index("E_s")] > STIFFEST_BELOW * theta[:, names.index("E_c")])


@dataclass(frozen=True)
class Fit:
    """The most probable point of one set of mechanisms: values by name (SI), log density, evidence.

    covariance (D, D) is that of the unit cube's coordinates, the priors' 1/12 at most; latent (r,) the
    surrogate's error, in sd of each column of its factor.
    """

    names: tuple[str, ...]
    log_posterior: LogPosterior
    theta: Mapping[str, float]
    value: float
    log_evidence: float
    covariance: Array
    latent: Array

    @cached_property
    def force_n(self) -> Array:
        """The force on all bins (m,), with the surrogate's error as the recording shows it."""
        return self.log_posterior.force_n(self.log_posterior.vector(self.theta), self.latent)

    @cached_property
    def mean_n(self) -> Array:
        """The surrogate's mean on all bins (m,): the force without what its own error is believed to be."""
        values = self.log_posterior.from_sampling(self.log_posterior.vector(self.theta))
        return np.asarray(self.log_posterior.predict_mean(values[None])[0])

    @cached_property
    def unit(self) -> Array:
        """The point in the unit cube, (D,)."""
        low, high = self.log_posterior.bounds
        return np.asarray((self.log_posterior.vector(self.theta) - low) / (high - low))

    @property
    def log_likelihood(self) -> float:
        """At the point: the density without that of the uniform priors."""
        low, high = self.log_posterior.bounds
        return self.value + float(np.sum(np.log(high - low)))

    def draws(self, count: int, seed: int) -> Array:
        """SI values (count, D) from the Gaussian about the point, folded back at the priors' bounds."""
        rng = np.random.default_rng(seed)
        root = np.linalg.cholesky(self.covariance + 1e-12 * np.eye(len(self.covariance)))
        unit = self.unit + rng.standard_normal((count, len(root))) @ root.T
        unit = np.abs(np.mod(unit + 1.0, 2.0) - 1.0)
        low, high = self.log_posterior.bounds
        return self.log_posterior.from_sampling(low + unit * (high - low))


def stored(found: Fit) -> dict[str, Any]:
    """A fit without its posterior, as JSON has it."""
    plain = {"names": list(found.names), "theta": dict(found.theta), "value": found.value}
    arrays = {"covariance": found.covariance.tolist(), "latent": found.latent.tolist()}
    return {**plain, "log_evidence": found.log_evidence, **arrays}


def restored(plain: Mapping[str, Any], log_posterior: LogPosterior) -> Fit:
    """The fit of `stored`, of the posterior that it was made from."""
    covariance, latent = (np.asarray(plain[name], dtype=float) for name in ("covariance", "latent"))
    value, log_evidence = plain["value"], plain["log_evidence"]
    return Fit(tuple(plain["names"]), log_posterior, plain["theta"], value, log_evidence, covariance, latent)


def promised(
    log_posterior: LogPosterior, start: Mapping[str, float], neutral: Mapping[str, float],
    parts: Sequence[Sequence[str]], seed: int,
) -> float:  # fmt: skip
    """Nats that the most promising of draws of any part's parameters would gain on `start`, by `promise`."""
    low, high = log_posterior.bounds
    vector = np.clip(log_posterior.vector({**neutral, **start}), low, high)
    rng, best = np.random.default_rng(seed), 0.0
    new = np.array([name not in start for name in log_posterior.names])
    for part in parts:
        columns = [log_posterior.names.index(name) for name in part]
        trials = _drawn(vector, columns, RANKED, low, high, rng)
        best = max(best, promise(log_posterior, vector, trials, ~new, 1)[0][1])
    return best


def _drawn(
    vector: Array, columns: list[int], each: int, low: Array, high: Array, rng: np.random.Generator
) -> Array:
    """Points (n, D) with some coordinates drawn from the prior, so many for each of them."""
    trials = np.tile(vector, (each * len(columns), 1))
    trials[:, columns] = rng.uniform(low[columns], high[columns], (len(trials), len(columns)))
    return trials


def fit(
    names: Sequence[str],
    log_posterior: LogPosterior,
    start: Mapping[str, float],
    neutral: Mapping[str, float],
    seed: int,
    parts: Sequence[Sequence[str]] = (),
) -> Fit:
    """The best of a few climbs from `start`, which has the values of a smaller set.

    What `start` does not have begins at its neutral value, and is searched for, one of `parts` (names of
    parameters) after the other; at last, with all others as found, the skin is, by itself and with the
    mechanisms that are in it: one that changes much has led the smaller set to another skin.
    """
    low, high = log_posterior.bounds
    starts = [np.clip(log_posterior.vector({**neutral, **start}), low, high)]
    rng = np.random.default_rng(seed)
    laters = [[name for other in parts[index + 1 :] for name in other] for index in range(len(parts))]
    rounds = list(zip(parts, laters, strict=True))
    rounds += [(part, []) for part in parts] if len(parts) > 1 else []  # again, with the others found
    for part, later in rounds:
        starts = [_searched(log_posterior, starts[0], part, later, neutral, rng)]
    return _best(names, log_posterior, starts, seed)


def fit_near(names: Sequence[str], log_posterior: LogPosterior, theta: Mapping[str, float]) -> Fit:
    """The top that one climb from a point reaches."""
    low, high = log_posterior.bounds
    top = gauss_newton(log_posterior, np.clip(log_posterior.vector(theta), low, high), None, ROUNDS)
    return _fit_at(names, log_posterior, top)


def _searched(
    log_posterior: LogPosterior, vector: Array, part: Sequence[str], later: Sequence[str],
    neutral: Mapping[str, float], rng: np.random.Generator,
) -> Array:  # fmt: skip
    """The best point (D,) of climbs along the most promising draws of a part's parameters, and near them.

    Parameters of parts that come `later` are neutral as yet.
    """
    low, high = log_posterior.bounds
    columns = [log_posterior.names.index(name) for name in part]
    without = log_posterior.named(log_posterior.from_sampling(vector))
    without |= {name: neutral[name] for name in (*part, *later)}
    alone = np.clip(log_posterior.vector(without), low, high)
    trials = _drawn(alone, columns, DRAWS, low, high, rng)
    top = _climbed(log_posterior, [vector, *_promising(log_posterior, alone, trials, part, later, neutral)])[
        0
    ]
    for _ in range(REDRAWN if len(columns) > 1 else 0):
        near = _about(top.vector, columns, low, high, len(trials), rng)
        trials[:, columns] = near[:, columns]
        starts = _promising(log_posterior, alone, trials, part, later, neutral)
        top = _climbed(log_posterior, [top.vector, *starts])[0]
    return top.vector


def _promising(
    log_posterior: LogPosterior, alone: Array, trials: Array, part: Sequence[str], later: Sequence[str],
    neutral: Mapping[str, float],
) -> list[Array]:  # fmt: skip
    """The trials along which most is to be gained, each as strong as the recording asks for."""
    low, high = log_posterior.bounds
    names, strength = log_posterior.names, part[0]
    parameter = log_posterior.space.parameters[names.index(strength)]
    own = np.array([name in part for name in names])
    free = ~own & np.array([name not in later for name in names])
    starts = []
    for row, _, multiple, moved in promise(log_posterior, alone, trials, free, STARTS):
        for rest in (alone, moved):
            values = log_posterior.named(log_posterior.from_sampling(np.where(own, trials[row], rest)))
            far = _times(multiple, values[strength], neutral[strength])
            values[strength] = float(np.clip(far, parameter.lower, parameter.upper))
            starts.append(np.clip(log_posterior.vector(values), low, high))
    return starts


def _times(multiple: float, value: float, neutral: float) -> float:
    """A value that acts so many times as strongly; by its reciprocal where infinity is off."""
    if np.isfinite(neutral):
        return neutral + multiple * (value - neutral)
    return value / multiple if multiple > 0.0 else neutral


def _about(
    vector: Array, fresh: list[int], low: Array, high: Array, count: int, rng: np.random.Generator
) -> Array:
    """Points (count, D) with one or two of the new coordinates moved: near by, or anywhere in the prior."""
    width = (high - low)[fresh]
    changed = np.argsort(rng.uniform(size=(count, len(fresh))), axis=1) < rng.integers(1, 3, (count, 1))
    reach = 10.0 ** rng.uniform(-3.0, -0.5, (count, 1)) * width
    near = vector[fresh] + reach * rng.standard_normal((count, len(fresh)))
    drawn = np.where(
        rng.uniform(size=(count, 1)) < 0.5, near, rng.uniform(low[fresh], high[fresh], near.shape)
    )
    trials = np.tile(vector, (count, 1))
    trials[:, fresh] = np.clip(np.where(changed, drawn, vector[fresh]), low[fresh], high[fresh])
    return trials


def likely(log_posterior: LogPosterior, trials: Array, count: int) -> list[Array]:
    """The most probable of trials (n, D), among those whose force is nearest to the recorded one."""
    if not len(trials):
        return []
    bins, recorded = log_posterior.chain.bins, log_posterior.chain.force_n
    mean = log_posterior.predict_mean(log_posterior.from_sampling(trials))[:, bins]
    trials = trials[np.argsort(np.sum((recorded - mean) ** 2, axis=1))]
    found, values, weighed = trials[:0], np.empty(0), NEAREST * count
    for start in range(0, len(trials), weighed):  # in order, until so many of them are possible
        value = log_posterior.log_prob(part := trials[start : start + weighed])
        possible = np.isfinite(value)
        found, values = np.concatenate([found, part[possible]]), np.concatenate([values, value[possible]])
        if len(found) >= weighed:
            break
    return list(found[:weighed][np.argsort(-values[:weighed])[:count]])


def _climbed(log_posterior: LogPosterior, starts: Sequence[Array]) -> list[Top]:
    """Tops after a few rounds, of those that were ahead after the first of them; the best first."""
    tops: list[Top] = []
    for rounds in FIRST_ROUNDS:
        tops = [gauss_newton(log_posterior, start, None, rounds, quick=True) for start in starts]
        tops = sorted(tops, key=lambda one: -one.value)[:FIRST_KEPT]
        starts = [top.vector for top in tops]
    return tops


def _best(
    names: Sequence[str], log_posterior: LogPosterior, starts: Sequence[Array], seed: int
) -> Fit:  # fmt: skip
    ahead = _climbed(log_posterior, starts)[0]
    others = _other_starts(ahead.vector, log_posterior, seed, SKIN_STARTS)
    quiet = with_less_noise(log_posterior, ahead.vector)
    ahead = _climbed(log_posterior, [ahead.vector, quiet, *others])[0]
    return _fit_at(names, log_posterior, gauss_newton(log_posterior, ahead.vector, None, ROUNDS))


def _fit_at(names: Sequence[str], log_posterior: LogPosterior, top: Top) -> Fit:
    theta = log_posterior.named(log_posterior.from_sampling(top.vector))
    return Fit(tuple(names), log_posterior, theta, top.value, *evidence(log_posterior, top), top.latent)


def _other_starts(vector: Array, log_posterior: LogPosterior, seed: int, count: int) -> list[Array]:
    """Returns so many of the most probable `other_skins` of each kind."""
    kinds = skins(log_posterior.surrogate)
    drawn = [other_skins(vector, log_posterior, seed, skin) for skin in kinds]
    return [start for trials in drawn for start in likely(log_posterior, trials, count)]


def other_skins(vector: Array, log_posterior: LogPosterior, seed: int, skin: int) -> Array:
    """Points (n, D) with the first `skin` parameters drawn anew, those of the base and maybe of tissue
    mechanisms, and stiffness such that the force fits best."""
    low, high = log_posterior.bounds
    trials = np.tile(np.clip(vector, low, high), (SKINS, 1))
    trials[:, :skin] = np.random.default_rng(seed).uniform(low[:skin], high[:skin], (len(trials), skin))
    return trials


def occam(information: Array) -> float:
    """Logarithm of what a recording leaves of uniform priors, from the eigenvalues (d,) of its information
    over their widths; nothing is lost where there is none."""
    return float(0.5 * np.sum(np.log(2.0 * np.pi / (np.maximum(information, 0.0) + 2.0 * np.pi))))


def held_density(steep: Array, curved: Array) -> tuple[Array, Array]:
    """Distances (t,) from a bound into the unit cube, and the density (h, t) there over that on the bound, of
    parameters that it holds; from minus its logarithm's first and second derivatives (h,) at the bound."""
    t = np.linspace(0.0, 1.0, 2001) ** 3  # close together where the density is steep
    return t, np.exp(-np.outer(steep, t) - 0.5 * np.outer(curved, t**2))


def evidence(log_posterior: LogPosterior, top: Top) -> tuple[float, Array]:
    """Log evidence, and the covariance (D, D) over the unit cube; the prior's where nothing is possible."""
    if not np.isfinite(top.value):
        return -np.inf, np.eye(log_posterior.dim) / 12.0
    low, high = log_posterior.bounds
    unit = (top.vector - low) / (high - low)
    uphill = np.where(unit < EDGE, -top.gradient, np.where(unit > 1.0 - EDGE, top.gradient, 0.0))
    held = uphill > 0.0
    free = ~held
    values, vectors = np.linalg.eigh(top.information[np.ix_(free, free)])
    t, density = held_density(uphill[held], np.diag(top.information)[held])
    mass = np.trapezoid(density, t, axis=1)
    log_likelihood = top.value + float(np.sum(np.log(high - low)))
    log_evidence = log_likelihood + occam(values) + float(np.sum(np.log(mass)))
    covariance = np.zeros((len(unit), len(unit)))
    width = np.maximum(np.maximum(values, 0.0) + 2.0 * np.pi, 12.0)
    covariance[np.ix_(free, free)] = (vectors / width) @ vectors.T
    away = np.trapezoid(density * t**2, t, axis=1) / mass  # mean square, from the bound
    covariance[held, held] = away
    share = np.ones(len(unit))
    for i in np.flatnonzero(free[: log_posterior.surrogate.space.dim]):
        gaussian = np.sqrt(2.0 * np.pi / (max(top.information[i, i], 0.0) + 2.0 * np.pi))
        share[i] = min(_room(log_posterior, top, unit, int(i)) / gaussian, 1.0)
    return log_evidence + float(np.sum(np.log(share))), covariance * np.outer(share, share)


def _room(log_posterior: LogPosterior, top: Top, unit: Array, i: int) -> float:
    """Integral over one coordinate of the unit cube of the density relative to the top's, the others held.

    As far as the Gaussian of its information reaches.
    """
    low, high = log_posterior.bounds
    far = min(FAR / np.sqrt(max(top.information[i, i], 1.0)), 1.0)
    near = min(NEAR, far / 100.0)
    away = np.geomspace(far, near, 1 + round(np.log(far / near) / np.log(NEXT)))
    places = np.unique(np.clip(np.concatenate([unit[i] - away, unit[i : i + 1], unit[i] + away]), 0.0, 1.0))
    points = np.repeat(unit[None], len(places), axis=0)
    points[:, i] = places
    points = np.clip(low + points * (high - low), low, high)
    values = log_posterior.log_prob(points) - top.value
    return float(np.trapezoid(np.exp(np.minimum(values, 0.0)), places))
