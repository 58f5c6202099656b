"""The progress of a diagnosis: a share of tasks that never reaches one before the end."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bayeskin.execution.local import here
from bayeskin.mismatch.tasks import RunTask, Task
from bayeskin.store import Store
from bayeskin.workflow import diagnosis_tasks
from bayeskin.workflow.diagnosis_progress import USUAL, share_done
from bayeskin.workflow.diagnosis_tasks import asked


def test_the_share_rises_with_each_task_and_stays_below_one() -> None:
    shares = [share_done(tasks) for tasks in range(5000)]
    assert shares[0] == 0.0
    usual = np.diff(shares[: USUAL // 2])
    np.testing.assert_allclose(usual, 1.0 / USUAL)
    assert np.all(np.diff(shares) >= -1e-12)
    assert 0.8 < shares[-1] < 0.9  # of a search that is much longer than usual


@contextmanager
def in_this_process(function: Callable[[Any], Any], workers: int) -> Iterator[Callable[..., Any]]:
    yield partial(here, function)


def test_each_task_that_is_run_is_told_and_none_whose_answer_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Answers:
        def __init__(self, source: object) -> None: ...

        def __call__(self, task: RunTask) -> dict[str, Any]:
            return {"message": f"failed at {task.theta['E_c']}"}

    monkeypatch.setattr(diagnosis_tasks, "_Worker", Answers)
    monkeypatch.setattr(diagnosis_tasks, "standing", in_this_process)
    store = tmp_path / "answers.store"

    def told(*counts: int) -> list[int]:
        heard: list[int] = []
        with asked(None, None, Store(store, "toy", print), 1, heard.append) as ask:  # type: ignore[arg-type]
            for count in counts:
                tasks: list[Task] = [RunTask((), {"E_c": float(i)}) for i in range(count)]
                assert len(ask(tasks)) == count
        return heard

    assert told(3) == [1, 2, 3]
    assert told(3, 5, 5) == [4, 5]  # three answers were kept
