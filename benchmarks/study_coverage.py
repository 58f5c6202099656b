"""Tests the intervals of a population: simulated studies are inferred, and their true values are compared.

A study has 12 subjects in two groups, with two sessions each. Medians and the ratio of the groups are drawn
for each study. The spreads between subjects and within a subject are drawn from the prior of the model, up to
0.8 (a factor of 2.2). Each recording measures, with noise of its own size,

- the mean of E_c and E_s with weights 0.2 and 0.8, which leaves a curved ridge of the two,
- the ratio E_c / E_s, five times less precisely,
- k_c and k_s, each plus 5e-15 m^2, so that low values cannot be told apart and posteriors end at a bound.
  Two fifths of the recordings say nothing about k_c.

The posterior of each recording, under the default priors, is drawn exactly. 2,000 draws of it enter the model
of the population.

    python benchmarks/study_coverage.py              # 100 studies
    python benchmarks/study_coverage.py --n 20       # the first 20 of them

Finished studies are rows of benchmarks/results/study_coverage.csv, and a later start does not repeat them
while the sources of the model behave alike. The program prints the tables, and writes them between their
markers of docs/population.md.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import rows
from numpy.typing import NDArray

import bayeskin.study
from bayeskin.study import Entry, Individual, Population, Priors, SamplerSettings, infer_population
from bayeskin.study.result import Estimate
from bayeskin.types import Array, Parameter, ParameterSpace

DOCS = Path(__file__).parents[1] / "docs" / "population.md"
SPACE = ParameterSpace(
    (
        Parameter("E_c", "Pa", 1e4, 2e6, "log-uniform", stress_power=1),
        Parameter("E_s", "Pa", 1e3, 5e5, "log-uniform", stress_power=1),
        Parameter("k_c", "m^2", 1e-16, 1e-11, "log-uniform", stress_power=-1),
        Parameter("k_s", "m^2", 1e-16, 1e-11, "log-uniform", stress_power=-1),
    )
)
LOW, HIGH = np.log(SPACE.lower), np.log(SPACE.upper)
GROUPS = ("control", "keloid")
DRAWS = 2000
# Range of the medians of the first group; sd of the logarithm of the groups' ratio; largest spread (sd of the
# natural logarithm); correlation of the effects of subjects on E_c and E_s.
MEDIANS, RATIO_SD = np.log([[4e4, 1e4, 3e-15, 3e-15], [1.5e5, 4e4, 1e-13, 1e-13]]), 0.5
WIDEST, CORRELATION = 0.8, 0.4
# Range of the size of a recording's noise, and sds of what it measures at size 1 (logarithms).
NOISE, MEAN_SD, RATIO_ERROR, PERMEABILITY_SD = (0.4, 2.5), 0.1, 0.5, 0.3
FLOOR, UNSEEN = 5e-15, 0.4  # added to permeabilities [m^2]; share of recordings that do not inform k_c
QUANTITIES = ("median control", "median keloid", "ratio", "between", "within")
ENDS = ("true", "low", "middle", "high")
SHRINKAGE = ("alone", "shrunk", "error alone", "error shrunk")
SETTINGS = SamplerSettings()
NUMERICAL = ("individual", "mixture", "layout", "model", "exact_draws", "moves", "sampler", "population")
ROWS = rows.Rows(
    rows.RESULTS / "study_coverage.csv",
    ("sources", "seed", "index"),
    (
        *(f"{name} {quantity} {end}" for name in SPACE.names for quantity in QUANTITIES for end in ENDS),
        *(f"{name} {what}" for name in SPACE.names for what in SHRINKAGE),
        "trusted", "sweeps", "contradictions", "poor overlaps", "cpu_s",
    ),
)  # fmt: skip


@dataclass(frozen=True)
class Truth:
    """True values of a study, as natural logarithms.

    medians (2, d) : of the groups; between, within (d,) : spreads; x (N, d) : values of the recordings
    """

    medians: Array
    between: Array
    within: Array
    x: Array


def simulate(
    rng: np.random.Generator, subjects: int = 12, sessions: int = 2
) -> tuple[Truth, tuple[Entry, ...], tuple[Individual, ...]]:
    """Returns the true values, the table and the posteriors of a study."""
    dim = SPACE.dim
    control = rng.uniform(*MEDIANS)
    medians = np.stack([control, control + RATIO_SD * rng.standard_normal(dim)])
    between, within = (_spreads(dim, rng) for _ in range(2))
    tie = np.eye(dim)
    tie[0, 1] = tie[1, 0] = CORRELATION
    root = np.linalg.cholesky(tie)
    values, entries, individuals = [], [], []
    for subject in range(subjects):
        own = medians[subject % 2] + between * (root @ rng.standard_normal(dim))
        for session in range(sessions):
            x = np.clip(own + within * rng.standard_normal(dim), LOW, HIGH)
            name = f"s{subject + 1:02d}-{session + 1}"
            group = GROUPS[subject % 2]
            entries.append(Entry(name, Path(f"{name}.h5"), f"s{subject + 1:02d}", None, group, str(session)))
            individuals.append(Individual(name, SPACE, np.exp(posterior(x, rng))))
            values.append(x)
    return Truth(medians, between, within, np.array(values)), tuple(entries), tuple(individuals)


def _spreads(dim: int, rng: np.random.Generator) -> Array:
    """Returns spreads (dim,), drawn from their prior up to the largest."""
    priors, drawn = Priors(), np.empty(0)
    while len(drawn) < dim:
        tried = priors.spread_scale * np.abs(rng.standard_t(priors.freedom, 4 * dim))
        drawn = np.concatenate([drawn, tried[tried < WIDEST]])
    return drawn[:dim]


def posterior(x: Array, rng: np.random.Generator) -> Array:
    """Returns exact draws (n, d) of the posterior of a recording with the true values x (d,), as logarithms.

    In the coordinates log(0.2 E_c + 0.8 E_s) and log(E_c / E_s), which keep volumes, the likelihood of the
    moduli is normal.
    """
    low, high = np.log(NOISE)
    size = np.exp(rng.uniform(low, high))
    mean_sd, ratio_sd, permeability_sd = (size * sd for sd in (MEAN_SD, RATIO_ERROR, PERMEABILITY_SD))
    mean = np.log(0.2 * np.exp(x[0]) + 0.8 * np.exp(x[1])) + mean_sd * rng.standard_normal()
    ratio = x[0] - x[1] + ratio_sd * rng.standard_normal()
    moduli = np.empty((0, 2))
    while len(moduli) < DRAWS:
        means = mean + mean_sd * rng.standard_normal(4 * DRAWS)
        ratios = ratio + ratio_sd * rng.standard_normal(4 * DRAWS)
        soft = means - np.log(0.2 * np.exp(ratios) + 0.8)
        tried = np.column_stack([soft + ratios, soft])
        inside = np.all((tried >= LOW[:2]) & (tried <= HIGH[:2]), axis=1)
        moduli = np.concatenate([moduli, tried[inside]])
    k_c_sd = np.inf if rng.random() < UNSEEN else permeability_sd
    permeabilities = [
        _permeability(x[column], sd, permeability_sd, LOW[column], HIGH[column], rng)
        for column, sd in ((2, k_c_sd), (3, permeability_sd))
    ]
    return np.column_stack([moduli[:DRAWS], *permeabilities])


def _permeability(
    x: float, sd: float, noise: float, low: float, high: float, rng: np.random.Generator
) -> Array:
    """Returns exact draws (n,) of a permeability's posterior, from its density on a fine grid."""
    measured = np.log(np.exp(x) + FLOOR) + noise * rng.standard_normal()
    width = (high - low) / 4000
    centres = low + width * (np.arange(4000) + 0.5)
    density = np.exp(-0.5 * ((np.log(np.exp(centres) + FLOOR) - measured) / sd) ** 2)
    cells = rng.choice(centres, DRAWS, p=density / density.sum())
    return cells + width * rng.uniform(-0.5, 0.5, DRAWS)


