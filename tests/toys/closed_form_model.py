"""A closed-form stand-in for the full model, for tests of what stands above it: fast, smooth, known."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayeskin.types import PadMotion, Parameter, ParameterSpace, Simulation, frozen_array

SPACE = ParameterSpace(
    (
        Parameter("E_c", "Pa", 1e4, 2e6, "log-uniform", "Young's modulus of the cutis"),
        Parameter("E_s", "Pa", 1e3, 5e5, "log-uniform", "Young's modulus of the subcutis"),
        Parameter("k_c", "m^2", 1e-16, 1e-11, "log-uniform", "permeability of the cutis"),
        Parameter("k_s", "m^2", 1e-16, 1e-11, "log-uniform", "permeability of the subcutis"),
        Parameter("p_init", "Pa", -670.0, 2144.0, "uniform", "initial interstitial pressure"),
    )
)
MOTION = PadMotion(
    np.array([0.0, 5.0, 15.0, 45.0, 55.0, 65.0, 75.0, 105.0, 115.0, 130.0]),
    1e-3 * np.array([0.0, 0.0, 9.0, 9.0, 0.0, 0.0, 9.0, 9.0, 0.0, 0.0]),
)
EDGES_S = np.arange(0.0, 130.5, 0.5)


def toy_force(theta: np.ndarray, time_s: np.ndarray, motion: PadMotion = MOTION) -> np.ndarray:
    """Force [N] (n, len(time_s)) at theta (n, 5): a stretch curve times one relaxation; p_init inert."""
    theta = np.atleast_2d(theta)
    e_c, e_s, k_c, k_s = theta[:, :4].T
    stiffness = 0.4 * (e_c + 2.6 * e_s)  # N/m
    tau = np.clip(3e-8 / (k_s * e_s), 0.3, 300.0) ** 0.5 * 3.0
    share = 0.02 + 0.1 * e_s / (e_s + e_c) + 0.02 * np.tanh(np.log10(k_c * 1e14))
    fine = np.linspace(0.0, motion.time_s[-1], 2601)
    u = motion.at(fine)
    rate = np.gradient(u * (1.0 + 30.0 * u), fine)
    step = fine[1] - fine[0]
    decay = np.exp(-step / tau)
    memory = np.zeros((len(theta), len(fine)))
    for i in range(1, len(fine)):
        memory[:, i] = memory[:, i - 1] * decay + rate[i] * step * 0.5 * (1 + decay)
    force = stiffness[:, None] * ((1 - share)[:, None] * u * (1.0 + 30.0 * u) + share[:, None] * memory)
    return np.stack([np.interp(time_s, fine, row) for row in force])


def toy_bin_means(theta: np.ndarray, edges_s: np.ndarray = EDGES_S) -> np.ndarray:
    """Bin means [N] (n, m) of `toy_force`."""
    fine = edges_s[:-1, None] + np.linspace(0, 1, 11) * np.diff(edges_s)[:, None]
    force = toy_force(theta, fine.ravel()).reshape(-1, *fine.shape)
    return np.trapezoid(force, dx=0.1, axis=-1)


def toy_simulate(theta: Mapping[str, float]) -> Simulation:
    """The toy behind the same face as the full model: a mapping of parameters in, a Simulation out."""
    time_s = np.unique(np.concatenate([np.linspace(0, MOTION.time_s[-1], 261), MOTION.time_s]))
    row = np.array([[theta[name] for name in SPACE.names]])
    return Simulation(
        theta=dict(theta),
        time_s=time_s,
        displacement_m=MOTION.at(time_s),
        force_n=toy_force(row, time_s)[0],
        corner=frozen_array(np.isin(time_s, MOTION.time_s), bool),
        status="ok",
        message="",
        stats={"seconds": 0.0},
        model_hash="toy",
    )
