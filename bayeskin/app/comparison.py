"""Puts the answers of several runs beside each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from bayeskin.app.recordings import RecordingFolder
from bayeskin.errors import InputError
from bayeskin.report.page.answer import answer
from bayeskin.report.page.parts import Answer, ParameterSummary, Table, row
from bayeskin.workflow.engine import Silent, open_run
from bayeskin.workflow.page import facts_of
from bayeskin.workflow.stages import stages_of


@dataclass(frozen=True)
class RunAnswer:
    """The answer of one run, with the name of its recording."""

    name: str
    answer: Answer


@dataclass(frozen=True)
class ParameterOfRuns:
    """One parameter in several runs: its name, its meaning, and its posterior in each run that has it."""

    name: str
    meaning: str
    runs: Sequence[tuple[str, ParameterSummary]]


def answer_of(folder: RecordingFolder) -> Answer | None:
    """Returns the answer of a recording's run as far as it is finished, or None where no run was started.

    It names no commands, since the page has buttons.
    """
    if not folder.config.is_file():
        return None
    try:
        run = open_run(folder.config, Silent())
        said = answer(facts_of(run, stages_of(run.config)))
    except (InputError, OSError):  # a job that runs may just replace a file
        return None
    parts = {part: replace(getattr(said, part), command="") for part in ("material", "sure", "missing")}
    return replace(said, **parts)


def answered(folders: Sequence[RecordingFolder]) -> list[RunAnswer]:
    """Returns the answers of the recordings whose run has been started."""
    answers = ((folder.name, answer_of(folder)) for folder in folders)
    return [RunAnswer(name, said) for name, said in answers if said is not None]


def by_parameter(runs: Sequence[RunAnswer]) -> list[ParameterOfRuns]:
    """Returns the parameters of several runs, each with its posterior in all of them."""
    summaries = [(run.name, summary) for run in runs for summary in run.answer.parameters]
    meanings = {summary.name: summary.meaning for _, summary in summaries}
    return [
        ParameterOfRuns(parameter, meaning, [pair for pair in summaries if pair[1].name == parameter])
        for parameter, meaning in meanings.items()
    ]


def table(runs: Sequence[RunAnswer], parameters: Sequence[ParameterOfRuns]) -> Table:
    """Returns a table with a row for each run: its posteriors, the trust in them, and what is missing."""
    head = ("recording", *(parameter.name for parameter in parameters), "how sure", "what is missing")
    rows = []
    for run in runs:
        known = {summary.name: f"{summary.median} ({summary.interval})" for summary in run.answer.parameters}
        values = [known.get(parameter.name, "–") for parameter in parameters]
        rows.append(row((run.name, *values, run.answer.sure.word, run.answer.missing.word)))
    return Table("Posterior medians with 90 % intervals", head, rows)
