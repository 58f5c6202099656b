"""Workers that stay from one call to the next: who they are, and what is left of them."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest
from toys.worker_functions import counted, dead_once, met, slept

from bayeskin.execution.local import Lost, standing

pytestmark = pytest.mark.skipif(
    not Path("/proc/self/stat").exists(), reason="looks processes up in /proc"
)  # fmt: skip


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def folder(path: Path, name: str) -> str:
    (path / name).mkdir()
    return str(path / name)


def test_workers_stay_from_one_call_to_the_next_and_end_at_the_exit(tmp_path: Path) -> None:
    with standing(met, 2) as run_all:
        calls = [{pid for _, pid in run_all([folder(tmp_path, name)] * 2)} for name in ("a", "b", "c")]
        assert calls[0] == calls[1] == calls[2]
        assert len(calls[0]) == 2
        assert os.getpid() not in calls[0]
        assert all(alive(pid) for pid in calls[0])
    assert not any(alive(pid) for pid in calls[0])


def test_what_a_function_keeps_in_its_process_it_has_in_the_next_call() -> None:
    with standing(counted, 1) as run_all:
        assert list(run_all([7])) == [(0, (7,))]
        assert list(run_all([])) == []
        assert list(run_all([8, 9])) == [(0, (7, 8)), (1, (7, 8, 9))]


def test_workers_end_where_a_caller_fails() -> None:
    pids: list[int] = []

    def fails() -> None:
        with standing(dead_once, 1) as run_all:
            pids.extend(pid for _, pid in run_all([""]))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fails()
    assert len(pids) == 1
    assert not alive(pids[0])


def test_a_worker_that_is_killed_between_two_calls_is_replaced() -> None:
    with standing(dead_once, 1) as run_all:
        ((_, first),) = run_all([""])
        os.kill(first, signal.SIGKILL)
        assert [place for place, _ in run_all(["", ""])] == [0, 1]
        ((_, second),) = run_all([""])
        assert second != first
        assert alive(second)


def test_an_item_that_kills_a_worker_is_run_again_by_another(tmp_path: Path) -> None:
    with standing(dead_once, 1) as run_all:
        ((_, first),) = run_all([""])
        results = dict(run_all([str(tmp_path / "died"), ""]))
        assert (tmp_path / "died").exists()
        assert set(results) == {0, 1}
        assert results[0] == results[1] != first
        assert not any(isinstance(result, Lost) for result in results.values())
        assert dict(run_all([""])) == {0: results[0]}


def test_a_call_that_is_not_finished_leaves_no_worker_busy(tmp_path: Path) -> None:
    quick, slow = str(tmp_path / "quick"), str(tmp_path / "slow")
    with standing(slept, 2) as run_all:
        results = run_all([(quick, 0.0), (slow, 600.0)])
        place, (file, _) = next(results)
        assert (place, file) == (0, quick)
        patience = time.monotonic() + 60.0
        while not Path(slow).exists() and time.monotonic() < patience:
            time.sleep(0.02)
        busy = int(Path(slow).read_text())
        results.close()
        assert not alive(busy)
        files = [str(tmp_path / f"{i}") for i in range(4)]
        finished = dict(run_all([(file, 0.0) for file in files]))
        assert [finished[i][0] for i in range(4)] == files
        pids = {pid for _, pid in finished.values()}
        assert busy not in pids
    assert not any(alive(pid) for pid in pids)
