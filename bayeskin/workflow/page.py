"""The report of a run: one HTML file about the stages that are done, which is written again each time."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import bayeskin
from bayeskin import storage
from bayeskin.config import parameter_space
from bayeskin.report.page import RunFacts, StageFacts, render_page
from bayeskin.sensitivity.result import SobolResult
from bayeskin.workflow.diagnosis_forces import FORCES
from bayeskin.workflow.engine import Run, Stage, standing
from bayeskin.workflow.folder import Record
from bayeskin.workflow.further_tests import FOLDER, judged_tests

FILE = "report.html"


def write_page(run: Run, stages: Mapping[str, Stage]) -> Path:
    """Writes the page into the run's folder, completely or not at all, and returns its path.

    A stage that is not done, or that was made from other inputs than the present ones, is named and left out.
    """
    path = run.folder / FILE
    storage.write_bytes(path, render_page(facts_of(run, stages)).encode())
    return path


def facts_of(run: Run, stages: Mapping[str, Stage]) -> RunFacts:
    """Returns all content of the page, from the records of the stages."""
    config = run.config
    space = parameter_space(config, run.config_path)
    states = standing(run, stages)
    if states.get("diagnose", ("", None))[0] == "done" and (answered := judged_tests(run)) is not None:
        states[FOLDER] = "done", answered
    facts = {name: _facts(run, name, *state) for name, state in states.items() if name != "report"}
    return RunFacts(
        name=config.name,
        config_path=str(run.config_path),
        config_text=run.config_path.read_text(encoding="utf-8-sig") if run.from_file else "",
        config_sha256=config.sha256,
        version=bayeskin.__version__,
        seed=config.seed,
        observation=config.model.observation,
        mesh=config.model.forward or Path(config.model.mesh).name,
        parameters={p.name: p.description for p in space.parameters},
        stages=facts,
        history=_history(run) if "sample" in facts and facts["sample"].done else None,
        indices=_indices(run, facts["sobol"]) if "sobol" in facts else {},
        forces=_forces(run) if "diagnose" in facts and facts["diagnose"].done else (),
    )


def _facts(run: Run, name: str, stands: str, record: Record | None) -> StageFacts:
    """Returns state, duration, summary and figures of a stage; a stage that is not done has only a state."""
    if record is None:
        return StageFacts(name, stands)
    if stands == "failed":
        return StageFacts(name, stands, record.seconds, record.summary)
    if stands != "done":
        return StageFacts(name, stands)
    files = {
        file.removesuffix(".svg"): run.at(name, file) for file in record.outputs if file.endswith(".svg")
    }
    figures = {figure: path.read_text(encoding="utf-8") for figure, path in files.items()}
    return StageFacts(name, stands, record.seconds, record.summary, figures)


def _history(run: Run) -> dict[str, Any]:
    """Returns the bands of the stage `sample`."""
    history: dict[str, Any] = json.loads(run.at("sample", "bands.json").read_text(encoding="utf-8"))
    return history


def _forces(run: Run) -> list[dict[str, Any]]:
    """Returns the forces of the stage `diagnose`."""
    forces: list[dict[str, Any]] = json.loads(run.at("diagnose", FORCES).read_text(encoding="utf-8"))
    return forces


def _indices(run: Run, stage: StageFacts) -> dict[str, SobolResult]:
    """Returns the Sobol' indices over time of each set for which the stage `sobol` has a file."""
    files = {name: run.at("sobol", f"{name}.h5") for name in stage.summary if stage.done}
    return {name: storage.load(file, SobolResult) for name, file in files.items() if file.is_file()}
