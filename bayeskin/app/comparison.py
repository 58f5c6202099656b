"""Puts the answers of several runs beside each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from bayeskin.app.recordings import RecordingFolder
from bayeskin.errors import InputError
from bayeskin.report.page.answer import answer
from bayeskin.report.page.facts import RunFacts
from bayeskin.report.page.parts import Answer, Cell, ParameterSummary, Table, row
from bayeskin.workflow.engine import Silent, open_run
from bayeskin.workflow.page import facts_of
from bayeskin.workflow.stages import stages_of


@dataclass(frozen=True)
class RunAnswer:
    """The answer of one run, with the name of its recording.

    mechanisms : names of the mechanisms that the diagnosis has named
    """

    name: str
    answer: Answer
    mechanisms: Sequence[str] = ()


@dataclass(frozen=True)
class ParameterOfRuns:
    """One parameter in several runs: its name, its meaning, and its posterior in each run that has it."""

    name: str
    meaning: str
    runs: Sequence[tuple[str, ParameterSummary]]


def run_answer(name: str, facts: RunFacts) -> RunAnswer:
    """Returns the answer of a run; it names no commands, since the page has buttons."""
    said = answer(facts)
    parts = {part: replace(getattr(said, part), command="") for part in ("material", "sure", "missing")}
    mechanisms = [mechanism["name"] for mechanism in facts.said("diagnose").get("mechanisms", ())]
    return RunAnswer(name, replace(said, **parts), mechanisms)


def answer_of(folder: RecordingFolder) -> RunAnswer | None:
    """Returns the answer of a recording's run as far as it is finished, or None where no run was started."""
    if not folder.config.is_file():
        return None
    try:
        run = open_run(folder.config, Silent())
        return run_answer(folder.name, facts_of(run, stages_of(run.config)))
    except (InputError, OSError):  # a job that runs may just replace a file
        return None


def answered(folders: Sequence[RecordingFolder]) -> list[RunAnswer]:
    """Returns the answers of the recordings whose run has been started."""
    return [run for run in map(answer_of, folders) if run is not None]


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
        missing = ", ".join(run.mechanisms) or run.answer.missing.word
        name = Cell(run.name, href=f"recordings/{run.name}")
        rows.append(row((name, *values, run.answer.sure.word, missing)))
    return Table("Posterior medians with 90 % intervals", head, rows)
