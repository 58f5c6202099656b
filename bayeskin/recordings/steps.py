"""Finds steps of the load cell's zero: sudden, lasting shifts of the force inside a phase.

The detector is a linear filter of the force. At each moment it takes the mean over the half second after the
moment minus the mean over the half second before it. It then subtracts the part that the slope on both sides
explains. The sd of the filter's output under the noise is known, but a load cell also drifts. The unit of
significance is therefore this sd, or the spread of the filter's output over the phase without the step, if
that is larger. A step is an output beyond a threshold that noise alone exceeds once in a hundred recordings.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.ndimage import maximum_filter1d, minimum_filter1d
from scipy.stats import norm

from bayeskin.recordings.correlation import NoiseShape, weighted_covariance
from bayeskin.types import Array, Jumps


@dataclass(frozen=True)
class StepSettings:
    """Settings of the search for steps and of the limits of jumps.

    gap_s : time [s] that is left out beside a step or jump, since neither is infinitely fast

    Steps
    family_wise : probability that noise alone shows any step in a whole recording
    window_s : time [s] over which the force is averaged on either side of a moment
    most : largest number of steps in one phase

    Jumps
    finest_s : approximate least time [s] between the samples that are used
    beside_s : time [s] on either side of a moment whose samples are used
    beyond, times : the samples refute a jump that exceeds the estimated jump both by `beyond` sd and by the
        factor `times`
    """

    gap_s: float = 0.05
    family_wise: float = 0.01
    window_s: float = 0.5
    most: int = 50
    finest_s: float = 0.01
    beside_s: float = 1.0
    beyond: float = 3.0
    times: float = 2.0


@dataclass(frozen=True)
class Step:
    """A step of the load cell's zero: its time [s], its size [N], and its size in sds of the estimate."""

    time_s: float
    size_n: float
    significance: float


def step_filter(interval_s: float, settings: StepSettings = StepSettings()) -> Array:
    """Returns weights (odd size,) that give the size of a step in their middle, and 0 on a straight line."""
    window = max(3, round(settings.window_s / interval_s))
    gap = max(1, round(settings.gap_s / interval_s))
    near = np.full(window, 1.0 / window)
    reach = (window + 2 * gap + 1) / window  # near windows' distance over the distance from near to far
    right = np.concatenate([np.zeros(gap), (1 + 0.5 * reach) * near, -0.5 * reach * near])
    return np.concatenate([-right[::-1], [0.0], right])


def find_steps(
    time_s: Array, force_n: Array, sd_n: float, shape: NoiseShape, tests: int,
    settings: StepSettings = StepSettings(),
) -> tuple[Step, ...]:  # fmt: skip
    """Returns the steps in one phase's force without spikes (n,), in time order.

    `sd_n` and `shape` describe the noise of an undisturbed phase. `tests` is the number of samples of the
    whole recording, to which the probability of a false step refers. The search leaves out 1.05 s at both
    ends of the phase.
    """
    interval_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 1.0
    weights = step_filter(interval_s, settings)
    half = len(weights) // 2
    if len(force_n) <= 2 * len(weights):
        return ()
    correlation = shape.at(interval_s * np.arange(len(weights)))
    expected = sd_n * float(np.sqrt(weighted_covariance(weights, weights, correlation)))
    threshold = float(norm.isf(0.5 * settings.family_wise / tests))
    window = max(3, round(settings.window_s / interval_s))
    corrected, steps = force_n.copy(), []
    jump = np.convolve(corrected, weights[::-1], mode="valid")
    available = np.ones(len(jump), dtype=bool)
    for _ in range(settings.most):
        peak = int(np.argmax(np.where(available, np.abs(jump), 0.0)))
        first = _first_sample_after_step(corrected, peak + half, window)
        size = float(jump[np.clip(first - half, 0, len(jump) - 1)])
        height = abs(float(jump[peak]))
        corrected[first:] -= size
        jump = np.convolve(corrected, weights[::-1], mode="valid")
        unit = max(expected, 1.4826 * float(np.median(np.abs(jump - np.median(jump)))))
        if not available[peak] or height <= threshold * unit:
            break
        available[max(0, peak - window) : peak + window + 1] = False
        steps.append(Step(float(time_s[first]), size, height / unit))
    return tuple(sorted(steps, key=lambda step: step.time_s))


def allowed_jumps(
    time_s: Array, force_n: Array, sd_n: Array, shape: NoiseShape, settings: StepSettings = StepSettings()
) -> Jumps:
    """Returns the jumps that one phase's force without spikes (n,) allows, with noise of local sd_n (n,).

    Generalised least squares fits a parabola plus a jump over one second on either side. The fit leaves a
    gap, because a jump may take some samples. The limits include the jumps estimated up to half a second
    before and after, because the time of a jump is not known more precisely. Near the phase's ends the force
    itself bends, so no jump is judged there. If the samples are closer than `finest_s`, only some of them
    are used.
    """
    interval_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 1.0
    every = max(1, int(settings.finest_s / interval_s))
    time_s, force_n, sd_n, interval_s = time_s[::every], force_n[::every], sd_n[::every], every * interval_s
    half = max(5, round(settings.beside_s / interval_s))
    lowest, highest = np.full(len(time_s), -np.inf), np.full(len(time_s), np.inf)
    if len(force_n) > 4 * half:
        gap = max(1, round(settings.gap_s / interval_s))
        weights, share = _jump_filter(half, gap, shape.at(interval_s * np.arange(2 * half)))
        jump = np.convolve(force_n, weights[::-1], mode="valid")  # element i is the jump at sample i + half
        unit, enlarged = settings.beyond * share * sd_n[half : len(sd_n) - half + 1], settings.times * jump
        low, high = np.minimum(jump - unit, enlarged), np.maximum(jump + unit, enlarged)
        reach = half // 2
        judged = slice(half + reach, len(time_s) - half - reach + 1)
        lowest[judged] = minimum_filter1d(np.minimum(low, 0.0), 2 * reach + 1)[reach : len(low) - reach]
        highest[judged] = maximum_filter1d(np.maximum(high, 0.0), 2 * reach + 1)[reach : len(high) - reach]
    return Jumps(time_s, lowest, highest)


def _jump_filter(half: int, gap: int, correlation: Array) -> tuple[Array, float]:
    """Returns weights (2 half,) that estimate a jump, and the sd of the estimate over the sd of the noise.

    The jump lies at the first sample of the second half. The `gap` samples before it and the `gap` samples
    from it on have zero weight.
    """
    line = np.linspace(-1.0, 1.0, 2 * half)
    # Each sample in the gap has a free value of its own, so it does not affect the estimate.
    between = np.eye(2 * half, 2 * gap, gap - half)
    design = np.column_stack([line > 0.0, np.vander(line, 3), between])
    white = solve_toeplitz(correlation, design)
    covariance = np.linalg.inv(design.T @ white)
    return np.asarray(covariance[0] @ white.T), float(np.sqrt(covariance[0, 0]))


def _first_sample_after_step(values: Array, near: int, window: int) -> int:
    """Returns the index of the first sample after the step near `near`.

    It is the least-squares fit of a line plus one step.
    """
    start, stop = max(0, near - window), min(len(values), near + window)
    size = stop - start
    line = np.linalg.qr(np.vander(np.linspace(-1, 1, size), 2))[0]
    splits = np.arange(size // 4, size - size // 4)
    steps = (np.arange(size) >= splits[:, None]).astype(float)
    steps -= (steps @ line) @ line.T
    gain = (steps @ values[start:stop]) ** 2 / np.sum(steps**2, axis=1)
    return int(start + splits[np.argmax(gain)])
