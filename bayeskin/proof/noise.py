"""Noise like that of a real load cell on skin: white, correlated, and one-sided spikes.

Its make-up follows the article's recording, in round numbers: quiet rests, in holds as much noise
correlated over half a second as white, in ramps white noise of the drive; upward spikes, most in holds.
"""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from bayeskin.proof.protocol import EDGES_S, KINDS, RATE_HZ, kind_at
from bayeskin.types import Array

WHITE = {"rest": 1.0, "hold": 1.8, "load": 8.0, "unload": 6.0}  # sd at 20 Hz, each relative to the others
SLOW = {"rest": 0.1, "hold": 1.9, "load": 0.3, "unload": 0.3}
SLOW_S = 0.55
SPIKES_PER_S = {"rest": 0.02, "hold": 0.25, "load": 0.1, "unload": 0.01}
SPIKE_LEAST, SPIKE_MORE = 6.0, 8.0  # of the floor: the smallest, and the mean of what comes on top
FLOORS_N = (1.5e-3, 2.5e-3)  # between which a recording's floor is drawn


def floor_after(floor_n: float, from_s: float) -> float:
    """RMS of the noise of 0.5 s means [N] from a time on, where it is floor_n over the whole recording."""
    return floor_n * floor_unit(from_s) / floor_unit()


def floor_unit(from_s: float = 0.0) -> float:
    """RMS over the 0.5 s bins from a time on of the sd of their means, of noise with the sds of `WHITE` and
    `SLOW`."""
    middle = 0.5 * (EDGES_S[1:] + EDGES_S[:-1])
    middle = middle[middle > from_s]
    count = round((EDGES_S[1] - EDGES_S[0]) * RATE_HZ)
    lags = np.abs(np.subtract.outer(np.arange(count), np.arange(count))) / RATE_HZ
    shared = float(np.mean(np.exp(-lags / SLOW_S)))
    white, slow = _by_kind(WHITE, middle), _by_kind(SLOW, middle)
    return float(np.sqrt(np.mean(white**2 / count + slow**2 * shared)))


def noise(rng: np.random.Generator, time_s: Array, floor_n: float) -> Array:
    """Noise (n,) [N] at samples time_s (n,), spikes included, whose 0.5 s means have the RMS floor_n."""
    scale, n = floor_n / floor_unit(), len(time_s)
    keep = np.exp(-1.0 / (RATE_HZ * SLOW_S))
    start = round(20 * SLOW_S * RATE_HZ)
    slow = np.sqrt(1.0 - keep**2) * lfilter([1.0], [1.0, -keep], rng.standard_normal(n + start))[start:]
    smooth = scale * (
        _by_kind(WHITE, time_s) * rng.standard_normal(n) + _by_kind(SLOW, time_s) * np.asarray(slow)
    )
    height = floor_n * (SPIKE_LEAST + SPIKE_MORE * rng.exponential(size=n))
    return np.asarray(smooth + height * (rng.random(n) < _by_kind(SPIKES_PER_S, time_s) / RATE_HZ))


def _by_kind(values: dict[str, float], time_s: Array) -> Array:
    return np.array([values[kind] for kind in KINDS])[kind_at(time_s)]
