"""Whether the whole chain is calibrated: draws of the prior, recordings made with them, inferred again.

Simulation-based calibration (Talts et al. 2018, arXiv:1804.06788; Modrak et al. 2023, Bayesian Analysis):
the rank of the true value among posterior draws is uniform if likelihood, sampler and stopping rule are
right. Beside it the share of true values inside 50 and 90 % intervals, and of the bins of a fresh recording
at the same parameters inside the 50 and 90 % bands. On the demo's protocol, its first loading and hold (80
bins of 0.5 s), with the shipped surrogate, noise priors and limits of trust; 100 draws a posterior.

    python benchmarks/calibration.py                     # 300 recordings made by the surrogate with its error
    python benchmarks/calibration.py --data full --n 50  # made by the full model

Finished recordings are rows of benchmarks/results/calibration.csv, which a later start does not repeat. A
chain that is not trusted at its last step is counted, and stays in. Draws docs/figures/calibration.{png,svg}.
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
from bayeskin.recordings import bin_recording, read_recording, segment, uniform_edges
from bayeskin.report import save_figure
from bayeskin.report.style import GREY, MODEL, PAGE_IN, new_figure, state_finding, styled, symbol
from bayeskin.shipped import shipped
from bayeskin.surrogates import load_manifest, load_surrogate
from bayeskin.types import Array
from bayeskin.workflow.recording import pad_motion

FIGURES = Path(__file__).parents[1] / "docs" / "figures"
WINDOW_S = ((5.0, 45.0),)
DRAWS = 100
SETTINGS = SampleSettings(2, 40, 8000, Limits(effective_samples=1000.0))
NAMES = ("E_c", "E_s", "k_c", "k_s", "p_init", "sd_load", "sd_hold", "tau_noise", "nu_noise")
_EACH = ("true", "rank", "in50", "in90")
ROWS = rows.Rows(
    rows.RESULTS / "calibration.csv",
    ("surrogate", "data", "seed", "index"),
    (
        *(f"{what}_{name}" for name in NAMES for what in _EACH),
        "band50", "band90", "trusted", "steps", "reason", "cpu_s", "code",
    ),
)  # fmt: skip
Item = dict[str, Any]


@cache
def problem() -> LogPosterior:
    """The demo's posterior on the window; its recorded force is replaced in each replicate."""
    recording = read_recording(shipped("data/demo.h5"))
    phases = segment(recording)
    surrogate = load_surrogate(shipped("surrogates/demo.h5"))
    edges_s = uniform_edges(float(surrogate.edges_s[-1]))
    return LogPosterior(surrogate, bin_recording(recording, phases, edges_s), WINDOW_S)


def surrogate_hash() -> str:
    """Short name of the shipped surrogate: ranks of one say nothing of another."""
    return str(load_manifest(shipped("surrogates/demo.h5"))["arrays_sha256"])[:12]


def made_by_surrogate(about: LogPosterior, theta: Array, rng: np.random.Generator) -> Array:
    """Force [N] of all bins (m,) at theta (D,): mean and an error of the surrogate's, no noise."""
    at = about.predict(theta)
    return np.asarray(at.mean[0] + at.factor[0] @ rng.standard_normal(at.factor.shape[2]))


def made_by_model(about: LogPosterior, theta: Array) -> Array:
    """Force [N] of all bins (m,) by a full run; raises RuntimeError where it fails."""
    recording = read_recording(shipped("data/demo.h5"))
    motion = pad_motion("reaction", recording, segment(recording), "idealised")
    names = about.surrogate.space.names
    material = map(float, about.split(theta)[0][0])
    run = simulate(ModelSpec(), motion, dict(zip(names, material, strict=True)))
    if run.status != "ok":
        raise RuntimeError(run.message)
    return run.bin_means(about.surrogate.edges_s)


