"""Exports the posterior of a run: as a table of draws, a fitted normal distribution, or FEBio materials."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bayeskin.errors import InputError
from bayeskin.external.febio import Biphasic, febio_file
from bayeskin.finite_element.problem import Constants
from bayeskin.inference import draws_of, fitted_normal, load_inference_data
from bayeskin.json_files import plain
from bayeskin.storage import write_bytes
from bayeskin.types import Array, ParameterSpace
from bayeskin.workflow.engine import Reporter, Run, open_run, standing
from bayeskin.workflow.output_paths import check_ending
from bayeskin.workflow.stages import doubts_of, stages_of

LAYERS = (("cutis", "c"), ("subcutis", "s"))  # with the letters that end the names of their parameters
LAYERS_NEED = ("E_c", "E_s", "k_c", "k_s")


def export(config: Path, out: Path, reporter: Reporter) -> dict[str, Any]:
    """Writes the posterior of a run to a file, and returns the answer of `bayeskin export`.

    out : .csv for all draws, .json for a fitted normal distribution, .feb for the materials at the medians
    Raises InputError for another ending, and for a run whose posterior is not sampled or out of date.
    """
    check_ending(out, *WRITERS)
    run = open_run(config, reporter)
    state = standing(run, stages_of(run.config))["sample"][0]
    if state != "done":
        problem = f"the posterior is not up to date (sample: {state})"
        raise InputError(config, problem, f"start `bayeskin run {config}` first")
    space, draws = draws_of(load_inference_data(run.at("sample", "posterior.nc")))
    doubts = doubts_of(run)
    contents, says = WRITERS[out.suffix](run, space, draws, doubts)
    write_bytes(out, contents)
    remarks = [f"The posterior is not to be trusted: {doubt}" for doubt in doubts]
    return plain({
        "ok": not doubts, "out": out, "parameters": space.names, "draws": len(draws), "because": doubts,
        "text": "\n".join([f"{out}: {says}", *remarks]),
    })  # fmt: skip


def _table(run: Run, space: ParameterSpace, draws: Array, doubts: list[str]) -> tuple[bytes, str]:
    """Returns all draws as a table with a column for each parameter, and what the file contains."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([f"{p.name} [{p.unit}]" if p.unit else p.name for p in space.parameters])
    writer.writerows([repr(float(value)) for value in row] for row in draws)
    return text.getvalue().encode(), f"{len(draws)} draws of {', '.join(space.names)}, in SI units"


def _normal(run: Run, space: ParameterSpace, draws: Array, doubts: list[str]) -> tuple[bytes, str]:
    """Returns the fitted normal distribution and the fixed constants as JSON, and what the file contains."""
    normal, sample = fitted_normal(space, draws), run.summary("sample")
    sd = np.sqrt(np.diag(normal.covariance))
    document = {
        "parameters": [
            {"name": p.name, "unit": p.unit, "normal_in": "logarithm" if log else "value",
             "mean": mean, "sd": spread, "median": median}
            for p, log, mean, spread, median in zip(
                space.parameters, normal.in_log, normal.mean, sd, np.median(draws, axis=0), strict=True
            )
        ],
        "covariance": normal.covariance,
        "constants": vars(Constants()),
        "trusted": not doubts,
        "because": doubts or sample["reasons"],
        "config_sha256": run.config.sha256,
        "name": run.config.name,
    }  # fmt: skip
    text = json.dumps(plain(document), indent=2, allow_nan=False) + "\n"
    return text.encode(), f"a normal distribution of {', '.join(space.names)}, in SI units"


def _materials(run: Run, space: ParameterSpace, draws: Array, doubts: list[str]) -> tuple[bytes, str]:
    """Returns FEBio's materials at the posterior's medians, and what the file contains.

    Raises InputError where the run does not infer the moduli and permeabilities of both layers.
    """
    missing = [name for name in LAYERS_NEED if name not in space.names]
    if missing:
        remedy = "the materials need the parameters of both layers"
        raise InputError(run.config_path, f"it has no parameter {', '.join(missing)}", remedy)
    theta = dict(zip(space.names, map(float, np.median(draws, axis=0)), strict=True))
    remark = f"Medians of the posterior of {run.config.name} by bayeskin, in SI units."
    remark += "".join(f" The posterior is not to be trusted: {doubt}" for doubt in doubts)
    contents = febio_file([_layer(theta, *layer) for layer in LAYERS], remark)
    return contents, "FEBio's materials of both layers, at the medians, in SI units"


def _layer(theta: Mapping[str, float], name: str, letter: str) -> Biphasic:
    """Returns the material of a layer; letter : the letter that ends the names of its parameters."""
    fixed = Constants()
    poisson_ratio = theta.get(f"nu_{letter}", getattr(fixed, f"nu_{letter}"))
    solid_fraction = 1.0 - getattr(fixed, f"porosity_{letter}")
    permeability_m4_ns = theta[f"k_{letter}"] / fixed.viscosity_pa_s
    return Biphasic(name, solid_fraction, theta[f"E_{letter}"], poisson_ratio, permeability_m4_ns)


WRITERS: dict[str, Callable[[Run, ParameterSpace, Array, list[str]], tuple[bytes, str]]] = {
    ".csv": _table,
    ".json": _normal,
    ".feb": _materials,
}
