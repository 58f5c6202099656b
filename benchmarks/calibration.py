"""Tests the calibration of the whole inference: parameters drawn from the prior are inferred again.

The method is simulation-based calibration (Talts et al. 2018, arXiv:1804.06788; Modrak et al. 2023, Bayesian
Analysis). Parameters are drawn from the prior, a recording is made with them, and the posterior is sampled.
The rank of the true value among the posterior draws is uniform if likelihood, sampler and stopping rule are
right. The table also has the share of true values inside the 50 % and 90 % intervals, and the share of the
bins of a fresh recording at the same parameters inside the 50 % and 90 % bands. The recordings have the
protocol of the demo, restricted to its loading and hold (70 bins of 0.5 s). Surrogate, noise priors and
convergence limits are the shipped ones; each posterior gives 100 draws.

    python benchmarks/calibration.py                     # 300 recordings made by the surrogate with its error
    python benchmarks/calibration.py --data full --n 50  # 50 recordings made by the full model

Finished recordings are rows of benchmarks/results/calibration.csv, and a later start does not repeat them.
Chains that are not trusted at their last step are counted and stay in the table. The program draws
docs/figures/calibration.{png,svg}.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import rows
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import binom, chi2

from bayeskin import inference
from bayeskin.execution.local import Lost, run_parallel
from bayeskin.finite_element import ModelSpec, simulate
from bayeskin.inference import Limits, LogPosterior, SampleSettings
from bayeskin.inference.noise_model import draw_noise
from bayeskin.recordings import bin_recording, idealised_motion, read_recording, segment, uniform_edges
from bayeskin.report import save_figure
from bayeskin.report.style import GREY, MODEL, PAGE_IN, new_figure, state_finding, styled, symbol
from bayeskin.shipped import shipped
from bayeskin.surrogates import load_manifest, load_surrogate
from bayeskin.types import Array

FIGURES = Path(__file__).parents[1] / "docs" / "figures"
WINDOW_S = ((5.0, 40.0),)
DRAWS = 100
SETTINGS = SampleSettings(2, 40, 8000, Limits(effective_samples=1000.0))
NAMES = ("E_c", "E_s", "k_c", "k_s", "p_init", "sd_load", "sd_hold", "tau_noise", "nu_noise")
_EACH = ("true", "rank", "in50", "in90")
ROWS = rows.Rows(
    rows.RESULTS / "calibration.csv",
    ("surrogate", "data", "seed", "index"),
    (
        *(f"{quantity}_{name}" for name in NAMES for quantity in _EACH),
        "band50", "band90", "trusted", "steps", "reason", "cpu_s", "code",
    ),
)  # fmt: skip
Item = dict[str, Any]


@cache
def problem() -> LogPosterior:
    """Returns the demo's log-posterior on the window; each replicate replaces its recorded force."""
    recording = read_recording(shipped("data/demo.h5"))
    phases = segment(recording)
    surrogate = load_surrogate(shipped("surrogates/demo.h5"))
    edges_s = uniform_edges(float(surrogate.edges_s[-1]))
    return LogPosterior(surrogate, bin_recording(recording, phases, edges_s), WINDOW_S)


def surrogate_hash() -> str:
    """Returns a short name of the shipped surrogate, since ranks are valid for one surrogate only."""
    return str(load_manifest(shipped("surrogates/demo.h5"))["arrays_sha256"])[:12]


def made_by_surrogate(about: LogPosterior, theta: Array, rng: np.random.Generator) -> Array:
    """Returns the noise-free force [N] (m,) of all bins: mean plus a draw of the surrogate's error."""
    prediction = about.predict(theta)
    return np.asarray(
        prediction.mean[0] + prediction.factor[0] @ rng.standard_normal(prediction.factor.shape[2])
    )


def made_by_model(about: LogPosterior, theta: Array) -> Array:
    """Returns the force [N] of all bins (m,) by a full run; raises RuntimeError where the run fails."""
    recording = read_recording(shipped("data/demo.h5"))
    motion = idealised_motion(recording, segment(recording))
    names = about.surrogate.space.names
    material = map(float, about.split(theta)[0][0])
    run = simulate(ModelSpec(), motion, dict(zip(names, material, strict=True)))
    if run.status != "ok":
        raise RuntimeError(run.message)
    return run.bin_means(about.surrogate.edges_s)


