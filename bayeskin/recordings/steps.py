"""Steps of the load cell's zero: sudden lasting shifts of the force inside a phase.

The mean of half a second after each moment minus that of half a second before it, less what the slope on
both sides accounts for, is a linear filter of the force. Its sd under the noise is known, but a load
cell also wanders; that sd, or where it is larger the filter's own spread over the phase once the step is
taken out, is one unit, and a step is what passes the level that noise passes once in a hundred recordings.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.ndimage import maximum_filter1d, minimum_filter1d
from scipy.stats import norm

from bayeskin.recordings.correlation import NoiseShape, weighted_covariance
from bayeskin.types import Array, Jumps

FAMILY_WISE = 0.01  # probability that noise alone shows any step in a whole recording
_WINDOW_S = 0.5
_GAP_S = 0.05  # a step of the zero is not infinitely fast
_MOST = 50  # in one phase
_FINEST_S = 0.01  # between samples that are looked at for jumps
_BESIDE_S = 1.0  # of a moment, in which a jump is looked for
_BEYOND = 3.0  # sd by which a jump has to exceed what is seen, and
_TIMES = 2.0  # how often that, to be refuted


@dataclass(frozen=True)
class Step:
    """A step of the load cell's zero: when [s], by how much [N], and its size in sds of its estimate."""

    time_s: float
    size_n: float
    significance: float


def step_filter(interval_s: float) -> Array:
    """Weights (odd size,) that give a step's size at their middle, and zero on any straight line."""
    window = max(3, round(_WINDOW_S / interval_s))
    gap = max(1, round(_GAP_S / interval_s))
    near = np.full(window, 1.0 / window)
    reach = (window + 2 * gap + 1) / window  # distance of the near windows in units of that of near to far
    right = np.concatenate([np.zeros(gap), (1 + 0.5 * reach) * near, -0.5 * reach * near])
    return np.concatenate([-right[::-1], [0.0], right])


def find_steps(time_s: Array, force_n: Array, sd_n: float, shape: NoiseShape, tests: int) -> tuple[Step, ...]:
    """Steps in one phase's force without spikes (n,), in time order.

    sd_n and shape are the noise of an undisturbed phase, `tests` the samples of the whole recording, over
    which the probability of a false step is kept. None is looked for within 1.05 s of the phase's ends.
    """
    interval_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 1.0
    weights = step_filter(interval_s)
    half = len(weights) // 2
    if len(force_n) <= 2 * len(weights):
        return ()
    correlation = shape.at(interval_s * np.arange(len(weights)))
    expected = sd_n * float(np.sqrt(weighted_covariance(weights, weights, correlation)))
    threshold = float(norm.isf(0.5 * FAMILY_WISE / tests))
    window = max(3, round(_WINDOW_S / interval_s))
    left, steps = force_n.copy(), []
    jump = np.convolve(left, weights[::-1], mode="valid")
    free = np.ones(len(jump), dtype=bool)
    for _ in range(_MOST):
        at = int(np.argmax(np.where(free, np.abs(jump), 0.0)))
        first = _first_after(left, at + half, window)
        size = float(jump[np.clip(first - half, 0, len(jump) - 1)])
        height = abs(float(jump[at]))
        left[first:] -= size
        jump = np.convolve(left, weights[::-1], mode="valid")
        unit = max(expected, 1.4826 * float(np.median(np.abs(jump - np.median(jump)))))
        if not free[at] or height <= threshold * unit:
            break
        free[max(0, at - window) : at + window + 1] = False
        steps.append(Step(float(time_s[first]), size, height / unit))
    return tuple(sorted(steps, key=lambda step: step.time_s))


def allowed_jumps(time_s: Array, force_n: Array, sd_n: Array, shape: NoiseShape) -> Jumps:
    """Returns the jumps that one phase's force without spikes (n,) allows, with noise of local sd_n (n,).

    A jump beside a parabola, by generalised least squares over a second to either side, with a gap for a jump
    that takes some samples. Those seen half a second before and after count too, since a jump's time is not
    known better. Near the phase's ends, where the force itself bends, none is judged. Of samples that lie
    closer than `_FINEST_S` some are looked at.
    """
    interval_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 1.0
    every = max(1, int(_FINEST_S / interval_s))
    time_s, force_n, sd_n, interval_s = time_s[::every], force_n[::every], sd_n[::every], every * interval_s
    half = max(5, round(_BESIDE_S / interval_s))
    lowest, highest = np.full(len(time_s), -np.inf), np.full(len(time_s), np.inf)
    if len(force_n) > 4 * half:
        gap = max(1, round(_GAP_S / interval_s))
        weights, share = _jump_filter(half, gap, shape.at(interval_s * np.arange(2 * half)))
        jump = np.convolve(force_n, weights[::-1], mode="valid")  # [i]: at sample i + half
        unit = _BEYOND * share * sd_n[half : len(sd_n) - half + 1]
        low, high = np.minimum(jump - unit, _TIMES * jump), np.maximum(jump + unit, _TIMES * jump)
        reach = half // 2
        judged = slice(half + reach, len(time_s) - half - reach + 1)
        lowest[judged] = minimum_filter1d(np.minimum(low, 0.0), 2 * reach + 1)[reach : len(low) - reach]
        highest[judged] = maximum_filter1d(np.maximum(high, 0.0), 2 * reach + 1)[reach : len(high) - reach]
    return Jumps(time_s, lowest, highest)


def _jump_filter(half: int, gap: int, correlation: Array) -> tuple[Array, float]:
    """Weights (2 half,) that give the jump at the first sample of the second half, and the sd of what they
    give, over the noise's; none lies on `gap` samples before and from there."""
    line = np.linspace(-1.0, 1.0, 2 * half)
    between = np.eye(2 * half, 2 * gap, gap - half)  # a value of its own each: it tells nothing
    design = np.column_stack([line > 0.0, np.vander(line, 3), between])
    white = solve_toeplitz(correlation, design)
    covariance = np.linalg.inv(design.T @ white)
    return np.asarray(covariance[0] @ white.T), float(np.sqrt(covariance[0, 0]))


def _first_after(values: Array, near: int, window: int) -> int:
    """Index of the first sample after the step near `near`: least squares of a line plus one step."""
    start, stop = max(0, near - window), min(len(values), near + window)
    size = stop - start
    line = np.linalg.qr(np.vander(np.linspace(-1, 1, size), 2))[0]
    splits = np.arange(size // 4, size - size // 4)
    steps = (np.arange(size) >= splits[:, None]).astype(float)
    steps -= (steps @ line) @ line.T
    gain = (steps @ values[start:stop]) ** 2 / np.sum(steps**2, axis=1)
    return int(start + splits[np.argmax(gain)])