def noisy(
    about: LogPosterior, theta: Array, force_n: Array, diagonal: Array, rng: np.random.Generator
) -> Array:
    """The fitted bins of force_n (m,) with noise drawn at theta (D,); the others as they are."""
    chain = about.chain
    noise = draw_noise(chain, about.split(theta)[1], diagonal[None, chain.bins], rng)[0]
    out = force_n.copy()
    out[chain.bins] += noise
    return out


def replicate(item: Item, about: LogPosterior, settings: SampleSettings = SETTINGS) -> Item:
    """One recording made, inferred and ranked, as a row."""
    started = time.process_time()
    rng = np.random.default_rng([item["seed"], item["index"], int(item["data"] == "full")])
    theta = about.space.from_unit(rng.uniform(size=about.dim))
    blank = np.zeros(len(about.surrogate.edges_s) - 1)
    if item["data"] == "full":
        own = fresh = made_by_model(about, theta)
        diagonal = blank
    else:
        own, fresh = (made_by_surrogate(about, theta, rng) for _ in range(2))
        diagonal = about.predict(theta).diagonal[0]
    recorded, seen = (noisy(about, theta, force, diagonal, rng) for force in (own, fresh))
    measured = replace(about, binned=replace(about.binned, force_n=recorded))
    seed = int(rng.integers(2**31))
    best = inference.find_map(measured, seed, starts=3, evaluations=2000).theta
    with tempfile.TemporaryDirectory() as folder:
        posterior = inference.sample(measured, folder, seed, best, settings)
    verdict = posterior.convergence.verdict
    return item | {
        **ranked(posterior.flat, theta, rng),
        **dict(zip(("band50", "band90"), banded(measured, posterior.flat, seen, rng), strict=True)),
        "trusted": verdict.trusted, "steps": posterior.convergence.steps,
        "reason": "" if verdict.trusted else verdict.reasons[0],
        "cpu_s": time.process_time() - started, "code": rows.CODE,
    }  # fmt: skip


def ranked(flat: Array, theta: Array, rng: np.random.Generator) -> Item:
    """Rank of each true value among `DRAWS` draws, 0 to DRAWS, and whether central intervals hold it."""
    few = flat[rng.choice(len(flat), DRAWS, replace=len(flat) < DRAWS)]
    out: Item = {}
    for j, name in enumerate(NAMES):
        share = float(np.mean(flat[:, j] < theta[j]))
        out[f"true_{name}"] = float(theta[j])
        out[f"rank_{name}"] = int(np.sum(few[:, j] < theta[j]))
        out[f"in50_{name}"], out[f"in90_{name}"] = 0.25 <= share <= 0.75, 0.05 <= share <= 0.95
    return out


def banded(measured: LogPosterior, flat: Array, seen: Array, rng: np.random.Generator) -> tuple[float, float]:
    """Share of the fitted bins of a fresh recording (m,) inside the 50 and the 90 % band."""
    some = flat[np.linspace(0, len(flat) - 1, min(1000, len(flat))).astype(int)]
    found = inference.bands(measured, some, rng)
    again = dataclasses.replace(measured.binned, force_n=seen)
    low50, high50 = found.interval(0.5)
    low90, high90 = found.interval(0.9)
    return (
        inference.coverage(again, low50, high50, WINDOW_S),
        inference.coverage(again, low90, high90, WINDOW_S),
    )


def perform(item: Item) -> Item | str:
    """One replicate in a worker; the message of a full run that failed."""
    try:
        return replicate(item, problem())
    except RuntimeError as error:
        return str(error)


def uniformity(ranks: Array) -> float:
    """p-value of chi-square for ranks (n,) in ten bins of as near equal size as DRAWS + 1 ranks allow."""
    edges = np.linspace(0, DRAWS + 1, 11).round()
    counts = np.histogram(ranks, edges - 0.5)[0]
    expected = len(ranks) * np.diff(edges) / (DRAWS + 1)
    return float(chi2.sf(np.sum((counts - expected) ** 2 / expected), 9))


