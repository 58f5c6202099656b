"""The page says more than the reports do: comparisons of runs, the steps of a job, and the time left."""

from __future__ import annotations

import os
import shutil
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
from toys.app_page import DEVICE, Visitor, served, until
from toys.external_models import PARAMETERS, SPRING
from toys.finished_run import facts
from toys.small_reduced import hollow
from toys.small_study import SPRING_RUN, record

from bayeskin.app import jobs
from bayeskin.app.comparison import RunAnswer, by_parameter, run_answer, table
from bayeskin.app.devices import state
from bayeskin.app.estimate import OVERRUN, SHIPPED_DESIGN_S, USUAL_S, seconds_left, usual_seconds
from bayeskin.app.jobs import Job, State
from bayeskin.app.pages import job_page, recording_page, recordings_page
from bayeskin.app.questions import CALIBRATE, MISSING, ask
from bayeskin.app.recordings import RecordingFolder, open_recordings
from bayeskin.app.steps import steps
from bayeskin.config import config_of
from bayeskin.config.device import DeviceFile
from bayeskin.geometry import Geometry
from bayeskin.shipped import shipped
from bayeskin.workflow.diagnosis_progress import tell_tasks
from bayeskin.workflow.engine import Silent, open_run, run_stages
from bayeskin.workflow.folder import Record, write_record
from bayeskin.workflow.new import new_config
from bayeskin.workflow.progress import Tasks
from bayeskin.workflow.stages import stages_of

REDUCED, NEW = shipped("surrogates/article-device-reduced.h5"), "device-reduced.h5"
CONFIG = f'[recording]\nfile = "a.h5"\n{SPRING_RUN.format(workers=1)}'


def test_runs_are_compared_parameter_by_parameter() -> None:
    run = run_answer("left", facts())
    said = run.answer
    without = replace(said, parameters=[one for one in said.parameters if one.name != "p_init"])
    runs = [run, RunAnswer("right", without)]
    parameters = by_parameter(runs)
    assert [(one.name, [name for name, _ in one.runs]) for one in parameters] == [
        ("E_c", ["left", "right"]),
        ("p_init", ["left"]),
    ]
    rows = [[cell.text for cell in cells] for cells in table(runs, parameters).rows]
    assert [row[0] for row in rows] == ["left", "right"]
    assert rows[0][1] == f"{said.parameters[0].median} ({said.parameters[0].interval})"
    assert rows[1][2] == "–"
    assert rows[0][-2:] == ["trusted", "device-friction"]
    assert rows[1][-1] == said.missing.word
    assert said.missing.command == ""


def test_a_stage_takes_as_long_as_in_finished_runs_of_other_recordings(tmp_path: Path) -> None:
    config = config_of({"name": "a", "recording": {"file": "a.h5"}}, "a.toml")
    others = [RecordingFolder(tmp_path / name) for name in ("one", "two", "three", "four")]
    assert usual_seconds("sample", config, others) == USUAL_S["sample"]
    for other, seconds, done in zip(
        others, (10.0, 30.0, 50.0, 900.0), (True, True, True, False), strict=True
    ):
        (other.run / "sample").mkdir(parents=True)
        write_record(other.run / "sample", Record("0", done, seconds))
    assert usual_seconds("sample", config, others) == 30.0
    shipped = config_of({"name": "a", "recording": {"file": "a.h5"}, "surrogate": {"file": "demo.h5"}}, "a")
    assert usual_seconds("design", shipped, others) == SHIPPED_DESIGN_S


@pytest.mark.parametrize(
    ("so_far_s", "tasks_left_s", "left_s"), [(0.0, [], 60.0), (20.0, [], 40.0), (20.0, [90.0], 90.0),
                                             (200.0, [], OVERRUN * 200.0)],
)  # fmt: skip
def test_the_time_left_of_a_stage(so_far_s: float, tasks_left_s: list[float], left_s: float) -> None:
    assert seconds_left(so_far_s, 60.0, tasks_left_s) == left_s


@pytest.fixture(scope="module")
def spring(tmp_path_factory: pytest.TempPathFactory) -> RecordingFolder:
    """A recording whose run has its first two stages."""
    folder = RecordingFolder(tmp_path_factory.mktemp("springs") / "a")
    folder.path.mkdir()
    record(folder.stored, 100.0, 1)
    (folder.path / "spring.py").write_text(SPRING)
    folder.config.write_text(CONFIG + PARAMETERS)
    run = open_run(folder.config, Silent())
    run_stages(run, stages_of(run.config), "design")
    return folder


def test_the_steps_of_a_job_show_how_its_stages_stand(spring: RecordingFolder) -> None:
    spring.job.mkdir(exist_ok=True)
    running = Job(spring.job, CALIBRATE.key, State.RUNNING, time.time(), None)
    shown = steps(spring, running, [])
    assert [step.state for step in shown] == ["done", "done", "working", *4 * ["waiting"]]
    assert shown[1].seconds > 0.0
    assert shown[1].left_s == 0.0
    assert [step.left_s for step in shown[2:]] == [USUAL_S[step.name] for step in shown[2:]]
    ended = replace(running, state=State.FAILED, ended_s=time.time())
    train = spring.run / "train"
    train.mkdir(exist_ok=True)
    inputs = Record("0", False, 3.0, summary={"message": "no surrogate"})
    write_record(train, inputs)
    assert [step.state for step in steps(spring, ended, [])][2] == "waiting"  # of other inputs


