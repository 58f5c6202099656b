"""The reduced model's estimate of its own error beside the true error, where nothing was tuned.

    OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 python benchmarks/reduced_error.py [--full] [--figure FILE.png]

Four cases of the base model and of each mechanism of the tissue, which half the time have one or two other
mechanisms beside it, a quarter of them on other layers and another arm, each on a random protocol of its own.
None of them was used to train the model or to choose a constant of it. Sixteen more lie outside of the
trained region, where the model refuses to run: here it runs all the same, to see whether its estimate still
holds. Forces of the full model are in results/reduced_fresh.h5; with --full those that are missing there are
made, some ten seconds each.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
from matplotlib.figure import Figure
from reduced_model import Row, compared, keep_full_run

from bayeskin.finite_element.simulate import ModelSpec
from bayeskin.geometry import LENGTHS
from bayeskin.reduced import simulate as reduced_runs
from bayeskin.reduced.cases import BASE, SETS, THICKNESS_RANGE, Case
from bayeskin.reduced.files import load_reduced
from bayeskin.reduced.model import ReducedModel
from bayeskin.reduced.region import outside
from bayeskin.reduced.runs import FullRuns
from bayeskin.report.style import INK, PAGE_IN, new_figure, state_finding, styled
from bayeskin.shipped import shipped
from bayeskin.types import PadMotion, ParameterSpace
from bayeskin.workflow.reducing import SHIPPED, trained_for

RESULTS = Path(__file__).with_name("results") / "reduced_fresh.h5"
SEED = 20261128  # of no training case
EACH = 4  # cases of a kind, and of a way to leave the trained region
BEYOND = 0.2  # of the width of a prior, by which a parameter leaves it
WIDER, FASTER, THICKER = 1.3, 4.0, 1.4  # than the widest, fastest and thickest that was trained
GROUPS = {0: ("base model", "#0072B2"), 1: ("one mechanism", "#009E73"), 2: ("sets of 2 and 3", "#D55E00")}


def fresh() -> dict[str, Case]:
    """The cases by their names."""
    trained = trained_for(ModelSpec().geometry)
    kinds = [BASE, *sorted(trained.mechanisms)]
    return {f"{kind}-{index}": trained.case(kind, index, SEED) for kind in kinds for index in range(EACH)}


def beyond(index: int) -> Case:
    """A case outside of the trained region: a parameter, the displacement, the speed or the layers."""
    trained = trained_for(ModelSpec().geometry)
    kind = BASE if index < 2 * EACH else SETS
    case = trained.case(kind, index, SEED)
    rng, time_s, height_m = (
        np.random.default_rng([SEED, index]),
        case.motion.time_s,
        case.motion.displacement_m,
    )
    if index % 4 == 0:
        return replace(case, theta={**case.theta, **pushed(trained.base, case.theta, rng)})
    if index % 4 == 1:
        largest_m = WIDER * trained.protocols.largest_m
        return replace(case, motion=PadMotion(time_s, height_m * largest_m / height_m.max()))
    if index % 4 == 2:
        fastest = np.abs(np.diff(height_m) / np.diff(time_s)).max()
        return replace(
            case, motion=PadMotion(time_s * fastest / (FASTER * trained.protocols.speeds_m_s[1]), height_m)
        )
    thick = 1.0 + THICKER * THICKNESS_RANGE
    layers = {name: thick * getattr(trained.geometry, name) for name in ("cutis_m", "subcutis_m")}
    return replace(case, geometry=replace(trained.geometry, **layers))


def pushed(space: ParameterSpace, theta: Mapping[str, float], rng: np.random.Generator) -> dict[str, float]:
    """One parameter of a prior beyond its end."""
    unit = space.to_unit([theta[name] for name in space.names])
    column = int(rng.integers(space.dim))
    unit[column] = 1.0 + BEYOND if unit[column] > 0.5 else -BEYOND
    return {space.names[column]: float(space.from_unit(unit)[column])}


def theta_of(case: Case) -> dict[str, float]:
    """The parameters of a case, its lengths among them."""
    return {**case.theta, **{name: getattr(case.geometry, name) for name in LENGTHS}}


def told(rows: Sequence[tuple[Case, Row]]) -> list[str]:
    """How often the true error is within the estimate, and what was refused, in sentences."""
    fine = [(case, row) for case, row in rows if not row.message]
    refused = len(rows) - len(fine)
    lines = [f"{len(rows)} cases that the full model finishes; the reduced model refuses {refused} of them."]
    for label, some in (
        ("all cases", fine),
        ("the trained geometry", [one for one in fine if one[0].geometry == ModelSpec().geometry]),
        ("other layers and arms", [one for one in fine if one[0].geometry != ModelSpec().geometry]),
        *((label, [one for one in fine if min(len(one[0].mechanisms), 2) == count])
          for count, (label, _) in GROUPS.items()),
    ):  # fmt: skip
        if not some:
            continue
        true, estimate = np.array([[row.rms, row.estimate] for _, row in some]).T
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
def figure(rows: Sequence[tuple[Case, Row]]) -> Figure:
    """Estimated against true error, both in % of the peak force."""
    fine = [(case, row) for case, row in rows if not row.message]
    out = new_figure(0.7 * PAGE_IN, 0.62 * PAGE_IN)
    ax = out.subplots()
    for count, (label, colour) in GROUPS.items():
        for moved, marker in ((False, "o"), (True, "^")):
            some = [row for case, row in fine if min(len(case.mechanisms), 2) == count
                    and (case.geometry != ModelSpec().geometry) == moved]  # fmt: skip
            ax.loglog([100 * row.rms for row in some], [100 * row.estimate for row in some], marker, ms=5,
                      color=colour, mew=0, alpha=0.85,
                      label=label + (", other layers and arm" if moved else ""))  # fmt: skip
    values = [100 * value for _, row in fine for value in (row.rms, row.estimate)]
    ends = 0.7 * min(values), 1.4 * max(values)
    ax.plot(ends, ends, color=INK, lw=1.0)
    ax.set(xlim=ends, ylim=ends, xlabel="true RMS error [% of the peak force]",
           ylabel="estimated RMS error [% of the peak force]")  # fmt: skip
    ax.legend(loc="lower right", fontsize=7)
    within = sum(row.rms <= row.estimate for _, row in fine)
    state_finding(
        out, f"The true error is within its estimate in {within} of {len(fine)} fresh runs.",
        "Above the line the estimate is larger than the true error.",
    )  # fmt: skip
    return out


def key_of(name: str, case: Case) -> str:
    """Where the file holds a case's force: its name, and a hash of all that the force depends on."""
    spec = ModelSpec()
    return f"{name}-{FullRuns(spec.geometry, spec.refinement, RESULTS.parent).path(case).stem[:12]}"


