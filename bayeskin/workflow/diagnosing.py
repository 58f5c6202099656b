"""The command `bayeskin diagnose`: runs the stages of a diagnosis, and writes its page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bayeskin.json_files import plain
from bayeskin.workflow import diagnosis, stages
from bayeskin.workflow.diagnosis_text import in_words
from bayeskin.workflow.engine import Reporter, Run, Stage, run_stages
from bayeskin.workflow.page import write_page


def diagnose(sources: Sequence[Path], reporter: Reporter, device: Path | None = None) -> dict[str, Any]:
    """Returns the answer of `bayeskin diagnose` for a configuration's run, or for recordings by themselves.

    Outputs go to the run's folder. For recordings, they go to STEM-diagnosis in the folder of the first one.

    sources : a configuration, or one or several recordings of one skin
    device : file of the device with which the recordings were made
    Raises InputError for bad input, and for a device without a reduced model.
    """
    run = diagnosis.opened(sources, reporter, device)
    own = diagnosis.stages_of(run.config)
    list(own[diagnosis.NAME].files(run))  # before anything is written: a device needs a reduced model
    outcome = run_stages(run, own)[-1]
    page = write_page(run, stages_of_page(run))
    answer = {**outcome.record.summary, "ok": outcome.ok, "folder": run.folder / diagnosis.NAME, "page": page}
    text = in_words(answer) if outcome.record.done else f"{outcome.stage}: failed: {answer['message']}"
    return plain({**answer, "text": text})


def stages_of_page(run: Run) -> Mapping[str, Stage]:
    """Returns the stages that the page of a diagnosis shows: all, if the run has a configuration file."""
    return stages.stages_of(run.config) if run.from_file else diagnosis.stages_of(run.config)
