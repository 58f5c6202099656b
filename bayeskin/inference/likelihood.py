"""Log-likelihood of binned forces: correlated heavy-tailed noise and the surrogate's own error.

Observed y = f + F z + e with f, F the surrogate's mean and factor, z ~ N(0, I_r), and e the noise chain
of `noise_model` whose variance takes in the surrogate's diagonal. With the residual and the columns of F
whitened by the chain, w and G, the innovations are eps(z) = w - G z, independent Student-t, and

    p(y) = prod_j 1/(s_j sqrt(1 - rho_j^2)) * int N(z; 0, I) prod_j t_nu(eps_j(z)) dz .

N is the normal density within three sd; beyond, its logarithm falls by 50 (|z| - 3)^2 more, since a
surrogate that were wrong by tens of its sd could explain any misfit by an error that it denies. The integral
is Gaussian and exact for nu = inf within three sd. For finite nu it is Laplace's approximation about the
mode, found by reweighted least squares and then Newton steps (Tierney & Kadane 1986, JASA 81:82; Lange,
Little & Taylor 1989, JASA 84:881). Float64 throughout; one thread; one call for any number of points.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from bayeskin.inference.noise_model import NoiseChain
from bayeskin.types import Array, NDArray, Prediction

_STEPS = 40  # bound on the mode search; five or six are usual
FARTHEST, STIFF = 3.0, 100.0  # sd of the surrogate's error that z is normal to, and the stiffness beyond
_REWEIGHTED = 2  # steps of reweighted least squares before Newton, which needs a start near the mode
_DECREMENT = 1e-8  # of the log density, at which the mode is found
# Sums may be reordered for SIMD; infinities and NaN keep their meaning.
_FAST = {"reassoc", "contract", "nsz", "arcp"}
# The helpers are put into `_kernel` before it is compiled: as functions of their own, the process that
# compiles them and one that loads them from numba's cache would run differently reordered sums.


def log_likelihood(chain: NoiseChain, prediction: Prediction, noise: Array) -> Array:
    """Log density of the chain's forces, (n,), in nats (forces in N).

    `prediction` at n points on all the recording's bins; noise (n, q): columns of
    `noise_space(chain.kinds)`, whose last is nu, inf allowed.
    """
    return _kernel(
        np.ascontiguousarray(prediction.mean, dtype=np.float64),
        np.ascontiguousarray(prediction.factor.transpose(0, 2, 1), dtype=np.float64),
        np.ascontiguousarray(prediction.diagonal, dtype=np.float64),
        np.ascontiguousarray(noise, dtype=np.float64),
        chain.bins,
        chain.force_n,
        chain.variance_n2,
        chain.covariance_n2,
        chain.gap_s,
        chain.starts,
        chain.kind,
    )


@nb.njit(cache=True, fastmath=_FAST)
def _kernel(
    mean: Array, factor: Array, diagonal: Array, noise: Array,
    bins: NDArray[np.int64], force: Array, variance: Array, covariance: Array,
    gap: Array, starts: NDArray[np.bool_], kind: NDArray[np.int64],
) -> Array:  # fmt: skip
    points, (k, rank) = len(mean), (len(bins), factor.shape[1])
    out = np.empty(points)
    white, design = np.empty(k), np.empty((rank, k))
    for i in range(points):
        log_scale = _whiten(
            mean[i], factor[i], diagonal[i], noise[i],
            bins, force, variance, covariance, gap, starts, kind, white, design,
        )  # fmt: skip
        out[i] = _marginal(white, design, noise[i, -1]) - log_scale
    return out


@nb.njit(fastmath=_FAST, inline="always")
def _whiten(
    mean: Array, factor: Array, diagonal: Array, noise: Array,
    bins: NDArray[np.int64], force: Array, variance: Array, covariance: Array,
    gap: Array, starts: NDArray[np.bool_], kind: NDArray[np.int64], white: Array, design: Array,
) -> float:  # fmt: skip
    """Fills `white` (k,) and `design` (r, k); returns the sum of the innovations' log scales."""
    k, rank, tau = len(bins), len(factor), noise[-2]
    log_scale, product = 0.0, 1.0
    sd_before, inverse_before, decay, gap_before = 0.0, 0.0, 0.0, -1.0
    for j in range(k):
        b = bins[j]
        sd = noise[kind[j]]
        inverse = 1.0 / math.sqrt(sd * sd + variance[j] + diagonal[b])
        rho, narrow = 0.0, 1.0
        if not starts[j]:
            if gap[j] != gap_before:
                gap_before = gap[j]
                decay = math.exp(-gap_before / tau)
            rho = (sd_before * sd * decay + covariance[j]) * inverse * inverse_before
            narrow = 1.0 / math.sqrt(1.0 - rho * rho)
        now, before = narrow * inverse, narrow * rho * inverse_before
        white[j] = now * (force[j] - mean[b])
        for a in range(rank):
            design[a, j] = now * factor[a, b]
        if before != 0.0:
            c = bins[j - 1]
            white[j] -= before * (force[j - 1] - mean[c])
            for a in range(rank):
                design[a, j] -= before * factor[a, c]
        product *= now
        if j % 8 == 7:  # one logarithm for eight factors
            log_scale -= math.log(product)
            product = 1.0
        sd_before, inverse_before = sd, inverse
    return log_scale - math.log(product)


