"""Compares the reduced model of any device with its full model, and its estimated error with the true one.

    OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 python benchmarks/reduced_device.py device.toml device-reduced.h5

The cases are skins of the base model on random protocols of their own, half of them with other layers and
another arm. None was used to train the model. The full runs are kept in a store beside the reduced model.

With `--kept device-reduced-training/runs.store` the cases are training runs of mechanisms, from number
`--least` on. They are kept until the model is finished. A model that was trained with fewer runs has not used
them.

The last lines count the cases that each model finishes, and those in which the true error is within the
estimate.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import rows

from bayeskin.config.device import load_device
from bayeskin.execution.local import local
from bayeskin.finite_element.simulate import ModelSpec, simulate
from bayeskin.geometry import LENGTHS, Geometry
from bayeskin.mechanisms import catalogue
from bayeskin.reduced.build import BuildSettings
from bayeskin.reduced.cases import BASE, Case
from bayeskin.reduced.files import load_reduced
from bayeskin.reduced.runs import FullRuns, depends_on
from bayeskin.reduced.simulate import simulate_reduced
from bayeskin.store import Store
from bayeskin.types import Array
from bayeskin.workflow.reducing import REFINEMENT, trained_for

SEED = 777  # no training case has this seed


def theta_of(case: Case) -> dict[str, float]:
    """Returns the parameters of a case together with its lengths; a flat arm has no radius."""
    lengths = {name: getattr(case.geometry, name) for name in LENGTHS}
    return {**case.theta, **{name: value for name, value in lengths.items() if value is not None}}


class FullForce:
    """Runs the full model of a device on a case; returns times [s], force [N] and why it failed."""

    def __init__(self, geometry: Geometry) -> None:
        self.spec = ModelSpec(refinement=REFINEMENT, geometry=geometry)

    def __call__(self, case: Case) -> dict[str, Array | str]:
        run = simulate(self.spec, case.motion, theta_of(case), falls_too=False)
        return {"time_s": run.time_s, "force_n": run.force_n, "message": run.message}


def full_forces(cases: Mapping[int, Case], geometry: Geometry, path: Path) -> dict[int, dict[str, Array]]:
    """Returns the full runs of those cases that the full model finishes."""
    model, forces = FullForce(geometry), {}
    with Store(path, model.spec.hash, rows.say) as store:
        todo = [case for number, case in cases.items() if number not in store]
        names = [number for number in cases if number not in store]
        for index, force in local(2)(model, todo):
            store.add(names[index], force)
            rows.say(f"full run {names[index]}: {force['message'] or 'finished'}")
        for number in cases:
            force = store.read(number, dict)
            if not force["message"]:
                forces[number] = force
    return forces


def kept_forces(geometry: Geometry, path: Path, least: int) -> tuple[dict[str, Case], dict[str, Any]]:
    """Returns the training runs of mechanisms with a number of at least `least` that have finished.

    path : store of the training runs, which `bayeskin reduce` keeps until the model is finished
    """
    spec, trained = ModelSpec(refinement=REFINEMENT, geometry=geometry), trained_for(geometry)
    settings, cases, forces = BuildSettings(), dict[str, Case](), dict[str, Any]()
    with Store(path, "training runs", rows.say) as store:
        runs = FullRuns(spec, store)
        for kind in sorted(trained.mechanisms):
            for number, case in enumerate(settings.cases(trained, kind)):
                if number < least or depends_on(spec, case) not in store:
                    continue
                run = runs.read(case)
                if not run.message:
                    name = f"{kind} {number}"
                    cases[name], forces[name] = case, {"time_s": run.time_s, "force_n": run.force_n}
    return cases, forces


def main() -> None:
    """Prints the errors of the cases, and counts them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("device", type=Path)
    parser.add_argument("reduced", type=Path)
    parser.add_argument("--cases", type=int, default=16)
    parser.add_argument("--kept", type=Path, help="store of training runs")
    parser.add_argument("--least", type=int, default=BuildSettings().first_runs, help="first of these runs")
    options = parser.parse_args()
    model, geometry = load_reduced(options.reduced), load_device(options.device).geometry
    cases: Mapping[Any, Case] = {
        number: trained_for(geometry).case(BASE, number, SEED) for number in range(options.cases)
    }
    if options.kept is None:
        full: Mapping[Any, Any] = full_forces(cases, geometry, options.reduced.with_suffix(".fresh.store"))
    else:
        cases, full = kept_forces(geometry, options.kept, options.least)
    errors: dict[int, list[tuple[float, float]]] = {}
    for name, force in full.items():
        case = cases[name]
        active = [catalogue()[mechanism] for mechanism in case.mechanisms]
        run = simulate_reduced(model, case.motion, theta_of(case), active, estimate=True)
        if run.status != "ok":
            rows.say(f"case {name}: {run.message}")
            continue
        peak_n, weights = float(np.abs(force["force_n"]).max()), np.gradient(force["time_s"])
        squared = (run.at(force["time_s"]) - force["force_n"]) ** 2
        true = 100 * float(np.sqrt(np.average(squared, weights=weights))) / peak_n
        estimate = 100 * run.stats["error_estimate_n"] / peak_n
        errors.setdefault(len(case.mechanisms), []).append((true, estimate))
        rows.say(f"case {name}: error {true:.3f} %, estimate {estimate:.3f} % of the peak")
    for count, pairs in sorted(errors.items()):
        wanted = sum(len(cases[name].mechanisms) == count for name in full)
        true, estimate = np.array(pairs).T
        print(
            f"{count} mechanisms: of {wanted} cases that the full model finishes, the reduced model finishes "
            f"{len(pairs)}; RMS error in % of the peak {np.median(true):.3f} in the median, "
            f"{np.quantile(true, 0.9):.3f} in nine of ten, {true.max():.3f} at most; within the estimate in "
            f"{np.sum(true <= estimate)}"
        )


if __name__ == "__main__":
    main()
