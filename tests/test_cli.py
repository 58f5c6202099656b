"""The command line: one line and exit code 2 for wrong input, one JSON document, nothing written over."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from toys import stand_in_model
from toys.closed_form_model import SPACE
from toys.command_line import Command, assert_refused, write_csv

from bayeskin import cli, storage
from bayeskin.design import first_wave
from bayeskin.finite_element.simulate import ModelSpec
from bayeskin.recordings import idealised_motion, read_recording, segment
from bayeskin.surrogates import manifest_of, save_surrogate, train
from bayeskin.types import Design, Recording
from bayeskin.workflow import stages
from bayeskin.workflow.engine import CannotGoOn, Run, Stage
from bayeskin.workflow.shipping import motion_sha256


def test_import_writes_the_recording_and_says_what_it_found(
    bayeskin: Command, measured: Path, tmp_path: Path
) -> None:
    code, out, err = bayeskin("import", measured, "-o", tmp_path / "r.h5", "--json")
    said = json.loads(out)
    stored = storage.load(tmp_path / "r.h5", Recording)
    assert (code, err.splitlines()) == (0, said["notes"])
    assert said["notes"][1] == "column 'displacement (mm)' read as displacement in mm"
    assert said["columns"]["displacement"]["factor_to_si"] == 1e-3
    assert said["samples"] == len(stored.time_s) == 1301
    assert [phase["kind"] for phase in said["phases"]][:4] == ["rest", "load", "hold", "unload"]
    assert stored.displacement_m.max() == pytest.approx(9e-3)


def without_force(path: Path) -> None:
    write_csv(path, "time (s),displacement (mm)", np.arange(200) * 0.1, np.arange(200) * 0.01)


def with_two_forces(path: Path) -> None:
    ramp = np.arange(200) * 0.1
    write_csv(path, "time (s),displacement (mm),force (N),force (N)", ramp, ramp, ramp, 2 * ramp)


def still(path: Path) -> None:
    ramp, noise = np.arange(500) * 0.1, np.random.default_rng(2).normal(size=500)
    write_csv(
        path, "time (s),displacement (mm),force (N)", ramp, 0.01 * np.round(noise - noise[0]), 0.01 * ramp
    )


def backwards(path: Path) -> None:
    ramp = np.arange(500) * 0.1
    write_csv(path, "time (s),displacement (mm),force (N)", ramp[::-1], ramp, ramp)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (without_force, "force"),
        (with_two_forces, "force"),
        (still, "little more than its noise"),
        (backwards, "increase"),
        (lambda path: path.write_text(""), "empty"),
        (
            lambda path: path.write_text(
                "time (s),displacement (mm),force (N)\n" + 3 * "0,0,0\n" + "1,0,abc"
            ),
            "abc",
        ),
        (lambda path: None, "no such file"),
        (lambda path: path.mkdir(), "a folder"),
    ],
    ids=["no force", "two forces", "still", "time backwards", "empty", "text", "absent", "a folder"],
)
def test_an_unsound_recording_is_refused_and_the_earlier_output_kept(
    bayeskin: Command, tmp_path: Path, make: Callable[[Path], object], says: str
) -> None:
    make(tmp_path / "bad.csv")
    (tmp_path / "out.h5").write_bytes(b"earlier")
    assert_refused(bayeskin("import", tmp_path / "bad.csv", "-o", tmp_path / "out.h5"), "bad", says)
    assert (tmp_path / "out.h5").read_bytes() == b"earlier"


def test_a_reader_that_leaves_early_does_not_hide_what_was_found(monkeypatch: pytest.MonkeyPatch) -> None:
    code = (
        "import sys; from bayeskin import cli\n"
        "import bayeskin.workflow.new as new\n"
        "new.new_demo = lambda out: {'ok': False, 'text': 'x' * 10 ** 6}\n"
        "cli.main(['new'])\n"
    )
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run([sys.executable, "-c", code], stdout=write, stderr=subprocess.PIPE, text=True)
    os.close(write)
    assert (done.returncode, done.stderr) == (1, "")


@pytest.mark.parametrize("command", ["design", "train", "map", "sample", "sobol", "report", "run"])
def test_every_stage_refuses_a_wrong_configuration(bayeskin: Command, tmp_path: Path, command: str) -> None:
    path = tmp_path / "case.toml"
    path.write_text('[recording]\nfile = "r.csv"\ncolour = 3\n')
    assert_refused(bayeskin(command, path), "case.toml: recording.colour", "this key is not known")
    path.write_text('[recording]\nfile = "r.csv"\n[parameters.k_c]\nlower = 1e-11\nupper = 1e-16\n')
    assert_refused(bayeskin(command, path), "case.toml: parameters.k_c", "the lower bound")
    path.write_text('[recording]\nfile = "r.csv"\n')
    assert_refused(bayeskin(command, path), "case.toml", "r.csv")
    assert_refused(bayeskin(command, tmp_path / "absent.toml"), "no such file")
    assert sorted(p.name for p in tmp_path.rglob("*") if p.is_file()) in (
        ["case.toml"],
        [".lock", "case.toml"],
    )


@pytest.fixture(scope="module")
def ready(measured: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the recording and a surrogate of its protocol, as shipped ones are."""
    folder = tmp_path_factory.mktemp("ready")
    (folder / "measured.csv").write_bytes(measured.read_bytes())
    recording = read_recording(measured)
    motion, spec = idealised_motion(recording, segment(recording)), ModelSpec()
    edges_s = np.arange(0.0, 130.5, 0.5)
    wave = first_wave(SPACE, 24, 4, seed=1)
    force_n = [
        stand_in_model.simulate(spec, motion, dict(zip(SPACE.names, row, strict=True))).bin_means(edges_s)
        for row in wave.theta
    ]
    n = len(wave.theta)
    design = Design(
        SPACE, edges_s, wave.theta, np.array(force_n), np.zeros(n, dtype=np.int64), wave.held_out,
        np.ones(n, dtype=bool), ("",) * n, np.zeros(n), 1, spec.hash,
    )  # fmt: skip
    surrogate, validation = train(design, "chaos")
    manifest = {
        **manifest_of(surrogate, validation),
        "motion_sha256": motion_sha256(motion),
        "waves": [dict(wave.record)],
    }
    save_surrogate(folder / "ready.h5", surrogate, manifest)
    storage.save(folder / "ready-design.h5", design)
    return folder


