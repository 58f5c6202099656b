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
from typing import Any

import meshio
import numpy as np
import pytest
import toy_model
from matplotlib.figure import Figure
from matplotlib.image import imread
from toy import MOTION, SPACE, toy_force

from bayeskin import cli, report, storage
from bayeskin.design import first_wave
from bayeskin.finite_element.simulate import ModelSpec, OnState, problem_of
from bayeskin.recordings import idealised_motion, read_recording, segment
from bayeskin.surrogates import manifest_of, save_surrogate, train
from bayeskin.types import Design, PadMotion, Recording, Simulation
from bayeskin.workflow import single, stages
from bayeskin.workflow.engine import CannotGoOn, Run, Stage
from bayeskin.workflow.field_outputs import FieldOutputs
from bayeskin.workflow.shipping import motion_sha256

THETA = np.array([[200e3, 30e3, 1e-14, 1e-13, 300.0]])


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sound recording as CSV."""
    path = tmp_path_factory.mktemp("measured") / "measured.csv"
    time_s = np.arange(0.0, 130.001, 0.1)
    noise_n = 0.003 * np.random.default_rng(5).standard_normal(len(time_s))
    force_n = toy_model.SCALE * toy_force(THETA, time_s)[0] + noise_n
    write_csv(path, "time (s),displacement (mm),force (N)", time_s, 1e3 * MOTION.at(time_s), force_n)
    return path


def write_csv(path: Path, header: str, *columns: np.ndarray) -> None:
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=header, comments="", fmt="%.9g")


@pytest.fixture
def bayeskin(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Runs the command; gives exit code, stdout and stderr."""

    def call(*arguments: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as stop:
            cli.main([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return int(stop.value.code or 0), captured.out, captured.err

    return call


Command = Callable[..., tuple[int, str, str]]


def assert_refused(answer: tuple[int, str, str], *says: str) -> None:
    """Exit code 2, nothing on stdout, and one line that names the fault."""
    code, out, err = answer
    line = err.splitlines()[-1]
    assert code == 2
    assert out == ""
    assert line.startswith("bayeskin: ")
    assert "Traceback" not in err
    assert [text for text in err.splitlines() if text.startswith("bayeskin: ")] == [line]
    for part in says:
        assert part in line


def test_import_writes_the_recording_and_says_what_it_found(
    bayeskin: Command, measured: Path, tmp_path: Path
) -> None:
    code, out, err = bayeskin("import", measured, "-o", tmp_path / "r.h5", "--json")
    said = json.loads(out)
    stored = storage.load(tmp_path / "r.h5", Recording)
    assert (code, err) == (0, "")
    assert said["samples"] == len(stored.time_s) == 1301
    assert [phase["kind"] for phase in said["phases"]][:4] == ["rest", "load", "hold", "unload"]
    assert stored.displacement_m.max() == pytest.approx(9e-3)


def without_force(path: Path) -> None:
    write_csv(path, "time (s),displacement (mm)", np.arange(200) * 0.1, np.arange(200) * 0.01)


def with_two_forces(path: Path) -> None:
    ramp = np.arange(200) * 0.1
    write_csv(path, "time (s),displacement (mm),force (N),force (N)", ramp, ramp, ramp, 2 * ramp)


def one_phase(path: Path) -> None:
    ramp = np.arange(500) * 0.1
    write_csv(path, "time (s),displacement (mm),force (N)", ramp, 0.1 * ramp, 0.01 * ramp)


def backwards(path: Path) -> None:
    ramp = np.arange(500) * 0.1
    write_csv(path, "time (s),displacement (mm),force (N)", ramp[::-1], ramp, ramp)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (without_force, "force"),
        (with_two_forces, "force"),
        (one_phase, "one phase only"),
        (backwards, "increase"),
        (lambda path: path.write_text(""), "empty"),
        (lambda path: path.write_text("time (s),displacement (mm),force (N)\n0,0,abc\n"), "abc"),
        (lambda path: None, "no such file"),
        (lambda path: path.mkdir(), "a folder"),
    ],
    ids=["no force", "two forces", "one phase", "time backwards", "empty", "text", "absent", "a folder"],
)
def test_an_unsound_recording_is_refused_and_the_earlier_output_kept(
    bayeskin: Command, tmp_path: Path, make: Callable[[Path], object], says: str
) -> None:
    make(tmp_path / "bad.csv")
    (tmp_path / "out.h5").write_bytes(b"earlier")
    assert_refused(bayeskin("import", tmp_path / "bad.csv", "-o", tmp_path / "out.h5"), "bad", says)
    assert (tmp_path / "out.h5").read_bytes() == b"earlier"


def test_simulate_writes_the_columns_that_scripts_rely_on(
    bayeskin: Command, measured: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(single, "simulate", toy_model.simulate)
    common = ("simulate", "--recording", measured, "--set", "E_c=200e3", "--json")
    code, out, _ = bayeskin(*common, "-o", tmp_path / "force.csv")
    said = json.loads(out)
    assert (code, said["status"], said["theta"]["E_c"]) == (0, "ok", 200e3)
    assert said["theta"]["p_init"] == pytest.approx(SPACE.from_unit(np.full(5, 0.5))[4])
    lines = (tmp_path / "force.csv").read_text().splitlines()
    assert lines[0] == "time_s,displacement_m,force_n"
    bayeskin(*common, "-o", tmp_path / "force.h5")
    stored = storage.load(tmp_path / "force.h5", Simulation)
    assert [float(x) for x in lines[-1].split(",")] == [
        stored.time_s[-1], stored.displacement_m[-1], stored.force_n[-1],
    ]  # fmt: skip


def test_simulate_adds_the_mechanisms_that_are_named(
    bayeskin: Command, measured: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(single, "simulate", toy_model.simulate)
    common = ("simulate", "--recording", measured, "--set", "E_c=200e3")
    mechanisms = (
        "--mechanism",
        "force-offset",
        "--mechanism",
        "viscous-drag",
        "--set",
        "F0=0.02",
        "--set",
        "drag=10",
    )
    bayeskin(*common, "-o", tmp_path / "base.h5")
    code, out, _ = bayeskin(*common, *mechanisms, "-o", tmp_path / "more.h5", "--json")
    assert (code, json.loads(out)["theta"]["F0"]) == (0, 0.02)
    base, more = (storage.load(tmp_path / f"{name}.h5", Simulation) for name in ("base", "more"))
    beyond = more.force_n - base.at(more.time_s)
    moving = np.abs(np.gradient(more.displacement_m, more.time_s)) > 8e-4
    assert len(more.time_s) > 1300
    np.testing.assert_allclose(np.abs(beyond[moving] - 0.02).max(), 10 * 0.9e-3, atol=1e-4)
    np.testing.assert_allclose(np.median(beyond), 0.02, atol=1e-6)


def test_the_peak_that_is_told_is_that_of_the_force_that_is_written(
    bayeskin: Command, measured: Path, tmp_path: Path, runs: list[str]
) -> None:
    peaks = []
    for offset in ("0", "-0.1"):
        out = tmp_path / f"{offset}.csv"
        more = ("--mechanism", "force-offset", "--set", f"F0={offset}")
        code, said, _ = bayeskin("simulate", "--recording", measured, "-o", out, *more, "--json")
        written = np.loadtxt(out, delimiter=",", skiprows=1)[:, 2]
        peaks.append(json.loads(said)["stats"]["peak_force_n"])
        assert (code, peaks[-1]) == (0, pytest.approx(np.abs(written).max()))
    assert peaks[0] - peaks[1] == pytest.approx(0.1)


def test_with_mechanisms_no_two_times_are_the_same(
    bayeskin: Command, measured: Path, tmp_path: Path, runs: list[str]
) -> None:
    out = tmp_path / "f.csv"
    assert bayeskin("simulate", "--recording", measured, "-o", out, "--mechanism", "force-offset")[0] == 0
    steps = np.diff(np.loadtxt(out, delimiter=",", skiprows=1)[:, 0])
    assert steps.min() > 1e-3
    assert steps.max() <= 0.1 + 1e-9


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


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """A stand-in for the full model that stretches all uniformly; lists the names of the runs it made."""
    made: list[str] = []

    def stretch(
        spec: ModelSpec,
        motion: PadMotion,
        theta: dict[str, float],
        on_progress: object,
        on_state: OnState | None,
        laws: object,
    ) -> Simulation:
        made.append(spec.mesh)
        space = problem_of(spec.mesh, spec.refinement).space
        for time_s in motion.time_s if on_state else ():
            x = np.zeros(space.dofs)
            x[0 : 3 * space.n_nodes : 3] = 10.0 * motion.at(time_s) * space.points_u[0]
            x[3 * space.n_nodes :] = -1e5 * motion.at(time_s)
            on_state(float(time_s), x, 0.0)
        return toy_model.simulate(spec, motion, theta)

    monkeypatch.setattr(single, "simulate", stretch)
    return made


def test_force_fields_and_figure_come_of_one_run(
    bayeskin: Command, measured: Path, tmp_path: Path, runs: list[str]
) -> None:
    outputs = ("-o", tmp_path / "f.csv", "--fields", tmp_path / "a" / "fields", "--figures", tmp_path / "b")
    code, out, err = bayeskin("simulate", "--recording", measured, *outputs, "--at", 15, "--json")
    said = json.loads(out)
    assert (code, runs) == (0, ["bricks"])
    assert err.splitlines() == ["simulating 130.0 s, reaction on bricks"]
    assert sorted(said["files"]) == sorted(str(path) for path in tmp_path.rglob("*.*"))
    assert said["fields"] == str(tmp_path / "a" / "fields" / "fields.xdmf")
    assert said["figures"] == [str(tmp_path / "b" / name) for name in ("fields.png", "fields.svg")]
    assert imread(said["figures"][0]).shape[1] > 1000


def drawn_fields(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Where what the figure of fields is given will be found."""
    given: dict[str, Any] = {}
    names = ("labels", "points_m", "faces", "part", "strong", "columns", "finding", "caption")

    def figure(*arguments: object) -> Figure:
        given.update(zip(names, arguments, strict=True))
        return Figure()

    monkeypatch.setattr(report, "figure_fields", figure)
    return given


def test_the_figure_of_fields_shows_four_moments_or_those_asked_for(
    bayeskin: Command, measured: Path, tmp_path: Path, runs: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    given = drawn_fields(monkeypatch)
    common = ("simulate", "--recording", measured, "-o", tmp_path / "f.csv", "--figures", tmp_path / "b")
    assert bayeskin(*common)[0] == 0
    first = [label.splitlines() for label in given["labels"]]
    assert [(what, pads) for _, what, pads in first] == [
        ("end of loading 1", "pads at 1.98 mm"), ("middle of hold 1", "pads at 1.98 mm"),
        ("end of unloading 1", "pads at 0.00 mm"), ("middle of rest 2", "pads at 0.00 mm"),
    ]  # fmt: skip
    assert given["columns"][1].values[:, 0] == pytest.approx([-0.9, -0.9, 0.0, 0.0])
    assert given["finding"].startswith("Pressure from -0.9 kPa (15 s, end of loading 1) to ")
    assert bayeskin(*common, "--at", 60, "--at", 10, "--at", 10, "--at", 0)[0] == 0
    assert [label.splitlines()[:2] for label in given["labels"]] == [
        ["0 s", "rest 0"], ["10 s", "loading 1"], ["60 s", "rest 1"],
    ]  # fmt: skip
    assert given["columns"][1].values[:, 0] == pytest.approx([0.0, -0.45, 0.0], abs=1e-6)
    assert given["columns"][0].values[1].max() == pytest.approx(0.045 * 65, rel=0.03)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--figures", "figures", "--at", "131"], ("--at 131", "0 to 130 s")),
        (["--figures", "figures", "--at", "-1"], ("--at -1", "0 to 130 s")),
        (["--figures", "figures", "--at", "nan"], ("--at nan", "0 to 130 s")),
        (["--figures", "figures", "--at", "soon"], ("--at", "soon")),
        (["--at", "3"], ("--at 3", "--figures DIR")),
        (["--figures", "file/figures"], ("--figures file/figures", "file is a file")),
        (["--fields", "file"], ("--fields file", "file is a file")),
        (
            ["--fields", "fields", "--observation", "article", "--mesh", "SKIN.msh"],
            ("--fields, --figures", "'article', whose stresses are not those of the fields"),
        ),
        (
            ["--figures", "figures", "--mechanism", "strain-stiffening"],
            ("--mechanism strain-stiffening", "fields are of the base law"),
        ),
        (
            ["--fields", "fields", "--mechanism", "pad-slip", "--mechanism", "preconditioning"],
            ("--mechanism preconditioning", "fields are of the base law"),
        ),
    ],
)
def test_wrong_options_of_the_outputs_are_refused_before_the_run(
    bayeskin: Command, measured: Path, tmp_path: Path, runs: list[str], monkeypatch: pytest.MonkeyPatch,
    options: list[str], says: tuple[str, ...],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    assert_refused(bayeskin("simulate", "--recording", measured, "-o", "f.csv", *options), *says)
    assert runs == []
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_simulation_that_fails_exits_with_1_and_writes_nothing(
    bayeskin: Command, measured: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(*arguments: object, **options: object) -> Simulation:
        run = toy_model.simulate(*arguments, **options)  # type: ignore[arg-type]
        return replace(run, status="failed", message="no convergence at 3 s; take smaller steps")

    monkeypatch.setattr(single, "simulate", failing)
    monkeypatch.setattr(FieldOutputs, "on_state", lambda *state: None)
    (tmp_path / "force.csv").write_text("earlier")
    outputs = ("-o", tmp_path / "force.csv", "--fields", tmp_path / "a", "--figures", tmp_path / "b")
    code, out, _ = bayeskin("simulate", "--recording", measured, *outputs, "--json")
    assert code == 1
    assert "smaller steps" in json.loads(out)["message"]
    assert json.loads(out)["files"] == []
    assert (tmp_path / "force.csv").read_text() == "earlier"
    assert [path.name for path in tmp_path.iterdir()] == ["force.csv"]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--set", "E_c"], "NAME=VALUE"),
        (["--set", "E_x=3"], "E_x"),
        (["--set", "E_c=stiff"], "'stiff'"),
        (["--set", "E_c=-3"], "positive"),
        (["--set", "E_c=nan"], "finite"),
        (["--mechanism", "pad-slip", "--set", "slip_rate=-1"], "at least 0"),
        (["--mesh", "absent.msh"], "no such file"),
        (["--observation", "article", "--mesh", "bricks"], "gmsh"),
        (["--observation", "power"], "--observation"),
        (["--depth", "3"], "--depth"),
        (["--mechanism", "magnet"], "one of amplifier-lag, backlash, bottom-adherence"),
        (["--mechanism", "device-friction", "--set", "presliding=0"], "finite positive"),
        (["--mechanism", "force-offset", "--set", "F0=inf"], "a finite number"),
        (["--set", "F0=0.1"], "F0"),
    ],
)
def test_wrong_options_are_refused(
    bayeskin: Command, measured: Path, tmp_path: Path, options: list[str], says: str
) -> None:
    out = tmp_path / "force.csv"
    assert_refused(bayeskin("simulate", "--recording", measured, *options, "-o", out), says)
    assert not out.exists()


def test_an_output_of_an_unknown_kind_is_refused(bayeskin: Command, measured: Path, tmp_path: Path) -> None:
    assert_refused(bayeskin("simulate", "--recording", measured, "-o", tmp_path / "f.xls"), ".csv or .h5")
    assert_refused(bayeskin("import", measured, "-o", tmp_path / "r.csv"), "ending .h5")


def test_a_mesh_without_the_named_boundaries_is_refused(
    bayeskin: Command, measured: Path, tmp_path: Path
) -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=float)
    meshio.Mesh(points, [("tetra", [[0, 1, 2, 3]])]).write(tmp_path / "bare.msh", file_format="gmsh")
    answer = bayeskin(
        "simulate", "--recording", measured, "--mesh", tmp_path / "bare.msh", "-o", tmp_path / "f.csv"
    )
    assert_refused(answer, "bare.msh", "right_patch")


@pytest.mark.parametrize("command", ["design", "train", "map", "sample", "sobol", "report", "run"])
def test_every_stage_refuses_a_wrong_configuration(bayeskin: Command, tmp_path: Path, command: str) -> None:
    path = tmp_path / "case.toml"
    path.write_text('[recording]\nfile = "r.csv"\ncolour = 3\n')
    assert_refused(bayeskin(command, path), "case.toml: recording.colour", "unknown key")
    path.write_text('[recording]\nfile = "r.csv"\n[parameters.k_c]\nlower = 1e-11\nupper = 1e-16\n')
    assert_refused(bayeskin(command, path), "case.toml: parameters.k_c", "lower below upper")
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
        toy_model.simulate(spec, motion, dict(zip(SPACE.names, row, strict=True))).bin_means(edges_s)
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
        ("[parameters.E_c]\nupper = 4e6\n", "a part of 10000 to 2e+06"),
        ("[fit]\nbin_width_s = 1.0\n", "130 bins"),
        ("[model]\nrefinement = 2\n", "another model"),
        ("[surrogate]\nfile = 'absent.h5'\n", "one that is shipped: demo.h5"),
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
            assert err.splitlines()[-1] == "bayeskin: interrupted; the same command goes on from here"


@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGTERM])
def test_a_command_that_is_interrupted_says_how_to_go_on(measured: Path, tmp_path: Path, ending: int) -> None:
    code = (
        "import sys, time; from bayeskin import cli; from bayeskin.workflow import single\n"
        "def slow(*_): print('at work', flush=True); time.sleep(60)\n"
        "single.import_recording = slow; cli.main(['import', *sys.argv[1:]])"
    )
    command = [sys.executable, "-c", code, str(measured), "-o", str(tmp_path / "r.h5")]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a background shell ignores it
    )  # fmt: skip
    assert process.stdout is not None
    process.stdout.readline()
    process.send_signal(ending)
    _, said = process.communicate()
    assert process.returncode == 130
    assert said.strip() == "bayeskin: interrupted; the same command goes on from here"


def test_help_teaches_each_command_by_an_example(bayeskin: Command) -> None:
    for name in cli.cli.commands:
        code, out, _ = bayeskin(name, "--help")
        assert code == 0
        assert "--json" in out
        assert f"bayeskin {name} " in out.split("Example:")[1]


def test_a_set_of_what_nobody_knows_is_refused(tmp_path: Path, bayeskin: Command) -> None:
    code, _, said = bayeskin("conceal", tmp_path / "set", "--seed", 1, "--count", 2, "--only", "pad-slop")
    assert code == 2
    assert "--only: found pad-slop; expected nothing, or one of backlash" in said
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