def noisy(
    about: LogPosterior, theta: Array, force_n: Array, diagonal: Array, rng: np.random.Generator
) -> Array:
    """Returns force_n (m,) with noise drawn at theta (D,) in the fitted bins; the other bins stay the same.

    diagonal (m,) : independent variance [N^2] of each bin, which is added to the noise
    """
    chain = about.chain
    noise = draw_noise(chain, about.split(theta)[1], diagonal[None, chain.bins], rng)[0]
    noisy_n = force_n.copy()
    noisy_n[chain.bins] += noise
    return noisy_n


def replicate(item: Item, about: LogPosterior, settings: SampleSettings = SETTINGS) -> Item:
    """Makes one recording, infers it, and returns its ranks and coverages as a row."""
    started = time.process_time()
    rng = np.random.default_rng([item["seed"], item["index"], int(item["data"] == "full")])
    theta = about.space.from_unit(rng.uniform(size=about.dim))
    no_variance = np.zeros(len(about.surrogate.edges_s) - 1)
    if item["data"] == "full":
        true_n = fresh_true_n = made_by_model(about, theta)
        diagonal = no_variance
    else:
        true_n, fresh_true_n = (made_by_surrogate(about, theta, rng) for _ in range(2))
        diagonal = about.predict(theta).diagonal[0]
    recorded, fresh_n = (noisy(about, theta, force, diagonal, rng) for force in (true_n, fresh_true_n))
    measured = replace(about, binned=replace(about.binned, force_n=recorded))
    seed = int(rng.integers(2**31))
    best = inference.find_map(measured, seed, starts=3, evaluations=2000).theta
    with tempfile.TemporaryDirectory() as folder:
        posterior = inference.sample(measured, folder, seed, best, settings)
    verdict = posterior.convergence.verdict
    return item | {
        **ranked(posterior.flat, theta, rng),
        **dict(zip(("band50", "band90"), banded(measured, posterior.flat, fresh_n, rng), strict=True)),
        "trusted": verdict.trusted, "steps": posterior.convergence.steps,
        "reason": "" if verdict.trusted else verdict.reasons[0],
        "cpu_s": time.process_time() - started, "code": rows.CODE,
    }  # fmt: skip


def ranked(flat: Array, theta: Array, rng: np.random.Generator) -> Item:
    """Returns for each parameter its true value and the rank of that value among `DRAWS` draws, 0 to `DRAWS`.

    The row also says whether the central 50 % and 90 % intervals contain the true value.
    """
    draws = flat[rng.choice(len(flat), DRAWS, replace=len(flat) < DRAWS)]
    row: Item = {}
    for j, name in enumerate(NAMES):
        share = float(np.mean(flat[:, j] < theta[j]))
        row[f"true_{name}"] = float(theta[j])
        row[f"rank_{name}"] = int(np.sum(draws[:, j] < theta[j]))
        row[f"in50_{name}"], row[f"in90_{name}"] = 0.25 <= share <= 0.75, 0.05 <= share <= 0.95
    return row


def banded(measured: LogPosterior, flat: Array, seen: Array, rng: np.random.Generator) -> tuple[float, float]:
    """Returns the shares of the fitted bins of a fresh recording (m,) inside the 50 % and the 90 % band."""
    draws = flat[np.linspace(0, len(flat) - 1, min(1000, len(flat))).astype(int)]
    bands = inference.bands(measured, draws, rng)
    fresh = dataclasses.replace(measured.binned, force_n=seen)
    low50, high50 = bands.interval(0.5)
    low90, high90 = bands.interval(0.9)
    return (
        inference.coverage(fresh, low50, high50, WINDOW_S),
        inference.coverage(fresh, low90, high90, WINDOW_S),
    )


def perform(item: Item) -> Item | str:
    """Runs one replicate in a worker process; returns the error message if a full run fails."""
    try:
        return replicate(item, problem())
    except RuntimeError as error:
        return str(error)


def uniformity(ranks: Array) -> float:
    """Returns the p-value of a chi-square test that ranks (n,) are uniform.

    The ten bins are as nearly equal in size as `DRAWS` + 1 ranks allow.
    """
    edges = np.linspace(0, DRAWS + 1, 11).round()
    counts = np.histogram(ranks, edges - 0.5)[0]
    expected = len(ranks) * np.diff(edges) / (DRAWS + 1)
    return float(chi2.sf(np.sum((counts - expected) ** 2 / expected), 9))


