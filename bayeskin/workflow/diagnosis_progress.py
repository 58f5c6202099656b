"""The share of a diagnosis that is done, although nobody knows how long its search will be.

The work of a diagnosis consists of tasks: fits, runs of the models, evidences. Six diagnoses of recordings of
one to six minutes needed 190 to 370 tasks. The share counts the tasks that are done among those that are
expected: the usual number or, beyond it, a part more than those that are done. So a search that is longer
than usual stays at five sixths until its end.
"""

from __future__ import annotations

from bayeskin.workflow.engine import Reporter

LABEL = "diagnosis"
USUAL = 280  # tasks of a diagnosis
OVERRUN = 0.2  # further tasks, as a share of those that are done, that are expected at least


def share_done(tasks: int) -> float:
    """Returns the share of a diagnosis that is done after a number of tasks; it stays below one."""
    return tasks / (tasks + max(USUAL - tasks, OVERRUN * tasks))


def tell_tasks(reporter: Reporter, tasks: int) -> None:
    """Reports the progress of a diagnosis after a number of tasks."""
    reporter.progress(LABEL, share_done(tasks), f"{tasks} tasks done, about {USUAL} are usual")


def tell_end(reporter: Reporter) -> None:
    """Reports that the work of a diagnosis is done."""
    reporter.progress(LABEL, 1.0)
