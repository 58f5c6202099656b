"""A set of mechanisms fitted by the full model itself, with its own slopes.

About a run F at theta_0 with derivatives J the force is taken as

    F + S(theta) - S(theta_0) + (J - dS/du) (u - u_0) ,

S the surrogate's mean, u coordinates of the box: right to first order, with the surrogate's curvature;
without J its slopes are the surrogate's, where that knows them well. Each round maximises the posterior of
that force, which has no surrogate's error in it, within a trust region of the parameters that the full model
solves, makes a run there, and goes on from it if the posterior of the full model itself has risen.

First-order model management: Alexandrov, Lewis, Gumbert, Green & Newman, J. Aircraft 38 (2001), 1093-1101.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bayeskin.inference import LogPosterior
from bayeskin.inference.gauss_newton import gauss_newton
from bayeskin.inference.noise_model import scales
from bayeskin.types import Array, ParameterSpace, Prediction, Surrogate

TRUST, SMALLEST, LARGEST = 0.1, 0.005, 0.4  # of the prior's width, either side
ENOUGH = 2.0  # nats still to be gained, where the residual is noise: the posterior is about the run
AHEAD = 0.5  # nats by which another climb has to be better: what is not informed stays as it is
STARTS = 3  # climbs of a round: from the best point, and from others in the trust region
CLIMB = 20  # rounds of each
STEP = 1e-4  # of the box, for the surrogate's differences

Full = Callable[[Mapping[str, float], Mapping[str, float]], tuple[Array, Array | None] | str]


@dataclass(frozen=True)
class Anchored:
    """Satisfies `types.Surrogate`, without error: force_n (m,) at theta (d,), where a run was made.

    slopes_n (m, d) are added to those of `surrogate`, by coordinates of its box.
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
        force = self.predict_mean(theta)
        return Prediction(force, np.zeros((*force.shape, 1)), np.zeros(force.shape))

    def predict_mean(self, theta: ArrayLike) -> Array:
        """Force (n, m) at theta (n, d) or (d,). Raises InputError outside the box."""
        theta = np.atleast_2d(np.asarray(theta, dtype=float))
        mean = self.surrogate.predict_mean(np.vstack([self.theta, theta]))
        away = self.space.box.to_unit(theta) - self.space.box.to_unit(self.theta)
        return np.asarray(self.force_n + mean[1:] - mean[0] + away @ self.slopes_n.T)


@dataclass(frozen=True)
class FullFit:
    """theta: all parameters by name (SI) of the best run; value: its log posterior; force_n (m,): the run's,
    with what its own mesh is wrong by as the recording shows it.

    mesh_n (m,) : that error, 0 where none is allowed for; runs : made; gained : nats on the first of them;
    settled : whether next to nothing is still to be gained
    """

    theta: Mapping[str, float]
    value: float
    force_n: Array
    mesh_n: Array
    runs: int
    gained: float
    settled: bool = False


