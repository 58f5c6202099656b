"""A set of mechanisms fitted by the full model itself, with its own slopes where it has them.

The force is the surrogate's, corrected by all runs made (`corrected`): at a run it is the run's, to first
order where that has slopes. Each round maximises the posterior of that force, as if it had no error, within
a trust region of the parameters that the full model solves, makes a run there, and goes on from it if the
posterior of the full model itself has risen. The surrogate that is returned has the error again.

First-order model management: Alexandrov, Lewis, Gumbert, Green & Newman, J. Aircraft 38 (2001), 1093-1101.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bayeskin.inference import LogPosterior
from bayeskin.inference.gauss_newton import gauss_newton, with_less_noise
from bayeskin.inference.noise_model import innovations
from bayeskin.mismatch.corrected import CorrectedSurrogate, FullRun, error_lengths
from bayeskin.mismatch.fit import Fit
from bayeskin.mismatch.joint_fit import in_box
from bayeskin.mismatch.wrapper import Sure
from bayeskin.types import Array, ParameterSpace

TRUST, SMALLEST, LARGEST = 0.1, 0.005, 0.4  # of the prior's width, either side
COMMON = 100.0  # variance of the mean of errors of added effects, over that of the rest
ENOUGH = 2.0  # nats still to be gained, where the residual is noise: the posterior is about the run
BEHIND = 3.0  # nats, of what is still promised, from which on a fit is not worth going on with
AHEAD = 0.5  # nats by which another climb has to be better: what is not informed stays as it is
STARTS = 3  # climbs of a round: from the best point, and from others in the trust region
CLIMB = 20  # rounds of each

Full = Callable[[Mapping[str, float], Mapping[str, float]], tuple[Array, Array | None] | str]


@dataclass(frozen=True)
class FullFit:
    """theta: all parameters by name (SI) of the best run; value: its log posterior; force_n (m,): the run's,
    with what is allowed for its mesh and the load cell as the recording shows it.

    mesh_n (m,) : that, 0 where none is allowed for; runs : made; gained : nats on the first of them;
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
    seed: int, given: Sequence[FullRun] = (), several: bool = True, at_least: float = -np.inf,
) -> tuple[FullFit, CorrectedSurrogate] | str:  # fmt: skip
    """Returns a fit from `start` (all parameters) in so many runs at most; why the first failed, if so.

    With the fit comes the surrogate of the force about it.

    full : of all parameters, and of changes of those of the force that count as one: bins' means (m,) and
        their derivatives (m, d) for these changes (None: the surrogate's), or why a run failed
    exact : parameters whose effect the surrogate has exactly, which no trust region holds
    given : runs of the same model made before
    several : whether the surrogate adds up several effects, so that its errors go far; climbs take them to
    at_least : log posterior that makes the fit worth having; from the second run on one that promises less
        is left as it is
    """
    surrogate, rng = log_posterior.surrogate, np.random.default_rng(seed)
    space, trial, trust = surrogate.space, dict(start), TRUST
    held = np.array([name in exact for name in space.names])
    lengths = error_lengths(surrogate, np.array([trial[name] for name in space.names]), held)
    runs = tuple(given)
    best: FullFit | None = None
    local = log_posterior
    for count in range(1, rounds + 1):
        theta = np.array([trial[name] for name in space.names])
        found = full(trial, dict(zip(space.names, change(space, theta), strict=True)))
        if isinstance(found, str):
            if best is None:
                return found
            trust *= 0.25
        else:
            others = (run for run in runs if not np.array_equal(run.theta, theta))
            runs = (*others, FullRun(theta, *found))
            ahead = Sure(CorrectedSurrogate(surrogate, runs, lengths, COMMON))
            local = replace(log_posterior, surrogate=ahead, sure_within_n=None)
            vector, latent = _with_noise(local, trial)
            values = local.from_sampling(vector)
            value = float(local.log_prob(vector[None])[0])
            if best is None or value > best.value:
                first = value if best is None else best.value - best.gained
                trust = TRUST if best is None else min(2.0 * trust, LARGEST)
                allowed_n = local.predict(values).factor[0] @ latent
                named = {**local.named(values), **{name: trial[name] for name in space.names}}
                best = FullFit(named, value, found[0] + allowed_n, allowed_n, count, value - first)
            else:
                trust *= 0.25
        best = replace(best, runs=count)
        if trust < SMALLEST:
            break
        trial, promised, force_n = _maximum(local, best.theta, trust, exact, rng)
        if promised - best.value < ENOUGH * _excess(local, trial, force_n):
            best = replace(best, settled=trust >= TRUST)
            break
        if count > 1 and promised < at_least - BEHIND:
            break
    assert best is not None
    return best, CorrectedSurrogate(surrogate, runs, lengths, COMMON if several else 0.0)


