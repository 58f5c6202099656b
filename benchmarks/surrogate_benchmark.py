"""Surrogate of a visco-hyperelastic force with six parameters, learnt from 128 points.

    F(t) = E_inf g + sum_i E_i int_0^t exp(-(t - s) / tau_i) dg(s),   g = (exp(b e) - 1) / b

with the stretch e(t) going 0 to 1 over 0-10 s, held to 80 s, back to 0 by 90 s, at rest to 120 s; 200
times. E_inf [0.5, 2], E_1 [0.3, 3], E_2 [0.1, 1], tau_1 [1, 6] s, tau_2 [15, 60] s log-uniform, b [0.5, 2]
uniform. Error: ||prediction - truth|| / ||truth - its mean|| over 512 random points.

Run with one thread: ``OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python benchmarks/surrogate_benchmark.py``.
Prints medians over designs of other seeds; times are CPU seconds of this process.
"""

from __future__ import annotations

import json
import time

import numpy as np
from scipy.stats import qmc

from bayeskin.inference.likelihood import log_likelihood
from bayeskin.inference.noise_model import noise_chain
from bayeskin.surrogates import train
from bayeskin.types import BinnedForce, Design, Parameter, ParameterSpace, Phase

SPACE = ParameterSpace(
    (
        Parameter("E_inf", "N", 0.5, 2.0, "log-uniform"),
        Parameter("E_1", "N", 0.3, 3.0, "log-uniform"),
        Parameter("E_2", "N", 0.1, 1.0, "log-uniform"),
        Parameter("tau_1", "s", 1.0, 6.0, "log-uniform"),
        Parameter("tau_2", "s", 15.0, 60.0, "log-uniform"),
        Parameter("b", "1", 0.5, 2.0, "uniform"),
    )
)
TIME_S = np.linspace(0.0, 120.0, 200)
EDGES_S = np.linspace(-0.5, 1.0, 201) * 120.0  # bins are not means here; only their number matters
RAMPS = ((0.0, 10.0, 0.0, 0.1), (80.0, 90.0, 1.0, -0.1))  # start, end [s], stretch, its rate [1/s]
POINTS, TESTS, BATCH = 128, 512, 512


def force(theta: np.ndarray, time_s: np.ndarray = TIME_S) -> np.ndarray:
    """F (n, m) [N] at theta (n, 6), in closed form on each ramp of the stretch."""
    e_inf, e_1, e_2, tau_1, tau_2, b = (column[:, None] for column in theta.T)
    stretch = np.interp(time_s, [0.0, 10.0, 80.0, 90.0], [0.0, 1.0, 1.0, 0.0])
    total = e_inf * np.expm1(b * stretch) / b
    for stiffness, tau in ((e_1, tau_1), (e_2, tau_2)):
        for start, end, at, rate in RAMPS:
            inside = np.clip(time_s, start, end) - start
            rise = np.exp(b * rate * inside) - np.exp(-inside / tau)
            memory = rate * np.exp(b * at) * rise / (b * rate + 1.0 / tau)
            total = total + stiffness * memory * np.exp(-np.maximum(time_s - end, 0.0) / tau)
    return total


def design(seed: int, points: int = POINTS, tests: int = TESTS) -> Design:
    """Scrambled Sobol' points to learn from, uniform ones held out."""
    learnt = qmc.Sobol(SPACE.dim, seed=seed).random(points)
    unit = np.vstack([learnt, np.random.default_rng(seed + 1000).random((tests, SPACE.dim))])
    n, theta = len(unit), SPACE.from_unit(unit)
    return Design(
        space=SPACE, edges_s=EDGES_S, theta=theta, force_n=force(theta), wave=np.zeros(n, np.int64),
        held_out=np.arange(n) >= points, ok=np.ones(n, bool), messages=("",) * n, seconds=np.zeros(n),
        seed=seed, model_hash="visco-hyperelastic benchmark",
    )  # fmt: skip


def rate(action, points: int) -> float:  # type: ignore[no-untyped-def]
    """Points a CPU second, the median of five rounds."""
    action()
    rates = []
    for _ in range(5):
        start = time.process_time()
        for _ in range(8):
            action()
        rates.append(8 * points / (time.process_time() - start))
    return float(np.median(rates))


def run(seed: int) -> dict[str, float]:
    """One design: error, coverage, training time, predictions and log-likelihoods a second."""
    runs = design(seed)
    start = time.process_time()
    surrogate, validation = train(runs, "gp", seed)
    seconds = time.process_time() - start
    theta = runs.theta[runs.held_out][:BATCH]
    m = len(TIME_S)
    phase = Phase("hold", 1, float(EDGES_S[0]), float(EDGES_S[-1]))
    binned = BinnedForce(
        EDGES_S, runs.force_n[-1], np.full(m, 1e-8), np.zeros(m - 1), np.zeros(m, np.int64), (phase,)
    )
    chain, noise = noise_chain(binned), np.tile([1e-2, 5.0, np.inf], (len(theta), 1))
    return {
        "held_out_error": validation.relative_error,
        "coverage_90": validation.coverage_90,
        "latents": validation.components + 1,
        "training_s": seconds,
        "predictions_per_s": rate(lambda: surrogate.predict(theta), len(theta)),
        "log_likelihoods_per_s": rate(
            lambda: log_likelihood(chain, surrogate.predict(theta), noise), len(theta)
        ),
    }


def main() -> None:
    results = [run(seed) for seed in range(5)]
    print(json.dumps({key: float(np.median([r[key] for r in results])) for key in results[0]}, indent=2))


if __name__ == "__main__":
    main()
