"""Designs whose waves a reduced model makes: which one, where the full model runs, and what is refused."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from multiprocessing.reduction import ForkingPickler
from pathlib import Path

import numpy as np
import pytest
from toys import stand_in_model
from toys.closed_form_model import MOTION, toy_force
from toys.coarse_proposals import propose_coarsely
from toys.small_reduced import hollow

from bayeskin import cli, report, storage
from bayeskin.config import load_config
from bayeskin.execution.local import here
from bayeskin.finite_element.simulate import ModelSpec
from bayeskin.forward import design_model
from bayeskin.forward.design_model import FullModel, ReducedOrFull
from bayeskin.geometry import Geometry
from bayeskin.types import BinnedForce, Design, PadMotion, Recording, Simulation
from bayeskin.workflow import executor, maximum, model, reducing, stages
from bayeskin.workflow.engine import Silent, open_run, standing
from bayeskin.workflow.model import full_model, waves_model
from bayeskin.workflow.new import new_config
from bayeskin.workflow.reducing import find_reduced

TRUE = {"E_c": 200e3, "E_s": 30e3, "k_c": 1e-14, "k_s": 1e-13, "p_init": 300.0}
STIFF = {**TRUE, "E_c": 3e6}
THICK = Geometry(cutis_m=4e-3)
CONFIG = """
[recording]
file = "measured.h5"
[model]
refinement = 3
[fit]
bin_width_s = 1.0
[design]
points = [24, 12, 12]
held_out = 8
coarse = "reduced"
workers = 1
[map]
starts = 1
evaluations = 400
"""


@dataclass(frozen=True)
class ToyReduced(ReducedOrFull):
    """The toy on its coarsest mesh in a reduced model's place."""

    def __call__(self, motion: PadMotion, theta: Mapping[str, float]) -> Simulation:
        spec = replace(self.full.spec, refinement=1)
        return replace(stand_in_model.simulate(spec, motion, theta), model_hash=self.hash)


