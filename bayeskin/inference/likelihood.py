"""Log-likelihood of binned forces: correlated heavy-tailed noise and the surrogate's own error.

The observation is y = f + F z + e. Here f and F are the surrogate's mean and factor, z ~ N(0, I_r), and e is
the noise of `noise_model`, which includes the surrogate's diagonal. The filter of that noise turns the
residual and the columns of F into innovations; divided by their sd s_j, these are w and G. The innovations of
the noise are then eps(z) = w - G z. They are independent Student-t, and

    p(y) = prod_j 1/s_j * int N(z; 0, I) prod_j t_nu(eps_j(z)) dz .

N is the normal density within three sd. Beyond three sd its logarithm falls by a further 50 (|z| - 3)^2 in
each coordinate. Otherwise a surrogate that is wrong by tens of its sd could explain any misfit by an error
that its own sd rules out. For nu = inf and a mode within three sd the integral is Gaussian and exact. For
finite nu it is Laplace's approximation about the mode. The mode is found by reweighted least squares and then
by Newton steps, which keep an earlier curvature as long as they converge quickly (Tierney & Kadane 1986, JASA
81:82; Lange, Little & Taylor 1989, JASA 84:881). All computations are in float64 and in one thread, and one
call serves any number of points.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from bayeskin.inference.noise_model import NoiseChain, filter_gains
from bayeskin.types import Array, Prediction


class ErrorPrior(NamedTuple):
    """Prior of the surrogate's error z, in sd of each column of the factor.

    farthest : number of sd within which z is normal
    stiff : added stiffness beyond, which makes larger errors practically impossible
    """

    farthest: float = 3.0
    stiff: float = 100.0


class ModeSearch(NamedTuple):
    """Settings of the search for the mode of z.

    steps : upper limit on the number of steps; five or six are usual
    reweighted : number of steps of reweighted least squares before Newton steps, which need a start near the
        mode
    slow : share of the previous decrement above which the curvature is computed anew
    patient : number of first steps that may go too far, because such a step often lands on the side of three
        sd that the next step needs
    back : factor on the distance from the best point, for a later step that goes too far
    decrement : decrement of the log density [nats] below which the search ends
    """

    steps: int = 40
    reweighted: int = 2
    slow: float = 0.1
    patient: int = 8
    back: float = 0.3
    decrement: float = 1e-8


# Numba compiles both into the kernel as constants, and its cache notices a change of this file only. So this
# file is not split.
ERROR_PRIOR, MODE_SEARCH = ErrorPrior(), ModeSearch()
# Sums may be reordered for SIMD; infinities and NaN keep their meaning.
_FAST = {"reassoc", "contract", "nsz", "arcp"}
# LLVM inlines every part into `_kernel`. As separate functions, their sums would be reordered differently in
# the process that compiles them and in one that loads them from numba's cache. Each part is called in as few
# places as possible, and copies arrays by loops, because the kernel takes long to compile.
part = nb.njit(error_model="numpy", fastmath=_FAST, forceinline=True)


def log_likelihood(chain: NoiseChain, prediction: Prediction, noise: Array) -> Array:
    """Returns the log density (n,) of the chain's forces, in nats (forces in N).

    `prediction` covers all bins of the recording, at n points or at a single point for all rows of the noise.
    noise (n, q) has the columns of `noise_space(chain.kinds)`; the last column is nu and may be inf.
    """
    return _kernel(
        np.ascontiguousarray(prediction.mean, dtype=np.float64),
        np.ascontiguousarray(prediction.factor.transpose(0, 2, 1), dtype=np.float64),
        np.ascontiguousarray(prediction.diagonal, dtype=np.float64),
        np.ascontiguousarray(noise, dtype=np.float64),
        chain.bins,
        chain.force_n,
        chain.variance_n2,
        chain.correlation,
        chain.gap_s,
        chain.starts,
        chain.kind,
    )


_gains = part(filter_gains)


@nb.njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def _kernel(
    mean: Array, factor: Array, diagonal: Array, noise: Array,
    bins: NDArray[np.int64], force: Array, variance: Array, correlation: Array,
    gap: Array, starts: NDArray[np.bool_], kind: NDArray[np.int64],
) -> Array:  # fmt: skip
    points, k, rank = len(noise), len(bins), factor.shape[1]
    out = np.empty(points)
    # Rows of zeros fill the last block of four: they add nothing, and the loops need no remainder.
    white, design, work = np.empty(k), np.zeros((-(-rank // 4) * 4, k)), np.empty((8, k))
    for i in range(points):
        p = i if len(mean) > 1 else 0
        log_scale = _whiten(
            mean[p], factor[p], diagonal[p], noise[i],
            bins, force, variance, correlation, gap, starts, kind, white, design, work,
        )  # fmt: skip
        out[i] = _marginal(white, design, rank, noise[i, -1], work) - log_scale
    return out


@part
def _whiten(
    mean: Array, factor: Array, diagonal: Array, noise: Array,
    bins: NDArray[np.int64], force: Array, variance: Array, correlation: Array, gap: Array,
    starts: NDArray[np.bool_], kind: NDArray[np.int64], white: Array, design: Array, work: Array,
) -> float:  # fmt: skip
    """Fills `white` (k,) and the first r rows of `design`; returns the sum of the innovations' log sd.

    The filter's states are kept as forces: the contributions of x and w that are expected in a bin.
    """
    k, tau = len(bins), noise[-2]
    decay, gap_before = 0.0, -1.0
    sd, own, keep, keep_quick = work[0], work[1], work[2], work[3]
    for j in range(k):
        if gap[j] != gap_before:
            gap_before = gap[j]
            decay = math.exp(-gap_before / tau)
        keep[j] = decay
        sd[j], own[j] = noise[kind[j]], diagonal[bins[j]]
    of_memory, of_quick, inverse = _gains(sd, variance, own, keep, correlation, starts)
    log_scale, product = 0.0, 1.0
    for j in range(k):
        product *= inverse[j]
        if j % 8 == 7:  # one logarithm of eight factors is faster than eight logarithms
            log_scale += math.log(product)
            product = 1.0
    log_scale += math.log(product)
    for j in range(k):
        inverse[j] = 1.0 / inverse[j]
        of_memory[j] *= sd[j]
        quick = math.sqrt(variance[j])
        of_quick[j] *= quick
        own[j] = quick
    for j in range(k - 1, 0, -1):
        fresh = starts[j]
        keep[j] = 0.0 if fresh else keep[j] * sd[j] / sd[j - 1]
        keep_quick[j] = 0.0 if fresh or own[j - 1] == 0.0 else correlation[j] * own[j] / own[j - 1]
    keep[0] = keep_quick[0] = 0.0
    column1, column2, column3, column4 = work[4], work[5], work[6], work[7]
    for j in range(k):
        column1[j] = force[j] - mean[bins[j]]
    _innovations(
        column1,
        column1,
        column1,
        column1,
        keep,
        keep_quick,
        of_memory,
        of_quick,
        inverse,
        white,
        white,
        white,
        white,
    )
    rank, last = len(factor), len(design)
    whole = bins[k - 1] - bins[0] == k - 1  # without a gap the bins are one slice, which is faster to copy
    for a in range(0, last, 4):
        for b in range(4):
            target = work[4 + b]
            if a + b >= rank:
                for j in range(k):
                    target[j] = 0.0
                continue
            row = factor[a + b]
            if whole:
                for j in range(k):
                    target[j] = row[bins[0] + j]
            else:
                for j in range(k):
                    target[j] = row[bins[j]]
        _innovations(
            column1, column2, column3, column4, keep, keep_quick, of_memory, of_quick, inverse,
            design[a], design[a + 1], design[a + 2], design[a + 3],
        )  # fmt: skip
    return log_scale


@part
def _innovations(
    column1: Array, column2: Array, column3: Array, column4: Array,
    keep: Array, keep_quick: Array, of_memory: Array, of_quick: Array, inverse: Array,
    out1: Array, out2: Array, out3: Array, out4: Array,
) -> None:  # fmt: skip
    """Computes the innovations of four columns (k,) at once, so that the processor need not wait for each."""
    m1, m2, m3, m4 = 0.0, 0.0, 0.0, 0.0
    q1, q2, q3, q4 = 0.0, 0.0, 0.0, 0.0
    for j in range(len(column1)):
        a, b, g, h, s = keep[j], keep_quick[j], of_memory[j], of_quick[j], inverse[j]
        m1, m2, m3, m4 = a * m1, a * m2, a * m3, a * m4
        q1, q2, q3, q4 = b * q1, b * q2, b * q3, b * q4
        e1, e2, e3, e4 = (
            column1[j] - m1 - q1,
            column2[j] - m2 - q2,
            column3[j] - m3 - q3,
            column4[j] - m4 - q4,
        )
        out1[j], out2[j], out3[j], out4[j] = e1 * s, e2 * s, e3 * s, e4 * s
        m1, m2, m3, m4 = m1 + g * e1, m2 + g * e2, m3 + g * e3, m4 + g * e4
        q1, q2, q3, q4 = q1 + h * e1, q2 + h * e2, q3 + h * e3, q4 + h * e4


@part
def _marginal(white: Array, design: Array, rank: int, nu: float, work: Array) -> float:
    """Returns the log of the integral over z of N(z; 0, I) prod_j t_nu(white_j - design[:, j] z).

    The curvature takes most of the time. It is computed anew only where steps with an earlier curvature
    converge too slowly.
    """
    gaussian = math.isinf(nu)
    z, best, gradient = np.zeros(len(design)), np.zeros(rank), np.empty(rank)
    gram, curvature, change = np.empty((len(design), len(design))), np.empty((rank, rank)), np.empty(rank)
    eps, pulled, bend = work[0], work[1], work[2]
    value, lowest, decrement = np.inf, np.inf, np.inf
    for step in range(MODE_SEARCH.steps + 1):
        if step == MODE_SEARCH.steps:
            for a in range(rank):
                z[a] = best[a]
        value = _energy(white, design, rank, z, nu, eps)
        if step == MODE_SEARCH.steps or (step == 1 and gaussian and _is_normal(z)):
            break  # in the second case the integrand is a normal density: one step is exact
        if value <= lowest + 1e-9:
            lowest = value
            for a in range(rank):
                best[a] = z[a]
        elif step >= MODE_SEARCH.patient:
            share = 0.0 if step == MODE_SEARCH.patient else MODE_SEARCH.back
            for a in range(rank):
                z[a] = best[a] + share * (z[a] - best[a])
            continue
        before = decrement
        for attempt in range(3):  # with an earlier curvature, with the present one, with a bound on it
            if attempt != 1:
                _weights(eps, nu, step, attempt == 0 and step >= MODE_SEARCH.reweighted, pulled, bend)
            if attempt == 0:
                _slope(design, z, pulled, gradient)
            if attempt > 0 or step == 0:
                _gram(design, bend, gram)
            sound = _factored(gram, z, curvature)
            decrement = _solved(curvature, gradient, change) if sound else np.inf
            slow = attempt == 0 and decrement > MODE_SEARCH.slow * before
            if step == 0 or gaussian or (sound and not slow):
                break
        if step > 0 and decrement < MODE_SEARCH.decrement:
            value -= 0.5 * decrement
            break
        for a in range(rank):
            z[a] += change[a]
    # Laplace needs the density's own curvature, not that of a bound or of an earlier point.
    for attempt in range(0 if gaussian else 2):
        _weights(eps, nu, MODE_SEARCH.steps, attempt == 0, pulled, bend)
        _gram(design, bend, gram)
        if _factored(gram, z, curvature):
            break
    for a in range(rank):
        value += math.log(curvature[a, a])
    return len(white) * _log_norm(nu) - value


@part
def _is_normal(z: Array) -> bool:
    """Returns whether the prior of the surrogate's error is a normal density at z."""
    near = True
    for a in range(len(z)):
        near = near and abs(z[a]) <= ERROR_PRIOR.farthest
    return near