def test_a_step_that_works_counts_the_time_since_it_began(spring: RecordingFolder) -> None:
    run = open_run(spring.config, Silent())
    stages = stages_of(run.config)

    class Stopped(Exception):
        """Ends the stage in the midst of its work."""

    def stop(_: object) -> dict[str, object]:
        raise Stopped

    with pytest.raises(Stopped):
        run_stages(run, {**stages, "train": replace(stages["train"], work=stop)}, "train")
    file = spring.run / "train" / "stage.json"
    os.utime(file, (time.time() - 100.0, time.time() - 100.0))
    spring.job.mkdir(exist_ok=True)
    running = Job(spring.job, CALIBRATE.key, State.RUNNING, time.time(), None)
    working = steps(spring, running, [])[2]
    assert working.state == "working"
    assert working.seconds == pytest.approx(100.0, abs=10.0)
    assert working.left_s == pytest.approx(OVERRUN * working.seconds)


def test_a_configuration_is_written_anew_only_if_what_it_is_made_of_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[list[str]] = []
    monkeypatch.setattr(jobs, "start", lambda folder, question, commands: asked.extend(commands))
    folder = RecordingFolder(tmp_path / "arm")
    folder.path.mkdir()
    shutil.copy(shipped("data/demo.h5"), folder.stored)
    state(folder, DeviceFile())
    ask(folder, "missing")
    assert asked == [["diagnose", "arm.toml"]]
    own = folder.config.read_text() + "# my own\n"
    folder.config.write_text(own)
    ask(folder, "calibrate")
    assert folder.config.read_text() == own
    for change in (lambda: state(folder, DeviceFile()), lambda: shutil.copyfile(REDUCED, folder.path / NEW)):
        time.sleep(0.02)
        change()
        ask(folder, "calibrate")
        assert "# my own" not in folder.config.read_text()
        folder.config.write_text(own)


def test_a_device_can_be_prepared_until_its_reduced_model_is_complete(tmp_path: Path) -> None:
    recordings = open_recordings(tmp_path / "recordings")
    folder = recordings.new("arm.h5")
    (folder.path / "original").mkdir()
    shutil.copy(shipped("data/demo.h5"), folder.stored)
    offers = {}
    for when, gauge_mm in (("article", 36), ("other", 30)):
        state(folder, DeviceFile.model_validate({"device": {"gauge_mm": gauge_mm}}))
        offers[when] = recording_page("/x", recordings, folder)
    hollow(folder.path / "device-reduced.h5", Geometry(gauge_m=30e-3))
    offers["complete"] = recording_page("/x", recordings, folder)
    (folder.path / "device-reduced-training").mkdir()
    offers["first version"] = recording_page("/x", recordings, folder)
    offered = {
        when: [f"/ask/{key}" in page for key in ("missing", "prepare")] for when, page in offers.items()
    }
    assert offered == {
        "article": [True, False],
        "other": [False, True],
        "complete": [True, False],
        "first version": [True, True],
    }


@pytest.mark.slow
def test_two_calibrations_are_compared(tmp_path: Path) -> None:
    with served(tmp_path / "recordings") as page:
        owner = Visitor(page)
        owner.enter()
        for name, stiffness in (("soft", 100.0), ("stiff", 200.0)):
            record(tmp_path / f"{name}.h5", stiffness, 1)
            assert owner.drop(f"{name}.h5", (tmp_path / f"{name}.h5").read_bytes()).status == 200
            assert owner.fill(f"/recordings/{name}/device", **DEVICE).status == 303
            folder = RecordingFolder(page.folder / name)
            (folder.path / "spring.py").write_text(SPRING)
            folder.config.write_text(CONFIG.replace("a.h5", f"{name}.h5") + PARAMETERS)
            assert owner.fill(f"/recordings/{name}/ask/calibrate").status == 303
            until(lambda job=folder.job: not jobs.job_of(job).running, patience_s=600.0)
            assert "Open the report" in owner.ask("GET", f"/recordings/{name}/job").text
        shown = owner.ask("GET", "/compare?recording=soft&recording=stiff").text
        bars = [shown.count(f'<p class="run-name">{name}</p>') for name in ("soft", "stiff")]
        assert bars == [3, 3]  # stiffness, share, tau
        assert "100 N/m" in shown
        assert "200 N/m" in shown


def test_a_diagnosis_states_the_share_that_is_done_and_a_range_of_the_time_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recordings = open_recordings(tmp_path / "recordings")
    folder = recordings.new("arm.h5")
    (folder.path / "original").mkdir()
    shutil.copy(shipped("data/demo.h5"), folder.stored)
    new_config([folder.stored], folder.config)
    run = open_run(folder.config, Silent())
    run_stages(run, stages_of(run.config), "recording")
    folder.job.mkdir()
    (folder.job / jobs.OUTPUT).write_text("search: pad-slip: +3.0 nats\n")
    now_s = time.monotonic()
    told = Tasks(folder.job / jobs.PROGRESS)
    monkeypatch.setattr("bayeskin.workflow.diagnosis_progress.USUAL", 200)
    for done, at_s in ((50, now_s - 120.0), (100, now_s)):
        tell_tasks(SimpleNamespace(progress=partial(told.report, now_s=at_s)), done)  # type: ignore[arg-type]
    running = Job(folder.job, MISSING.key, State.RUNNING, time.time() - 130.0, None)
    page = job_page("/x", recordings, folder, running)
    assert '<progress max="1" value="0.5">50 %</progress>' in page
    assert "50 % <strong></strong>" in page
    assert "100 tasks done, about 200 are usual" in page
    assert (
        "<dt>time left, estimated</dt><dd>2 to 8 minutes</dd>" in page
    )  # half of it is left, at a quarter in two minutes
    monkeypatch.setattr(jobs, "job_of", lambda _: running)
    assert "What is missing: running, 50 %" in recordings_page("/x", recordings)
