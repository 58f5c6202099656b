"""What a fit leaves over, with all that its parameters could still take up projected out of it.

With r the residual at a fit, G the derivatives of the force by the surrogate's parameters (central
differences in sampling coordinates), e the noise and the errors that are allowed for, of covariance R, and d
the discrepancy,

    r = G b + d + e ,    G' d = 0 .

In describing d, b has no prior: whatever looks like a parameter is the parameter's, and is no discrepancy
(Plumlee 2017, JASA 112:1274; without this the two compete and the parameters lose their meaning:
Brynjarsdottir & O'Hagan 2014, Inverse Problems 30:114007). A parameter at a bound of its prior has no column
in G. With N an orthonormal basis of what is orthogonal to G, and N' R N = M M', both the flat prior of b and
the condition on d hold in the coordinates a = M^-1 N' r, in which the noise is the identity. The price: what
parameters can imitate of a true discrepancy is not seen. Evidence, which compares sets, gives b its prior.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solve_triangular

from bayeskin.inference import LogPosterior
from bayeskin.inference.noise_model import noise_covariance
from bayeskin.mismatch.fit import Fit, held_density
from bayeskin.types import Array, PadMotion, Phase

STEP = 1e-3  # of the prior box in sampling coordinates, for derivatives
AT_BOUND = 1e-3  # of the box: nearer to its bound than this a parameter does not move
SMALLEST = 1e-6  # singular value of the derivatives, of the largest, that still is a direction
DIRECTION = {"rest": 0.0, "load": 1.0, "hold": 0.0, "unload": -1.0}


@dataclass(frozen=True)
class Place:
    """Where times stand in a test: arrays of one shape.

    time_s; displacement_m; speed_m_s; since_s, since the last corner; kind ("rest", "load", ...);
    cycle; phase, index into the recording's; direction, 1 loading, -1 unloading, 0 still.
    """

    time_s: Array
    displacement_m: Array
    speed_m_s: Array
    since_s: Array
    kind: NDArray[np.str_]
    cycle: Array
    phase: NDArray[np.int64]
    direction: Array


def place(time_s: ArrayLike, phase: ArrayLike, phases: tuple[Phase, ...], motion: PadMotion) -> Place:
    """Of times (any shape) that belong to phases (same shape, index)."""
    time_s, phase = np.asarray(time_s, dtype=float), np.asarray(phase, dtype=np.int64)
    speed = np.diff(motion.displacement_m) / np.diff(motion.time_s)
    stretch = np.clip(np.searchsorted(motion.time_s, time_s, side="right") - 1, 0, len(speed) - 1)
    start = np.array([p.start_s for p in phases])
    kind = np.array([p.kind for p in phases])
    cycle = np.array([float(p.cycle) for p in phases])
    direction = np.array([DIRECTION[p.kind] for p in phases])
    return Place(
        time_s, motion.at(time_s), speed[stretch], np.maximum(time_s - start[phase], 0.0),
        kind[phase], cycle[phase], phase, direction[phase],
    )  # fmt: skip


@dataclass(frozen=True)
class Memory:
    """Noise with a memory: as many times sd_n (k,) as `size` says, forgotten within time_s.

    apart_s (k, k) : between bins, infinite between fit windows
    size_within, time_within : what its priors allow
    """

    sd_n: Array
    apart_s: Array
    size: float
    time_s: float
    size_within: tuple[float, float]
    time_within: tuple[float, float]

    @cached_property
    def covariance_n2(self) -> Array:
        """(k, k) [N^2]."""
        return np.asarray(self.size**2 * np.outer(self.sd_n, self.sd_n) * np.exp(-self.apart_s / self.time_s))


@dataclass(frozen=True)
class Unexplained:
    """A fit's residual and what it takes to split it; k bins, r of them taken up by parameters.

    residual_n (k,) recorded minus model; force_n (k,) the model's; measured_n2 (k, k) covariance of the
    noise that the bins carry themselves and of the errors that are allowed for; memory: the noise with a
    memory beside it; slopes (k, d) of the force over the priors' widths of the d parameters that move, and
    inwards (k, h) of those that a bound holds; taken (k, r), an orthonormal basis of the slopes, and basis
    (k, k - r), N; at: where the bins stand.
    """

    bins: NDArray[np.int64]
    residual_n: Array
    force_n: Array
    measured_n2: Array
    memory: Memory
    slopes: Array
    inwards: Array
    taken: Array
    basis: Array
    at: Place

    @cached_property
    def noise_n2(self) -> Array:
        """R, (k, k) [N^2]."""
        return self.measured_n2 + self.memory.covariance_n2

    def with_memory(self, line: Array) -> Unexplained:
        """The same beside noise of another size and time, from their logarithms (2,)."""
        size, time_s = (float(value) for value in np.exp(line))
        return replace(self, memory=replace(self.memory, size=size, time_s=time_s))

    def log_evidence(self, kernel_n2: Array | None = None) -> float:
        """Of the fit, with a discrepancy of covariance (k, k) or without any, its force linear in the
        parameters, up to a constant that is the same for all fits to the same bins.

        b is normal, as dense at the fit as the uniform prior is; what a bound holds moves inwards only.
        """
        covariance = self.noise_n2 + self.open_n2
        if kernel_n2 is not None:
            covariance = covariance + self.beyond(self.beyond(kernel_n2).T)
        root = np.linalg.cholesky(covariance)
        white = solve_triangular(root, self.residual_n, lower=True)
        moved = solve_triangular(root, self.inwards, lower=True)
        t, density = held_density(np.maximum(-moved.T @ white, 0.0), np.sum(moved**2, axis=0))
        mass = np.trapezoid(density, t, axis=1)
        return float(np.sum(np.log(mass)) - np.sum(np.log(np.diag(root))) - 0.5 * white @ white)

    @cached_property
    def open_n2(self) -> Array:
        """Covariance (k, k) [N^2] of the force by what the priors leave open of the parameters."""
        return np.asarray(self.slopes @ self.slopes.T / (2.0 * np.pi))

    @cached_property
    def _root(self) -> Array:
        """M, (k - r, k - r)."""
        return np.asarray(np.linalg.cholesky(self.basis.T @ self.noise_n2 @ self.basis))

    @cached_property
    def reduce(self) -> Array:
        """M^-1 N', (k - r, k): from forces to the coordinates a."""
        return np.asarray(solve_triangular(self._root, self.basis.T, lower=True))

    @cached_property
    def expand(self) -> Array:
        """N M, (k, k - r): back to forces, orthogonal to what parameters take up."""
        return np.asarray(self.basis @ self._root)

    def beyond(self, forces_n: Array) -> Array:
        """What parameters cannot take up of forces (k,) or (k, p), by least squares."""
        return np.asarray(forces_n - self.taken @ (self.taken.T @ forces_n))