@part
def _log_norm(nu: float) -> float:
    if math.isinf(nu):
        return -0.5 * math.log(2.0 * math.pi)
    return math.lgamma(0.5 * (nu + 1.0)) - math.lgamma(0.5 * nu) - 0.5 * math.log(nu * math.pi)


@part
def _energy(white: Array, design: Array, rank: int, z: Array, nu: float, eps: Array) -> float:
    """Returns minus the log of the integrand, without constants, and fills `eps` (k,)."""
    k = len(white)
    square = 0.0
    for j in range(k):
        eps[j] = white[j]
    for a in range(rank):
        beyond = max(abs(z[a]) - ERROR_PRIOR.farthest, 0.0)
        square += z[a] * z[a] + ERROR_PRIOR.stiff * beyond * beyond
    for a in range(0, len(design) if square > 0.0 else 0, 4):
        g1, g2, g3, g4 = design[a], design[a + 1], design[a + 2], design[a + 3]
        for j in range(k):
            eps[j] -= g1[j] * z[a] + g2[j] * z[a + 1] + g3[j] * z[a + 2] + g4[j] * z[a + 3]
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


@part
def _weights(eps: Array, nu: float, step: int, newton: bool, pulled: Array, bend: Array) -> None:
    """Fills the terms (k,) of the gradient, `pulled`, and of the curvature, `bend`.

    They are eps and 1 in the first step and for Gaussian noise.
    """
    if step == 0 or math.isinf(nu):
        for j in range(len(eps)):
            pulled[j], bend[j] = eps[j], 1.0
        return
    for j in range(len(eps)):
        square = eps[j] * eps[j]
        weight = (nu + 1.0) / (nu + square)
        pulled[j] = weight * eps[j]
        bend[j] = weight * (nu - square) / (nu + square) if newton else weight


