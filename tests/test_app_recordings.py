"""The page takes a dropped file: names, limits, columns and units, the device, and the archive."""

from __future__ import annotations

import fcntl
import io
import json
import os
import re
import socket
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from toys.app_page import DEVICE, Visitor, served, until
from toys.laboratory_exports import NUMBERS, D, F, T
from toys.laboratory_files import text, workbook

from bayeskin import storage
from bayeskin.app import jobs, uploads
from bayeskin.app.recordings import open_recordings
from bayeskin.config.device import DeviceFile, load_device_file
from bayeskin.types import Recording
from bayeskin.workflow.folder import locked

BARE = text([["clock", "pull", "cell"], *NUMBERS], ";")


@pytest.fixture(scope="module")
def owner(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Visitor]:
    """Whoever started the page."""
    with served(tmp_path_factory.mktemp("app") / "recordings") as page:
        visitor = Visitor(page)
        visitor.enter()
        yield visitor


def dropped(owner: Visitor, name: str, data: bytes) -> str:
    """Drops a file that is taken; returns the path of its recording below the page's root."""
    answer = owner.drop(name, data)
    assert answer.status == 200, answer.text
    return str(json.loads(answer.body)["at"]).removeprefix(owner.page.access.root)


@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("Forearm 3 (left).csv", "Forearm-3-left"),
        ("../../etc/passwd.csv", "passwd"),
        ("..\\..\\boot.csv", "boot"),
        ("..csv", "recording"),
        ("peau saine é.csv", "peau-saine"),
        ("<script>.csv", "script"),
        (100 * "a" + ".csv", 60 * "a"),
        (".hidden.csv", "hidden"),
    ],
)
def test_names_of_files_become_safe_names_of_folders(tmp_path: Path, file: str, name: str) -> None:
    recordings = open_recordings(tmp_path / "recordings")
    made = [recordings.new(file) for _ in range(2)]
    assert [folder.path for folder in made] == [
        tmp_path / "recordings" / name,
        tmp_path / "recordings" / f"{name}-2",
    ]


def test_a_sound_file_is_read_at_once(owner: Visitor, measured: Path) -> None:
    at = dropped(owner, "sound.csv", measured.read_bytes())
    shown = owner.ask("GET", at).text
    assert "2: displacement (mm)" in shown
    assert "All 9 phases" in shown
    assert "<li>column &#39;force (N)&#39; read as force in N</li>" in shown
    assert 'class="phase hold"' in shown
    assert (owner.page.folder / "sound/sound.h5").is_file()


@pytest.mark.parametrize(
    ("name", "data", "says"),
    [
        ("empty.csv", b"", "empty.csv: the file is empty"),
        ("noise.xlsx", bytes(range(256)) * 40, "an xlsx workbook"),
        ("letter.txt", b"Dear reader,\nthis is no table.\n", "no rows of numbers"),
        ("name", b"1,2,3\n", "is no ending of a table"),
        ("broken.h5", b"\x89HDF\r\n\x1a\n" + bytes(200), "broken.h5"),
    ],
)
def test_what_is_no_recording_is_refused_in_the_line_of_the_command_and_not_kept(
    owner: Visitor, name: str, data: bytes, says: str
) -> None:
    before = sorted(owner.page.folder.iterdir())
    answer = owner.drop(name, data)
    assert answer.status == 400
    said = json.loads(answer.body)["error"]
    assert says in said
    assert "\n" not in said
    assert str(owner.page.folder) not in said
    assert sorted(owner.page.folder.iterdir()) == before


def test_a_refused_file_can_be_mended_and_dropped_again(owner: Visitor) -> None:
    assert owner.drop("mended.csv", b"no table\n").status == 400
    assert "2: pull" in owner.ask("GET", dropped(owner, "mended.csv", BARE)).text


