"""Devices on the command line: what is wrong is one line and exit code 2, with nothing written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from toys.gmsh_file import coarse_tetrahedra, gmsh_text

from bayeskin import cli, storage
from bayeskin.config import load_config, parameter_space
from bayeskin.finite_element import ModelSpec, simulate
from bayeskin.geometry import Geometry
from bayeskin.recordings import idealised_motion, read_recording, segment
from bayeskin.shipped import shipped
from bayeskin.types import PadMotion, Recording, Simulation

FLAT = '[tissue]\narm_radius_mm = "flat"\n'
Command = Callable[..., tuple[int, str]]


@pytest.fixture
def bayeskin(capsys: pytest.CaptureFixture[str]) -> Command:
    """Runs the command; gives the exit code and the last line of stderr."""

    def call(*arguments: object) -> tuple[int, str]:
        with pytest.raises(SystemExit) as stop:
            cli.main([str(argument) for argument in arguments])
        return int(stop.value.code or 0), (capsys.readouterr().err.splitlines() or [""])[-1]

    return call


@pytest.fixture
def short(tmp_path: Path) -> Path:
    """A recording of one small pull."""
    time_s = np.arange(0.0, 40.0, 0.1)
    u_m = np.interp(time_s, [0.0, 5.0, 8.0, 30.0, 33.0, 40.0], [0.0, 0.0, 2e-3, 2e-3, 0.0, 0.0])
    path = tmp_path / "short.h5"
    noise_n = 0.001 * np.random.default_rng(1).standard_normal(len(time_s))
    storage.save(path, Recording(time_s, u_m, 30 * u_m + noise_n, "short", "0" * 64))
    return path


def test_simulate_takes_a_device_and_the_means_of_an_uncertain_tissue(
    bayeskin: Command, short: Path, tmp_path: Path
) -> None:
    (tmp_path / "device.toml").write_text(
        "[device]\ngauge_mm = 24\nguard_mm = false\n[tissue]\ncutis_mm = { mean = 1.5, sd = 0.2 }\n"
    )
    (tmp_path / "case.toml").write_text('[recording]\nfile = "short.h5"\n[model]\nrefinement = 0\n')
    out = tmp_path / "force.h5"
    given = ("--recording", short, "--device", tmp_path / "device.toml", "-o", out)
    assert bayeskin("simulate", tmp_path / "case.toml", *given)[0] == 0
    simulation, recording = storage.load(out, Simulation), read_recording(short)
    motion: PadMotion = idealised_motion(recording, segment(recording))
    spec = ModelSpec(refinement=0, geometry=Geometry(gauge_m=24e-3, guard=None, cutis_m=1.5e-3))
    np.testing.assert_allclose(
        simulation.force_n, simulate(spec, motion, simulation.theta).force_n, rtol=1e-9
    )


@pytest.mark.parametrize(
    ("device", "says"),
    [
        ("[device]\ngauge_mm = 0\n", "device.gauge_mm: it is 0 mm, so the pads overlap"),
        (
            "[device]\nguard_mm = { gap = 0, width = 8 }\n",
            "device.guard_mm.gap: it is 0 mm, so the guard lies",
        ),
        ("[tissue]\ncutis_mm = -2\n", "tissue.cutis_mm: it is -2 mm"),
        ("[device]\ngauge_mm = 0.036\n", "device.gauge_mm: it is 0.036 mm, probably 1000 times too small"),
        ("[tissue]\narm_radius_mm = 20\n", "tissue.arm_radius_mm: it is 20 mm"),
        ("[device]\nguard_mm = false\nforce_on = 'pad and guard'\n", "device.force_on"),
        ("[device]\nguage_mm = 36\n", "device.guage_mm: this key is not known"),
        ("[device]\npad_mm = 8\n", "device.pad_mm: 8 is not allowed; it must be a list"),
        ("guard", "device.toml"),
    ],
)
@pytest.mark.parametrize("command", ["simulate", "new", "run"])
def test_a_wrong_device_is_one_line_and_nothing_is_written(
    bayeskin: Command, short: Path, tmp_path: Path, command: str, device: str, says: str
) -> None:
    path = tmp_path / "device.toml"
    path.write_text(device)
    if command == "run":
        path.write_text(f'[recording]\nfile = "short.h5"\n{device}' if "[" in device else device)
        code, line = bayeskin("run", path)
    elif command == "new":
        code, line = bayeskin("new", short, "--device", path, "-o", tmp_path / "out.toml")
    else:
        code, line = bayeskin("simulate", "--recording", short, "--device", path, "-o", tmp_path / "f.csv")
    assert (code, line[:10]) == (2, "bayeskin: ")
    assert says in line
    assert {file.name for file in tmp_path.iterdir()} == {"short.h5", "device.toml"}


@pytest.mark.parametrize(
    ("unit", "device", "says"),
    [
        (1e3, FLAT, "probably millimetres"),
        (
            1.0,
            f"[device]\ngauge_mm = 40\n{FLAT}",
            "right_patch: the mesh extends over x 18 to 26 mm; the device and the tissue require x 20",
        ),
        (1.0, f"[device]\nguard_mm = false\n{FLAT}", "u_right: the mesh has a guard"),
        (1.0, f"{FLAT}cutis_mm = 3\n", "top_layer: the mesh extends over z 8 to 10 mm"),
    ],
)
def test_a_mesh_of_another_device_is_refused(
    bayeskin: Command, short: Path, tmp_path: Path, unit: float, device: str, says: str
) -> None:
    (tmp_path / "skin.msh").write_text(gmsh_text(coarse_tetrahedra(Geometry(arm_radius_m=None)), unit))
    (tmp_path / "device.toml").write_text(device)
    given = ("--device", tmp_path / "device.toml", "--mesh", tmp_path / "skin.msh")
    code, line = bayeskin("simulate", "--recording", short, *given, "-o", tmp_path / "f.csv")
    assert code == 2
    assert says in line
    assert not (tmp_path / "f.csv").exists()


def test_new_writes_the_device_into_the_configuration(bayeskin: Command, tmp_path: Path) -> None:
    (tmp_path / "demo.h5").write_bytes(shipped("data/demo.h5").read_bytes())
    (tmp_path / "device.toml").write_text(
        "[device]\npad_mm = [10, 12.5]\nguard_mm = { gap = 2, width = 6 }\n"
        "[tissue]\ncutis_mm = { mean = 1.5, sd = 0.25 }\narm_radius_mm = 60\n"
    )
    given = (tmp_path / "demo.h5", "--device", tmp_path / "device.toml", "-o", tmp_path / "case.toml")
    assert bayeskin("new", *given)[0] == 0
    config = load_config(tmp_path / "case.toml")
    assert config.device.pad_mm == (10.0, 12.5)
    assert config.geometry().sd_m == {"cutis_m": 0.25e-3}
    assert config.surrogate.file is None  # the shipped one is of another device
    assert parameter_space(config).names[-1] == "cutis_m"
    code, line = bayeskin("diagnose", tmp_path / "case.toml")
    assert code == 2
    assert (
        "there is none for this device and tissue; make it from the device's file with `bayeskin reduce`"
        in line
    )
    assert not (tmp_path / "case").exists()


def test_the_article_s_device_in_a_file_takes_the_shipped_surrogate(
    bayeskin: Command, tmp_path: Path
) -> None:
    (tmp_path / "demo.h5").write_bytes(shipped("data/demo.h5").read_bytes())
    (tmp_path / "device.toml").write_text("[device]\ngauge_mm = 36\n")
    given = (tmp_path / "demo.h5", "--device", tmp_path / "device.toml", "-o", tmp_path / "case.toml")
    assert bayeskin("new", *given)[0] == 0
    assert load_config(tmp_path / "case.toml").surrogate.file == "demo.h5"


def test_a_shipped_surrogate_stays_with_its_device(bayeskin: Command, tmp_path: Path) -> None:
    (tmp_path / "demo-recording.h5").write_bytes(shipped("data/demo.h5").read_bytes())
    (tmp_path / "case.toml").write_text(
        '[recording]\nfile = "demo-recording.h5"\n[surrogate]\nfile = "demo.h5"\n'
        '[device]\nforce_on = "pad and guard"\n'
    )
    code, line = bayeskin("design", tmp_path / "case.toml")
    assert code == 2
    assert "surrogate.file demo.h5: it belongs to another device or tissue" in line


def test_the_demo_comes_with_its_own_device(bayeskin: Command, tmp_path: Path) -> None:
    (tmp_path / "device.toml").write_text("")
    code, line = bayeskin("new", "--device", tmp_path / "device.toml", "-o", tmp_path / "demo.toml")
    assert code == 2
    assert "because the demo uses the article's device" in line
    assert not (tmp_path / "demo.toml").exists()


UNCERTAIN = "[tissue]\ncutis_mm = { mean = 2.0, sd = 0.2 }\n"


@pytest.mark.parametrize(
    ("device", "says"),
    [
        ("[tissue]\ncutis_mm = 4.0\n", "make it from the device's file with `bayeskin reduce`"),
        ("[device]\ngauge_mm = 0\n", "device.gauge_mm: it is 0 mm, so the pads overlap"),
        (None, "device.toml: there is no such file"),
    ],
    ids=["no reduced model", "impossible", "absent"],
)
def test_a_device_that_cannot_be_diagnosed_is_refused_in_one_line(
    bayeskin: Command, short: Path, tmp_path: Path, device: str | None, says: str
) -> None:
    path = tmp_path / "device.toml"
    if device is not None:
        path.write_text(device)
    code, line = bayeskin("diagnose", short, "--device", path)
    assert (code, line[:10]) == (2, "bayeskin: ")
    assert says in line
    assert not (tmp_path / "short-diagnosis" / "diagnose" / "diagnosis.json").exists()


def test_a_device_beside_a_configuration_which_states_its_own_is_refused(
    bayeskin: Command, short: Path, tmp_path: Path
) -> None:
    (tmp_path / "device.toml").write_text("[device]\ngauge_mm = 36\n")
    (tmp_path / "case.toml").write_text(f'[recording]\nfile = "{short.name}"\n')
    code, line = bayeskin("diagnose", tmp_path / "case.toml", "--device", tmp_path / "device.toml")
    assert (code, line[:20]) == (2, "bayeskin: --device: ")
    assert "device.toml cannot be given with a configuration; use the configuration's sections" in line
    assert {file.name for file in tmp_path.iterdir()} == {"short.h5", "device.toml", "case.toml"}


def test_a_recording_beyond_what_the_reduced_model_was_trained_for_is_refused(
    bayeskin: Command, short: Path
) -> None:
    recording = storage.load(short, Recording)
    storage.save(short, replace(recording, displacement_m=6.0 * recording.displacement_m))
    code, line = bayeskin("diagnose", short)
    assert code == 2
    assert "short.h5: article-device-reduced.h5 was not trained for this protocol" in line
    assert "the pads open by 12.00 mm, more than the trained 10 mm" in line
