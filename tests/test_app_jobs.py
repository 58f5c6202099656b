"""Jobs of the page: they end as their commands end, can be stopped and go on, and outlive the page."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from toys.app_page import until
from toys.external_models import PARAMETERS
from toys.small_study import record

from bayeskin.app import jobs
from bayeskin.app.jobs import State
from bayeskin.errors import InputError
from bayeskin.workflow.progress import begun

# Its runs take long, until a file says that they need not.
SLOW_SPRING = """
import time
from pathlib import Path

def force(theta, time_s, displacement_m):
    while not Path("quick").exists():
        time.sleep(0.1)
    return theta["stiffness"] * displacement_m
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The folder of a job, in a folder with a configuration whose design takes as long as the test wants."""
    record(tmp_path / "a.h5", 100.0, 1)
    (tmp_path / "spring.py").write_text(SLOW_SPRING)
    settings = '[model]\nforward = "spring.py:force"\n[fit]\nbin_width_s = 1.0\n'
    settings += "[design]\npoints = [12]\nheld_out = 3\nworkers = 1\n"
    (tmp_path / "a.toml").write_text(f'[recording]\nfile = "a.h5"\n{settings}{PARAMETERS}')
    return tmp_path / "job"


def state(folder: Path) -> State:
    job = jobs.job_of(folder)
    assert job is not None
    return job.state


def lines(folder: Path) -> list[str]:
    job = jobs.job_of(folder)
    assert job is not None
    return job.lines


@pytest.mark.parametrize(
    ("commands", "ends", "says"),
    [
        ([["--version"], ["--version"]], State.DONE, 2),
        ([["run", "absent.toml"], ["--version"]], State.REFUSED, 0),
    ],
)
def test_a_job_ends_as_its_commands_end(
    folder: Path, commands: list[list[str]], ends: State, says: int
) -> None:
    assert jobs.job_of(folder) is None
    jobs.start(folder, "calibrate", commands)
    until(lambda: state(folder) is not State.RUNNING)
    assert state(folder) is ends
    assert len([line for line in lines(folder) if "version" in line]) == says
    if ends is State.REFUSED:
        assert lines(folder)[-1].startswith("bayeskin: absent.toml: ")


def test_a_job_is_stopped_and_goes_on(folder: Path) -> None:
    jobs.start(folder, "design", [["design", "a.toml"]])
    until(lambda: any("wave" in line or "trial" in line for line in lines(folder)))
    with pytest.raises(InputError, match="a job runs already"):
        jobs.start(folder, "design", [["design", "a.toml"]])
    jobs.stop(folder)
    until(lambda: state(folder) is State.STOPPED)
    assert "run the same command again to continue" in lines(folder)[-1]
    (folder.parent / "quick").touch()
    jobs.start(folder, "design", [["design", "a.toml"]])
    until(lambda: state(folder) is not State.RUNNING)
    job = jobs.job_of(folder)
    assert job is not None
    assert job.state is State.DONE
    assert job.tasks == []  # what is finished is not shown
    wave = jobs.read_progress(folder / jobs.PROGRESS)[-1]
    assert (wave.label, wave.share, wave.note) == ("wave 1 of 1", 1.0, "15 of 15 runs, 0 failed")


def test_the_time_that_is_left_follows_the_pace() -> None:
    task = begun("runs", 0.2, "", 100.0)
    assert task.left_s(105.0) is None
    assert task.later(0.4, "", 110.0).left_s(110.0) == pytest.approx(30.0)
    assert task.later(0.4, "", 110.0).left_s(125.0) == pytest.approx(15.0)
    assert task.later(0.4, "", 110.0).left_s(1000.0) == 0.0
    assert task.later(0.1, "", 110.0) == begun("runs", 0.1, "", 110.0)


def test_a_job_outlives_the_program_of_the_page_and_is_seen_when_it_is_killed(folder: Path) -> None:
    start = f"jobs.start(Path({str(folder)!r}), 'design', [['design', 'a.toml']])"
    code = f"from pathlib import Path; from bayeskin.app import jobs; {start}"
    subprocess.run([sys.executable, "-c", code], check=True)
    until(lambda: any("trial" in line for line in lines(folder)))
    assert state(folder) is State.RUNNING
    os.killpg(int((folder / jobs.LOCK).read_text()), signal.SIGKILL)
    until(lambda: state(folder) is not State.RUNNING)
    assert state(folder) is State.FAILED
