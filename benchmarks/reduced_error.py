"""Compares the reduced model's estimate of its own error with the true error, on fresh cases.

    OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 python benchmarks/reduced_error.py [--full] [--figure FILE.png]

There are four cases of the base model and of each mechanism of the tissue. Half of the latter have one or two
other mechanisms too, and a quarter have other layers and another arm. Each case has a random protocol of its
own. None of them was used to train the model or to choose one of its constants. Sixteen more cases lie
outside the trained region, where the model refuses to run. Here it runs all the same, to see whether its
estimate still holds. The forces of the full model are stored in results/reduced_fresh.h5. With --full the
missing ones are computed, in some ten seconds each.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from unittest import mock

import h5py
import numpy as np
from matplotlib.figure import Figure
from reduced_model import Row, compared, keep_full_run

from bayeskin.finite_element.simulate import ModelSpec
from bayeskin.geometry import LENGTHS
from bayeskin.hashing import sha256_of
from bayeskin.reduced import simulate as reduced_runs
from bayeskin.reduced.cases import BASE, CASES, SETS, Case
from bayeskin.reduced.files import load_reduced
from bayeskin.reduced.model import ReducedModel
from bayeskin.reduced.region import outside
from bayeskin.reduced.runs import depends_on
from bayeskin.report.style import INK, PAGE_IN, new_figure, state_finding, styled
from bayeskin.shipped import shipped
from bayeskin.types import PadMotion, ParameterSpace
from bayeskin.workflow.reducing import SHIPPED, trained_for

RESULTS = Path(__file__).with_name("results") / "reduced_fresh.h5"
SEED = 20261128  # no training case has this seed
EACH = 4  # cases of each kind, and cases of each way to leave the trained region
BEYOND = 0.2  # distance of a parameter from the end of its prior, over the prior's width
# Factors on the largest trained displacement, speed and change of thickness.
WIDER, FASTER, THICKER = 1.3, 4.0, 1.4
GROUPS = {0: ("base model", "#0072B2"), 1: ("one mechanism", "#009E73"), 2: ("sets of 2 and 3", "#D55E00")}


def fresh() -> dict[str, Case]:
    """Returns the cases by their names."""
    trained = trained_for(ModelSpec().geometry)
    kinds = [BASE, *sorted(trained.mechanisms)]
    return {f"{kind}-{index}": trained.case(kind, index, SEED) for kind in kinds for index in range(EACH)}


def beyond(index: int) -> Case:
    """Returns a case outside the trained region by a parameter, the displacement, the speed or the layers."""
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
    thick = 1.0 + THICKER * CASES.thickness_range
    layers = {name: thick * getattr(trained.geometry, name) for name in ("cutis_m", "subcutis_m")}
    return replace(case, geometry=replace(trained.geometry, **layers))


def pushed(space: ParameterSpace, theta: Mapping[str, float], rng: np.random.Generator) -> dict[str, float]:
    """Returns one parameter of a prior, by its name, with a value beyond the prior's end."""
    unit = space.to_unit([theta[name] for name in space.names])
    column = int(rng.integers(space.dim))
    unit[column] = 1.0 + BEYOND if unit[column] > 0.5 else -BEYOND
    return {space.names[column]: float(space.from_unit(unit)[column])}


def theta_of(case: Case) -> dict[str, float]:
    """Returns the parameters of a case together with its lengths."""
    return {**case.theta, **{name: getattr(case.geometry, name) for name in LENGTHS}}


def told(rows: Sequence[tuple[Case, Row]]) -> list[str]:
    """Returns sentences on how often the true error is within the estimate, and on refused cases."""
    finished = [(case, row) for case, row in rows if not row.message]
    refused = len(rows) - len(finished)
    lines = [f"{len(rows)} cases that the full model finishes; the reduced model refuses {refused} of them."]
    for label, runs in (
        ("all cases", finished),
        ("the trained geometry", [pair for pair in finished if pair[0].geometry == ModelSpec().geometry]),
        ("other layers and arms", [pair for pair in finished if pair[0].geometry != ModelSpec().geometry]),
        *((label, [pair for pair in finished if min(len(pair[0].mechanisms), 2) == count])
          for count, (label, _) in GROUPS.items()),
    ):  # fmt: skip
        if not runs:
            continue
        true, estimate = np.array([[row.rms, row.estimate] for _, row in runs]).T
        shares = ", ".join(
            f"{np.sum(true <= factor * estimate)} within {limit}"
            for factor, limit in ((1, "the estimate"), (2, "twice it"), (4, "four times it"))
        )
        lines.append(
            f"- {label}: {len(runs)} runs, {shares}; true error {100 * np.median(true):.3f} % in the median, "
            f"{100 * true.max():.2f} % at most; median ratio of estimate to true error "
            f"{np.median(estimate / true):.1f}"
        )
    return lines