def main(arguments: Sequence[str]) -> None:
    """Prints the coverage, and draws the figure where a file is named."""
    trained = trained_for(ModelSpec().geometry)
    inside, leaving = fresh(), {f"outside-{index}": beyond(index) for index in range(4 * EACH)}
    if "--full" in arguments:
        for name, case in {**inside, **leaving}.items():
            keep_full_run(RESULTS, key_of(name, case), case.motion, theta_of(case), case.mechanisms)
    for name, case in leaving.items():
        why = outside(trained, case.theta, case.mechanisms, case.geometry, case.motion)
        assert why, name
        print(name, why, file=sys.stderr)
    model = load_reduced(shipped(SHIPPED))
    rows = ran(model, inside)
    print("\n".join(told(rows)))
    reduced_runs.outside = lambda *_: ""  # type: ignore[assignment]
    print("\n".join(["Outside of the trained region:", *told(ran(model, leaving))[:2]]))
    if "--figure" in arguments:
        figure(rows).savefig(arguments[arguments.index("--figure") + 1], dpi=200)


def ran(model: ReducedModel, cases: Mapping[str, Case]) -> list[tuple[Case, Row]]:
    """The reduced model's errors on those cases that the full model finishes."""
    rows = []
    with h5py.File(RESULTS) as handle:
        for name, case in cases.items():
            group = handle[key_of(name, case)]
            if not group.attrs["message"]:
                row = compared(model, case.motion, theta_of(case), case.mechanisms, group, estimate=True)
                rows.append((case, row))
                print(name, row, file=sys.stderr, flush=True)
    return rows


if __name__ == "__main__":
    main(sys.argv[1:])
