"""Compares the reduced model of any device with its full model, and its estimated error with the true one.

    OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 python benchmarks/reduced_device.py device.toml device-reduced.h5

The cases are skins of the base model on random protocols of their own, half of them with other layers and
another arm. None was used to train the model. The full runs are kept in a store beside
the reduced model. The last lines count the cases that each model finishes, and those in which the true error
is within the estimate.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import rows

from bayeskin.config.device import load_device
from bayeskin.execution.local import local
from bayeskin.finite_element.simulate import ModelSpec, simulate
from bayeskin.geometry import LENGTHS, Geometry
from bayeskin.reduced.cases import BASE, Case
from bayeskin.reduced.files import load_reduced
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


def main() -> None:
    """Prints the errors of the cases, and counts them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("device", type=Path)
    parser.add_argument("reduced", type=Path)
    parser.add_argument("--cases", type=int, default=16)
    options = parser.parse_args()
    model, geometry = load_reduced(options.reduced), load_device(options.device).geometry
    cases = {number: trained_for(geometry).case(BASE, number, SEED) for number in range(options.cases)}
    full, errors = full_forces(cases, geometry, options.reduced.with_suffix(".fresh.store")), []
    for number, force in full.items():
        case = cases[number]
        run = simulate_reduced(model, case.motion, theta_of(case), [], estimate=True)
        if run.status != "ok":
            rows.say(f"case {number}: {run.message}")
            continue
        peak_n, weights = float(np.abs(force["force_n"]).max()), np.gradient(force["time_s"])
        squared = (run.at(force["time_s"]) - force["force_n"]) ** 2
        true = float(np.sqrt(np.average(squared, weights=weights))) / peak_n
        errors.append((100 * true, 100 * run.stats["error_estimate_n"] / peak_n))
        rows.say("case {}: error {:.3f} %, estimate {:.3f} % of the peak".format(number, *errors[-1]))
    finished = len(errors)
    print(f"{len(full)} of {len(cases)} finish in the full model, {finished} of these in the reduced")
    true, estimate = np.array(errors).T
    print(f"RMS error in % of the peak: {np.median(true):.3f} in the median, {true.max():.3f} at most")
    print(f"the true error is within the estimate in {np.sum(true <= estimate)} of {finished} cases")


if __name__ == "__main__":
    main()
