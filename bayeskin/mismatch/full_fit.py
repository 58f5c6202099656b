"""A set of mechanisms fitted by the full model itself, with the surrogate's slopes.

About a full run F at theta_0 the force is taken as

    F + S(theta) - S(theta_0) + B (u - u_0) ,

S the surrogate's mean, u coordinates of the unit cube, and B what the runs so far have shown of the slopes
that the surrogate has wrong (Broyden's rank-one updates). Each round maximises the posterior of that force,
which has no surrogate's error in it, within a trust region of the parameters that the full model solves,
makes a full run there, and goes on from it if the posterior of the full model itself has risen.

Space mapping, manifold mapping: Echeverria & Hemker, Comput. Methods Appl. Math. 5 (2005), 107-136.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bayeskin.inference import LogPosterior
from bayeskin.inference.gauss_newton import gauss_newton
from bayeskin.types import Array, ParameterSpace, Prediction, Surrogate

TRUST, SMALLEST, LARGEST = 0.1, 0.005, 0.4  # of the prior's width, either side
ENOUGH = 0.5  # nats still to be gained
STARTS = 3  # climbs of a round: from the best point, and from others in the trust region
CLIMB = 20  # rounds of each

Full = Callable[[Mapping[str, float]], Array | str]  # all bins' means (m,), or why a run failed


@dataclass(frozen=True)
class Anchored:
    """Satisfies `types.Surrogate`, without error: force_n (m,) at theta (d,), where a full run was made.

    slopes_n (m, d) are added to those of `surrogate`, by coordinates of its unit cube.
    """

    surrogate: Surrogate
    theta: Array
    force_n: Array
    slopes_n: Array

    @property
    def space(self) -> ParameterSpace:
        return self.surrogate.space

    @property
    def edges_s(self) -> Array:
        return self.surrogate.edges_s

    @property
    def provenance(self) -> Mapping[str, Any]:
        return self.surrogate.provenance

    def predict(self, theta: ArrayLike) -> Prediction:
        """Force at theta (n, d) or (d,). Raises InputError outside the box."""
        theta = np.atleast_2d(np.asarray(theta, dtype=float))
        mean = self.surrogate.predict(np.vstack([self.theta, theta])).mean
        away = self.space.to_unit(theta) - self.space.to_unit(self.theta)
        force = self.force_n + mean[1:] - mean[0] + away @ self.slopes_n.T
        return Prediction(force, np.zeros((*force.shape, 1)), np.zeros(force.shape))


@dataclass(frozen=True)
class FullFit:
    """theta: all parameters by name (SI) of the best full run; value: its log posterior; force_n (m,).

    runs : full runs made; gained : nats on the first of them
    """

    theta: Mapping[str, float]
    value: float
    force_n: Array
    runs: int
    gained: float


def fit_full(
    log_posterior: LogPosterior, start: Mapping[str, float], full: Full, exact: Sequence[str], rounds: int,
    seed: int,
) -> FullFit | str:  # fmt: skip
    """From `start` (all parameters), at most so many full runs; the message of the first, where that fails.

    exact : parameters whose effect the surrogate has exactly, which no trust region holds
    """
    surrogate, rng = log_posterior.surrogate, np.random.default_rng(seed)
    space, trial, trust = surrogate.space, dict(start), TRUST
    slopes = np.zeros((len(surrogate.edges_s) - 1, space.dim))
    best: FullFit | None = None
    local = log_posterior
    for count in range(1, rounds + 1):
        force = full(trial)
        if isinstance(force, str):
            if best is None:
                return force
            trust *= 0.25
        else:
            theta = np.array([trial[name] for name in space.names])
            if best is not None:
                slopes = _corrected(slopes, local, theta, force, exact)
            there = _anchored(log_posterior, Anchored(surrogate, theta, force, slopes))
            vector = _with_noise(there, trial)
            value = float(there.log_prob(vector[None])[0])
            if best is None or value > best.value:
                first = value if best is None else best.value - best.gained
                trust = TRUST if best is None else min(2.0 * trust, LARGEST)
                named = there.named(there.from_sampling(vector))
                best, local = FullFit(named, value, force, count, value - first), there
            else:
                trust *= 0.25
                local = _anchored(local, replace(_of(local), slopes_n=slopes))
        best = replace(best, runs=count)
        if trust < SMALLEST:
            break
        trial, promised = _maximum(local, best.theta, trust, exact, rng)
        if promised - best.value < ENOUGH:
            break
    assert best is not None
    return best


def _of(local: LogPosterior) -> Anchored:
    assert isinstance(local.surrogate, Anchored)
    return local.surrogate


def _anchored(log_posterior: LogPosterior, surrogate: Anchored) -> LogPosterior:
    return replace(log_posterior, surrogate=surrogate, sure_within_n=None)


def _corrected(slopes: Array, local: LogPosterior, theta: Array, force: Array, exact: Sequence[str]) -> Array:
    """Broyden's update: what the force at theta was wrong by goes to the direction that was taken, but for
    the slopes that are right already."""
    space = local.surrogate.space
    away = space.to_unit(theta) - space.to_unit(_of(local).theta)
    unsure = np.where(np.isin(space.names, exact), 0.0, away)
    wrong = force - local.surrogate.predict(theta).mean[0]
    return np.asarray(slopes + np.outer(wrong, unsure) / max(float(away @ away), 1e-12))


def _with_noise(there: LogPosterior, trial: Mapping[str, float]) -> Array:
    """The point (D,) with the noise that suits its force best: a climb with all else held."""
    low, high = there.bounds
    vector = np.clip(there.vector(trial), low, high)
    held = _within(there, vector, np.zeros(there.surrogate.space.dim))
    return np.clip(gauss_newton(held, np.clip(vector, *held.bounds), None, 3).vector, low, high)


def _within(local: LogPosterior, vector: Array, reach: Array) -> LogPosterior:
    """The same posterior in a smaller box: `reach` (d,) of the prior's width about a point (D,)."""
    space, low, high = local.surrogate.space, *local.bounds
    width = (high - low)[: space.dim]
    reach = np.maximum(reach, 1e-9) * width
    line = vector[: space.dim]
    lower, upper = (space.from_line(np.clip(line + sign * reach, low[: space.dim], high[: space.dim]))
                    for sign in (-1.0, 1.0))  # fmt: skip
    narrowed = tuple(
        replace(p, lower=float(max(a, p.lower)), upper=float(min(b, p.upper)))
        for p, a, b in zip(space.parameters, lower, upper, strict=True)
    )
    return replace(local, material=ParameterSpace(narrowed))


def _maximum(
    local: LogPosterior, centre: Mapping[str, float], trust: float, exact: Sequence[str],
    rng: np.random.Generator,
) -> tuple[dict[str, float], float]:  # fmt: skip
    """The most probable point in the trust region, and its log posterior."""
    names = local.surrogate.space.names
    vector = local.vector(centre)
    near = _within(local, vector, np.array([1.0 if name in exact else trust for name in names]))
    low, high = near.bounds
    starts = [np.clip(vector, low, high)]
    starts += [np.clip(starts[0] + 0.3 * rng.uniform(-1, 1, len(low)) * (high - low), low, high)
               for _ in range(STARTS - 1)]  # fmt: skip
    top = max((gauss_newton(near, start, None, CLIMB) for start in starts), key=lambda one: one.value)
    inside = np.clip(top.vector, *local.bounds)
    return local.named(local.from_sampling(inside)), float(local.log_prob(inside[None])[0])