@part
def _slope(design: Array, z: Array, pulled: Array, gradient: Array) -> None:
    """Fills `gradient` with G' pulled - z, and with the stiffer prior's pull beyond three sd."""
    for a in range(len(gradient)):
        row, total = design[a], 0.0
        for j in range(len(pulled)):
            total += row[j] * pulled[j]
        beyond = max(abs(z[a]) - ERROR_PRIOR.farthest, 0.0)
        gradient[a] = total - z[a] - math.copysign(ERROR_PRIOR.stiff * beyond, z[a])


@part
def _gram(design: Array, bend: Array, gram: Array) -> None:
    """Fills the lower triangle of G' diag(bend) G, eight entries at once."""
    k = len(bend)
    for a in range(0, len(gram), 2):
        upper, under = design[a], design[a + 1]
        for b in range(0, a + 2, 4):
            g1, g2, g3, g4 = design[b], design[b + 1], design[b + 2], design[b + 3]
            first, second, third, fourth = 0.0, 0.0, 0.0, 0.0
            fifth, sixth, seventh, eighth = 0.0, 0.0, 0.0, 0.0
            for j in range(k):
                left, right = upper[j] * bend[j], under[j] * bend[j]
                first += left * g1[j]
                second += left * g2[j]
                third += left * g3[j]
                fourth += left * g4[j]
                fifth += right * g1[j]
                sixth += right * g2[j]
                seventh += right * g3[j]
                eighth += right * g4[j]
            gram[a, b], gram[a, b + 1], gram[a, b + 2], gram[a, b + 3] = first, second, third, fourth
            gram[a + 1, b], gram[a + 1, b + 1] = fifth, sixth
            gram[a + 1, b + 2], gram[a + 1, b + 3] = seventh, eighth