@nb.njit(fastmath=_FAST, inline="always")
def _marginal(white: Array, design: Array, nu: float) -> float:
    """Log of the integral over z of N(z; 0, I) prod_j t_nu(white_j - design[:, j] z)."""
    rank, k = design.shape
    gaussian = math.isinf(nu)
    z, gradient = np.zeros(rank), np.empty(rank)
    best, curvature = np.zeros(rank), np.empty((rank, rank))
    eps, pull, bend = np.empty(k), np.empty(k), np.empty(k)
    newton, lowest = False, np.inf
    value = np.inf
    for step in range(_STEPS):
        value = _energy(white, design, z, nu, eps)
        if newton and value > lowest + 1e-9:  # Newton overshot: back, and reweight from there on
            newton, lowest = False, np.inf
            z[:] = best
            value = _energy(white, design, z, nu, eps)
        elif step == _REWEIGHTED and not gaussian:
            newton = True
        lowest = value
        best[:] = z
        _weights(eps, nu, step, newton, pull, bend)
        _normal_equations(design, z, eps, pull, bend, gradient, curvature)
        if not _cholesky(curvature):
            newton = False
            _weights(eps, nu, step, False, pull, bend)
            _normal_equations(design, z, eps, pull, bend, gradient, curvature)
            _cholesky(curvature)
        decrement = _solve(curvature, gradient)
        z += gradient
        value -= 0.5 * decrement
        if step > 0 and decrement < _DECREMENT:
            break
    if not gaussian and not newton:  # Laplace takes the curvature of the density, not of its bound
        value = _energy(white, design, z, nu, eps)
        _weights(eps, nu, _STEPS, True, pull, bend)
        _normal_equations(design, z, eps, pull, bend, gradient, curvature)
        if not _cholesky(curvature):
            _weights(eps, nu, _STEPS, False, pull, bend)
            _normal_equations(design, z, eps, pull, bend, gradient, curvature)
            _cholesky(curvature)
    for a in range(rank):
        value += math.log(curvature[a, a])
    return k * _log_norm(nu) - value


@nb.njit(fastmath=_FAST, inline="always")
def _log_norm(nu: float) -> float:
    if math.isinf(nu):
        return -0.5 * math.log(2.0 * math.pi)
    return math.lgamma(0.5 * (nu + 1.0)) - math.lgamma(0.5 * nu) - 0.5 * math.log(nu * math.pi)


@nb.njit(fastmath=_FAST, inline="always")
def _energy(white: Array, design: Array, z: Array, nu: float, eps: Array) -> float:
    """Minus the log of the integrand, without constants; fills `eps` (k,)."""
    rank, k = design.shape
    eps[:] = white
    square = 0.0
    for a in range(rank):
        beyond = max(abs(z[a]) - FARTHEST, 0.0)
        square += z[a] * z[a] + STIFF * beyond * beyond
        if z[a] != 0.0:
            for j in range(k):
                eps[j] -= design[a, j] * z[a]
    if math.isinf(nu):
        for j in range(k):
            square += eps[j] * eps[j]
        return 0.5 * square
    logs, product = 0.0, 1.0
    for j in range(k):
        product *= 1.0 + eps[j] * eps[j] / nu
        if j % 8 == 7:
            logs += math.log(product)
            product = 1.0
    return 0.5 * square + 0.5 * (nu + 1.0) * (logs + math.log(product))


@nb.njit(fastmath=_FAST, inline="always")
def _weights(eps: Array, nu: float, step: int, newton: bool, pull: Array, bend: Array) -> None:
    """Weights of the gradient (`pull`) and of the curvature (`bend`), (k,); both 1 for the Gaussian."""
    for j in range(len(eps)):
        if step == 0 or math.isinf(nu):
            pull[j] = bend[j] = 1.0
        else:
            square = eps[j] * eps[j]
            weight = (nu + 1.0) / (nu + square)
            pull[j] = weight
            bend[j] = weight * (nu - square) / (nu + square) if newton else weight


@nb.njit(fastmath=_FAST, inline="always")
def _normal_equations(
    design: Array, z: Array, eps: Array, pull: Array, bend: Array, gradient: Array, curvature: Array
) -> None:
    """gradient = G' (pull eps) - z; lower triangle of curvature = I + G' diag(bend) G."""
    rank, k = design.shape
    for a in range(rank):
        total = 0.0
        for j in range(k):
            total += design[a, j] * pull[j] * eps[j]
        beyond = max(abs(z[a]) - FARTHEST, 0.0)
        gradient[a] = total - z[a] - math.copysign(STIFF * beyond, z[a])
        for b in range(a + 1):
            total = 0.0
            if a == b:
                total = 1.0 + STIFF if beyond > 0.0 else 1.0
            for j in range(k):
                total += design[a, j] * design[b, j] * bend[j]
            curvature[a, b] = total


@nb.njit(inline="always")
def _cholesky(matrix: Array) -> bool:
    """Factors the lower triangle in place; False when it is not positive definite."""
    for a in range(len(matrix)):
        for b in range(a + 1):
            total = matrix[a, b]
            for c in range(b):
                total -= matrix[a, c] * matrix[b, c]
            if a != b:
                matrix[a, b] = total / matrix[b, b]
            elif total > 0.0:
                matrix[a, a] = math.sqrt(total)
            else:
                return False
    return True


@nb.njit(inline="always")
def _solve(lower: Array, vector: Array) -> float:
    """Solves in place with the Cholesky factor; returns vector' matrix^-1 vector."""
    rank, norm = len(vector), 0.0
    for a in range(rank):
        for b in range(a):
            vector[a] -= lower[a, b] * vector[b]
        vector[a] /= lower[a, a]
        norm += vector[a] * vector[a]
    for a in range(rank - 1, -1, -1):
        for b in range(a + 1, rank):
            vector[a] -= lower[b, a] * vector[b]
        vector[a] /= lower[a, a]
    return norm