@pytest.fixture(autouse=True)
def ships(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A hollow model in the shipped one's place."""
    path = hollow(tmp_path_factory.mktemp("shipped") / "article-device-reduced.h5")
    monkeypatch.setattr(reducing, "SHIPPED", str(path))
    return path


def measured(where: Path, largest_m: float = float(MOTION.displacement_m.max())) -> Path:
    """A configuration whose waves a reduced model makes, with its recording."""
    time_s = np.arange(0.0, 130.001, 0.1)
    force_n = stand_in_model.SCALE * toy_force(np.array([list(TRUE.values())]), time_s)[0]
    force_n = stand_in_model.finer(3, TRUE) * force_n
    force_n += 0.02 * np.random.default_rng(5).standard_normal(len(time_s))
    displacement_m = MOTION.at(time_s) * largest_m / MOTION.displacement_m.max()
    storage.save(where / "measured.h5", Recording(time_s, displacement_m, force_n, "toy", "0" * 64))
    (where / "case.toml").write_text(CONFIG)
    return where / "case.toml"


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    with pytest.raises(SystemExit) as end:
        cli.main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    last = captured.err.splitlines()[-1]
    assert (end.value.code, captured.out) == (2, "")
    assert "Traceback" not in captured.err
    return last


def test_a_run_with_a_reduced_design_is_corrected_by_the_full_model(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    case = measured(tmp_path)
    monkeypatch.setattr(report, "save_figure", lambda figure, stem, provenance: None)
    propose_coarsely(monkeypatch)
    monkeypatch.setattr(model, "FullModel", stand_in_model.ToyModel)
    monkeypatch.setattr(executor, "local", lambda workers: here)  # starts no process
    monkeypatch.setattr(model, "ReducedOrFull", ToyReduced)
    monkeypatch.setattr(maximum, "simulate", stand_in_model.simulate)
    stages.run(case, "map", Silent())
    run = open_run(case, Silent())
    waves, fine = (storage.load(run.at("design", f"{name}.h5"), Design) for name in ("design", "fine"))
    assert (waves.model_hash, fine.model_hash) == (waves_model(run).hash, full_model(run).hash)
    assert waves.model_hash != fine.model_hash
    few = run.config.design
    recorded_n = storage.load(run.at("recording", "binned.h5"), BinnedForce).force_n
    left_n = np.sqrt(np.mean((waves.force_n - recorded_n) ** 2, axis=1))
    assert np.median(left_n[waves.wave == 2]) < 0.7 * np.median(left_n[waves.wave == 1])
    assert (fine.training.sum(), fine.testing.sum()) == (few.fine_points, few.fine_held_out)
    check = json.loads(run.at("map", "stage.json").read_text())["summary"]["checks"][-1]
    assert check["rms_n"] < 0.005 * stand_in_model.SCALE * 2000  # the toy's coarsest mesh is off by 3 %
    hollow(tmp_path / "mine-reduced.h5", size=2.0)
    assert standing(run, stages.STAGES)["design"][0] == "out of date"
    assert waves_model(run).hash != waves.model_hash


def test_the_full_model_runs_where_the_reduced_one_was_not_trained(
    ships: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    waves = ReducedOrFull(ships, stand_in_model.ToyModel(ModelSpec()))
    in_worker = ForkingPickler.loads(ForkingPickler.dumps(waves))
    run = in_worker(MOTION, STIFF)
    right = stand_in_model.simulate(ModelSpec(), MOTION, STIFF)
    np.testing.assert_array_equal(run.force_n, right.force_n)
    assert (run.status, run.model_hash) == ("ok", waves.hash)
    assert run.message == "run by the full model: E_c is 3e+06, outside the trained range 10000 to 2e+06"
    inside = replace(right, stats={"inside": 1.0}, force_n=2.0 * right.force_n)
    monkeypatch.setattr(design_model, "simulate_reduced", lambda *arguments, **more: inside)
    reduced_run = waves(MOTION, TRUE)
    np.testing.assert_array_equal(reduced_run.force_n, inside.force_n)
    assert (reduced_run.model_hash, reduced_run.message) == (waves.hash, "")


def test_the_hash_is_of_the_reduced_model_and_of_the_full_one(ships: Path, tmp_path: Path) -> None:
    other = hollow(tmp_path / "other-reduced.h5", size=2.0)
    thick = ModelSpec(geometry=replace(Geometry(), cutis_m=2.1e-3))
    models = [
        ReducedOrFull(ships, FullModel(ModelSpec())),
        ReducedOrFull(other, FullModel(ModelSpec())),
        ReducedOrFull(ships, FullModel(thick)),
    ]
    assert len({model.hash for model in models} | {FullModel(ModelSpec()).hash}) == 4


def test_the_reduced_model_of_the_very_geometry_goes_first(ships: Path, tmp_path: Path) -> None:
    config = tmp_path / "case.toml"
    assert find_reduced(THICK, [config]) is None
    near = hollow(tmp_path / "a-reduced.h5", Geometry(cutis_m=3.5e-3))
    storage.save(tmp_path / "recording-reduced.h5", MOTION)  # is none
    assert find_reduced(THICK, [config]) == near
    assert find_reduced(Geometry(), [config]) == ships
    assert find_reduced(Geometry(cutis_m=2.5e-3), [config]) == near
    very = hollow(tmp_path / "b-reduced.h5", THICK)
    assert find_reduced(THICK, [config]) == very


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"refinement = 3": 'mesh = "skin.msh"'}, "bricks with refinement 1 or more"),
        ({"refinement = 3": 'mesh = "a.msh"\nobservation = "article"'}, "bricks with refinement 1 or more"),
        ({"refinement = 3": "refinement = 0"}, "bricks with refinement 1 or more"),
        ({"refinement = 3": 'forward = "own.py:force"'}, "it concerns the full model"),
        ({'"reduced"': '"redced"'}, "design.coarse"),
        (
            {"[map]": "[tissue]\ncutis_mm = 4.0\n[map]"},
            "make it from the device's file with `bayeskin reduce`",
        ),
    ],
    ids=["gmsh", "article", "coarsest", "own", "misspelt", "device"],
)
def test_what_has_no_reduced_model_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], changes: dict[str, str], says: str
) -> None:
    case = measured(tmp_path)
    text = CONFIG
    for old, new in changes.items():
        text = text.replace(old, new)
    case.write_text(text)
    assert says in refused(capsys, "design", case)


def test_a_protocol_beyond_the_training_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    case = measured(tmp_path, 12e-3)
    line = refused(capsys, "design", case)
    assert "design.coarse: article-device-reduced.h5 was not trained for this protocol" in line
    assert "the pads open by 12.00 mm, more than the trained 10 mm" in line


def test_new_takes_the_reduced_model_where_it_knows_device_and_protocol(tmp_path: Path) -> None:
    (tmp_path / "device.toml").write_text("[tissue]\ncutis_mm = 4.0\n")
    measured(tmp_path)
    recording = tmp_path / "measured.h5"

    def coarse(name: str, *device: Path) -> object:
        said = new_config([recording], tmp_path / name, *device)
        text = (tmp_path / name).read_text()
        config = load_config(tmp_path / name).design
        assert ("a design of the reduced model" in said["text"]) == (config.coarse == "reduced")
        assert ("`bayeskin reduce`" in text) == (config.coarse is None)
        return config.coarse

    assert coarse("near.toml") == "reduced"
    assert coarse("thick.toml", tmp_path / "device.toml") is None
    hollow(tmp_path / "device-reduced.h5", THICK)
    assert coarse("known.toml", tmp_path / "device.toml") == "reduced"
    recording = measured(tmp_path, 12e-3).with_name("measured.h5")
    assert coarse("far.toml") is None