@pytest.mark.parametrize(
    ("extra", "says"),
    [
        ("[parameters.E_c]\nupper = 4e6\n", "it must lie within 10000 to 2e+06"),
        ("[fit]\nbin_width_s = 1.0\n", "130 bins"),
        ("[model]\nrefinement = 2\n", "another model"),
        ("[surrogate]\nfile = 'absent.h5'\n", "a shipped one: demo.h5"),
    ],
    ids=["parameters outside its box", "other bins", "other model", "absent"],
)
def test_a_surrogate_is_used_only_where_it_belongs(
    bayeskin: Command, ready: Path, extra: str, says: str
) -> None:
    named = "" if "[surrogate]" in extra else '[surrogate]\nfile = "ready.h5"\n'
    (ready / "case.toml").write_text(f'[recording]\nfile = "measured.csv"\n{named}{extra}')
    assert_refused(bayeskin("design", ready / "case.toml"), says)
    assert not (ready / "case" / "design" / "design.h5").exists()


def test_a_surrogate_of_another_protocol_is_refused(bayeskin: Command, ready: Path, tmp_path: Path) -> None:
    for file in ready.glob("ready*"):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    slower = read_recording(ready / "measured.csv")
    storage.save(tmp_path / "slower.h5", replace(slower, time_s=1.02 * slower.time_s))
    (tmp_path / "case.toml").write_text('[recording]\nfile = "slower.h5"\n[surrogate]\nfile = "ready.h5"\n')
    assert_refused(bayeskin("design", tmp_path / "case.toml"), "another protocol")


def one_stage(work: Callable[[Run], dict[str, object]]) -> dict[str, Stage]:
    return {"report": Stage("report", "reports", (), (), work)}


