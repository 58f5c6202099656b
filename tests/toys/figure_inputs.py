"""Inputs of figures: a noisy recording of the closed-form model, its bins, draws, a curved surface."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from toys.closed_form_model import EDGES_S, MOTION, SPACE, toy_bin_means, toy_force

from bayeskin.types import BinnedForce, Phase, Recording

TRUTH = np.array([1.2e5, 1.8e4, 3e-14, 4e-13, 300.0])
EDGES = EDGES_S[::4]
BINS = len(EDGES) - 1
PHASES = tuple(
    Phase(kind, cycle, start, end)
    for kind, cycle, start, end in [
        ("rest", 0, 0.0, 5.0), ("load", 1, 5.0, 15.0), ("hold", 1, 15.0, 45.0), ("unload", 1, 45.0, 55.0),
        ("rest", 1, 55.0, 65.0), ("load", 2, 65.0, 75.0), ("hold", 2, 75.0, 105.0),
        ("unload", 2, 105.0, 115.0), ("rest", 2, 115.0, 130.0),
    ]
)  # fmt: skip
TIME_S = 0.5 * (EDGES[1:] + EDGES[:-1])
DISPLACEMENT_M = MOTION.at(TIME_S)
FORCE_N = 1e-3 * toy_bin_means(TRUTH, EDGES)[0]


def noisy_bins() -> BinnedForce:
    """The force in bins with white noise of 6 mN."""
    starts = np.array([p.start_s for p in PHASES])
    phase = np.searchsorted(starts, TIME_S, side="right") - 1
    noisy = FORCE_N + 0.006 * np.random.default_rng(2).normal(size=BINS)
    return BinnedForce(EDGES, noisy, np.full(BINS, 0.006**2), np.full(BINS - 1, 0.3), phase, PHASES)


BINNED = noisy_bins()


def noisy_recording() -> Recording:
    """The force at 50 Hz with white noise of 20 mN."""
    time_s = np.arange(0.0, 130.0, 0.02)
    noise = 0.02 * np.random.default_rng(3).normal(size=len(time_s))
    return Recording(time_s, MOTION.at(time_s), 1e-3 * toy_force(TRUTH, time_s)[0] + noise, "arm", "0" * 64)


RECORDING = noisy_recording()


def drawn_points() -> np.ndarray:
    """2,000 points: E_c, E_s and k_s narrow and correlated, k_c and p_init spread over the prior."""
    rng = np.random.default_rng(4)
    unit = rng.random((2000, 5))
    ridge = rng.normal(size=2000)
    unit[:, 0] = 0.5 + 0.02 * ridge
    unit[:, 1] = 0.5 - 0.04 * ridge + 0.005 * rng.normal(size=2000)
    unit[:, 3] = 0.6 + 0.05 * rng.normal(size=2000)
    return SPACE.from_unit(unit)


DRAWS = drawn_points()


def labels(figure: Figure) -> list[str]:
    return [text for ax in figure.axes for text in (ax.get_xlabel(), ax.get_ylabel()) if text]


def headline(figure: Figure) -> str:
    return figure.get_suptitle().replace("\n", " ")


def drawn(figure: Figure) -> Figure:
    figure.draw_without_rendering()
    return figure


def surface() -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(np.linspace(0, 0.105, 8), np.linspace(0, 0.084, 7), indexing="ij")
    points = np.stack([x, 0.058 * np.sin(y / 0.058), 0.058 * np.cos(y / 0.058)], axis=-1).reshape(-1, 3)
    node = np.arange(56).reshape(8, 7)
    quads = np.stack([node[:-1, :-1], node[1:, :-1], node[1:, 1:], node[:-1, 1:]], axis=-1).reshape(-1, 4)
    return np.stack([points, points + np.array([1e-3, 0, 0])]), quads
