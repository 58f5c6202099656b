"""What the likelihood takes a recording's noise to be: its parameters, its order in time, its draws.

The noise e of the bins is a Markov chain in time. With sd_j the sampled sd of bin j's phase kind, v_j
the variance that the binned data carry themselves, d_j the surrogate's diagonal and c_j the correlation
that neighbouring bins' own noise carries,

    s_j^2 = sd_j^2 + v_j + d_j                                                (variance of bin j)
    rho_j = (sd_{j-1} sd_j exp(-dt_j / tau) + c_j sqrt(v_{j-1} v_j)) / (s_{j-1} s_j)
    eps_j = (e_j / s_j - rho_j e_{j-1} / s_{j-1}) / sqrt(1 - rho_j^2)         (innovation)

and the innovations are independent Student-t of `nu_noise` degrees of freedom and unit *scale*. sd_j is
hence the sd of the Gaussian core: the sd itself as nu_noise grows, and finite meaning at nu_noise = 2.
Without v and d this is the Ornstein-Uhlenbeck process at the bins' own times, so unequal and omitted
bins need no special case; with them, the variances and the covariances of neighbours stay exact and the
rest follows from the Markov property (the completion of largest entropy; Dempster 1972, Biometrics
28:157). A chain starts anew in each fit window.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from bayeskin.errors import InputError
from bayeskin.types import (
    Array,
    BinnedForce,
    NDArray,
    Parameter,
    ParameterSpace,
    PhaseKind,
    _FreezesArrays,
)

KINDS: tuple[PhaseKind, ...] = ("rest", "load", "hold", "unload")
Windows = Sequence[tuple[float, float]]
_SOURCE = "weakly informative: spans what load cells and living skin show"


@dataclass(frozen=True)
class NoisePriors:
    """Bounds of the log-uniform priors on the noise: sd [N], correlation time [s], tail index."""

    sd_n: tuple[float, float] = (1e-4, 0.3)
    tau_s: tuple[float, float] = (0.1, 100.0)
    nu: tuple[float, float] = (2.0, 100.0)


@dataclass(frozen=True)
class NoiseChain(_FreezesArrays):
    """The bins that enter a likelihood, in time order, with what does not depend on any parameter.

    All (k,): `bins` index into the recording's bins; `force_n`; `variance_n2` own variance v;
    `covariance_n2` with the bin before it, c sqrt(v v); `gap_s` time since the bin before;
    `starts` True where a chain begins; `kind` index into `kinds`.
    """

    bins: NDArray[np.int64]
    force_n: Array
    variance_n2: Array
    covariance_n2: Array
    gap_s: Array
    starts: NDArray[np.bool_]
    kind: NDArray[np.int64]
    kinds: tuple[PhaseKind, ...]


def noise_space(kinds: Sequence[PhaseKind], priors: NoisePriors | None = None) -> ParameterSpace:
    """Parameters of the noise: one sd a phase kind, then `tau_noise` [s] and `nu_noise`, all log-uniform."""
    priors = priors or NoisePriors()
    sds = [
        Parameter(f"sd_{kind}", "N", *priors.sd_n, "log-uniform", f"noise sd while pads {kind}", _SOURCE)
        for kind in kinds
    ]
    tau = Parameter("tau_noise", "s", *priors.tau_s, "log-uniform", "correlation time of the noise", _SOURCE)
    nu = Parameter("nu_noise", "1", *priors.nu, "log-uniform", "tail index of the noise", _SOURCE)
    return ParameterSpace((*sds, tau, nu))


def bins_in_windows(binned: BinnedForce, windows: Windows | None) -> NDArray[np.int64]:
    """Window index (m,) of each bin that lies wholly in it and has a finite force, else -1.

    Without windows all finite bins belong to window 0. Raises InputError on windows that are reversed,
    overlap or are out of order.
    """
    usable = np.isfinite(binned.force_n) & np.isfinite(binned.variance_n2)
    if windows is None:
        return np.where(usable, 0, -1).astype(np.int64)
    inside = np.full(len(binned.force_n), -1, dtype=np.int64)
    last = -np.inf
    slack = 1e-9 * float(np.ptp(binned.edges_s))
    for index, (start, end) in enumerate(windows):
        if not (last <= start < end):
            raise InputError(f"fit window {index}", f"{start}..{end} s", "windows in order, none overlapping")
        last = end
        within = (binned.edges_s[:-1] >= start - slack) & (binned.edges_s[1:] <= end + slack)
        inside[within & usable] = index
    return inside


def noise_chain(binned: BinnedForce, windows: Windows | None = None, omit: int | None = None) -> NoiseChain:
    """The chain through the bins of `windows`, or all; `omit` leaves out one phase (index) as a gap.

    Raises InputError when no bin is left or a variance is negative.
    """
    window = bins_in_windows(binned, windows)
    kinds = _kinds(binned, np.flatnonzero(window >= 0))
    keep = window >= 0 if omit is None else (window >= 0) & (binned.phase != omit)
    bins = np.flatnonzero(keep)
    if not len(bins):
        raise InputError("fit windows", "no bin of the recording inside them", "at least one bin")
    variance = binned.variance_n2[bins]
    if np.any(variance < 0):
        raise InputError("binned force", "a negative variance", "variances of at least 0")
    starts = np.concatenate([[True], np.diff(window[bins]) != 0])
    # A product of neighbours' correlations bridges omitted bins, as a Markov chain's does.
    neighbour = np.clip(np.nan_to_num(binned.correlation), -0.999, 0.999)
    bridge = [np.prod(neighbour[a:b]) for a, b in pairwise(bins)]
    covariance = np.zeros(len(bins))
    covariance[1:] = np.array(bridge) * np.sqrt(variance[1:] * variance[:-1])
    of_kind = [kinds.index(binned.phases[p].kind) for p in binned.phase[bins]]
    return NoiseChain(
        bins=bins.astype(np.int64),
        force_n=binned.force_n[bins],
        variance_n2=variance,
        covariance_n2=np.where(starts, 0.0, covariance),
        # Equal gaps are equal to the last bit then, and share one exponential.
        gap_s=np.round(np.diff(binned.time_s[bins], prepend=binned.time_s[bins[0]]), 12),
        starts=starts,
        kind=np.array(of_kind, dtype=np.int64),
        kinds=kinds,
    )


def _kinds(binned: BinnedForce, bins: NDArray[np.int64]) -> tuple[PhaseKind, ...]:
    present = {binned.phases[p].kind for p in binned.phase[bins]}
    return tuple(kind for kind in KINDS if kind in present)


def scales(chain: NoiseChain, noise: Array, diagonal: Array) -> tuple[Array, Array]:
    """s (n, k) [N] and rho (n, k) of the module's equations; rho is 0 where a chain starts.

    noise (n, q): columns of `noise_space(chain.kinds)`; diagonal (n, k) the surrogate's [N^2].
    """
    sd = noise[:, chain.kind]
    scale = np.sqrt(sd**2 + chain.variance_n2 + diagonal)
    covariance = np.zeros_like(scale)
    decay = np.exp(-chain.gap_s[1:] / noise[:, -2:-1])
    covariance[:, 1:] = sd[:, 1:] * sd[:, :-1] * decay + chain.covariance_n2[1:]
    rho = covariance
    rho[:, 1:] /= scale[:, 1:] * scale[:, :-1]
    rho[:, chain.starts] = 0.0
    return scale, rho


def innovations(chain: NoiseChain, noise: Array, diagonal: Array, columns: Array) -> Array:
    """eps (k, n) of the module's equations, of each of `columns` (k, n) [N]; noise (q,), diagonal (k,)."""
    scale, rho = (one[0, :, None] for one in scales(chain, noise[None], diagonal[None]))
    unit = columns / scale
    before = np.concatenate([np.zeros((1, columns.shape[1])), unit[:-1]])
    return np.asarray((unit - rho * before) / np.sqrt(1.0 - rho**2))


def draw_noise(chain: NoiseChain, noise: Array, diagonal: Array, rng: np.random.Generator) -> Array:
    """Noise [N] (n, k) drawn from the chain at n noise parameter vectors (n, q)."""
    scale, rho = scales(chain, noise, diagonal)
    innovation = rng.standard_t(noise[:, -1:], size=scale.shape)
    unit = np.empty_like(scale)
    unit[:, 0] = innovation[:, 0]
    for j in range(1, scale.shape[1]):
        unit[:, j] = rho[:, j] * unit[:, j - 1] + np.sqrt(1.0 - rho[:, j] ** 2) * innovation[:, j]
    return scale * unit