def table(recordings: Sequence[Mapping[str, str]]) -> str:
    """Returns the table: for each parameter the p-value of uniform ranks and the shares inside the intervals.

    The last row has the shares of a fresh recording inside the predictive bands.
    """
    table_rows = []
    for name in NAMES:
        ranks = np.array([int(r[f"rank_{name}"]) for r in recordings])
        shares = [np.mean([r[f"in{level}_{name}"] == "True" for r in recordings]) for level in (50, 90)]
        table_rows.append([name, f"{uniformity(ranks):.3f}", *(f"{100 * share:.1f} %" for share in shares)])
    bands = [np.mean([float(r[f"band{level}"]) for r in recordings]) for level in (50, 90)]
    table_rows.append(["predictive bands, fresh recording", "", *(f"{100 * b:.1f} %" for b in bands)])
    return rows.markdown(
        ["", "p-value of uniform ranks", "inside 50 % interval", "inside 90 % interval"], table_rows
    )


@styled
def figure_calibration(recordings: Sequence[Mapping[str, str]], data: str) -> Figure:
    """Returns rank histograms of all parameters, with the range that uniform ranks would have."""
    figure = new_figure(PAGE_IN, 3.6)
    axes = figure.subplots(2, 5).ravel()
    for ax, name in zip(axes, NAMES, strict=False):
        _draw_ranks(ax, np.array([int(r[f"rank_{name}"]) for r in recordings]))
        ax.set_title(symbol(name))
    axes[-1].axis("off")
    failed = sum(r["trusted"] != "True" for r in recordings)
    smallest = min(uniformity(np.array([int(r[f"rank_{n}"]) for r in recordings])) for n in NAMES)
    source = "the surrogate with its error" if data == "surrogate" else "the full model"
    state_finding(
        figure, f"Ranks of the true values among posterior draws: least p-value of nine {smallest:.2g}",
        f"{len(recordings)} recordings made by {source} at draws of the prior; {failed} of the chains did "
        f"not reach the limits of trust. Grey: 99 % of uniform ranks' counts. Ten bins of {DRAWS + 1} ranks.",
    )  # fmt: skip
    return figure


def _draw_ranks(ax: Axes, ranks: Array) -> None:
    """Draws the histogram of ranks (n,), and the range in which 99 % of uniform ranks' counts lie."""
    edges = np.linspace(0, DRAWS + 1, 11).round()
    low, high = (binom.ppf(q, len(ranks), 0.1) for q in (0.005, 0.995))
    ax.axhspan(low, high, color=GREY, alpha=0.25, lw=0)
    ax.hist(ranks, list(edges - 0.5), color=MODEL)
    ax.set(xlim=(-0.5, DRAWS + 0.5), ylim=(0, 1.15 * max(high, ax.get_ylim()[1])), xlabel="rank")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--n", type=int, default=300, help="number of recordings (default 300)")
    parser.add_argument("--data", choices=("surrogate", "full"), default="surrogate")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args()
    inputs = {"surrogate": surrogate_hash(), "data": options.data, "seed": options.seed}
    items = [{**inputs, "index": index} for index in range(options.n)]
    stored_rows = {ROWS.key_of(row): row for row in ROWS.read()}
    todo = [item for item in items if ROWS.key_of(item) not in stored_rows]
    rows.say(f"{len(items) - len(todo)} of {len(items)} are finished already")
    for done, (i, result) in enumerate(run_parallel(perform, todo, options.workers), start=1):
        if isinstance(result, Lost | str):
            rows.say(f"{todo[i]['index']} failed: {result.reason if isinstance(result, Lost) else result}")
            continue
        stored_rows[ROWS.key_of(result)] = ROWS.append(**result)
        rows.say(f"{done} of {len(todo)}: {float(result['cpu_s']):.1f} CPU s, {result['steps']} steps")
    recordings = [stored_rows[ROWS.key_of(item)] for item in items if ROWS.key_of(item) in stored_rows]
    rows.warn_of_mixed_code(recordings)
    failed = sum(row["trusted"] != "True" for row in recordings)
    print(f"{options.data}, seed {options.seed}: {len(recordings)} recordings, {failed} chains not trusted\n")
    print(table(recordings))
    stem = "calibration" if options.data == "surrogate" else "calibration-full"
    save_figure(figure_calibration(recordings, options.data), FIGURES / stem, "benchmarks/calibration.py")


if __name__ == "__main__":
    main()