def at_run(found: Fit, full: FullFit) -> Fit:
    """A fit by a surrogate that is sure, moved to the best run, with the noise that suits it."""
    local = found.log_posterior
    vector, latent = _with_noise(local, full.theta)
    return replace(found, theta=local.named(local.from_sampling(vector)), latent=latent)


def _excess(local: LogPosterior, theta: Mapping[str, float], force_n: Array) -> float:
    """Returns the factor, 1 at least, on nats where more than noise is left of the force (m,).

    The mean squared score of the innovations, which is what a sandwich of informations has in its middle
    (Godambe 1960, Ann. Math. Stat. 31:1208).
    """
    chain, values = local.chain, local.from_sampling(local.vector(theta))[None]
    noise = local.split(values)[1][0]
    left = (chain.force_n - force_n[chain.bins])[:, None]
    eps, nu = innovations(chain, noise, np.zeros(len(left)), left), float(noise[-1])
    return max(float(np.mean(((nu + 1.0) * eps / (nu + eps**2)) ** 2)), 1.0)


def change(space: ParameterSpace, theta: Array) -> Array:
    """Returns the change of each parameter (d,) along one coordinate of the box."""
    unit, h = space.box.to_unit(theta), 1e-6
    return np.asarray((space.box.from_unit(unit + h) - space.box.from_unit(unit - h)) / (2.0 * h))


def _with_noise(there: LogPosterior, trial: Mapping[str, float]) -> tuple[Array, Array]:
    """The point (D,) with the noise that suits its force best, a climb with all else held; latent (r,)."""
    low, high = there.bounds
    vector = np.clip(there.vector(trial), low, high)
    held = in_box(there, vector, np.zeros(there.surrogate.space.dim))
    top = gauss_newton(held, np.clip(vector, *held.bounds), None, 3)
    return np.clip(top.vector, low, high), top.latent


def _maximum(
    local: LogPosterior, centre: Mapping[str, float], trust: float, exact: Sequence[str],
    rng: np.random.Generator,
) -> tuple[dict[str, float], float, Array]:  # fmt: skip
    """The most probable point in the trust region, its log posterior and the force (m,) that it promises."""
    names = local.surrogate.space.names
    vector = local.vector(centre)
    near = in_box(local, vector, np.array([1.0 if name in exact else trust for name in names]))
    low, high = near.bounds
    starts = [np.clip(vector, low, high)]
    starts.append(np.clip(with_less_noise(local, starts[0]), low, high))
    starts += [np.clip(starts[0] + 0.3 * rng.uniform(-1, 1, len(low)) * (high - low), low, high)
               for _ in range(STARTS - 1)]  # fmt: skip
    top, *others = (gauss_newton(near, start, None, CLIMB) for start in starts)
    for one in others:
        top = one if one.value > top.value + AHEAD else top
    inside = np.clip(top.vector, *local.bounds)
    value = float(local.log_prob(inside[None])[0])
    return local.named(local.from_sampling(inside)), value, local.force_n(inside, top.latent)
