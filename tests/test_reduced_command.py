"""`bayeskin reduce` and `bayeskin simulate --reduced` as a user meets them."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bayeskin.errors import InputError
from bayeskin.geometry import Geometry
from bayeskin.reduced.build import BuildSettings
from bayeskin.reduced.files import load_reduced
from bayeskin.reduced.library import Library
from bayeskin.reduced.model import ReducedModel
from bayeskin.reduced.runs import FullRuns
from bayeskin.shipped import shipped
from bayeskin.workflow import reducing
from bayeskin.workflow.engine import Silent
from bayeskin.workflow.reducing import SHIPPED, default_path, reduced_file

DEVICE = "[device]\ngauge_mm = 30\n"
NEAR = "[tissue]\ncutis_mm = 2.3\nsubcutis_mm = 6\narm_radius_mm = 44\n"


def test_a_reduced_run_is_near_the_full_one_and_says_how_near(bayeskin, tmp_path) -> None:
    """The run has the demo's protocol, which no training run had."""
    set_ = ("--set", "E_c=80e3", "--set", "E_s=15e3")
    reduced, full = tmp_path / "reduced.csv", tmp_path / "full.csv"
    code, out, _ = bayeskin("simulate", "--reduced", *set_, "-o", reduced, "--json")
    said = json.loads(out)
    assert code == 0
    assert said["inside"] is True
    assert said["seconds"] > 0.0
    assert bayeskin("simulate", *set_, "-o", full)[0] == 0
    (t, _, f), (t0, _, f0) = (np.loadtxt(p, delimiter=",", skiprows=1).T for p in (reduced, full))
    wrong = np.interp(t0, t, f) - f0
    assert np.sqrt(np.mean(wrong**2)) < 2e-3 * f0.max()
    assert np.sqrt(np.mean(wrong**2)) < 2.0 * said["error_estimate_n"]


def test_other_layers_within_the_trained_range_run(bayeskin, tmp_path) -> None:
    device = tmp_path / "device.toml"
    device.write_text(NEAR)
    code, out, _ = bayeskin("simulate", "--reduced", "--device", device, "-o", tmp_path / "f.csv", "--json")
    assert code == 0
    assert json.loads(out)["inside"] is True


def test_outside_of_the_trained_region_it_says_so_and_writes_nothing(bayeskin, tmp_path) -> None:
    out = tmp_path / "force.csv"
    code, text, _ = bayeskin("simulate", "--reduced", "--set", "E_c=9e6", "-o", out, "--json")
    said = json.loads(text)
    assert code == 1
    assert said["inside"] is False
    assert "E_c is 9e+06" in said["message"]
    assert not out.exists()


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--device", "device.toml"), "none for this device"),
        (("--mesh", "none.msh"), "none.msh"),
        (("--observation", "article"), "bricks"),
    ],
)
def test_what_no_reduced_model_fits_is_one_line(bayeskin, tmp_path, monkeypatch, options, says) -> None:
    monkeypatch.chdir(tmp_path)
    Path("device.toml").write_text(DEVICE)
    code, out, error = bayeskin("simulate", "--reduced", *options, "-o", "force.csv")
    assert (code, out) == (2, "")
    assert says in error.splitlines()[-1]
    assert not Path("force.csv").exists()


def test_one_beside_the_source_goes_before_the_shipped_one(tmp_path) -> None:
    source = tmp_path / "device.toml"
    source.write_text(NEAR)
    shutil.copy(shipped(SHIPPED), default_path(source))
    assert reduced_file(Geometry(), [source]) == default_path(source)
    assert reduced_file(Geometry(), []) == shipped(SHIPPED)
    with pytest.raises(InputError, match="none for this device"):
        reduced_file(Geometry(gauge_m=30e-3), [source])
    default_path(source).write_bytes(b"cut off")
    with pytest.raises(InputError, match=r"device-reduced\.h5"):
        reduced_file(Geometry(), [source])


@pytest.mark.parametrize(
    ("contents", "options", "says"),
    [
        ("[device]\ngauge_mm = 0.036\n", (), "0.036 mm"),
        ("[device]\nguard_mm = { gap = -1, width = 8 }\n", (), "inside the pad"),
        ("[device]\nlength = 3\n", (), "this key is not known"),
        (NEAR, ("-o", "model.csv"), "use .h5"),
        (None, (), "no such file"),
    ],
)
def test_bad_input_of_reduce_is_one_line(bayeskin, tmp_path, monkeypatch, contents, options, says) -> None:
    monkeypatch.chdir(tmp_path)
    if contents is not None:
        Path("device.toml").write_text(contents)
    code, out, error = bayeskin("reduce", "device.toml", *options)
    assert (code, out) == (2, "")
    assert says in error.splitlines()[-1]
    assert [p.name for p in tmp_path.iterdir()] == ([] if contents is None else ["device.toml"])


def test_a_finished_model_stays_as_it_is(bayeskin, tmp_path) -> None:
    path = tmp_path / "model.h5"
    shutil.copy(shipped(SHIPPED), path)
    before = path.read_bytes()
    code, out, _ = bayeskin("reduce", "-o", path)
    assert code == 0
    assert "done before" in out
    assert path.read_bytes() == before
    device = tmp_path / "device.toml"
    device.write_text(DEVICE)
    code, _, error = bayeskin("reduce", device, "-o", path)
    assert code == 2
    assert "another geometry" in error
    assert path.read_bytes() == before


def test_an_interrupted_building_goes_on_and_a_second_one_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, model, built = tmp_path / "model.h5", load_reduced(shipped(SHIPPED)), list[tuple[str, int]]()
    without = replace(
        model, trained=replace(model.trained, mechanisms={}), library=Library(model.library.base, {})
    )

    def base(trained: object, full: FullRuns, settings: BuildSettings, *_: object) -> ReducedModel:
        if "a run" not in full.store:
            full.store.add("a run", {"message": ""})
            with pytest.raises(InputError, match="another bayeskin"):
                reducing.reduce(None, path, Silent())
            raise KeyboardInterrupt
        built.append(("base", settings.base_runs))
        return without

    def whole(base: object, trained: object, full: FullRuns, settings: BuildSettings, *_: object) -> object:
        if settings.runs == BuildSettings().runs and "another run" not in full.store:
            full.store.add("another run", {"message": ""})
            raise KeyboardInterrupt
        built.append(("mechanisms", settings.runs))
        return model

    monkeypatch.setattr(reducing, "base_model", base)
    monkeypatch.setattr(reducing, "with_mechanisms", whole)
    with pytest.raises(KeyboardInterrupt):
        reducing.reduce(None, path, Silent())
    assert not path.exists()
    with pytest.raises(KeyboardInterrupt):  # the mechanisms can be used, but better ones follow
        reducing.reduce(None, path, Silent())
    assert load_reduced(path).trained.mechanisms
    assert reducing.reduce(None, path, Silent())["ok"]
    sizes = BuildSettings()
    assert built == [
        ("base", sizes.first_base_runs), ("base", sizes.base_runs), ("mechanisms", sizes.first_runs),
        ("mechanisms", sizes.runs),
    ]  # fmt: skip
    assert {file.name for file in tmp_path.iterdir()} == {"model.h5", "model.json"}