@part
def _factored(gram: Array, z: Array, lower: Array) -> bool:
    """Fills `lower` with the Cholesky factor of the gram matrix plus the prior's curvature.

    Returns False where there is no such factor.
    """
    for a in range(len(lower)):
        for b in range(a + 1):
            total = gram[a, b]
            if a == b:
                total += 1.0 + ERROR_PRIOR.stiff if abs(z[a]) > ERROR_PRIOR.farthest else 1.0
            for c in range(b):
                total -= lower[a, c] * lower[b, c]
            if a != b:
                lower[a, b] = total / lower[b, b]
            elif total > 0.0:
                lower[a, a] = math.sqrt(total)
            else:
                return False
    return True


@part
def _solved(lower: Array, gradient: Array, change: Array) -> float:
    """Fills `change` with matrix^-1 gradient by the Cholesky factor; returns gradient' matrix^-1 gradient."""
    rank, norm = len(change), 0.0
    for a in range(rank):
        total = gradient[a]
        for b in range(a):
            total -= lower[a, b] * change[b]
        change[a] = total / lower[a, a]
        norm += change[a] * change[a]
    for a in range(rank - 1, -1, -1):
        for b in range(a + 1, rank):
            change[a] -= lower[b, a] * change[b]
        change[a] /= lower[a, a]
    return norm
