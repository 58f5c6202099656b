"""Tests of `bayeskin new`: its configuration loads, suits the recording, and overwrites no file."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
import tomllib
from pathlib import Path

import h5py
import numpy as np
import pytest

from bayeskin import cli, storage
from bayeskin.config import Config, DesignConfig, RecordingConfig, load_config, parameter_space
from bayeskin.design import default_space
from bayeskin.errors import InputError
from bayeskin.inference import NoisePriors
from bayeskin.shipped import shipped
from bayeskin.surrogates import load_manifest
from bayeskin.types import Recording
from bayeskin.workflow import stages
from bayeskin.workflow.engine import Silent, open_run
from bayeskin.workflow.new import new_config, new_demo
from bayeskin.workflow.shipping import shipped_files

REDUCED = DesignConfig.model_validate({"coarse": "reduced"})


@pytest.fixture
def demo(tmp_path: Path) -> Path:
    path = tmp_path / "data" / "forearm.h5"
    path.parent.mkdir()
    path.write_bytes(shipped("data/demo.h5").read_bytes())
    return path


@pytest.fixture
def own(tmp_path: Path) -> Path:
    """A recording whose protocol nobody knows."""
    time_s = np.arange(0.0, 60.0, 0.1)
    displacement_m = np.interp(time_s, [0.0, 5.0, 15.0, 40.0, 50.0, 60.0], [0.0, 0.0, 7e-3, 7e-3, 0.0, 0.0])
    noise_n = 0.002 * np.random.default_rng(1).standard_normal(len(time_s))
    path = tmp_path / "own.h5"
    note = "column 'F\x07 [N]\n]#' read as force, in N"
    storage.save(
        path, Recording(time_s, displacement_m, 30 * displacement_m + noise_n, "own", "0" * 64, (note,))
    )
    return path


def test_a_known_protocol_takes_the_shipped_surrogate_and_the_design_stage_accepts_it(demo: Path) -> None:
    out = demo.parent.parent / "forearm.toml"
    said = new_config([demo], out)
    assert (said["out"], said["surrogate"], said["cycles"]) == (str(out), "demo.h5", 1)
    assert load_config(out) == Config(
        name="forearm",
        recording=RecordingConfig(file="data/forearm.h5"),
        surrogate={"file": "demo.h5"},
    )
    assert open_run(out, Silent()).beside("data/forearm.h5").samefile(demo)
    assert "#   demo: 3001 samples at 50 Hz" in out.read_text()
    manifest = load_manifest(shipped("surrogates/demo.h5"))
    assert stages.run(out, "design", Silent())["training"] == manifest["training_rows"]


def test_an_unknown_protocol_gets_a_design_of_its_own(own: Path) -> None:
    said = new_config([own])
    config = load_config(own.with_suffix(".toml"))
    assert (said["surrogate"], config.surrogate.file) == (None, None)
    assert config == Config(name="own", recording=RecordingConfig(file="own.h5"), design=REDUCED)
    text = own.with_suffix(".toml").read_text()
    assert "# 416 runs of the reduced model article-device-reduced.h5" in text
    assert "and 12 runs of the full model, which correct them: 1 to 3 minutes with 2 workers." in text


def test_a_device_without_a_reduced_model_gets_a_design_of_full_runs(own: Path) -> None:
    device = own.with_name("device.toml")
    device.write_text("[device]\ngauge_mm = 30.0\n")
    new_config([own], device=device)
    assert load_config(own.with_suffix(".toml")).design == DesignConfig()
    assert "# 336 runs of about 4 to 15 s each, 11 to 42 minutes with 2 workers." in (
        own.with_suffix(".toml").read_text()
    )


def test_every_key_that_is_commented_out_is_a_default(own: Path) -> None:
    new_config([own])
    text = own.with_suffix(".toml").read_text()
    with_keys = re.sub(r"^# (?=\[|\w+ = )", "", text, flags=re.MULTILINE)
    assert re.findall(r"^# \w+ = .*[^#]# *$", text, re.MULTILINE) == []  # each says what it is
    own.with_suffix(".toml").write_text(with_keys.replace("windows_s = [[0.0, 60.0]]", ""))
    config = load_config(own.with_suffix(".toml"))
    assert set(tomllib.loads(with_keys)) == {*Config.model_fields} - {"slurm", "surrogate", "recordings"}
    default = Config(name="own", recording=RecordingConfig(file="own.h5"), design=REDUCED)
    assert config.model_copy(update={"parameters": {}, "noise": default.noise}) == default
    assert dict(config.noise) == {
        name: bounds
        for name, bounds in dataclasses.asdict(NoisePriors()).items()
        if not name.startswith("by_")
    }
    space = parameter_space(config)
    for ours, known in zip(space.parameters, default_space().parameters, strict=True):
        assert (ours.lower, ours.upper, ours.prior) == (known.lower, known.upper, known.prior)


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    with pytest.raises(SystemExit) as end:
        cli.main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    assert (end.value.code, captured.out, captured.err.count("\n")) == (2, "", 1)
    return captured.err


def test_nothing_is_written_over(own: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = own.with_suffix(".toml")
    out.write_text("mine")
    assert "own.toml: this file exists already" in refused(capsys, "new", own)
    assert out.read_text() == "mine"


def test_what_cannot_be_done_is_refused_in_one_line_and_nothing_written(
    own: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "use .toml" in refused(capsys, "new", own, "-o", tmp_path / "own.yaml")
    assert "no such file" in refused(capsys, "new", tmp_path / "absent.csv")
    assert ".: it is a folder; bayeskin needs a recording" in refused(capsys, "new", Path())
    assert [path.name for path in tmp_path.iterdir()] == ["own.h5"]


def test_a_folder_that_is_not_there_is_made(own: Path, tmp_path: Path) -> None:
    new_config([own], tmp_path / "a" / "b" / "own.toml")
    new_demo(tmp_path / "c" / "demo.toml")
    assert open_run(tmp_path / "a" / "b" / "own.toml", Silent()).config.recording.file == "../../own.h5"
    assert (tmp_path / "c" / "demo-recording.h5").is_file()


def test_a_name_that_toml_or_a_run_cannot_take_as_it_is(
    own: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    odd = own.rename(tmp_path / '..é "test" 3\\.h5')
    with pytest.raises(SystemExit) as end:
        cli.main(["new", str(odd), "--json"])
    assert end.value.code == 0
    out = Path(json.loads(capsys.readouterr().out)["out"])
    config = load_config(out)
    assert config.recording.file == odd.name
    assert config.name == "test--3-"


def test_without_a_recording_it_is_the_demo(tmp_path: Path) -> None:
    said = new_demo(tmp_path / "demo.toml")
    run = open_run(tmp_path / "demo.toml", Silent())
    assert said["ok"]
    assert run.beside(run.config.recording.file) == tmp_path.resolve() / "demo-recording.h5"
    assert shipped_files(run).surrogate == shipped("surrogates/demo.h5")
    assert run.config == load_config(shipped("runs/demo.toml")).model_copy(
        update={"recording": run.config.recording}
    )
    with pytest.raises(InputError, match="exists already"):
        new_demo(tmp_path / "other.toml")
    assert not (tmp_path / "other.toml").exists()


def test_a_recording_with_the_name_of_a_shipped_surrogate_is_not_taken_for_it(tmp_path: Path) -> None:
    recording = tmp_path / "demo.h5"
    shutil.copy(shipped("data/demo.h5"), recording)
    case = tmp_path / "case.toml"
    case.write_text('[recording]\nfile = "demo.h5"\n[surrogate]\nfile = "demo.h5"\n')
    run = open_run(case, Silent())
    assert shipped_files(run).surrogate == shipped("surrogates/demo.h5")


def test_a_surrogate_that_is_nowhere_is_told_apart_from_a_broken_installation(tmp_path: Path) -> None:
    shutil.copy(shipped("data/demo.h5"), tmp_path / "a.h5")
    case = tmp_path / "case.toml"
    case.write_text('[recording]\nfile = "a.h5"\n[surrogate]\nfile = "mine.h5"\n')
    with pytest.raises(InputError, match=r"surrogate.file: there is no file .*mine.h5; .*: demo.h5, "):
        shipped_files(open_run(case, Silent()))


def test_a_window_without_a_bin_is_refused_before_anything_is_run(own: Path) -> None:
    new_config([own])
    case = own.with_suffix(".toml")
    case.write_text(case.read_text() + "\n[fit]\nwindows_s = [[0.0, 20.0], [60.2, 90.0]]\n")
    with pytest.raises(InputError, match=r"fit.windows_s: the window \[60.2, 90\] .* 0 to 59.5 s"):
        stages.run(case, "recording", Silent())


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"waves": None}, "manifest: waves: it is None"),
        ({"parameters": {}}, "manifest: parameters: they differ"),
    ],
    ids=["no waves", "no box"],
)
def test_a_manifest_without_what_a_run_reads_is_refused(demo: Path, change: dict, says: str) -> None:
    for name in ("demo", "demo-design"):
        shutil.copy(shipped(f"surrogates/{name}.h5"), demo.with_name(f"{name.replace('demo', 'mine')}.h5"))
    with h5py.File(demo.with_name("mine.h5"), "r+") as handle:
        handle.attrs["manifest"] = json.dumps({**json.loads(handle.attrs["manifest"]), **change})
    case = demo.with_name("case.toml")
    case.write_text(f'[recording]\nfile = "{demo.name}"\n[surrogate]\nfile = "mine.h5"\n')
    with pytest.raises(InputError, match=says):
        stages.run(case, "design", Silent())
