"""The record of the further tests that `bayeskin experiment` has judged for the diagnosis of a run."""

from __future__ import annotations

from bayeskin.workflow.engine import Run
from bayeskin.workflow.folder import Record, current_record, read_record

FOLDER = "experiment"


def judged_tests(run: Run) -> Record | None:
    """Returns the record of the tests for the diagnosis in the run's folder, or None without one."""
    return current_record(run.folder / FOLDER, diagnosis_hash(run))


def diagnosis_hash(run: Run) -> str:
    """Returns the hash of the diagnosis in the run's folder, or "" without one."""
    record = read_record(run.folder / "diagnose")
    return "" if record is None else record.sha256
