"""Computes the residual of a fit, and removes the part of it that the parameters could still explain.

Let r be the residual at a fit, G the derivatives of the force by the surrogate's parameters (central
differences in sampling coordinates), e the noise and the errors that are allowed for, with covariance R, and
d the discrepancy. Then

    r = G b + d + e ,    G' d = 0 .

When d is described, b has no prior: every change of the force that a parameter can make is attributed to this
parameter, and not to the discrepancy (Plumlee 2017, JASA 112:1274). Otherwise the two compete, and the
parameters lose their meaning (Brynjarsdottir & O'Hagan 2014, Inverse Problems 30:114007). A parameter at a
bound of its prior has no column in G. Let N be an orthonormal basis of the space orthogonal to G, and let
N' R N = M M'. The coordinates a = M^-1 N' r satisfy both the flat prior of b and the condition on d, and in
them the covariance of the noise is the identity. The disadvantage is that the part of a true discrepancy that
parameters can imitate remains hidden. The evidence, which compares sets, gives b its prior.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solve_triangular

from bayeskin.inference import LogPosterior
from bayeskin.inference.noise_model import noise_covariance
from bayeskin.mismatch.evidence import held_density
from bayeskin.mismatch.fit import Fit
from bayeskin.types import Array, PadMotion, Phase

DIRECTION = {"rest": 0.0, "load": 1.0, "hold": 0.0, "unload": -1.0}


@dataclass(frozen=True)
class UnexplainedSettings:
    """Settings of the split of a residual.

    step : step of central differences, as a share of the prior's box in sampling coordinates
    at_bound : distance from a bound, as a share of the box, below which a parameter is held there
    smallest : smallest singular value of the derivatives that counts, as a share of the largest one
    seen : smallest share of the norm of a force or coordinate that must remain after the parameters' part is
        removed, so that it can be compared with the residual
    """

    step: float = 1e-3
    at_bound: float = 1e-3
    smallest: float = 1e-6
    seen: float = 1e-3


UNEXPLAINED = UnexplainedSettings()


@dataclass(frozen=True)
class Place:
    """The state of a test at given times; all arrays have the same shape.

    since_s : time since the last corner
    kind : kind of the phase ("rest", "load", ...); cycle : number of the cycle
    phase : index of the phase in the recording's phases
    direction : 1 for loading, -1 for unloading, 0 for still pads
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
    """Returns the state of a test at times of any shape.

    phase : index of the phase to which each time belongs, same shape
    """
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
    """Noise with a memory; its sd is sd_n (k,) [N] times `size`, and its correlation time is time_s.

    apart_s (k, k) : time between bins, infinite for bins of different fit windows
    size_within, time_within : bounds of size and time_s by the priors
    """

    sd_n: Array
    apart_s: Array
    size: float
    time_s: float
    size_within: tuple[float, float]
    time_within: tuple[float, float]

    @cached_property
    def covariance_n2(self) -> Array:
        """Returns the covariance (k, k) [N^2]."""
        return np.asarray(self.size**2 * np.outer(self.sd_n, self.sd_n) * np.exp(-self.apart_s / self.time_s))