def test_a_file_that_is_too_large_is_refused_while_it_arrives(
    owner: Visitor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(uploads, "MOST_BYTES", 1000)
    answer = owner.drop("huge.csv", BARE)
    assert (answer.status, "the file has more than" in answer.text) == (400, True)
    assert not list(owner.page.folder.glob("huge*"))


def test_a_file_that_does_not_arrive_whole_is_not_kept(owner: Visitor) -> None:
    access = owner.page.access
    head = (
        f"POST {access.root}/upload?name=half.csv HTTP/1.1\r\nHost: 127.0.0.1:{access.port}\r\n"
        f"Origin: {owner.origin}\r\nCookie: bayeskin={owner.cookie}\r\nContent-Length: 100000\r\n\r\n"
    )
    with socket.create_connection(("127.0.0.1", access.port)) as connection:
        connection.sendall(head.encode() + BARE[:500])
        until(lambda: list(owner.page.folder.glob("half/.dropped*")))
    until(lambda: not list(owner.page.folder.glob("half")))


def test_columns_and_units_are_corrected(owner: Visitor) -> None:
    at = dropped(owner, "bare.csv", BARE)
    shown = owner.ask("GET", at).text
    assert "there is no time column" in shown
    assert '<option value="2">2: pull</option>' in shown  # the file's columns can be chosen
    fields = {"column-time": "1", "unit-time": "s", "column-displacement": "2", "unit-displacement": "mm",
              "column-force": "3", "unit-force": "-mN", "zero": ""}  # fmt: skip
    assert owner.fill(f"{at}/reading", **fields).status == 303
    stored = storage.load(owner.page.folder / "bare/bare.h5", Recording)
    assert stored.force_n.tolist() == pytest.approx([-1e-3 * float(value) for value in F])
    assert stored.displacement_m.max() == pytest.approx(1e-3 * max(map(float, D)))
    assert "sign turned" in owner.ask("GET", at).text


def test_a_wrong_correction_leaves_the_earlier_reading(owner: Visitor, measured: Path) -> None:
    at = dropped(owner, "kept.csv", measured.read_bytes())
    before = (owner.page.folder / "kept/kept.h5").read_bytes()
    assert owner.fill(f"{at}/reading", **{"column-force": "7"}).status == 303
    shown = owner.ask("GET", at).text
    assert re.search(r"kept.csv, row 1: --force 7: the columns are .* name one of these columns", shown)
    assert "as it was read before" in shown
    assert (owner.page.folder / "kept/kept.h5").read_bytes() == before


def test_a_table_of_a_workbook_is_chosen(owner: Visitor) -> None:
    sheet = [["Time (s)", "Displacement (mm)", "Force (N)"], *zip(T, D, F, strict=True)]
    at = dropped(owner, "book.xlsx", workbook({"first": sheet, "second": sheet}))
    assert '<option value="second">' in owner.ask("GET", at).text
    owner.fill(f"{at}/reading", sheet="second")
    assert (owner.page.folder / "book/book.h5").is_file()
    owner.fill(f"{at}/reading", sheet="all")
    assert "name a single one" in owner.ask("GET", at).text


def test_text_of_a_file_is_shown_as_text(owner: Visitor) -> None:
    header = ["<script>alert(1)</script> time (s)", 'pull & "displacement" (mm)', "force (N)"]
    at = dropped(owner, "script.csv", text([header, *NUMBERS], ";"))
    shown = owner.ask("GET", at).text
    assert "<script>alert" not in shown
    assert "&lt;script&gt;alert" in shown


def test_a_device_is_stated_by_its_fields(owner: Visitor, measured: Path) -> None:
    at = dropped(owner, "device.csv", measured.read_bytes())
    assert "State your device" in owner.ask("GET", at).text
    assert owner.fill(f"{at}/ask/calibrate").status == 400  # not before the device is stated
    assert owner.fill(f"{at}/device", **DEVICE).status == 303
    stated = load_device_file(owner.page.folder / "device/device.toml")
    assert (stated.device.gauge_mm, stated.device.pad_mm, stated.device.guard_mm) == (
        20.0,
        (6.0, 10.0),
        False,
    )
    assert stated.tissue.cutis_mm.mean == 1.5  # a decimal comma is understood
    assert (stated.tissue.cutis_mm.sd, stated.tissue.arm_radius_mm) == (0.2, "flat")
    (owner.page.folder / "device/device").mkdir()
    report = owner.page.folder / "device/device/report.html"
    report.write_text("report")
    assert "before the last change" not in owner.ask("GET", at).text
    os.utime(report, (0.0, 0.0))
    shown = owner.ask("GET", at).text
    assert "before the last change" in shown
    assert "Prepare this device" in shown  # no reduced model serves it
    assert f"{at}/ask/missing" not in shown
    other = dropped(owner, "other.csv", measured.read_bytes())
    assert owner.fill(f"{other}/device", **{"as": "device"}).status == 303
    assert load_device_file(owner.page.folder / "other/device.toml") == stated


@pytest.mark.parametrize(
    ("field", "given", "says"),
    [
        (
            "gauge",
            "long",
            "device: device.gauge_mm: &#34;long&#34; is not allowed; it must be a valid number",
        ),
        ("gauge", "-3", "device: device.gauge_mm"),
        ("gauge", "nan", "device.gauge_mm"),
        ("force_on", "arm", "device: device.force_on"),
        ("cutis_sd", "9", "it must be at most a third of the mean"),
    ],
)
def test_an_impossible_device_is_refused_in_one_line(
    owner: Visitor, measured: Path, field: str, given: str, says: str
) -> None:
    at = dropped(owner, "impossible.csv", measured.read_bytes())
    answer = owner.fill(f"{at}/device", **{**DEVICE, field: given})
    assert answer.status == 400
    assert says in answer.text
    assert not (owner.page.folder / at.rpartition("/")[2] / "device.toml").exists()


def test_the_fields_show_the_article_s_device_until_another_is_stated(owner: Visitor, measured: Path) -> None:
    at = dropped(owner, "article.csv", measured.read_bytes())
    shown = owner.ask("GET", at).text
    fields = dict(re.findall(r'<input name="(\w+)" value="([^"]*)"', shown))
    for name, options in re.findall(r'<select name="(\w+)">(.*?)</select>', shown, re.S):
        chosen = re.search(r'value="([^"]*)" selected', options)
        fields[name] = chosen[1] if chosen else ""
    del fields["as"]
    owner.fill(f"{at}/device", **fields)
    assert load_device_file(owner.page.folder / "article/device.toml") == DeviceFile()


def test_the_archive_has_everything_of_the_recording_and_nothing_from_outside(
    owner: Visitor, measured: Path
) -> None:
    at = dropped(owner, "packed.csv", measured.read_bytes())
    folder = owner.page.folder / "packed"
    (owner.page.folder.parent / "secret").mkdir(exist_ok=True)
    (owner.page.folder.parent / "secret/key").write_text("secret")
    (folder / "link").symlink_to(owner.page.folder.parent / "secret/key")
    (folder / "folder").symlink_to(owner.page.folder.parent / "secret")
    (folder / ".hidden").write_text("hidden")
    answer = owner.ask("GET", f"{at}/download")
    assert answer.headers["content-disposition"] == 'attachment; filename="packed.zip"'
    with zipfile.ZipFile(io.BytesIO(answer.body)) as archive:
        assert archive.testzip() is None
        assert archive.namelist() == ["packed/original/packed.csv", "packed/packed.h5", "packed/reading.json"]
        assert archive.read("packed/original/packed.csv") == measured.read_bytes()


def test_a_form_of_endless_length_is_refused(owner: Visitor, measured: Path) -> None:
    at = dropped(owner, "form.csv", measured.read_bytes())
    assert owner.ask("POST", f"{at}/device", b"gauge=" + b"1" * 200_000).status == 413
    assert owner.ask("POST", f"{at}/device", b"\xff=\xff").status == 400


def test_a_recording_is_removed_after_a_confirmation_and_nothing_outside_its_folder(
    owner: Visitor, measured: Path
) -> None:
    at = dropped(owner, "gone.csv", measured.read_bytes())
    folder, outside = owner.page.folder / "gone", owner.page.folder.parent / "kept"
    outside.mkdir()
    (outside / "own.csv").write_text("own")
    (folder / "link").symlink_to(outside)
    (folder / "gone").mkdir()
    assert "Remove gone for good" in owner.ask("GET", at).text
    refused = owner.fill(f"{at}/remove")
    assert refused.status == 400
    assert "the removal is not confirmed; tick the box first" in refused.text
    assert folder.is_dir()
    answer = owner.fill(f"{at}/remove", sure="yes")
    assert (answer.status, answer.headers["location"]) == (303, f"{owner.page.access.root}/")
    assert not folder.exists()
    assert not list(owner.page.folder.glob(".removed-*"))
    assert (outside / "own.csv").read_text() == "own"
    assert owner.ask("GET", at).status == 404
    assert owner.fill(f"{at}/remove", sure="yes").status == 404
    assert dropped(owner, "gone.csv", measured.read_bytes()) == at  # the name is free again


def test_a_recording_in_which_something_works_is_not_removed(owner: Visitor, measured: Path) -> None:
    at = dropped(owner, "busy.csv", measured.read_bytes())
    folder = owner.page.folder / "busy"
    with locked(folder / "busy"):
        said = owner.fill(f"{at}/remove", sure="yes")
        assert (said.status, "another bayeskin" in said.text) == (400, True)
    (folder / "job").mkdir()
    (folder / "job" / jobs.OUTPUT).touch()
    (folder / "job" / jobs.REQUEST).write_text('{"question": "calibrate", "started_s": 0.0}')
    with open(folder / "job" / jobs.LOCK, "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        said = owner.fill(f"{at}/remove", sure="yes")
        assert (said.status, "a job runs already; stop it first" in said.text) == (400, True)
        assert "A job runs at present. Stop it first." in said.text
    assert folder.is_dir()
    (owner.page.folder / ".removed-half" / "original").mkdir(parents=True)
    assert "removed-half" not in owner.ask("GET", "/").text
    assert owner.fill(f"{at}/remove", sure="yes").status == 303
    assert not folder.exists()