def test_the_exit_code_says_whether_the_answer_can_be_relied_on(
    bayeskin: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "case.toml").write_text('[recording]\nfile = "r.csv"\n')

    def failing(run: Run) -> dict[str, object]:
        raise CannotGoOn("3 training runs of 20; narrow the prior box")

    def interrupted(run: Run) -> dict[str, object]:
        raise KeyboardInterrupt

    original = stages.run
    for work, expected in ((failing, 1), (interrupted, 130)):
        monkeypatch.setattr(
            stages, "run", lambda c, last, r, work=work, scheduler=None: original(c, last, r, one_stage(work))
        )
        code, out, err = bayeskin("run", tmp_path / "case.toml", "--json")
        assert code == expected
        if expected == 1:
            assert json.loads(out)["ok"] is False
            assert "narrow the prior box" in json.loads(out)["text"]
        else:
            assert out == ""
            assert err.splitlines()[-1] == "bayeskin: interrupted; run the same command again to continue"


@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGTERM])
def test_a_command_that_is_interrupted_says_how_to_go_on(measured: Path, tmp_path: Path, ending: int) -> None:
    code = (
        "import sys, time; from bayeskin import cli; from bayeskin.workflow import importing\n"
        "def slow(*_, **__): print('at work', flush=True); time.sleep(60)\n"
        "importing.import_recording = slow; cli.main(['import', *sys.argv[1:]])"
    )
    command = [sys.executable, "-c", code, str(measured), "-o", str(tmp_path / "r.h5")]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a background shell ignores it
    )  # fmt: skip
    process.stdout.readline()
    process.send_signal(ending)
    _, said = process.communicate()
    assert process.returncode == 130
    assert said.strip() == "bayeskin: interrupted; run the same command again to continue"


def test_help_teaches_each_command_by_an_example(bayeskin: Command) -> None:
    for name in cli.cli.commands:
        code, out, _ = bayeskin(name, "--help")
        assert code == 0
        assert "--json" in out
        assert f"bayeskin {name} " in out.split("Example:")[1]


def test_the_command_line_starts_without_the_packages_of_the_computation() -> None:
    script = (
        "import sys; from bayeskin.cli import cli\n"
        "print(*{'numpy', 'scipy', 'h5py', 'matplotlib', 'pydantic'} & set(sys.modules))\n"
        "print(*(name for name in sys.modules if name.startswith('bayeskin')), sep='\\n')"
    )
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    heavy, *own = ended.stdout.splitlines()
    assert heavy == ""
    light = {"bayeskin", "bayeskin.compiled_code", "bayeskin.errors"}
    assert {name for name in own if not name.startswith("bayeskin.cli")} == light


def test_a_set_of_what_nobody_knows_is_refused(tmp_path: Path, bayeskin: Command) -> None:
    code, _, said = bayeskin("conceal", tmp_path / "set", "--seed", 1, "--count", 2, "--only", "pad-slop")
    assert code == 2
    assert "--only: pad-slop is not known; use one of nothing, backlash" in said
    assert not (tmp_path / "set" / "index.json").exists()


def test_the_list_of_commands_follows_the_work_and_fits_a_terminal(
    bayeskin: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    _, out, _ = bayeskin("--help")
    listed = re.findall(r"^  ([a-z]+)  ", out[out.index("From a recording") :], re.MULTILINE)
    assert sorted(listed) == sorted(cli.cli.commands)
    work = ["new", "import", "run", "diagnose", "report", "design", "train", "map", "sample", "sobol"]
    assert [name for name in listed if name in work] == work
    assert max(map(len, out.splitlines())) <= 80
    assert all(re.search(rf"^  {name} .*\.$", out, re.MULTILINE) for name in listed)  # each in one line
    assert "_BAYESKIN_COMPLETE" in out


def test_a_shell_completes_commands_and_options() -> None:
    def completed(words: str) -> list[str]:
        setting = {
            "_BAYESKIN_COMPLETE": "zsh_complete",
            "COMP_WORDS": words,
            "COMP_CWORD": str(words.count(" ")),
        }
        command = [sys.executable, "-c", "from bayeskin.cli import main; main()"]
        told = subprocess.run(
            command, env={**os.environ, **setting}, capture_output=True, text=True, check=False
        )
        return told.stdout.splitlines()[1::3]

    assert completed("bayeskin rep") == ["report"]
    assert completed("bayeskin simulate --ob") == ["--observation"]
    assert completed("bayeskin simulate --observation ") == ["reaction", "article"]