def table(found: Sequence[Mapping[str, str]]) -> str:
    """By parameter: p-value of uniform ranks, shares inside the intervals; then the bands'."""
    lines = []
    for name in NAMES:
        ranks = np.array([int(r[f"rank_{name}"]) for r in found])
        held = [np.mean([r[f"in{level}_{name}"] == "True" for r in found]) for level in (50, 90)]
        lines.append([name, f"{uniformity(ranks):.3f}", *(f"{100 * h:.1f} %" for h in held)])
    bands = [np.mean([float(r[f"band{level}"]) for r in found]) for level in (50, 90)]
    lines.append(["bands of a fresh recording", "", *(f"{100 * b:.1f} %" for b in bands)])
    return rows.markdown(["", "p of uniform ranks", "inside 50 %", "inside 90 %"], lines)


@styled
def figure_calibration(found: Sequence[Mapping[str, str]], data: str) -> Figure:
    """Rank histograms of all parameters, with what uniform ranks would scatter."""
    figure = new_figure(PAGE_IN, 3.6)
    axes = figure.subplots(2, 5).ravel()
    for ax, name in zip(axes, NAMES, strict=False):
        _draw_ranks(ax, np.array([int(r[f"rank_{name}"]) for r in found]))
        ax.set_title(symbol(name))
    axes[-1].axis("off")
    failed = sum(r["trusted"] != "True" for r in found)
    least = min(uniformity(np.array([int(r[f"rank_{n}"]) for r in found])) for n in NAMES)
    source = "the surrogate with its error" if data == "surrogate" else "the full model"
    state_finding(
        figure, f"Ranks of the true values among posterior draws: least p-value of nine {least:.2g}",
        f"{len(found)} recordings made by {source} at draws of the prior; {failed} of the chains did not "
        f"reach the limits of trust. Grey: 99 % of uniform ranks' counts. Ten bins of {DRAWS + 1} ranks.",
    )  # fmt: skip
    return figure


def _draw_ranks(ax: Axes, ranks: Array) -> None:
    edges = np.linspace(0, DRAWS + 1, 11).round()
    low, high = (binom.ppf(q, len(ranks), 0.1) for q in (0.005, 0.995))
    ax.axhspan(low, high, color=GREY, alpha=0.25, lw=0)
    ax.hist(ranks, edges - 0.5, color=MODEL)
    ax.set(xlim=(-0.5, DRAWS + 0.5), ylim=(0, 1.15 * max(high, ax.get_ylim()[1])), xlabel="rank")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--n", type=int, default=300, help="recordings (default 300)")
    parser.add_argument("--data", choices=("surrogate", "full"), default="surrogate")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--results", type=Path, default=rows.RESULTS)
    parser.add_argument("--figures", type=Path, default=FIGURES)
    asked = parser.parse_args()
    store = replace(ROWS, path=asked.results / ROWS.path.name)
    known = {"surrogate": surrogate_hash(), "data": asked.data, "seed": asked.seed}
    items = [{**known, "index": index} for index in range(asked.n)]
    there = {store.key_of(row): row for row in store.read()}
    todo = [item for item in items if store.key_of(item) not in there]
    rows.say(f"{len(items) - len(todo)} of {len(items)} are there already")
    for done, (i, result) in enumerate(run_parallel(perform, todo, asked.workers), start=1):
        if isinstance(result, Lost | str):
            rows.say(f"{todo[i]['index']} failed: {result.reason if isinstance(result, Lost) else result}")
            continue
        there[store.key_of(result)] = store.append(**result)
        rows.say(f"{done} of {len(todo)}: {float(result['cpu_s']):.1f} CPU s, {result['steps']} steps")
    found = [there[store.key_of(item)] for item in items if store.key_of(item) in there]
    rows.warn_of_mixed_code(found)
    failed = sum(row["trusted"] != "True" for row in found)
    print(f"{asked.data}, seed {asked.seed}: {len(found)} recordings, {failed} chains not trusted\n")
    print(table(found))
    stem = "calibration" if asked.data == "surrogate" else "calibration-full"
    save_figure(figure_calibration(found, asked.data), asked.figures / stem, "benchmarks/calibration.py")


if __name__ == "__main__":
    main()
