"""Compares posteriors of one recording by a coarse model, by a fine model, and by the corrected coarse model.

The demo's recording is inferred three times: with a design on 80 bricks only, with the same design corrected
by a few runs of the default 448 bricks, which are finer at the pads' edges, and with a design of these fine
runs only. The corrected posterior should equal the fine one, with a fraction of the fine runs. The posteriors
are compared parameter by parameter. They are also compared in the quantity that the recording determines
best, the stiffness that the peak force follows, about 3.8e-6 E_c + 9.9e-6 E_s [N, Pa].

    OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 python benchmarks/two_fidelities.py

The benchmark takes some 15 minutes on two cores. A benchmark that was stopped continues where it ended. The
program prints the table and writes docs/figures/two_fidelities.{png,svg}. The runs are stored in
benchmarks/results/two_fidelities.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import rows
from matplotlib.figure import Figure

from bayeskin.inference import load_inference_data
from bayeskin.report import save_figure
from bayeskin.report.style import INK, PAGE_IN, new_figure, panel_title, state_finding, styled
from bayeskin.types import Array
from bayeskin.workflow import stages

FOLDER = rows.RESULTS / "two_fidelities"
FIGURE = Path(__file__).parents[1] / "docs" / "figures" / "two_fidelities"
COMMON = """
[recording]
file = "../../../data/demo.h5"
[sample]
effective_samples = 3000
[design]
points = [32, 24]
held_out = 8
"""
CASES = {
    "coarse": COMMON + "[model]\nrefinement = 0\n",
    "corrected": COMMON + "coarse = 0\nfine_points = 12\nfine_held_out = 6\n",
    "fine": COMMON,
}
COLOURS = {"coarse": "#D55E00", "corrected": "#0072B2", "fine": INK}
PEAK_N_PER_PA = (3.8e-6, 9.9e-6)  # change of the peak force by E_c and by E_s
QUANTITIES = ("stiffness", "E_c", "E_s", "k_c", "k_s")


def sampled(case: str) -> tuple[dict[str, Array], str]:
    """Returns the draws of every quantity, and a sentence on their cost and on whether they are trusted."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    path = FOLDER / f"{case}.toml"
    path.write_text(CASES[case])
    rows.say(f"{case}:")
    answer = stages.run(path, "sample", rows.Log())
    posterior = load_inference_data(FOLDER / case / "sample" / "posterior.nc")["posterior"]
    draws = {name: np.ravel(posterior[name].to_numpy()) for name in QUANTITIES[1:]}
    draws["stiffness"] = PEAK_N_PER_PA[0] * draws["E_c"] + PEAK_N_PER_PA[1] * draws["E_s"]
    design = json.loads((FOLDER / case / "design" / "stage.json").read_text())["summary"]
    check = answer["full_model"][-1]
    sentence = (
        f"{case}: {design['seconds_of_runs']:.0f} s for {design['runs']} runs; of {check['draws']} draws "
        f"{check['effective']:.1f} are effective in the full model; {answer['verdict']}"
    )
    return draws, sentence


def table(draws: dict[str, dict[str, Array]]) -> str:
    """Returns a table of medians and 90 % intervals.

    Brackets have the distance of the median from that of the fine posterior in `spread`s of the latter, and
    the ratio of both spreads. These are of logarithms.
    """
    lines = []
    for name in QUANTITIES:
        fine = np.log(draws["fine"][name])
        cells = []
        for case in CASES:
            low, middle, high = np.quantile(draws[case][name], [0.05, 0.5, 0.95])
            shift = (np.log(middle) - np.median(fine)) / spread(fine)
            width = spread(np.log(draws[case][name])) / spread(fine)
            cells.append(f"{middle:.4g} [{low:.4g}, {high:.4g}] ({shift:+.2f}, x {width:.2f})")
        lines.append([name, *cells])
    return rows.markdown(["", *CASES], lines)


def spread(values: Array) -> float:
    """Returns half of the range that 68 % of the values span.

    This is the sd of a normal distribution, and the tails do not affect it.
    """
    low, high = np.quantile(values, [0.16, 0.84])
    return float(0.5 * (high - low))


@styled
def figure(draws: dict[str, dict[str, Array]]) -> Figure:
    """Returns the figure, with one panel for each quantity and one line for each posterior."""
    drawn = new_figure(PAGE_IN, 2.4)
    axes = drawn.subplots(1, 3)
    for ax, name, letter, unit in zip(axes, QUANTITIES, "abc", ("N", "Pa", "Pa"), strict=False):
        everything = np.concatenate([draws[case][name] for case in CASES])
        low, high = np.quantile(everything, [0.001, 0.999])
        edges = np.linspace(low, high, 61)
        for case, colour in COLOURS.items():
            density = np.histogram(draws[case][name], edges, density=True)[0]
            ax.stairs(density, edges, color=colour, label=case, lw=1.0)
        panel_title(ax, letter, name)
        ax.set(xlabel=f"{name} [{unit}]", yticks=[])
    axes[0].legend(loc="upper right")
    shifts = {
        case: (np.median(draws[case]["stiffness"]) - np.median(draws["fine"]["stiffness"]))
        / spread(draws["fine"]["stiffness"])
        for case in CASES
    }
    state_finding(
        drawn,
        f"In the stiffness the coarse posterior is {shifts['coarse']:+.1f} sd from the fine one, "
        f"the corrected one {shifts['corrected']:+.1f} sd",
        "Posteriors of the demo's recording. Stiffness: 3.8e-6 E_c + 9.9e-6 E_s; the peak force follows it.",
    )
    return drawn


def main() -> None:
    results = {case: sampled(case) for case in CASES}
    draws = {case: case_draws for case, (case_draws, _) in results.items()}
    print(table(draws))
    for _, sentence in results.values():
        print(sentence)
    save_figure(figure(draws), FIGURE, "benchmarks/two_fidelities.py")


if __name__ == "__main__":
    main()
