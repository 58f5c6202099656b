"""`bayeskin study` infers recordings, skips finished ones, leaves out others, and infers the population."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
from toys.closed_form_model import MOTION
from toys.command_line import Command, assert_refused
from toys.small_study import FACTOR, ROWS, infer_quickly, record, small_study, table_of

from bayeskin import report
from bayeskin.errors import InputError
from bayeskin.execution.local import here
from bayeskin.study import SamplerSettings
from bayeskin.types import PadMotion
from bayeskin.workflow import executor, study, study_recordings
from bayeskin.workflow.engine import Silent
from bayeskin.workflow.study import study as run_study
from bayeskin.workflow.study_recordings import Outcome

QUICK = partial(SamplerSettings, max_sweeps=150)
BROKEN = ("e-1", "ella", "keloid", 0.0)


class Heard(Silent):
    """Keeps the messages of a study."""

    def __init__(self) -> None:
        self.messages: list[str] = []

    def log(self, message: str) -> None:
        self.messages.append(message)


@pytest.fixture(scope="module")
def quickly() -> Iterator[pytest.MonkeyPatch]:
    """Lets a study run in this process, with few sweeps, and without posteriors and drawings."""

    def drawn(figure: object, stem: Path, provenance: str) -> None:
        stem.with_suffix(".svg").write_text('<svg xmlns="http://www.w3.org/2000/svg"/>')

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report, "save_figure", drawn)
        patch.setattr(executor, "local", lambda workers: here)
        patch.setattr(study, "SamplerSettings", QUICK)
        patch.setattr(study, "infer", infer_quickly)
        yield patch


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory, quickly: pytest.MonkeyPatch) -> Path:
    """A study that was interrupted at its third recording, and then finished; one recording is damaged."""
    folder = tmp_path_factory.mktemp("study")
    path = small_study(folder)
    table_of(folder, (*ROWS, BROKEN))
    (folder / "rec" / "e-1.h5").write_bytes(b"damaged")
    (folder / "rec" / "a-1-markers.h5").touch()
    inferred = list[str]()

    def interrupted(run: object) -> object:
        inferred.append(run.config.name)
        if len(inferred) == 3:
            raise KeyboardInterrupt
        return infer_quickly(run)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "infer", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run_study(path, Silent())
    (folder / "answer.json").write_text(json.dumps(run_study(path, Silent()), allow_nan=False))
    return path


def answer_of(path: Path) -> dict:
    return json.loads((path.parent / "answer.json").read_text())


def test_the_answer_compares_the_groups(finished: Path) -> None:
    answer = answer_of(finished)
    assert list(answer["parameters"]) == ["stiffness", "tau"]  # a share may be zero
    (ratio,) = answer["parameters"]["stiffness"]["ratios"]
    assert (ratio["numerator"], ratio["denominator"]) == ("keloid", "control")
    assert ratio["low_90"] < FACTOR < ratio["high_90"]
    assert ratio["probability_above_1"] > 0.9
    assert "group keloid is larger than group control" in answer["text"]
    stored = json.loads((finished.parent / "springs" / "study.json").read_text())
    assert {**stored, **{key: answer[key] for key in ("folder", "page", "text")}} == answer


def test_each_recording_has_its_values_its_origin_and_its_report(finished: Path) -> None:
    rows = {row["name"]: row for row in answer_of(finished)["recordings"]}
    assert list(rows) == [name for name, *_ in (*ROWS, BROKEN)]
    for seed, (name, subject, group, stiffness) in enumerate(ROWS):
        row = rows[name]
        assert (row["subject"], row["group"], row["sha256"]) == (subject, group, f"{seed:064d}")
        alone = row["alone"]["stiffness"]
        assert alone["low_90"] < stiffness < alone["high_90"]
        assert "What is this skin made of?" in (finished.parent / "springs" / row["report"]).read_text()
    assert len({row["model_hash"] for row in rows.values() if row["model_hash"]}) == 1


def test_a_recording_that_fails_is_left_out_and_the_answer_says_so(finished: Path) -> None:
    answer = answer_of(finished)
    assert list(answer["left_out"]) == ["e-1"]
    assert "e-1.h5" in answer["left_out"]["e-1"]
    assert "5 of 6 recordings enter." in answer["text"]
    assert f"left out: e-1: {answer['left_out']['e-1']}" in answer["text"]
    page = (finished.parent / "springs" / "report.html").read_text()
    assert "5 of 6 recordings enter; 1 is left out" in page


def test_markers_of_a_recording_are_not_used_and_the_answer_says_so(finished: Path) -> None:
    answer = answer_of(finished)
    assert answer["markers_unused"] == ["a-1"]
    said = "A study infers from the force alone, so it does not use the markers of a-1."
    assert said in answer["text"]
    assert said in (finished.parent / "springs" / "report.html").read_text()
    assert "markers = " not in (finished.parent / "springs" / "recordings" / "a-1.toml").read_text()


def test_the_page_opens_the_report_of_each_recording(finished: Path) -> None:
    folder = finished.parent / "springs"
    page = (folder / "report.html").read_text()
    links = re.findall(r'<th scope="row"><a href="([^"]+)">([^<]+)</a>', page)
    assert [name for _, name in links] == [name for name, *_ in ROWS]
    assert [link for link, _ in links if not (folder / link).is_file()] == []


def test_recordings_of_one_protocol_share_one_surrogate(finished: Path) -> None:
    folder = finished.parent / "springs"
    (shared,) = (folder / "protocols").iterdir()
    for name, *_ in ROWS:
        text = (folder / "recordings" / f"{name}.toml").read_text()
        assert f'file = "../protocols/{shared.name}/train/surrogate.h5"' in text


def test_a_finished_study_repeats_nothing(
    finished: Path, quickly: pytest.MonkeyPatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    def forbidden(*_: object, **__: object) -> None:
        raise AssertionError("computed again")

    monkeypatch.setattr(study, "infer_population", forbidden)
    monkeypatch.setattr("bayeskin.workflow.design_runs.run_design", forbidden)
    heard = Heard()
    again = run_study(finished, heard)
    assert again == answer_of(finished)
    assert "population: done before, unchanged" in heard.messages


@pytest.mark.slow
def test_another_group_in_the_table_needs_a_new_population_only(
    finished: Path, tmp_path: Path, quickly: pytest.MonkeyPatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(finished.parent, tmp_path, dirs_exist_ok=True)
    table_of(tmp_path, tuple((name, subject, "all", value) for name, subject, _, value in ROWS))
    monkeypatch.setattr("bayeskin.workflow.maximum.inference.refine_map", None)
    answer = run_study(tmp_path / finished.name, Silent())
    assert answer["left_out"] == {}
    assert answer["parameters"]["stiffness"]["ratios"] == []
    assert "bayeskin study" not in answer["text"]


def test_a_group_that_failures_leave_with_one_subject_ends_without_a_population(
    finished: Path, tmp_path: Path, quickly: pytest.MonkeyPatch
) -> None:
    shutil.copytree(finished.parent, tmp_path, dirs_exist_ok=True)
    (tmp_path / "rec" / "d-1.h5").write_bytes(b"damaged")
    answer = run_study(tmp_path / finished.name, Silent())
    assert (answer["ok"], answer["verdict"]) == (False, "no population")
    assert "has one subject only" in answer["text"]
    assert list(answer["left_out"]) == ["d-1", "e-1"]
    assert "d-1" in (tmp_path / "springs" / "report.html").read_text()


@pytest.mark.parametrize(
    ("stage", "doubts", "says"),
    [
        (None, ["R-hat is 1.3", "more"], "its posterior is not trusted: R-hat is 1.3"),
        ({"message": "too few runs"}, [], "the stage sample failed: too few runs"),
        (InputError("a.h5", "it is empty", "give a test"), [], "a.h5: it is empty; give a test"),
        (ZeroDivisionError("by\nzero"), [], "ZeroDivisionError: by zero"),
        (None, [], ""),
    ],
)
def test_a_recording_is_left_out_with_one_line(
    monkeypatch: pytest.MonkeyPatch, stage: object, doubts: list[str], says: str
) -> None:
    def ended(*_: object) -> list[object]:
        if isinstance(stage, Exception):
            raise stage
        return [SimpleNamespace(stage="sample", record=SimpleNamespace(done=stage is None, summary=stage))]

    for name, stand_in in (("run_stages", ended), ("write_page", print), ("doubts_of", lambda run: doubts),
                           ("stages_of", print)):  # fmt: skip
        monkeypatch.setattr(study_recordings, name, stand_in)
    assert study_recordings.infer(SimpleNamespace(config=None)) == Outcome(not says, says)


@pytest.mark.slow
def test_a_recording_of_another_protocol_has_a_design_of_its_own(
    finished: Path, tmp_path: Path, quickly: pytest.MonkeyPatch
) -> None:
    shutil.copytree(finished.parent, tmp_path, dirs_exist_ok=True)
    slower = PadMotion(1.5 * MOTION.time_s, MOTION.displacement_m)
    record(tmp_path / "rec" / "e-1.h5", 200.0, 9, slower)
    answer = run_study(tmp_path / finished.name, Silent())
    assert answer["left_out"] == {}
    text = (tmp_path / "springs" / "recordings" / "e-1.toml").read_text()
    assert "[surrogate]" in text
    assert "surrogate.h5" not in text
    assert (tmp_path / "springs" / "recordings" / "e-1" / "design" / "waves.json").is_file()


DEVICE = "[device]\ngauge_mm = 30.0\n"


@pytest.mark.parametrize(
    ("change", "table", "says"),
    [
        ({'table = "table.csv"': ""}, "", "springs.toml: table: there is no table"),
        ({'table = "table.csv"': "table = 3"}, "", "springs.toml: table: 3 is not the name of a file"),
        ({"table.csv": "none.csv"}, "", "none.csv: there is no such file"),
        ({"[fit]": '[recording]\nfile = "a.h5"\n[fit]'}, "", "the table names the recordings"),
        ({"[fit]": "recording = 3\n[fit]"}, "", "springs.toml: "),
        ({"[fit]": '[recording]\nmarkers = "m.h5"\n[fit]'}, "", "recording.markers: a study infers from the"),
        ({"bin_width_s": "bin_width"}, "", "springs.toml: fit.bin_width: this key is not known"),
        ({"spring.py": "none.py"}, "", "none.py"),
        ({}, "rec/x.h5,ella,keloid\n", "'rec/x.h5': there is no such file"),
        ({}, "rec/a-1.h5,ella,keloid\n", "a-1.h5 is also in"),
        ({}, "rec/e-1.h5,ella,scar\n", "'scar' has one subject only"),
        ({}, "rec/e-1.h5,ella,keloid,3\n", "cells is 4; it must be 3"),
        ({"lower = 10.0": "lower = -10.0", 'prior = "log-uniform"\nunit = "N/m"': "", "lower = 1.0":
          "lower = -1.0", 'prior = "log-uniform"\nunit = "s"': ""}, "", "none is always positive"),
    ],
)  # fmt: skip
def test_wrong_input_is_refused_in_one_line_and_nothing_is_written(
    bayeskin: Command, tmp_path: Path, change: dict[str, str], table: str, says: str
) -> None:
    path = small_study(tmp_path)
    (tmp_path / "rec" / "e-1.h5").touch()
    for old, new in change.items():
        assert old in path.read_text()
        path.write_text(path.read_text().replace(old, new, 1))
    (tmp_path / "table.csv").write_text((tmp_path / "table.csv").read_text() + table)
    assert_refused(bayeskin("study", path), says)
    assert not (tmp_path / "springs").exists()


@pytest.mark.parametrize(
    ("section", "says"),
    [
        (DEVICE, "has the section [device]"),
        ('[surrogate]\nfile = "demo.h5"\n', "devices is 2; it must be one"),
        ("", "there is none for this device and tissue"),
    ],
)
def test_devices_that_the_settings_cannot_serve_are_refused(
    bayeskin: Command, tmp_path: Path, section: str, says: str
) -> None:
    small_study(tmp_path)
    (tmp_path / "one.toml").write_text(DEVICE)
    (tmp_path / "other.toml").write_text(DEVICE.replace("30", "31"))
    lines = [f"rec/{name}.h5,{subject},{device}.toml" for (name, subject, *_), device in
             zip(ROWS, ("one", "one", "other", "one", "other"), strict=True)]  # fmt: skip
    (tmp_path / "table.csv").write_text("\n".join(["recording,subject,device", *lines]))
    path = tmp_path / "devices.toml"
    coarse = "" if "surrogate" in section else '[design]\ncoarse = "reduced"\n'
    path.write_text(f'table = "table.csv"\n{coarse}{section}')
    assert_refused(bayeskin("study", path), says)


@pytest.mark.slow
def test_a_worker_that_is_killed_loses_one_recording_which_is_inferred_again(tmp_path: Path) -> None:
    """A worker of a real Dask cluster is killed when it has begun the second stage of a recording."""
    distributed = pytest.importorskip("distributed")
    path, killed = small_study(tmp_path), list[tuple[int, str]]()
    recordings = tmp_path / "springs" / "recordings"

    def kill() -> None:
        while not killed:
            time.sleep(0.02)
            for begun in recordings.glob("*/design"):
                killed.append((int((begun.parent / ".lock").read_text()), begun.parent.name))
                os.kill(killed[0][0], signal.SIGKILL)
                return

    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, host="127.0.0.1"
    ) as cluster:
        workers = {worker.pid for worker in cluster.workers.values()}
        thread = threading.Thread(target=kill)
        thread.start()
        answer = run_study(path, Silent(), cluster.scheduler_address)
        thread.join()
    ((pid, name),) = killed
    assert pid in workers
    reasons = {reason.split(":")[0] for reason in answer["left_out"].values()}
    assert reasons == {"its posterior is not trusted"}
    assert (recordings / name / "sample" / "posterior.nc").is_file()