def fit_full(
    log_posterior: LogPosterior, start: Mapping[str, float], full: Full, exact: Sequence[str], rounds: int,
    seed: int, allow: Callable[[Surrogate], Surrogate] = lambda surrogate: surrogate,
) -> tuple[FullFit, LogPosterior] | str:  # fmt: skip
    """From `start` (all parameters), at most so many runs; the message of the first, where that fails.

    With the fit comes the posterior of the force about it.

    full : of all parameters, and of changes of those of the force that count as one: bins' means (m,) and
        their derivatives (m, d) for these changes (None: the surrogate's), or why a run failed
    exact : parameters whose effect the surrogate has exactly, which no trust region holds
    allow : puts the full model's own error into a surrogate that has none
    """
    surrogate, rng = log_posterior.surrogate, np.random.default_rng(seed)
    space, trial, trust = surrogate.space, dict(start), TRUST
    best: FullFit | None = None
    local = log_posterior
    for count in range(1, rounds + 1):
        theta = np.array([trial[name] for name in space.names])
        found = full(trial, dict(zip(space.names, _change(space, theta), strict=True)))
        if isinstance(found, str):
            if best is None:
                return found
            trust *= 0.25
        else:
            force, slopes = found
            own = np.zeros((len(force), space.dim)) if slopes is None else slopes - _slopes(surrogate, theta)
            anchored = Anchored(surrogate, theta, force, own)
            there = replace(log_posterior, surrogate=allow(anchored), sure_within_n=None)
            vector, latent = _with_noise(there, trial)
            values = there.from_sampling(vector)
            value = float(there.log_prob(vector[None])[0])
            if best is None or value > best.value:
                first = value if best is None else best.value - best.gained
                trust = TRUST if best is None else min(2.0 * trust, LARGEST)
                mesh_n = there.predict(values).factor[0] @ latent
                named = {**there.named(values), **{name: trial[name] for name in space.names}}
                best = FullFit(named, value, force + mesh_n, mesh_n, count, value - first)
                local = there
            else:
                trust *= 0.25
        best = replace(best, runs=count)
        if trust < SMALLEST:
            break
        trial, promised = _maximum(local, best.theta, trust, exact, rng)
        if promised - best.value < ENOUGH * _excess(local, best):
            best = replace(best, settled=trust >= TRUST)
            break
    assert best is not None
    return best, local


def _excess(local: LogPosterior, best: FullFit) -> float:
    """By how much nats are inflated where more than noise is left, 1 at least.

    The mean squared score of the innovations, which is what a sandwich of informations has in its middle
    (Godambe 1960, Ann. Math. Stat. 31:1208).
    """
    chain, values = local.chain, local.from_sampling(local.vector(best.theta))[None]
    noise = local.split(values)[1]
    scale_n, rho = (one[0] for one in scales(chain, noise, np.zeros((1, len(chain.bins)))))
    unit, nu = (chain.force_n - best.force_n[chain.bins]) / scale_n, float(noise[0, -1])
    eps = (unit - rho * np.concatenate([[0.0], unit[:-1]])) / np.sqrt(1.0 - rho**2)
    return max(float(np.mean(((nu + 1.0) * eps / (nu + eps**2)) ** 2)), 1.0)


def _change(space: ParameterSpace, theta: Array) -> Array:
    """Of each parameter (d,), by one coordinate of the box."""
    unit, h = space.box.to_unit(theta), 1e-6
    return np.asarray((space.box.from_unit(unit + h) - space.box.from_unit(unit - h)) / (2.0 * h))


def _slopes(surrogate: Surrogate, theta: Array) -> Array:
    """Of the surrogate's mean (m, d) by coordinates of the box, by differences toward its middle."""
    box = surrogate.space.box
    unit = box.to_unit(theta)
    steps = np.diag(np.where(unit > 0.5, -STEP, STEP))
    rows = np.vstack([theta, np.clip(box.from_unit(unit + steps), box.lower, box.upper)])
    mean = surrogate.predict_mean(rows)
    return np.asarray((mean[1:] - mean[0]).T / np.diag(steps))


def _with_noise(there: LogPosterior, trial: Mapping[str, float]) -> tuple[Array, Array]:
    """The point (D,) with the noise that suits its force best, a climb with all else held; latent (r,)."""
    low, high = there.bounds
    vector = np.clip(there.vector(trial), low, high)
    held = _within(there, vector, np.zeros(there.surrogate.space.dim))
    top = gauss_newton(held, np.clip(vector, *held.bounds), None, 3)
    return np.clip(top.vector, low, high), top.latent


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
    return replace(local, material=replace(space, parameters=narrowed))


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
    top, *others = (gauss_newton(near, start, None, CLIMB) for start in starts)
    for one in others:
        top = one if one.value > top.value + AHEAD else top
    inside = np.clip(top.vector, *local.bounds)
    return local.named(local.from_sampling(inside)), float(local.log_prob(inside[None])[0])