def infer(inputs: Mapping[str, Any], settings: SamplerSettings = SETTINGS) -> dict[str, Any]:
    """Simulates one study, infers its population, and returns a row."""
    started = time.process_time()
    rng = np.random.default_rng([inputs["seed"], inputs["index"]])
    truth, entries, individuals = simulate(rng)
    population = infer_population(entries, individuals, rng, settings=settings)
    return {
        **inputs, **_compared(truth, population), "trusted": population.trusted,
        "sweeps": population.convergence.steps,
        "contradictions": sum(overlap.contradicts for overlap in population.overlaps),
        "poor overlaps": sum(overlap.poor for overlap in population.overlaps),
        "cpu_s": time.process_time() - started,
    }  # fmt: skip


def _compared(truth: Truth, population: Population) -> dict[str, float]:
    """Returns true values with estimates, and how well the recordings' values are known alone and shrunk."""
    out: dict[str, float] = {}
    for j, summary in enumerate(population.parameters):
        name = summary.parameter.name
        assert summary.within is not None
        pairs = (
            *zip(np.exp(truth.medians[:, j]), (summary.medians[group] for group in GROUPS), strict=True),
            (np.exp(truth.medians[1, j] - truth.medians[0, j]), summary.contrasts[0].ratio),
            (truth.between[j], summary.between.sd), (truth.within[j], summary.within.sd),
        )  # fmt: skip
        for quantity, (true, estimate) in zip(QUANTITIES, pairs, strict=True):
            ends = (float(true), estimate.low, estimate.median, estimate.high)
            out |= {f"{name} {quantity} {end}": value for end, value in zip(ENDS, ends, strict=True)}
        for what in ("alone", "shrunk"):
            estimates = [getattr(recording, what)[j] for recording in population.recordings]
            true_x = truth.x[:, j]
            out[f"{name} {what}"] = float(
                np.mean([_contains(e, np.exp(x)) for e, x in zip(estimates, true_x, strict=True)])
            )
            errors = np.log([estimate.median for estimate in estimates]) - true_x
            out[f"{name} error {what}"] = float(np.sqrt(np.mean(errors**2)))
    return out


