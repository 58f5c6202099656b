"""A study of springs: recordings of two groups, whose stiffnesses differ by a known factor."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import arviz as az
import numpy as np
from toys.closed_form_model import MOTION
from toys.external_models import PARAMETERS, SPRING, TRUE, spring

from bayeskin import storage
from bayeskin.config import parameter_space
from bayeskin.inference import save_inference_data
from bayeskin.types import Array, PadMotion, Recording
from bayeskin.workflow.engine import Run, run_stages
from bayeskin.workflow.stages import stages_of
from bayeskin.workflow.study_recordings import Outcome

SPRING_RUN = """
[model]
forward = "spring.py:force"
[fit]
bin_width_s = 1.0
[design]
points = [24, 8]
held_out = 6
workers = {workers}
[sample]
ensembles = 2
walkers = 20
effective_samples = 100
max_steps = 500
[check]
draws = 0
[map]
starts = 2
evaluations = 500
"""
STUDY = f'table = "table.csv"\n{SPRING_RUN}'
FACTOR = 2.0  # of the stiffnesses of the second group over those of the first
ROWS = (
    ("a-1", "anna", "control", 90.0), ("a-2", "anna", "control", 95.0), ("b-1", "bela", "control", 110.0),
    ("c-1", "cora", "keloid", 180.0), ("d-1", "dora", "keloid", 220.0),
)  # fmt: skip
NOISE_N = 0.002


def small_study(folder: Path, workers: int = 1) -> Path:
    """The file of the study in a folder, with its table and its recordings beside it.

    Its 500 steps are too few for a posterior that is trusted.
    """
    (folder / "rec").mkdir()
    for seed, (name, _, _, stiffness) in enumerate(ROWS):
        record(folder / "rec" / f"{name}.h5", stiffness, seed)
    table_of(folder, ROWS)
    (folder / "spring.py").write_text(SPRING)
    path = folder / "springs.toml"
    path.write_text(STUDY.format(workers=workers) + PARAMETERS)
    return path


def table_of(folder: Path, rows: tuple[tuple[str, str, str, float], ...]) -> None:
    """Writes the table of the recordings."""
    lines = [f"rec/{name}.h5,{subject},{group}" for name, subject, group, _ in rows]
    (folder / "table.csv").write_text("\n".join(["recording,subject,group", *lines]) + "\n")


def record(path: Path, stiffness: float, seed: int, motion: PadMotion = MOTION) -> None:
    """Writes the recording of a spring."""
    time_s: Array = np.arange(0.0, motion.time_s[-1] + 1e-3, 0.1)
    pulled = motion.at(time_s)
    noise_n = NOISE_N * np.random.default_rng(seed).standard_normal(len(time_s))
    force_n = spring()({**TRUE, "stiffness": stiffness}, time_s, pulled) + noise_n
    storage.save(path, Recording(time_s, pulled, force_n, path.stem, f"{seed:064d}"))


def infer_quickly(run: Run) -> Outcome:
    """Stands in the place of `infer`: the posterior scatters about the most probable point."""
    run_stages(run, stages_of(run.config), "map")
    theta, space, file = (
        run.summary("map")["theta"],
        parameter_space(run.config),
        run.at("sample", "posterior.nc"),
    )
    if not file.is_file():
        best = np.array([theta[name] for name in space.names])
        scatter = np.exp(0.02 * np.random.default_rng(0).standard_normal((1000, space.dim)))
        draws = np.clip(best * scatter, space.lower, space.upper)
        posterior = {name: draws[None, :, column] for column, name in enumerate(space.names)}
        parameters = json.dumps([asdict(parameter) for parameter in space.parameters])
        save_inference_data(file, az.from_dict(posterior=posterior, attrs={"parameters": parameters}))
        (run.folder / "report.html").write_text("What is this skin made of?")
    return Outcome(True)
