"""The stages of a run that a job goes through: how each stands, and how long it still takes."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from bayeskin.app.estimate import seconds_left, usual_seconds
from bayeskin.app.jobs import Job
from bayeskin.app.questions import CALIBRATE, PREPARE
from bayeskin.app.recordings import RecordingFolder
from bayeskin.workflow.diagnosis import stages_of as stages_of_diagnosis
from bayeskin.workflow.diagnosis_progress import LABEL as WHOLE_DIAGNOSIS
from bayeskin.workflow.engine import Run, Silent, Stage, open_run, standing
from bayeskin.workflow.folder import RECORD, Record
from bayeskin.workflow.stages import stages_of


@dataclass(frozen=True)
class Step:
    """A stage of the run that a job works on.

    state : "done", "working", "waiting" or "failed"; message : why it failed
    seconds : how long it has taken so far; left_s : how long it is expected to take beyond that
    """

    name: str
    does: str
    state: str
    seconds: float
    left_s: float = 0.0
    message: str = ""


def steps(folder: RecordingFolder, job: Job, others: Sequence[RecordingFolder]) -> list[Step]:
    """Returns the stages that a job goes through; none for the preparation of a device.

    others : recordings whose finished runs show how long stages usually take
    """
    if job.question == PREPARE.key:
        return []
    run = open_run(folder.config, Silent())
    stages = _stages(run, job)
    shown: list[Step] = []
    for name, (stands, record) in standing(run, stages).items():
        begun = job.running and all(step.state == "done" for step in shown)
        usual_s = usual_seconds(name, run.config, others)
        shown.append(_step(run, stages[name], stands, record, job if begun else None, usual_s))
    return shown


def _stages(run: Run, job: Job) -> Mapping[str, Stage]:
    """Returns the stages of a question, in their order."""
    if job.question == CALIBRATE.key:
        stages = stages_of(run.config)
        return {name: stages[name] for name in (*stages["report"].needs, "report")}
    return stages_of_diagnosis(run.config)


def _step(
    run: Run, stage: Stage, stands: str, record: Record | None, job: Job | None, usual_s: float
) -> Step:
    """Returns how a stage stands; `job` is the job that works on it, or None where none does."""
    if stands == "done" and record is not None:
        return Step(stage.name, stage.does, "done", record.seconds)
    if job is None:
        if stands == "failed" and record is not None:
            return Step(stage.name, stage.does, "failed", record.seconds, 0.0, record.summary["message"])
        return Step(stage.name, stage.does, "waiting", 0.0, usual_s)
    seconds = 0.0
    if record is not None and stands == "not finished":  # its record was written when it began
        seconds = record.seconds + _age_s(run.folder / stage.name / RECORD)
    now_s = time.monotonic()
    tasks_left_s = {task.label: left_s for task in job.tasks if (left_s := task.left_s(now_s)) is not None}
    left_s = tasks_left_s.get(WHOLE_DIAGNOSIS, seconds_left(seconds, usual_s, list(tasks_left_s.values())))
    return Step(stage.name, stage.does, "working", seconds, left_s)


def _age_s(file: Path) -> float:
    """Returns the seconds since a file was written, and 0 if it is just being replaced."""
    try:
        return max(time.time() - file.stat().st_mtime, 0.0)
    except FileNotFoundError:
        return 0.0