def _contains(estimate: Estimate, value: float) -> bool:
    return bool(estimate.low <= value <= estimate.high)


def inside(results: Sequence[Mapping[str, str]], name: str, quantity: str) -> NDArray[np.bool_]:
    """Returns for each study whether the 90 % interval contains the true value, (n,)."""
    true, low, _, high = (
        np.array([float(row[f"{name} {quantity} {end}"]) for row in results]) for end in ENDS
    )
    return (low <= true) & (true <= high)


def coverage_table(results: Sequence[Mapping[str, str]]) -> str:
    """Returns the shares of studies whose 90 % intervals contain the true values."""
    lines = []
    for name in SPACE.names:
        shares = [inside(results, name, quantity).mean() for quantity in QUANTITIES]
        lines.append([name, *(f"{100 * share:.0f} %" for share in shares)])
    each = [np.mean([inside(results, name, quantity) for name in SPACE.names]) for quantity in QUANTITIES]
    lines.append(["all", *(f"{100 * share:.1f} %" for share in each)])
    header = (
        "", "median, first group", "median, second group", "ratio of the groups", "spread between subjects",
        "spread within a subject",
    )  # fmt: skip
    return rows.markdown(header, lines)


def shrinkage_table(results: Sequence[Mapping[str, str]]) -> str:
    """Returns how far single recordings' medians are off, and how often their intervals are right."""

    def mean(column: str) -> float:
        return float(np.mean([float(row[column]) for row in results]))

    lines = [
        [
            name, f"{mean(f'{name} error alone'):.2f}", f"{mean(f'{name} error shrunk'):.2f}",
            f"{100 * mean(f'{name} alone'):.0f} %", f"{100 * mean(f'{name} shrunk'):.0f} %",
        ]
        for name in SPACE.names
    ]  # fmt: skip
    header = ("", "error alone", "error shrunk", "inside the interval, alone", "inside the interval, shrunk")
    return rows.markdown(header, lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--n", type=int, default=100, help="number of studies (default 100)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--results", type=Path, default=rows.RESULTS)
    options = parser.parse_args()
    store = replace(ROWS, path=options.results / ROWS.path.name)
    folder = Path(bayeskin.study.__file__).parent
    sources = rows.code_digest(folder / f"{name}.py" for name in NUMERICAL)
    inputs = {"sources": sources, "seed": options.seed}
    results = []
    for index in range(options.n):
        row = store.find(**inputs, index=index)
        if row is None:
            row = store.append(**infer({**inputs, "index": index}))
            rows.say(f"{index + 1} of {options.n}: {float(row['cpu_s']):.0f} CPU s, {row['sweeps']} sweeps")
        results.append(row)
    trusted = sum(row["trusted"] == "True" for row in results)
    seconds = np.median([float(row["cpu_s"]) for row in results])
    rows.say(f"{trusted} of {len(results)} studies are trusted; {seconds:.0f} CPU s a study (median)")
    for name, table in (("coverage", coverage_table(results)), ("shrinkage", shrinkage_table(results))):
        print(f"{table}\n")
        if options.results == rows.RESULTS:
            rows.into_docs(DOCS, name, table)


if __name__ == "__main__":
    main()
