"""What a fit leaves over, with all that its parameters could still take up projected out of it.

With r the residual at a fit, G the derivatives of the force by the surrogate's parameters (central
differences in sampling coordinates), e the measured noise and the surrogate's own error, of covariance R,
and d the discrepancy,

    r = G b + d + e ,    G' d = 0 .

In describing d, b has no prior: whatever looks like a parameter is the parameter's, and is no discrepancy
(Plumlee 2017, JASA 112:1274; without this the two compete and the parameters lose their meaning:
Brynjarsdottir & O'Hagan 2014, Inverse Problems 30:114007). A parameter at a bound of its prior has no column
in G. With N an orthonormal basis of what is orthogonal to G, and N' R N = M M', both the flat prior of b and
the condition on d hold in the coordinates a = M^-1 N' r, in which the noise is the identity. The price: what
parameters can imitate of a true discrepancy is not seen. Evidence, which compares sets, gives b its prior.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solve_triangular

from bayeskin.inference import LogPosterior
from bayeskin.inference.noise_model import scales
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
class Unexplained:
    """A fit's residual and what it takes to split it; k bins, r of them taken up by parameters.

    residual_n (k,) recorded minus model; force_n (k,) the model's; noise_n2 (k, k) covariance of measured
    noise and surrogate's error; slopes (k, d) of the force over the priors' widths of the d parameters that
    move, and inwards (k, h) of those that a bound holds; basis (k, k - r) is N; at: where the bins stand.
    """

    bins: NDArray[np.int64]
    residual_n: Array
    force_n: Array
    noise_n2: Array
    slopes: Array
    inwards: Array
    basis: Array
    at: Place

    def log_evidence(self, kernel_n2: Array | None = None) -> float:
        """Of the fit, with a discrepancy of covariance (k, k) or without any, its force linear in the
        parameters, up to a constant that is the same for all fits to the same bins.

        b is normal, as dense at the fit as the uniform prior is; what a bound holds moves inwards only.
        """
        covariance = self.noise_n2 + self.slopes @ self.slopes.T / (2.0 * np.pi)
        if kernel_n2 is not None:
            covariance = covariance + self.beyond(self.beyond(kernel_n2).T)
        root = np.linalg.cholesky(covariance)
        white = solve_triangular(root, self.residual_n, lower=True)
        moved = solve_triangular(root, self.inwards, lower=True)
        t, density = held_density(np.maximum(-moved.T @ white, 0.0), np.sum(moved**2, axis=0))
        mass = np.trapezoid(density, t, axis=1)
        return float(np.sum(np.log(mass)) - np.sum(np.log(np.diag(root))) - 0.5 * white @ white)

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
        return np.asarray(self.basis @ (self.basis.T @ forces_n))


def unexplained(found: Fit, motion: PadMotion) -> Unexplained:
    """The residual at a fit, on the bins that were fitted."""
    log_posterior = found.log_posterior
    chain, binned = log_posterior.chain, log_posterior.binned
    theta = log_posterior.from_sampling(log_posterior.vector(found.theta))[None]
    prediction = log_posterior.predict(theta)
    force = prediction.mean[0, chain.bins]
    noise = log_posterior.split(theta)[1].copy()
    noise[:, :-2] = log_posterior.noise_priors.sd_n[0]  # the measured noise alone
    scale, rho = scales(chain, noise, prediction.diagonal[:, chain.bins])
    factor = prediction.factor[0, chain.bins]
    material = found.unit[: log_posterior.surrogate.space.dim]
    moves = (material > AT_BOUND) & (material < 1.0 - AT_BOUND)
    all_slopes = derivatives(log_posterior, found.unit)[chain.bins]
    slopes, inwards = all_slopes[:, moves], (all_slopes * np.where(material < 0.5, 1.0, -1.0))[:, ~moves]
    left, size, _ = np.linalg.svd(slopes)
    rank = int(np.sum(size > SMALLEST * size.max(initial=0.0)))
    at = place(binned.time_s[chain.bins], binned.phase[chain.bins], binned.phases, motion)
    return Unexplained(
        chain.bins, chain.force_n - force, force, chain_covariance(scale[0], rho[0]) + factor @ factor.T,
        slopes, inwards, left[:, rank:], at,
    )  # fmt: skip


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


def chain_covariance(scale: Array, rho: Array) -> Array:
    """Covariance (k, k) of a chain of standard deviations scale (k,) and correlations with the one before."""
    correlation = np.eye(len(scale))
    for i in range(1, len(scale)):
        correlation[i, :i] = rho[i] * correlation[i - 1, :i]
    correlation += np.tril(correlation, -1).T
    return np.asarray(scale[:, None] * correlation * scale)
