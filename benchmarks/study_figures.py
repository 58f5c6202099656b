"""Draws the figures of docs/population.md from one of the simulated studies of `study_coverage.py`.

python benchmarks/study_figures.py
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from study_coverage import simulate

from bayeskin.report import figure_population, figure_recordings, save_figure
from bayeskin.study import infer_population, sentences

FIGURES = Path(__file__).parents[1] / "docs" / "figures"
SEED = 6


def main() -> None:
    rng = np.random.default_rng(SEED)
    _, entries, individuals = simulate(rng)
    population = infer_population(entries, individuals, rng)
    print("\n".join(sentences(population)))
    for stem, figure in (("recordings", figure_recordings), ("population", figure_population)):
        save_figure(
            figure(population), FIGURES / f"study-{stem}", f"benchmarks/study_figures.py, seed {SEED}"
        )


if __name__ == "__main__":
    main()
