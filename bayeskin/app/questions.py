"""The questions that a person can ask about a recording, and the commands that answer them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from bayeskin.app import jobs
from bayeskin.app.recordings import RecordingFolder
from bayeskin.errors import InputError
from bayeskin.workflow.new import new_config
from bayeskin.workflow.reducing import default_path


@dataclass(frozen=True)
class Question:
    """A question, and what a person reads about the work that answers it."""

    key: str
    title: str
    explanation: str
    duration: str


CALIBRATE = Question(
    "calibrate",
    "Calibrate",
    "What is this skin made of? The answer has the stiffness and the permeability of both layers of the "
    "skin, how certain they are, and a verdict on whether they can be trusted.",
    "It usually takes three to ten minutes on the article's device, and longer on other devices.",
)
MISSING = Question(
    "missing",
    "What is missing",
    "Which physics does the model leave out of this recording, and where? The answer shows how much better "
    "the fit is with it.",
    "It usually takes two to ten minutes, and up to an hour where many effects act.",
)
PREPARE = Question(
    "prepare",
    "Prepare this device",
    "No complete reduced model for this device exists yet. It is built once, and makes both questions quick. "
    "The question of what is missing needs it.",
    "It takes two to three hours. A first version can be used after about ten minutes: stop the job then, "
    "ask, and go on with the preparation later.",
)
QUESTIONS = {question.key: question for question in (CALIBRATE, MISSING, PREPARE)}


def ask(folder: RecordingFolder, key: str) -> None:
    """Starts, or continues, the job that answers a question about a recording.

    The configuration is written anew if the recording, its device or the device's reduced model was changed
    since. Raises InputError if a job of this recording runs already, or if the recording or its device cannot
    be used.
    """
    if key not in QUESTIONS:
        raise InputError("question", f"{key!r} is not known", f"ask one of {', '.join(QUESTIONS)}")
    if not folder.stored.is_file():
        raise InputError(folder.name, "the recording was not read", "correct how it was understood")
    if not folder.device.is_file():
        raise InputError(folder.name, "the device is not stated", "state it first")
    refuse_running(folder)
    inputs = (folder.stored, folder.device, default_path(folder.device))
    changed_s = max(file.stat().st_mtime for file in inputs if file.is_file())
    if not folder.config.is_file() or folder.config.stat().st_mtime < changed_s:
        folder.config.unlink(missing_ok=True)
        new_config([folder.stored], folder.config, folder.device)
    jobs.start(folder.job, key, _commands(folder, key))


def refuse_running(folder: RecordingFolder) -> None:
    """Raises InputError if a job of a recording runs."""
    job = jobs.job_of(folder.job)
    if job is not None and job.running:
        raise InputError(folder.name, "a job runs already", "stop it first, or wait for its end")


def _commands(folder: RecordingFolder, key: str) -> Sequence[Sequence[str]]:
    """Returns the commands that answer a question; they run in the recording's folder."""
    config = folder.config.name
    return {
        CALIBRATE.key: [["run", config]],
        MISSING.key: [["diagnose", config]],
        PREPARE.key: [["reduce", folder.device.name]],
    }[key]
