"""The command `simulate`: what it writes, and wrong options that are refused before a run."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread
from toys import stand_in_model
from toys.closed_form_model import SPACE
from toys.command_line import Command, assert_refused

from bayeskin import report, storage
from bayeskin.finite_element.simulate import ModelSpec, OnState, problem_of
from bayeskin.types import PadMotion, Simulation
from bayeskin.workflow import simulating
from bayeskin.workflow.field_outputs import FieldOutputs


def test_simulate_writes_the_columns_that_scripts_rely_on(
    bayeskin: Command, measured: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(simulating, "simulate", stand_in_model.simulate)
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
    monkeypatch.setattr(simulating, "simulate", stand_in_model.simulate)
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


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """A stand-in for the full model that stretches all uniformly; lists the names of the runs it made."""
    drawn: list[str] = []

    def stretch(
        spec: ModelSpec,
        motion: PadMotion,
        theta: dict[str, float],
        on_progress: object,
        on_state: OnState | None,
        laws: object,
    ) -> Simulation:
        drawn.append(spec.mesh)
        space = problem_of(spec.mesh, spec.refinement).space
        for time_s in motion.time_s if on_state else ():
            x = np.zeros(space.dofs)
            x[0 : 3 * space.n_nodes : 3] = 10.0 * motion.at(time_s) * space.points_u[0]
            x[3 * space.n_nodes :] = -1e5 * motion.at(time_s)
            on_state(float(time_s), x, 0.0)
        return stand_in_model.simulate(spec, motion, theta)

    monkeypatch.setattr(simulating, "simulate", stretch)
    return drawn


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
    """Returns a mapping that takes the arguments of the figure of fields by name."""
    given: dict[str, Any] = {}
    names = ("labels", "points_m", "faces", "part", "strong", "columns", "finding", "caption")

    def figure(*arguments: object) -> Figure:
        given.update(zip(names, arguments, strict=True))
        return Figure()

    monkeypatch.setattr(report, "figure_fields", figure)
    return given


@pytest.mark.slow
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
    assert given["finding"].startswith("Pressure from −0.9 kPa (15 s, end of loading 1) to ")
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
        (["--figures", "file/figures"], ("--figures file/figures", "file is a file; it must be a folder")),
        (["--fields", "file"], ("--fields file", "file is a file; it must be a folder")),
        (
            ["--fields", "fields", "--observation", "article", "--mesh", "SKIN.msh"],
            ("--fields, --figures", "the stresses of observation 'article'"),
        ),
        (
            ["--figures", "figures", "--mechanism", "strain-stiffening"],
            ("the mechanism strain-stiffening", "fields are of the base law"),
        ),
        (
            ["--fields", "fields", "--mechanism", "pad-slip", "--mechanism", "preconditioning"],
            ("the mechanism preconditioning", "fields are of the base law"),
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
        run = stand_in_model.simulate(*arguments, **options)  # type: ignore[arg-type]
        return replace(run, status="failed", message="no convergence at 3 s; take smaller steps")

    monkeypatch.setattr(simulating, "simulate", failing)
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
    assert_refused(bayeskin("import", measured, "-o", tmp_path / "r.csv"), "use .h5")


def test_a_mesh_without_the_named_boundaries_is_refused(
    bayeskin: Command, measured: Path, tmp_path: Path
) -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=float)
    meshio.Mesh(points, [("tetra", [[0, 1, 2, 3]])]).write(tmp_path / "bare.msh", file_format="gmsh")
    answer = bayeskin(
        "simulate", "--recording", measured, "--mesh", tmp_path / "bare.msh", "-o", tmp_path / "f.csv"
    )
    assert_refused(answer, "bare.msh", "right_patch")
