"""The noise model of a recording: its parameters, its correlation in time, and draws from it.

The noise of bin j is the sum of three parts:

    e_j = sd_j x_j + sqrt(v_j) w_j + sqrt(d_j) u_j ,

The first part is noise with a memory, which forgets within `tau_noise`; x is an Ornstein-Uhlenbeck process at
the bins' own times. Its sd is sampled, for each kind of phase or for all together. The second part is quicker
noise; w is a Markov chain. The binned data themselves state its variance v_j and the correlation c_j of
neighbours. The third part is the surrogate's diagonal, which is white. x and w have unit variance, and both
start anew in each fit window.

A Kalman filter over (x, w) turns the noise into innovations, each divided by its sd (Kalman 1960, J. Basic
Eng. 82:35). With Gaussian noise they are exactly independent and standard normal, for bins of any width and
with any gap. The model takes them as independent Student-t with `nu_noise` degrees of freedom and unit
*scale*. Hence sd_j is the sd of the Gaussian core. It equals the sd of the noise as nu_noise grows, and it
still has a finite meaning at nu_noise = 2.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numba as nb
import numpy as np
from numpy.typing import NDArray

from bayeskin.errors import InputError
from bayeskin.types import (
    PHASE_KINDS,
    Array,
    BinnedForce,
    FreezesArrays,
    Parameter,
    ParameterSpace,
)
from bayeskin.types.joint import own_name, plain_name, recording_at, recording_of

ALL = "noise"  # the kind of all phases where they share one sd
Windows = Sequence[tuple[float, float]]
_SOURCE = "weakly informative: spans what load cells and living skin show"


@dataclass(frozen=True)
class NoisePriors:
    """Bounds of the log-uniform priors on the noise: sd [N], correlation time [s], tail index.

    by_kind : whether each kind of phase has an sd of its own
    by_recording : whether each of several recordings has an sd of its own; all share memory and tails, which
        are the load cell's
    """

    sd_n: tuple[float, float] = (1e-4, 0.3)
    tau_s: tuple[float, float] = (0.1, 10.0)
    nu: tuple[float, float] = (2.0, 100.0)
    by_kind: bool = True
    by_recording: bool = True


@dataclass(frozen=True)
class NoiseChain(FreezesArrays):
    """The bins that enter a likelihood, in time order, with all values that do not depend on a parameter.

    All arrays are (k,). `bins` are indices of the recording's bins, and `force_n` are their forces.
    `variance_n2` is the variance v of the quicker noise, and `correlation` is its correlation c with the
    previous bin. `gap_s` is the time since the previous bin. `starts` is True where a chain begins. `kind` is
    an index into `kinds`.
    """

    bins: NDArray[np.int64]
    force_n: Array
    variance_n2: Array
    correlation: Array
    gap_s: Array
    starts: NDArray[np.bool_]
    kind: NDArray[np.int64]
    kinds: tuple[str, ...]


def noise_space(kinds: Sequence[str], priors: NoisePriors | None = None) -> ParameterSpace:
    """Returns log-uniform noise parameters: an sd [N] for each of `kinds`, `tau_noise` [s] and `nu_noise`."""
    priors = priors or NoisePriors()
    sds = [
        Parameter(
            f"sd_{kind}", "N", *priors.sd_n, "log-uniform",
            "noise sd" if plain_name(kind) == ALL else f"noise sd while pads {plain_name(kind)}", _SOURCE,
        )
        for kind in kinds
    ]  # fmt: skip
    tau = Parameter("tau_noise", "s", *priors.tau_s, "log-uniform", "correlation time of the noise", _SOURCE)
    nu = Parameter("nu_noise", "1", *priors.nu, "log-uniform", "tail index of the noise", _SOURCE)
    return ParameterSpace((*sds, tau, nu))


def bins_in_windows(binned: BinnedForce, windows: Windows | None) -> NDArray[np.int64]:
    """Returns for each bin (m,) the index of the window in which it lies completely, else -1.

    Bins whose force or variance is not finite get -1, too. Without windows all finite bins belong to window
    0. Raises InputError on windows that are reversed, overlap or are out of order.
    """
    usable = np.isfinite(binned.force_n) & np.isfinite(binned.variance_n2)
    if windows is None:
        return np.where(usable, 0, -1).astype(np.int64)
    inside = np.full(len(binned.force_n), -1, dtype=np.int64)
    last = -np.inf
    slack = 1e-9 * float(np.ptp(binned.edges_s))
    for index, (start, end) in enumerate(windows):
        if not (last <= start < end):
            raise InputError(
                f"fit window {index}",
                f"{start}..{end} s does not follow the window before it",
                "windows must be in order and must not overlap",
            )
        last = end
        within = (binned.edges_s[:-1] >= start - slack) & (binned.edges_s[1:] <= end + slack)
        inside[within & usable] = index
    return inside


def noise_chain(
    binned: BinnedForce, windows: Windows | None = None, omit: int | None = None, by_kind: bool = True,
    by_recording: bool = True,
) -> NoiseChain:  # fmt: skip
    """Returns the chain through the bins of `windows`, or through all bins.

    omit : index of a phase that is left out as a gap
    by_kind, by_recording : whether each kind of phase, and each of several recordings, has an sd of its own
    Raises InputError when no bin is left or a variance is negative.
    """
    window = bins_in_windows(binned, windows)
    recording = recording_at(binned.spans, binned.time_s)
    kind_of_bin = [
        own_name(binned.phases[p].kind if by_kind else ALL, int(r) if by_recording else 0)
        for p, r in zip(binned.phase, recording, strict=True)
    ]
    kinds = _ordered({kind_of_bin[i] for i in np.flatnonzero(window >= 0)})
    keep = window >= 0 if omit is None else (window >= 0) & (binned.phase != omit)
    bins = np.flatnonzero(keep)
    if not len(bins):
        raise InputError(
            "fit windows", "they contain no bin of the recording", "they must contain at least one"
        )
    variance = binned.variance_n2[bins]
    if np.any(variance < 0):
        raise InputError("binned force", "one of its variances is negative", "all must be at least 0")
    starts = np.concatenate([[True], (np.diff(window[bins]) != 0) | (np.diff(recording[bins]) != 0)])
    # In a Markov chain, the correlation across omitted bins is the product of the neighbours' correlations.
    neighbour = np.clip(np.nan_to_num(binned.correlation), -0.999, 0.999)
    bridge = np.array([0.0, *(np.prod(neighbour[a:b]) for a, b in pairwise(bins))])
    return NoiseChain(
        bins=bins.astype(np.int64),
        force_n=binned.force_n[bins],
        variance_n2=variance,
        correlation=np.where(starts, 0.0, bridge),
        # After rounding, equal gaps are equal to the last bit and share one exponential.
        gap_s=np.round(np.diff(binned.time_s[bins], prepend=binned.time_s[bins[0]]), 12),
        starts=starts,
        kind=np.array([kinds.index(kind_of_bin[i]) for i in bins], dtype=np.int64),
        kinds=kinds,
    )


def _ordered(kinds: set[str]) -> tuple[str, ...]:
    """Returns names of kinds in the order of the recordings, then of `PHASE_KINDS`."""
    order = (*PHASE_KINDS, ALL)
    return tuple(sorted(kinds, key=lambda kind: (recording_of(kind), order.index(plain_name(kind)))))


def filter_gains(
    sd: Array, variance: Array, diagonal: Array, decay: Array, correlation: Array, starts: NDArray[np.bool_]
) -> tuple[Array, Array, Array]:
    """Returns the Kalman gains [1/N] of x and of w at each innovation, and the innovation's sd [N].

    All arrays are (k,): the sd of the noise with a memory [N], the variances of the quicker noise and of the
    surrogate's diagonal [N^2], and the correlations of x (`decay`) and of w with the previous bin.
    """
    k = len(sd)
    of_memory, of_quick, scale = np.empty(k), np.empty(k), np.empty(k)
    var_x, cov, var_w = 1.0, 0.0, 1.0  # variances and covariance of x and w
    for j in range(k):
        a, c = decay[j], correlation[j]
        if starts[j]:
            var_x, cov, var_w = 1.0, 0.0, 1.0
        else:
            var_x, cov, var_w = 1.0 - a * a * (1.0 - var_x), a * c * cov, 1.0 - c * c * (1.0 - var_w)
        quick = math.sqrt(variance[j])
        first, second = sd[j] * var_x + quick * cov, sd[j] * cov + quick * var_w
        square = sd[j] * first + quick * second + diagonal[j]
        inverse = 1.0 / square
        of_memory[j], of_quick[j], scale[j] = first * inverse, second * inverse, math.sqrt(square)
        var_x -= first * of_memory[j]
        cov -= first * of_quick[j]
        var_w -= second * of_quick[j]
    return of_memory, of_quick, scale


@nb.njit(cache=True)
def _filtered(
    sd: Array, variance: Array, decay: Array, correlation: Array, starts: NDArray[np.bool_],
    gains: tuple[Array, Array, Array], columns: Array, forwards: bool,
) -> Array:  # fmt: skip
    """Returns the innovations of columns (k, n) [N] over their sd.

    If not `forwards`, the input is taken as such innovations; the result is the columns [N] that have them.
    """
    k, n = columns.shape
    of_memory, of_quick, scale = gains
    out, x, w = np.empty((k, n)), np.zeros(n), np.zeros(n)
    for j in range(k):
        quick = math.sqrt(variance[j])
        a, c = (0.0, 0.0) if starts[j] else (decay[j], correlation[j])
        for i in range(n):
            x[i] *= a
            w[i] *= c
            expected = sd[j] * x[i] + quick * w[i]
            if forwards:
                new = columns[j, i] - expected
                out[j, i] = new / scale[j]
            else:
                new = columns[j, i] * scale[j]
                out[j, i] = expected + new
            x[i] += of_memory[j] * new
            w[i] += of_quick[j] * new
    return out


_gains = nb.njit(cache=True)(filter_gains)


def _decay(chain: NoiseChain, noise: Array) -> Array:
    return np.asarray(np.exp(-chain.gap_s / noise[-2]))


def innovations(chain: NoiseChain, noise: Array, diagonal: Array, columns: Array) -> Array:
    """Returns the innovations of each of `columns` (k, n) [N] over their sd.

    noise (q,) has the columns of `noise_space(chain.kinds)`; diagonal (k,) is the surrogate's [N^2].
    """
    return _run_filter(chain, noise, diagonal, columns, True)


def _run_filter(chain: NoiseChain, noise: Array, diagonal: Array, columns: Array, forwards: bool) -> Array:
    sd, decay = noise[chain.kind], _decay(chain, noise)
    gains = _gains(sd, chain.variance_n2, diagonal, decay, chain.correlation, chain.starts)
    columns = np.ascontiguousarray(columns, dtype=float)
    return np.asarray(
        _filtered(sd, chain.variance_n2, decay, chain.correlation, chain.starts, gains, columns, forwards)
    )


def noise_covariance(chain: NoiseChain, noise: Array, diagonal: Array) -> Array:
    """Returns the covariance (k, k) [N^2] of the noise's Gaussian core, for arguments as in `innovations`."""
    sd, quick = noise[chain.kind], np.sqrt(chain.variance_n2)
    memory = sd[:, None] * _markov(chain, _decay(chain, noise)) * sd
    return np.asarray(memory + quick[:, None] * _markov(chain, chain.correlation) * quick + np.diag(diagonal))


def _markov(chain: NoiseChain, with_the_one_before: Array) -> Array:
    """Returns the correlation matrix (k, k) of a Markov chain."""
    step = np.where(chain.starts, 0.0, with_the_one_before)
    out = np.eye(len(step))
    for i in range(1, len(step)):
        out[i, :i] = step[i] * out[i - 1, :i]
    return out + np.tril(out, -1).T


def draw_noise(chain: NoiseChain, noise: Array, diagonal: Array, rng: np.random.Generator) -> Array:
    """Returns noise [N] (n, k) drawn at n noise parameter vectors (n, q); diagonal (n, k) is in N^2."""
    innovation = rng.standard_t(noise[:, -1:], size=diagonal.shape)
    rows = zip(noise, diagonal, innovation, strict=True)
    return np.stack([_run_filter(chain, q, d, t[:, None], False)[:, 0] for q, d, t in rows])
