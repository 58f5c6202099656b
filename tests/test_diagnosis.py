"""`bayeskin diagnose` on a protocol that no shipped surrogate knows, by the shipped reduced model."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from bayeskin import storage
from bayeskin.finite_element import ModelSpec, simulate
from bayeskin.mechanisms import catalogue, laws
from bayeskin.types import PadMotion, Recording
from bayeskin.workflow.diagnosing import diagnose
from bayeskin.workflow.engine import Silent

THETA = {"E_c": 300e3, "E_s": 20e3, "k_c": 3e-14, "k_s": 2e-13, "p_init": 300.0}
CONCEALED = {"g_1": 0.3, "tau_1": 3.0, "g_2": 0.0, "tau_2": 60.0}
MOTION = PadMotion(
    np.array([0.0, 4.0, 8.0, 30.0, 34.0, 60.0]), 1e-3 * np.array([0.0, 0.0, 3.0, 3.0, 6.0, 6.0])
)
NOISE_N = 3e-3


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Made by the full model, whose solid relaxes."""
    law = laws([catalogue()["solid-viscoelasticity"]])
    run = simulate(ModelSpec(refinement=1), MOTION, {**THETA, **CONCEALED}, laws=law)
    assert run.status == "ok", run.message
    time_s = np.arange(0.0, 60.0, 0.05)
    noise_n = NOISE_N * np.random.default_rng(4).standard_normal(len(time_s))
    recorded = Recording(time_s, MOTION.at(time_s), run.at(time_s) + noise_n, "relaxing", "0" * 64)
    storage.save(tmp_path / "relaxing.h5", recorded)
    return tmp_path / "relaxing.h5"


@pytest.mark.slow
def test_a_solid_that_relaxes_is_named_on_any_protocol_and_a_second_call_makes_nothing_anew(
    recording: Path,
) -> None:
    said = diagnose([recording], Silent())
    assert said["ok"]
    assert said["verdict"] == "named"
    (mechanism,) = said["mechanisms"]
    assert mechanism["name"] == "solid-viscoelasticity"
    assert mechanism["probability"] > 0.9
    assert said["best_set"] == ["solid-viscoelasticity"]
    for name, parameter in mechanism["parameters"].items():
        low, high = parameter["interval90"]
        assert low < high
        if name in ("g_1", "tau_1"):
            assert abs(parameter["mean"] - CONCEALED[name]) < 4.0 * parameter["sd"]
            assert parameter["sd"] < 0.5 * CONCEALED[name]
    fitted = said["fit"]["after"]["theta"]
    for name in ("E_c", "E_s"):
        assert 0.5 < fitted[name]["mean"] / THETA[name] < 2.0
    assert said["located"]
    assert said["remaining"] == []
    assert said["fit"]["before"]["rmse"] > 2.0 * said["fit"]["after"]["rmse"]
    assert said["fit"]["after"]["rmse"] < NOISE_N
    checked = said["full_model"]
    assert checked["fit_off_by"] < 0.3 * NOISE_N
    assert checked["rmse"] < NOISE_N
    assert "solid-viscoelasticity (probability" in said["text"]

    folder = recording.with_name("relaxing-diagnosis")
    figures = {f"{name}.{kind}" for kind in ("png", "svg")
               for name in ("located", "before_after", "candidates", "contributions")}  # fmt: skip
    assert figures <= set(said["figures"])
    assert all((folder / "diagnose" / name).stat().st_size > 5000 for name in figures)
    written = json.loads((folder / "diagnose" / "diagnosis.json").read_text())
    assert written["verdict"] == "named"

    (answers,) = (folder / "finished").glob("answers-*.store")
    before = answers.read_bytes()
    shutil.rmtree(folder / "diagnose")
    again = diagnose([recording], Silent())
    assert answers.read_bytes() == before
    assert [answers] == list((folder / "finished").iterdir())
    same = ("verdict", "mechanisms", "sets", "fit", "located", "full_model")
    assert {name: again[name] for name in same} == {name: said[name] for name in same}
