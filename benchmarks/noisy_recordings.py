"""Makes recordings with the full model and noise, for benchmarks that infer them."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import lfilter

from bayeskin import storage
from bayeskin.finite_element import ModelSpec, simulate
from bayeskin.types import Array, PadMotion, Recording

TRUTH = {"E_c": 300e3, "E_s": 20e3, "k_c": 3e-14, "k_s": 2e-13, "p_init": 300.0}
RATE_HZ = 20.0
WHITE_N, SLOW_N, SLOW_S = 4e-3, 2e-3, 0.5  # sd of white noise, sd and correlation time of slow noise


def random_skin(rng: np.random.Generator, spread: float) -> dict[str, float]:
    """Returns the parameters of a random skin about `TRUTH`, in SI units.

    The initial pressure is that of `TRUTH`. The logarithms of the others have the sd `spread`.
    """
    return {
        name: value if name == "p_init" else float(value * np.exp(spread * rng.standard_normal()))
        for name, value in TRUTH.items()
    }


def correlated_noise(rng: np.random.Generator, count: int) -> Array:
    """Returns white and slow noise (count,) [N] for `count` samples."""
    correlation = np.exp(-1.0 / (RATE_HZ * SLOW_S))
    slow = lfilter([SLOW_N * np.sqrt(1.0 - correlation**2)], [1.0, -correlation], rng.standard_normal(count))
    return np.asarray(WHITE_N * rng.standard_normal(count) + slow)


def save_noisy_recording(
    file: Path, rng: np.random.Generator, motion: PadMotion, theta: Mapping[str, float]
) -> None:
    """Saves a recording of the full model's force with noise; ends the program if the model fails."""
    simulation = simulate(ModelSpec(), motion, theta)
    if simulation.status != "ok":
        raise SystemExit(simulation.message)
    time_s = np.arange(0.0, motion.time_s[-1] + 0.5 / RATE_HZ, 1.0 / RATE_HZ)
    force_n = simulation.at(time_s) + correlated_noise(rng, len(time_s))
    sha256 = hashlib.sha256(force_n.tobytes()).hexdigest()
    storage.save(file, Recording(time_s, motion.at(time_s), force_n, file.stem, sha256))


def inside_intervals(
    posterior: Mapping[str, Mapping[str, Any]], theta: Mapping[str, float]
) -> list[list[str]]:
    """Returns a table row of each parameter: true value, 90 % interval, and whether it contains the value."""
    return [
        [
            name, *(f"{value:.4g}" for value in (theta[name], p["low_90"], p["high_90"])),
            "yes" if p["low_90"] <= theta[name] <= p["high_90"] else "no",
        ]
        for name, p in posterior.items() if name in theta
    ]  # fmt: skip