@dataclass(frozen=True)
class Unexplained:
    """The residual of a fit in k bins, and the quantities that split it.

    bins : indices of the fitted bins, (k,)
    residual_n : recorded force minus the model's, (k,) [N]; force_n : the model's force, (k,) [N]
    measured_n2 : covariance (k, k) [N^2] of the noise that the bins themselves state, and of the errors that
        are allowed for
    memory : the noise with a memory, which is not part of measured_n2
    slopes : derivatives (k, d) [N] of the force over the priors' widths, by the d parameters that can move
    inwards : the same (k, h) by the h parameters that a bound holds, in the direction away from this bound
    taken : orthonormal basis (k, r) of the slopes; basis : orthonormal basis N (k, k - r) of all other forces
    at : the state of the test in the bins
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
        """Returns R, the covariance of noise and allowed errors, (k, k) [N^2]."""
        return self.measured_n2 + self.memory.covariance_n2

    def with_memory(self, line: Array) -> Unexplained:
        """Returns the same residual with another noise with a memory.

        line : logarithms (2,) of its size and its time
        """
        size, time_s = (float(value) for value in np.exp(line))
        return replace(self, memory=replace(self.memory, size=size, time_s=time_s))

    def log_evidence(self, kernel_n2: Array | None = None) -> float:
        """Returns the log-evidence of the fit, with a force that is linear in the parameters.

        It lacks a constant that is the same for all fits to the same bins. The prior of b is normal, with the
        same density at the fit as the uniform prior. Parameters that a bound holds move only inwards.

        kernel_n2 : covariance (k, k) [N^2] of a discrepancy, None without a discrepancy
        """
        covariance = self.noise_n2 + self.open_n2
        if kernel_n2 is not None:
            covariance = covariance + self.beyond(self.beyond(kernel_n2).T)
        lower = np.linalg.cholesky(covariance)
        whitened = solve_triangular(lower, self.residual_n, lower=True)
        inward = solve_triangular(lower, self.inwards, lower=True)
        t, density = held_density(np.maximum(-inward.T @ whitened, 0.0), np.sum(inward**2, axis=0))
        mass = np.trapezoid(density, t, axis=1)
        return float(np.sum(np.log(mass)) - np.sum(np.log(np.diag(lower))) - 0.5 * whitened @ whitened)

    @cached_property
    def open_n2(self) -> Array:
        """Returns the covariance (k, k) [N^2] of the force that follows from the priors of the parameters."""
        return np.asarray(self.slopes @ self.slopes.T / (2.0 * np.pi))

    @cached_property
    def _root(self) -> Array:
        """Returns M, (k - r, k - r)."""
        return np.asarray(np.linalg.cholesky(self.basis.T @ self.noise_n2 @ self.basis))

    @cached_property
    def reduce(self) -> Array:
        """Returns M^-1 N', (k - r, k), which maps forces to the coordinates a."""
        return np.asarray(solve_triangular(self._root, self.basis.T, lower=True))

    @cached_property
    def expand(self) -> Array:
        """Returns N M, (k, k - r), which maps coordinates a to forces that are orthogonal to G."""
        return np.asarray(self.basis @ self._root)

    def beyond(self, forces_n: Array) -> Array:
        """Returns the part of forces (k,) or (k, p) that parameters cannot explain, by least squares."""
        return np.asarray(forces_n - self.taken @ (self.taken.T @ forces_n))


def unexplained(fit: Fit, motion: PadMotion) -> Unexplained:
    """Returns the residual at a fit on the fitted bins; `motion` is the protocol of the recording."""
    log_posterior = fit.log_posterior
    chain, binned = log_posterior.chain, log_posterior.binned
    theta = log_posterior.from_sampling(log_posterior.vector(fit.theta))[None]
    prediction = log_posterior.predict(theta)
    force = prediction.mean[0, chain.bins]
    noise = log_posterior.split(theta)[1][0]
    measured = np.where(np.arange(len(noise)) < len(noise) - 2, 0.0, noise)
    covariance = noise_covariance(chain, measured, prediction.diagonal[0, chain.bins])
    factor = prediction.factor[0, chain.bins]
    material = fit.unit[: log_posterior.surrogate.space.dim]
    can_move = (material > UNEXPLAINED.at_bound) & (material < 1.0 - UNEXPLAINED.at_bound)
    all_slopes = derivatives(log_posterior, fit.unit)[chain.bins]
    slopes, inwards = (
        all_slopes[:, can_move],
        (all_slopes * np.where(material < 0.5, 1.0, -1.0))[:, ~can_move],
    )
    vectors, size, _ = np.linalg.svd(slopes)
    rank = int(np.sum(size > UNEXPLAINED.smallest * size.max(initial=0.0)))
    at = place(binned.time_s[chain.bins], binned.phase[chain.bins], binned.phases, motion)
    return Unexplained(
        chain.bins, chain.force_n - force, force, covariance + factor @ factor.T,
        _memory(log_posterior, noise), slopes, inwards, vectors[:, :rank], vectors[:, rank:], at,
    )  # fmt: skip


def _memory(log_posterior: LogPosterior, noise: Array) -> Memory:
    """Returns the noise with a memory of a fit, whose noise parameters are `noise` (q,)."""
    chain, priors = log_posterior.chain, log_posterior.noise_priors
    window, sd_n = np.cumsum(chain.starts), noise[chain.kind]
    time_s = np.cumsum(chain.gap_s)
    apart_s = np.where(window[:, None] == window, np.abs(time_s[:, None] - time_s), np.inf)
    low, high = (float(end / sd_n.max()) for end in priors.sd_n)
    return Memory(sd_n, apart_s, 1.0, float(noise[-2]), (low, high), priors.tau_s)


def derivatives(log_posterior: LogPosterior, unit: Array) -> Array:
    """Returns the derivatives (m, d) [N] of the force by the material parameters, over their priors' widths.

    unit : point (D,) in the unit cube
    """
    d, step = log_posterior.surrogate.space.dim, UNEXPLAINED.step
    low, high = log_posterior.bounds
    centre = np.clip(unit, step, 1.0 - step)
    points = np.tile(centre, (2 * d, 1))
    points[:d, :d] += step * np.eye(d)
    points[d:, :d] -= step * np.eye(d)
    mean = log_posterior.predict_mean(log_posterior.from_sampling(low + points * (high - low)))
    return np.asarray((mean[:d] - mean[d:]).T / (2 * step))
