"""Made-up recordings with a known truth: a smooth force, and noise, spikes and steps laid on it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from bayeskin.recordings import read_recording
from bayeskin.types import PadMotion, Recording

INTERVAL_S = 0.01
CORNERS_S = np.array([0.0, 5.03, 15.03, 45.41, 55.41, 65.0, 75.0, 105.27, 115.27, 130.0])
MOTION = PadMotion(CORNERS_S, 1e-3 * np.array([0.0, 0.0, 9.0, 9.0, 0.0, 0.0, 9.0, 9.0, 0.0, 0.0]))
KINDS = ["rest", "load", "hold", "unload", "rest", "load", "hold", "unload", "rest"]
TIME_S = INTERVAL_S * np.arange(13001)


def supplement(name: str) -> Path:
    """A file of the article's supplement; skips where there is none, fails where it is incomplete."""
    root = os.environ.get("BAYESKIN_SUPPLEMENT")
    if not root:
        pytest.skip("BAYESKIN_SUPPLEMENT is not set: the article's supplement is not at hand")
    path = Path(root) / name
    assert path.is_file(), f"BAYESKIN_SUPPLEMENT is set but has no {name}"
    return path


@cache
def article_recording() -> Recording:
    """The article's recording, read once a session."""
    return read_recording(supplement("data/Healthy_skin.xlsx"))


def true_force(time_s: np.ndarray = TIME_S, motion: PadMotion = MOTION) -> np.ndarray:
    """Force [N]: a J-shaped elastic part and one that relaxes in 4 s, up to 0.4 N."""
    u = motion.at(time_s) / motion.displacement_m.max()
    rate = np.gradient(u, time_s)
    step = float(time_s[1] - time_s[0])
    relaxing = lfilter([step], [1.0, -np.exp(-step / 4.0)], rate)
    return 0.2 * u * (0.5 + 0.5 * u**2) + 0.12 * relaxing


def quantised(values: np.ndarray, step: float) -> np.ndarray:
    return np.round(values / step) * step


def coloured(rng: np.random.Generator, size: int, white_n: float, slow_n: float, time_s: float) -> np.ndarray:
    """White noise plus a stationary AR(1) of sd slow_n and correlation time time_s."""
    a = np.exp(-INTERVAL_S / time_s)
    start = 20 * int(time_s / INTERVAL_S + 1)
    slow = lfilter([1.0], [1.0, -a], rng.normal(size=size + start) * slow_n * np.sqrt(1 - a * a))[start:]
    return white_n * rng.normal(size=size) + slow


def recording(force_n: np.ndarray, motion: PadMotion = MOTION, time_s: np.ndarray = TIME_S) -> Recording:
    """Returns what an instrument writes: displacement to 0.01 mm, force to 1 mN."""
    return Recording(time_s, quantised(motion.at(time_s), 1e-5), quantised(force_n, 1e-3), "made", "")


def with_spikes(
    rng: np.random.Generator, force_n: np.ndarray, starts: Sequence[int], least_n: float
) -> np.ndarray:
    """One-sided spikes of three falling samples, least_n high and more."""
    out = np.array(force_n)
    for start, height in zip(starts, least_n + rng.exponential(0.03, len(starts)), strict=True):
        out[start : start + 3] += height * np.array([1.0, 0.6, 0.2])
    return out
