"""Renders the pages: each function fills a template with what the page shows."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import datetime, timedelta
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment

from bayeskin.app import comparison, devices, jobs, reading
from bayeskin.app.estimate import range_left
from bayeskin.app.questions import MISSING, PREPARE, QUESTIONS
from bayeskin.app.recordings import RecordingFolder, Recordings
from bayeskin.app.steps import steps
from bayeskin.app.uploads import MOST_BYTES
from bayeskin.errors import InputError
from bayeskin.number_format import number, percent
from bayeskin.report.page.parts import Cell, Facts, Folded, Table, Text, row
from bayeskin.report.page.render import page_environment
from bayeskin.workflow.diagnosis_progress import LABEL as WHOLE_DIAGNOSIS
from bayeskin.workflow.progress import TaskProgress
from bayeskin.workflow.reducing import default_path, training_folder

HERE = Path(__file__).parent
_TITLES = {key: question.title for key, question in QUESTIONS.items()}
_TONES = {jobs.State.DONE: "good", jobs.State.RUNNING: "none", jobs.State.STOPPED: "none"}
_FINISHED = (jobs.State.DONE, jobs.State.NOT_TRUSTED)
# The parts of a recording's page in which an error may stand.
_PROBLEMS = ("reading", "device", "ask", "remove")


@cache
def _environment() -> Environment:
    return page_environment(HERE / "templates")


def render(template: str, root: str, **parts: Any) -> str:
    """Returns a filled template; `root` is the path below which all pages lie."""
    return _environment().get_template(template).render(root=root, **parts)


def recordings_page(root: str, recordings: Recordings) -> str:
    """Returns the page with all recordings, and the place to drop a further one."""
    rows = [
        (folder, _day(folder.dropped_s), job, _share(job))
        for folder in recordings.all()
        for job in [jobs.job_of(folder.job)]
    ]
    return render("recordings.html", root, rows=rows, titles=_TITLES, most_bytes=MOST_BYTES)


def recording_page(
    root: str, recordings: Recordings, folder: RecordingFolder, problems: Mapping[str, str] | None = None
) -> str:
    """Returns the page of a recording: how it was understood, its device, the questions, and the answer.

    problems : errors of the last request, by the part of the page that they belong to
    """
    read, job = reading.reading_of(folder), jobs.job_of(folder.job)
    problems = dict.fromkeys(_PROBLEMS, "") | dict(problems or {})
    try:
        device = devices.device_of(folder)
    except InputError as error:
        device, problems["device"] = devices.DeviceFile(), str(error)
    stated = folder.device.is_file() and not problems["device"]
    sheets, run = reading.beginnings(folder), comparison.answer_of(folder)
    others = [(other.name, other.name) for other in recordings.all()
              if other != folder and other.device.is_file()]  # fmt: skip
    return render(
        "recording.html", root, folder=folder, reading=read, choice=read.choice, problems=problems,
        facts=_facts(read.answer), details=_details(read.answer), charts=reading.charts(folder, read.answer),
        sheets=sheets, columns=_columns(sheets), units=reading.unit_options(),
        stated=stated, fields=devices.fields_of(device), others=others,
        job=job, titles=_TITLES, questions=_questions(folder, stated),
        ready=bool(read.answer) and stated and not (job and job.running),
        answer=run and run.answer,
    )  # fmt: skip


def job_page(root: str, recordings: Recordings, folder: RecordingFolder, job: jobs.Job) -> str:
    """Returns the page of a job: its progress with the time left, its steps, and its last lines."""
    now_s, lines = time.monotonic(), job.lines
    stages = steps(folder, job, [other for other in recordings.all() if other != folder])
    failed = any(step.state == "failed" for step in stages)
    left = _about(*range_left({step.name: step.left_s for step in stages}))
    return render(
        "job.html", root, folder=folder, job=job, question=QUESTIONS[job.question],
        word="failed" if failed else str(job.state), tone="doubt" if failed else _tone(job),
        goes_on=failed or job.state not in _FINISHED, refused=_refusal(job, lines), lines=lines,
        so_far=_duration(job.seconds), left=left if job.running and stages else "",
        tasks=[_task(task, now_s) for task in job.tasks if job.running],
        steps=[{**asdict(step), "taken": _duration(step.seconds) if step.seconds else ""} for step in stages],
    )  # fmt: skip


def comparison_page(root: str, folders: Sequence[RecordingFolder]) -> str:
    """Returns the page that compares the posteriors of several runs."""
    runs = comparison.answered(folders)
    parameters = comparison.by_parameter(runs)
    table = comparison.table(runs, parameters)
    return render("compare.html", root, runs=runs, parameters=parameters, table=table)


def _facts(answer: Mapping[str, Any]) -> Facts:
    """Returns short facts about a recording."""
    if not answer:
        return Facts(())
    displacement, force = answer["displacement_m"], answer["force_n"]
    low_mm, high_mm = 1e3 * displacement["min"], 1e3 * displacement["max"]
    return Facts((
        ("samples", f"{answer['samples']} at {number(answer['sampling_hz'], 3)} Hz"),
        ("duration", f"{number(answer['duration_s'], 4)} s"),
        ("cycles", str(answer["cycles"])),
        ("displacement", f"{number(low_mm)} to {number(high_mm)} mm"),
        ("force", f"{number(force['min'])} to {number(force['max'])} N"),
    ))  # fmt: skip


def _details(answer: Mapping[str, Any]) -> list[Folded]:
    """Returns the table of the phases, and the notes on how the file was read, both folded away."""
    rows = [
        row((
            phase["kind"], _cell(phase["cycle"]), _cell(phase["start_s"]), _cell(phase["end_s"]),
            _cell(1e3 * phase["start_m"]), _cell(1e3 * phase["end_m"]), _cell(1e3 * phase["noise_sd_n"], 2),
            _cell(phase["spikes"]), _cell(len(phase["steps"])),
        ))
        for phase in answer.get("phases", ())
    ]  # fmt: skip
    head = ("phase", "cycle", "from [s]", "to [s]", "from [mm]", "to [mm]", "noise [mN]", "spikes", "steps")
    notes = answer.get("notes", ())
    details = [Folded(f"All {len(rows)} phases", (Table("Phases", head, rows),))]
    return details + (
        [Folded("Notes on how the file was read", (Text(notes, listed=True),))] if notes else []
    )


def _cell(value: float, digits: int = 4) -> Cell:
    return Cell(number(value, digits), value)


def _columns(sheets: Sequence[reading.SheetPreview]) -> list[tuple[str, str]]:
    """Returns the columns that a person can choose, by number, with the names that they have in any sheet."""
    widths = [max([len(cells) for _, cells in sheet.rows], default=0) for sheet in sheets]
    options = []
    for index in range(max(widths, default=0)):
        names = (sheet.names[index] for sheet in sheets if index < len(sheet.names))
        name = next((name.strip() for name in names if name.strip()), "")
        options.append((str(index + 1), f"{index + 1}: {name}" if name else str(index + 1)))
    return options


def _questions(folder: RecordingFolder, stated: bool) -> list[Any]:
    """Returns the questions that can be asked; a device without a reduced model can be prepared."""
    unprepared = stated and not devices.has_reduced_model(folder)
    unfinished = unprepared or training_folder(default_path(folder.device)).is_dir()
    keys = [key for key in QUESTIONS if key != PREPARE.key or unfinished]
    return [QUESTIONS[key] for key in keys if key != MISSING.key or not unprepared]


def _day(time_s: float) -> str:
    """Returns a time of the local clock as a date with hours and minutes."""
    return datetime.fromtimestamp(time_s).strftime("%Y-%m-%d %H:%M")


def _tone(job: jobs.Job) -> str:
    return _TONES.get(job.state, "doubt")


def _about(shortest_s: float, longest_s: float) -> str:
    """Returns a rough duration, or a range of durations, in words."""
    low, high = max(round(shortest_s / 60), 1), round(longest_s / 60)
    if high < 1:
        return "less than a minute"
    return f"{low} to {high} minutes" if high > low else f"about {high} minute{'s' * (high > 1)}"


def _share(job: jobs.Job | None) -> str:
    """Returns the share of a running diagnosis that is done, and nothing for any other job."""
    tasks = job.tasks if job is not None and job.running else []
    return next((percent(task.share, 2) for task in tasks if task.label == WHOLE_DIAGNOSIS), "")


def _refusal(job: jobs.Job, lines: Sequence[str]) -> str:
    """Returns the line by which a command has refused its input, which is the last one that it printed."""
    return lines[-1].removeprefix("bayeskin: ") if job.state is jobs.State.REFUSED and lines else ""


def _task(task: TaskProgress, now_s: float) -> dict[str, Any]:
    """Returns what a task's line shows."""
    left_s = task.left_s(now_s)
    left = "" if left_s is None or task.label == WHOLE_DIAGNOSIS else f"{_duration(left_s)} left"
    return {**asdict(task), "percent": percent(task.share, 2), "left": left}


def _duration(seconds: float) -> str:
    """Returns a duration such as 0:01:30."""
    return str(timedelta(seconds=round(seconds)))