def unexplained(found: Fit, motion: PadMotion) -> Unexplained:
    """The residual at a fit, on the bins that were fitted."""
    log_posterior = found.log_posterior
    chain, binned = log_posterior.chain, log_posterior.binned
    theta = log_posterior.from_sampling(log_posterior.vector(found.theta))[None]
    prediction = log_posterior.predict(theta)
    force = prediction.mean[0, chain.bins]
    noise = log_posterior.split(theta)[1][0]
    measured = np.where(np.arange(len(noise)) < len(noise) - 2, 0.0, noise)
    covariance = noise_covariance(chain, measured, prediction.diagonal[0, chain.bins])
    factor = prediction.factor[0, chain.bins]
    material = found.unit[: log_posterior.surrogate.space.dim]
    moves = (material > AT_BOUND) & (material < 1.0 - AT_BOUND)
    all_slopes = derivatives(log_posterior, found.unit)[chain.bins]
    slopes, inwards = all_slopes[:, moves], (all_slopes * np.where(material < 0.5, 1.0, -1.0))[:, ~moves]
    left, size, _ = np.linalg.svd(slopes)
    rank = int(np.sum(size > SMALLEST * size.max(initial=0.0)))
    at = place(binned.time_s[chain.bins], binned.phase[chain.bins], binned.phases, motion)
    return Unexplained(
        chain.bins, chain.force_n - force, force, covariance + factor @ factor.T,
        _memory(log_posterior, noise), slopes, inwards, left[:, :rank], left[:, rank:], at,
    )  # fmt: skip


def _memory(log_posterior: LogPosterior, noise: Array) -> Memory:
    """The noise with a memory of a fit, with noise parameters (q,)."""
    chain, priors = log_posterior.chain, log_posterior.noise_priors
    window, sd_n = np.cumsum(chain.starts), noise[chain.kind]
    time_s = np.cumsum(chain.gap_s)
    apart_s = np.where(window[:, None] == window, np.abs(time_s[:, None] - time_s), np.inf)
    low, high = (float(end / sd_n.max()) for end in priors.sd_n)
    return Memory(sd_n, apart_s, 1.0, float(noise[-2]), (low, high), priors.tau_s)


def derivatives(log_posterior: LogPosterior, unit: Array) -> Array:
    """Of the force by each material parameter, over its prior's whole range [N], (m, d), at unit (D,)."""
    d = log_posterior.surrogate.space.dim
    low, high = log_posterior.bounds
    centre = np.clip(unit, STEP, 1.0 - STEP)
    points = np.tile(centre, (2 * d, 1))
    points[:d, :d] += STEP * np.eye(d)
    points[d:, :d] -= STEP * np.eye(d)
    mean = log_posterior.predict_mean(log_posterior.from_sampling(low + points * (high - low)))
    return np.asarray((mean[:d] - mean[d:]).T / (2 * STEP))
