"""Draws noise like that of a real load cell on skin: white noise, correlated noise and one-sided spikes.

Its composition follows the article's recording, in round numbers. Rests are quiet. Holds have as much noise
that is correlated over half a second as white noise. Ramps have white noise of the drive. Spikes are upward,
and most of them are in holds.
"""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from bayeskin.proof.protocol import EDGES_S, KINDS, RATE_HZ, kind_at
from bayeskin.types import Array

WHITE = {"rest": 1.0, "hold": 1.8, "load": 8.0, "unload": 6.0}  # sd at 20 Hz, relative to each other
SLOW = {"rest": 0.1, "hold": 1.9, "load": 0.3, "unload": 0.3}
SLOW_S = 0.55
SPIKES_PER_S = {"rest": 0.02, "hold": 0.25, "load": 0.1, "unload": 0.01}
SPIKE_LEAST, SPIKE_MORE = 6.0, 8.0  # least height, and mean excess over it, in noise floors
FLOORS_N = (1.5e-3, 2.5e-3)  # bounds between which a recording's floor is drawn


def floor_after(floor_n: float, from_s: float) -> float:
    """Returns the RMS of the noise of 0.5 s means [N] from a time on.

    floor_n : this RMS over the whole recording [N]
    """
    return floor_n * floor_unit(from_s) / floor_unit()


def floor_unit(from_s: float = 0.0) -> float:
    """Returns the noise floor from a time on, for noise with the sds of `WHITE` and `SLOW`.

    It is the RMS, over the 0.5 s bins, of the sd of their means.
    """
    middle = 0.5 * (EDGES_S[1:] + EDGES_S[:-1])
    middle = middle[middle > from_s]
    count = round((EDGES_S[1] - EDGES_S[0]) * RATE_HZ)
    lags = np.abs(np.subtract.outer(np.arange(count), np.arange(count))) / RATE_HZ
    shared = float(np.mean(np.exp(-lags / SLOW_S)))
    white, slow = _by_kind(WHITE, middle), _by_kind(SLOW, middle)
    return float(np.sqrt(np.mean(white**2 / count + slow**2 * shared)))


def noise(rng: np.random.Generator, time_s: Array, floor_n: float) -> Array:
    """Returns noise (n,) [N] at samples time_s (n,), spikes included.

    Without spikes, the 0.5 s means of the noise have the RMS floor_n.
    """
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
