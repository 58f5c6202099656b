"""The reduced model's estimate of its own error beside the true error, where nothing was tuned.

    OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 python benchmarks/reduced_error.py [--full] [--figure FILE.png]

Four cases of the base model and of each mechanism of the tissue, which half the time have one or two other
mechanisms beside it, a quarter of them on other layers and another arm, each on a random protocol of its own.
None of them was used to train the model or to choose a constant of it. Forces of the full model are in
results/reduced_fresh.h5; with --full those that are missing there are made, some ten seconds each.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np
from matplotlib.figure import Figure

from bayeskin.geometry import LENGTHS
from bayeskin.mechanisms import catalogue, laws
from bayeskin.model.simulate import ModelSpec, simulate
from bayeskin.pipeline.reducing import SHIPPED, trained_for
from bayeskin.reduced.cases import BASE, Case
from bayeskin.reduced.files import load_reduced
from bayeskin.reduced.model import ReducedModel
from bayeskin.reduced.simulate import simulate_reduced
from bayeskin.report.style import INK, PAGE_IN, new_figure, state_finding, styled
from bayeskin.shipped import shipped

RESULTS = Path(__file__).with_name("results") / "reduced_fresh.h5"
SEED = 20261128  # of no training case
EACH = 4  # cases of a kind
GROUPS = {0: ("base model", "#0072B2"), 1: ("one mechanism", "#009E73"), 2: ("sets of 2 and 3", "#D55E00")}


class Row(NamedTuple):
    """A reduced run beside a full one: true and estimated RMS error over the peak, or why there is none."""

    case: Case
    true: float
    estimate: float
    message: str


def fresh() -> dict[str, Case]:
    """The cases by their names."""
    trained = trained_for(ModelSpec().geometry)
    kinds = [BASE, *sorted(trained.mechanisms)]
    return {f"{kind}-{index}": trained.case(kind, index, SEED) for kind in kinds for index in range(EACH)}


def theta_of(case: Case) -> dict[str, float]:
    """The parameters of a case, its lengths among them."""
    return {**case.theta, **{name: getattr(case.geometry, name) for name in LENGTHS}}


def make_missing(cases: dict[str, Case]) -> None:
    """Runs the full model where its force is not in the results."""
    for name, case in cases.items():
        with h5py.File(RESULTS, "a") as handle:
            if name in handle:
                continue
        acting = [catalogue()[mechanism] for mechanism in case.mechanisms]
        run = simulate(ModelSpec(), case.motion, theta_of(case), laws=laws(acting), falls_too=False)
        with h5py.File(RESULTS, "a") as handle:
            group = handle.create_group(name)
            group["time_s"], group["force_n"] = run.time_s, run.force_n.astype(np.float32)
            group.attrs["message"] = run.message
        print(name, run.message or f"{run.stats['seconds']:.1f} s", file=sys.stderr, flush=True)


def compared(model: ReducedModel, case: Case, group: h5py.Group) -> Row:
    """Runs the reduced model with its estimate and compares it at the full run's own steps."""
    acting = [catalogue()[mechanism] for mechanism in case.mechanisms]
    run = simulate_reduced(model, case.motion, theta_of(case), acting, estimate=True)
    if run.status != "ok":
        return Row(case, np.nan, np.nan, run.message)
    time_s, force_n = group["time_s"][()], group["force_n"][()].astype(float)
    peak_n, wrong_n = np.abs(force_n).max(), run.at(time_s) - force_n
    rms_n = float(np.sqrt(np.average(wrong_n**2, weights=np.gradient(time_s))))
    return Row(case, rms_n / peak_n, run.stats["error_estimate_n"] / peak_n, "")


def told(rows: Sequence[Row]) -> list[str]:
    """How often the true error is within the estimate, and what was refused, in sentences."""
    fine = [row for row in rows if not row.message]
    refused = len(rows) - len(fine)
    lines = [f"{len(rows)} cases that the full model finishes; the reduced model refuses {refused} of them."]
    for label, some in (
        ("all cases", fine),
        ("the trained geometry", [row for row in fine if row.case.geometry == ModelSpec().geometry]),
        ("other layers and arms", [row for row in fine if row.case.geometry != ModelSpec().geometry]),
        *((label, [row for row in fine if min(len(row.case.mechanisms), 2) == count])
          for count, (label, _) in GROUPS.items()),
    ):  # fmt: skip
        true, estimate = np.array([[row.true, row.estimate] for row in some]).T
        shares = ", ".join(
            f"{np.sum(true <= factor * estimate)} within {word}"
            for factor, word in ((1, "the estimate"), (2, "twice it"), (4, "four times it"))
        )
        lines.append(
            f"- {label}: {len(some)} runs, {shares}; true error {100 * np.median(true):.3f} % in the median, "
            f"{100 * true.max():.2f} % at most; estimate over true error {np.median(estimate / true):.1f}"
        )
    return lines


@styled
def figure(rows: Sequence[Row]) -> Figure:
    """Estimated against true error, both in % of the peak force."""
    fine = [row for row in rows if not row.message]
    out = new_figure(0.7 * PAGE_IN, 0.62 * PAGE_IN)
    ax = out.subplots()
    for count, (label, colour) in GROUPS.items():
        for moved, marker in ((False, "o"), (True, "^")):
            some = [row for row in fine if min(len(row.case.mechanisms), 2) == count
                    and (row.case.geometry != ModelSpec().geometry) == moved]  # fmt: skip
            ax.loglog([100 * row.true for row in some], [100 * row.estimate for row in some], marker, ms=5,
                      color=colour, mew=0, alpha=0.85,
                      label=label + (", other layers and arm" if moved else ""))  # fmt: skip
    values = [100 * value for row in fine for value in (row.true, row.estimate)]
    ends = 0.7 * min(values), 1.4 * max(values)
    ax.plot(ends, ends, color=INK, lw=1.0)
    ax.set(xlim=ends, ylim=ends, xlabel="true RMS error [% of the peak force]",
           ylabel="estimated RMS error [% of the peak force]")  # fmt: skip
    ax.legend(loc="lower right", fontsize=7)
    within = sum(row.true <= row.estimate for row in fine)
    state_finding(
        out, f"The true error is within its estimate in {within} of {len(fine)} fresh runs.",
        "Above the line the estimate is larger than the true error.",
    )  # fmt: skip
    return out


def main(arguments: Sequence[str]) -> None:
    """Prints the coverage, and draws the figure where a file is named."""
    cases = fresh()
    if "--full" in arguments:
        make_missing(cases)
    model, rows = load_reduced(shipped(SHIPPED)), []
    with h5py.File(RESULTS) as handle:
        for name, case in cases.items():
            if not handle[name].attrs["message"]:
                rows.append(compared(model, case, handle[name]))
                print(name, *rows[-1][1:], file=sys.stderr, flush=True)
    print("\n".join(told(rows)))
    if "--figure" in arguments:
        figure(rows).savefig(arguments[arguments.index("--figure") + 1], dpi=200)


if __name__ == "__main__":
    main(sys.argv[1:])
