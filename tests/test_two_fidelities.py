"""A coarse model's surrogate corrected by a few runs of the fine one."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from toys import stand_in_model
from toys.closed_form_model import EDGES_S, MOTION, SPACE, toy_bin_means, toy_force

from bayeskin import report, storage
from bayeskin.design import fine_wave, first_wave, spread_out
from bayeskin.errors import InputError
from bayeskin.execution.local import here
from bayeskin.surrogates import Similarity, correct, load_surrogate, save_surrogate, train
from bayeskin.types import Design, Recording
from bayeskin.workflow import executor, maximum, model, stages
from bayeskin.workflow.engine import Silent


def designed(refinement: int, theta: np.ndarray, held_out: np.ndarray) -> Design:
    n = len(theta)
    named = [dict(zip(SPACE.names, row, strict=True)) for row in theta]
    force_n = toy_bin_means(theta) * np.array(
        [[stand_in_model.finer(refinement, values)] for values in named]
    )
    return Design(
        SPACE, EDGES_S, theta, force_n, np.zeros(n, dtype=np.int64), held_out,
        np.ones(n, dtype=bool), ("",) * n, np.zeros(n), 1, f"refinement {refinement}",
    )  # fmt: skip


@pytest.fixture(scope="module")
def coarse() -> Design:
    wave = first_wave(SPACE, 96, 16, seed=3)
    return designed(1, wave.theta, wave.held_out)


@pytest.fixture(scope="module")
def fine(coarse: Design) -> Design:
    wave = fine_wave(coarse, Similarity(SPACE).inputs(coarse.theta), 14, 8, seed=1)
    return designed(3, wave.theta, wave.held_out)


def test_the_correction_removes_the_coarse_models_bias_on_runs_held_out_of_both(coarse, fine):
    surrogate = train(coarse, "gp")[0]
    corrected, validation = correct(surrogate, fine)
    theta, truth = fine.theta[fine.testing], fine.force_n[fine.testing]

    def bias(prediction):
        return np.mean(np.log(prediction.predict(theta).mean[:, 30:60] / truth[:, 30:60]))

    assert bias(surrogate) == pytest.approx(0.03, abs=0.008)  # what the fine mesh changes
    assert abs(bias(corrected)) < 0.002
    assert validation.source == "held-out"
    assert validation.rows == 8
    assert corrected.provenance["model_hash"] == fine.model_hash
    relative = [
        np.mean(np.square(s.predict(theta).sd() / s.predict(theta).mean)[:, 30:60])
        for s in (corrected, surrogate)
    ]
    assert relative[0] >= relative[1]  # the correction's own uncertainty is added


def test_a_shape_that_the_coarse_model_does_not_know_is_no_noise_of_single_bins(coarse):
    fine = designed(3, coarse.theta, coarse.held_out)
    bent = np.sin(7.0 * np.pi * np.linspace(0.0, 1.0, fine.force_n.shape[1]))
    share = 0.05 * np.exp(-np.sum(SPACE.to_unit(fine.theta), axis=1))[:, None]
    size = np.sqrt(np.mean(fine.force_n**2, axis=1))[:, None]
    more = dataclasses.replace(fine, force_n=fine.force_n + share * size * bent)
    prediction = correct(train(coarse, "gp")[0], more)[0].predict(fine.theta[fine.testing])
    told = np.sqrt(prediction.diagonal.mean(axis=1) / np.mean(prediction.mean**2, axis=1))
    added = np.sqrt(np.mean(share**2) * np.mean(bent**2))
    assert np.all(told < 0.1 * added)


def test_without_held_out_runs_each_fine_run_is_left_out_in_turn(coarse, fine):
    surrogate = train(coarse, "gp")[0]
    every = dataclasses.replace(fine, held_out=np.zeros(len(fine.theta), dtype=bool))
    _, validation = correct(surrogate, every)
    assert validation.source == "leave-one-out"
    assert validation.rows == len(fine.theta)
    with pytest.raises(InputError, match="6 finished training rows"):
        correct(surrogate, dataclasses.replace(every, ok=np.arange(len(every.theta)) < 6))


def test_correcting_again_replaces_the_correction(coarse, fine):
    surrogate = train(coarse, "gp")[0]
    once = correct(surrogate, fine)[0]
    twice = correct(once, fine)[0]
    theta = fine.theta[fine.testing]
    np.testing.assert_allclose(once.predict(theta).mean, twice.predict(theta).mean)


@pytest.mark.parametrize("kind", ["gp", "chaos"])
def test_a_corrected_surrogate_is_read_back_as_it_was(tmp_path, coarse, fine, kind):
    corrected = correct(train(coarse, kind)[0], fine)[0]
    save_surrogate(tmp_path / "s.h5", corrected, {})
    theta = fine.theta[:3]
    stored, loaded = (s.predict(theta) for s in (load_surrogate(tmp_path / "s.h5"), corrected))
    np.testing.assert_array_equal(stored.mean, loaded.mean)
    np.testing.assert_array_equal(stored.sd(), loaded.sd())


def test_fine_points_are_the_coarse_designs_own_and_keep_their_labels(coarse):
    later = np.arange(len(coarse.theta)) % 3 == 0
    waves = dataclasses.replace(coarse, wave=later.astype(np.int64))
    wave = fine_wave(waves, Similarity(SPACE).inputs(coarse.theta), 10, 4, seed=1)
    row_of = {row.tobytes(): i for i, row in enumerate(coarse.theta)}
    rows = np.array([row_of[row.tobytes()] for row in wave.theta])
    assert len(set(rows)) == 14
    np.testing.assert_array_equal(coarse.held_out[rows], wave.held_out)
    assert later[rows[:10]].sum() >= 5


def test_points_spread_out_from_the_middle_to_the_ends():
    line = np.linspace(0.0, 1.0, 11)[:, None]
    assert spread_out(line, 3) == [5, 0, 10]
    assert spread_out(line, 4, [0, 10])[:3] == [0, 10, 5]
    assert len(spread_out(line, 20)) == 11


CONFIG = """
[recording]
file = "measured.h5"
[model]
refinement = 3
[fit]
bin_width_s = 1.0
[design]
points = [40, 24]
held_out = 8
coarse = 1
fine_points = 12
fine_held_out = 6
workers = 1
[map]
starts = 2
evaluations = 1000
"""
TRUE = {"E_c": 200e3, "E_s": 30e3, "k_c": 1e-14, "k_s": 1e-13, "p_init": 300.0}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    where = tmp_path_factory.mktemp("fine")
    time_s = np.arange(0.0, 130.001, 0.1)
    force_n = stand_in_model.SCALE * toy_force(np.array([list(TRUE.values())]), time_s)[0]
    force_n = stand_in_model.finer(3, TRUE) * force_n
    force_n += 0.02 * np.random.default_rng(5).standard_normal(len(time_s))
    storage.save(where / "measured.h5", Recording(time_s, MOTION.at(time_s), force_n, "toy", "0" * 64))
    (where / "case.toml").write_text(CONFIG)

    def drawn(figure: object, stem: Path, provenance: str) -> None:
        stem.with_suffix(".png").write_text(provenance)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report, "save_figure", drawn)
        patch.setattr(model, "FullModel", stand_in_model.ToyModel)
        patch.setattr(executor, "local", lambda workers: here)  # starts no process
        patch.setattr(maximum, "simulate", stand_in_model.simulate)
        stages.run(where / "case.toml", "map", Silent())
    return where / "case"


def test_a_run_with_a_coarse_design_is_checked_against_the_fine_model(folder: Path) -> None:
    coarse, fine = (storage.load(folder / "design" / f"{name}.h5", Design) for name in ("design", "fine"))
    assert coarse.model_hash != fine.model_hash
    assert (fine.training.sum(), fine.testing.sum()) == (12, 6)
    manifest = json.loads((folder / "train" / "surrogate.json").read_text())
    assert manifest["model_hash"] == fine.model_hash
    assert manifest["fine_rows"] == 12
    summary = json.loads((folder / "map" / "stage.json").read_text())["summary"]
    assert summary["ok"]
    check = summary["checks"][-1]
    assert check["rms_n"] < 0.005 * stand_in_model.SCALE * 2000  # the coarse model is off by 3 %
    assert storage.load(folder / "map" / "fine.h5", Design).model_hash == fine.model_hash


def test_coarse_bricks_must_be_coarser(tmp_path: Path) -> None:
    (tmp_path / "case.toml").write_text(CONFIG.replace("coarse = 1", "coarse = 3"))
    with pytest.raises(InputError, match=r"case.toml: design.coarse: it is 3 .* bricks with a higher"):
        stages.run(tmp_path / "case.toml", "map", Silent())
