"""Compares surrogates of a visco-hyperelastic force with six parameters, trained on 128 points.

    F(t) = E_inf g + sum_i E_i int_0^t exp(-(t - s) / tau_i) dg(s),   g = (exp(b e) - 1) / b

The stretch e(t) rises from 0 to 1 over 0-10 s, is held until 80 s, falls back to 0 by 90 s, and rests until
120 s. The force is given at 200 times. The parameters are E_inf [0.5, 2], E_1 [0.3, 3], E_2 [0.1, 1], tau_1
[1, 6] s and tau_2 [15, 60] s, all log-uniform, and b [0.5, 2], uniform. The error is ||prediction - truth|| /
||truth - its mean|| over 512 random points.

Run the benchmark with one thread:

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python benchmarks/surrogate_benchmark.py

It prints medians over designs of different seeds beside the targets; times are CPU seconds. Other packages
(extra `benchmark`) are measured on the same designs, one after the other in processes of their own. They must
be installed in this environment, or in one given by ``--peer NAME=PYTHON`` (see surrogate_peers.py).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import qmc

from bayeskin import __version__
from bayeskin.inference.likelihood import log_likelihood
from bayeskin.inference.noise_model import noise_chain
from bayeskin.surrogates import train
from bayeskin.types import BinnedForce, Design, Parameter, ParameterSpace, Phase, Prediction

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
# The forces are not means over these bins. Only the number of bins matters.
EDGES_S = np.linspace(-0.5, 1.0, 201) * 120.0
RAMPS = ((0.0, 10.0, 0.0, 0.1), (80.0, 90.0, 1.0, -0.1))  # start, end [s], stretch, its rate [1/s]
POINTS, TESTS, BATCH = 128, 512, 512
SEEDS = 5
Row = dict[str, Any]
PEERS = ("openturns", "surmise", "bayesvalidrox")
COLUMNS = ("held_out_error", "training_s", "log_likelihoods_per_s", "without_covariance_per_s")
TARGETS = {"held_out_error": 0.015, "training_s": 2.0, "log_likelihoods_per_s": 25_000.0}


def force(theta: np.ndarray, time_s: np.ndarray = TIME_S) -> np.ndarray:
    """Returns the force F (n, m) [N] at theta (n, 6), in closed form on each ramp of the stretch."""
    e_inf, e_1, e_2, tau_1, tau_2, b = (column[:, None] for column in theta.T)
    stretch = np.interp(time_s, [0.0, 10.0, 80.0, 90.0], [0.0, 1.0, 1.0, 0.0])
    total = e_inf * np.expm1(b * stretch) / b
    for stiffness, tau in ((e_1, tau_1), (e_2, tau_2)):
        for start, end, start_stretch, rate in RAMPS:
            inside = np.clip(time_s, start, end) - start
            rise = np.exp(b * rate * inside) - np.exp(-inside / tau)
            memory = rate * np.exp(b * start_stretch) * rise / (b * rate + 1.0 / tau)
            total = total + stiffness * memory * np.exp(-np.maximum(time_s - end, 0.0) / tau)
    return total


def design(seed: int, points: int = POINTS, tests: int = TESTS) -> Design:
    """Returns a design with scrambled Sobol' points for training and uniform points held out."""
    training = qmc.Sobol(SPACE.dim, seed=seed).random(points)
    unit = np.vstack([training, np.random.default_rng(seed + 1000).random((tests, SPACE.dim))])
    n, theta = len(unit), SPACE.from_unit(unit)
    return Design(
        space=SPACE, edges_s=EDGES_S, theta=theta, force_n=force(theta), wave=np.zeros(n, np.int64),
        held_out=np.arange(n) >= points, ok=np.ones(n, bool), messages=("",) * n, seconds=np.zeros(n),
        seed=seed, model_hash="visco-hyperelastic benchmark",
    )  # fmt: skip


def rate(action: Callable[[], object], points: int) -> float:
    """Returns points per CPU second, the median of five rounds."""
    action()
    rates = []
    for _ in range(5):
        start = time.process_time()
        for _ in range(8):
            action()
        rates.append(8 * points / (time.process_time() - start))
    return float(np.median(rates))


def run(seed: int) -> dict[str, float]:
    """Returns the error, coverage, training time and rates of one design.

    The rates are predictions and log-likelihoods per CPU second.
    """
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
        "without_covariance_per_s": rate(
            lambda: log_likelihood(chain, without_factor(surrogate.predict(theta)), noise), len(theta)
        ),
    }


def without_factor(prediction: Prediction) -> Prediction:
    """Returns the prediction as if its error were independent from bin to bin."""
    return Prediction(prediction.mean, prediction.factor[:, :, :0], prediction.diagonal)


def peer_rows(package: str, python: str) -> list[Row]:
    """Returns the medians over the designs for each method of a package.

    Where the package is not installed, prints one line and returns no row.
    """
    probe = f"import importlib.util, sys; sys.exit(importlib.util.find_spec({package!r}) is None)"
    if subprocess.run([python, "-c", probe], check=False).returncode:
        print(f"{package}: not installed for {python}, skipped")
        return []
    script, by_method = Path(__file__).with_name("surrogate_peers.py"), dict[str, list[Row]]()
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(SEEDS):
            runs, file = design(seed), Path(folder) / f"{seed}.npz"
            unit, held_out = SPACE.to_unit(runs.theta), runs.held_out
            np.savez(
                file, unit=unit[~held_out], force_n=runs.force_n[~held_out], test_unit=unit[held_out],
                test_force_n=runs.force_n[held_out],
            )  # fmt: skip
            command = [python, str(script), package, str(file)]
            process = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
            for line in process.stdout.splitlines():
                if line.startswith("ROW "):
                    row = json.loads(line[4:])
                    by_method.setdefault(row.pop("method"), []).append(row)
    return [{"method": name, **medians(rows)} for name, rows in by_method.items()]


def medians(rows: list[Row]) -> Row:
    """Returns the median of each column over the designs, or None where a method has no number."""
    return {
        key: None if value is None else float(np.median([row[key] for row in rows]))
        for key, value in rows[0].items()
    }


def table(rows: list[Row]) -> str:
    """Returns the rows below the targets as Markdown; brackets have the ratio to the first row."""
    lines = [["method", *COLUMNS], ["---"] * (1 + len(COLUMNS))]
    signs = {key: ">=" if key.endswith("per_s") else "<=" for key in TARGETS}
    targets = [f"{signs[key]} {TARGETS[key]:,g}" if key in TARGETS else "" for key in COLUMNS]
    lines.append(["target", *targets])
    for row in rows:
        cells = [
            "none" if row[key] is None else f"{float(f'{row[key]:.3g}'):,g} ({row[key] / rows[0][key]:.2g})"
            for key in COLUMNS
        ]
        lines.append([row["method"], *cells])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--peer", action="append", default=[], metavar="NAME=PYTHON")
    pythons = dict.fromkeys(PEERS, sys.executable)
    pythons |= dict(peer.split("=", 1) for peer in parser.parse_args().peer)
    ours = medians([run(seed) for seed in range(SEEDS)])
    print(json.dumps(ours, indent=2))
    rows: list[Row] = [{"method": f"bayeskin {__version__}", **ours}]
    for package, python in pythons.items():
        rows += peer_rows(package, python)
    print(table(rows))


if __name__ == "__main__":
    main()