@styled
def figure(rows: Sequence[tuple[Case, Row]]) -> Figure:
    """Returns the figure of estimated against true error, both in % of the peak force."""
    finished = [(case, row) for case, row in rows if not row.message]
    drawn = new_figure(0.7 * PAGE_IN, 0.62 * PAGE_IN)
    ax = drawn.subplots()
    for count, (label, colour) in GROUPS.items():
        for other_geometry, marker in ((False, "o"), (True, "^")):
            group = [row for case, row in finished if min(len(case.mechanisms), 2) == count
                    and (case.geometry != ModelSpec().geometry) == other_geometry]  # fmt: skip
            ax.loglog([100 * row.rms for row in group], [100 * row.estimate for row in group], marker, ms=5,
                      color=colour, mew=0, alpha=0.85,
                      label=label + (", other layers and arm" if other_geometry else ""))  # fmt: skip
    values = [100 * value for _, row in finished for value in (row.rms, row.estimate)]
    limits = 0.7 * min(values), 1.4 * max(values)
    ax.plot(limits, limits, color=INK, lw=1.0)
    ax.set(xlim=limits, ylim=limits, xlabel="true RMS error [% of the peak force]",
           ylabel="estimated RMS error [% of the peak force]")  # fmt: skip
    ax.legend(loc="lower right", fontsize=7)
    within = sum(row.rms <= row.estimate for _, row in finished)
    state_finding(
        drawn, f"The true error is within its estimate in {within} of {len(finished)} fresh runs.",
        "Above the line the estimate is larger than the true error.",
    )  # fmt: skip
    return drawn


def key_of(name: str, case: Case) -> str:
    """Returns the key of a case in the file: its name, and a hash of all that the force depends on."""
    return f"{name}-{sha256_of(depends_on(ModelSpec(), case))[:12]}"


def main(arguments: Sequence[str]) -> None:
    """Prints the coverage, and draws the figure if a file is named."""
    trained = trained_for(ModelSpec().geometry)
    inside_cases, outside_cases = fresh(), {f"outside-{index}": beyond(index) for index in range(4 * EACH)}
    if "--full" in arguments:
        for name, case in {**inside_cases, **outside_cases}.items():
            keep_full_run(RESULTS, key_of(name, case), case.motion, theta_of(case), case.mechanisms)
    for name, case in outside_cases.items():
        reason = outside(trained, case.theta, case.mechanisms, case.geometry, case.motion)
        assert reason, name
        print(name, reason, file=sys.stderr)
    model = load_reduced(shipped(SHIPPED))
    rows = ran(model, inside_cases)
    print("\n".join(told(rows)))
    with mock.patch.object(reduced_runs, "outside", return_value=""):
        print("\n".join(["Outside of the trained region:", *told(ran(model, outside_cases))[:2]]))
    if "--figure" in arguments:
        figure(rows).savefig(arguments[arguments.index("--figure") + 1], dpi=200)


def ran(model: ReducedModel, cases: Mapping[str, Case]) -> list[tuple[Case, Row]]:
    """Returns the reduced model's errors on the cases that the full model finishes."""
    rows = []
    with h5py.File(RESULTS) as handle:
        for name, case in cases.items():
            key = key_of(name, case)
            if key not in handle:
                raise SystemExit(f"{RESULTS}: no force of {name}; compute it with --full")
            group = handle[key]
            if not group.attrs["message"]:
                row = compared(model, case.motion, theta_of(case), case.mechanisms, group, estimate=True)
                rows.append((case, row))
                print(name, row, file=sys.stderr, flush=True)
    return rows


if __name__ == "__main__":
    main(sys.argv[1:])
