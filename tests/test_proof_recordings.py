"""Recordings of the proof: they follow the protocol, have the stated noise, and are made again alike."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from toys.quick_proof import COUNT, SEED, SKIN, THETA, one_by_one, quick_run, quickly

from bayeskin import storage
from bayeskin.errors import InputError
from bayeskin.execution.local import local
from bayeskin.finite_element import ModelSpec, simulate
from bayeskin.mechanisms import catalogue, laws
from bayeskin.proof import conceal, seals
from bayeskin.proof.cases import Case
from bayeskin.proof.conceal import Concealed, concealed, full_run
from bayeskin.proof.noise import noise
from bayeskin.proof.outside import OUTSIDE, Change
from bayeskin.proof.plans import Plan, plans
from bayeskin.proof.protocol import EDGES_S, KINDS, MOTION, SURROGATE, kind_at, samples_s
from bayeskin.proof.refit_residual import rms
from bayeskin.proof.screen import shipped_screen
from bayeskin.recordings import bin_recording, idealised_motion, read_recording, segment, uniform_edges
from bayeskin.shipped import shipped
from bayeskin.surrogates import load_manifest, load_surrogate
from bayeskin.types import Recording, Simulation
from bayeskin.workflow.shipping import motion_sha256


def test_a_recording_comes_back_with_the_protocol_of_the_shipped_surrogate(concealed_set: Path) -> None:
    recording = read_recording(seals.recording_path(concealed_set, "001"))
    phases = segment(recording)
    motion = idealised_motion(recording, phases)
    assert motion_sha256(motion) == load_manifest(shipped(SURROGATE))["motion_sha256"]
    assert tuple(phase.kind for phase in phases) == KINDS
    edges_s = uniform_edges(float(min(recording.time_s[-1], motion.time_s[-1])))
    np.testing.assert_array_equal(edges_s, load_surrogate(shipped(SURROGATE)).edges_s)


def test_noise_has_the_floor_that_the_key_states() -> None:
    time_s, floor_n = samples_s(), 2e-3
    means = []
    for seed in range(8):
        force_n = noise(np.random.default_rng(seed), time_s, floor_n)
        recording = Recording(time_s, np.round(MOTION.at(time_s), 5), force_n, "noise", "")
        phases = segment(recording)
        binned = bin_recording(recording, phases, EDGES_S)
        means.append(rms(binned.force_n))
        assert np.sqrt(binned.variance_n2.mean()) == pytest.approx(floor_n, rel=0.3)
    assert np.mean(means) == pytest.approx(floor_n, rel=0.1)


def test_spikes_are_upward_and_in_holds_above_all() -> None:
    time_s = samples_s()
    holds = np.array([kind == "hold" for kind in KINDS])[kind_at(time_s)]
    force_n = np.array([noise(np.random.default_rng(seed), time_s, 2e-3) for seed in range(5)])
    assert np.sum(force_n[:, holds] > 0.015) > 100
    assert np.sum(force_n[:, holds] < -0.015) == 0


def test_nothing_in_a_recording_tells_what_it_conceals(concealed_set: Path) -> None:
    recordings = [
        storage.load(seals.recording_path(concealed_set, f"{i + 1:03d}"), Recording) for i in range(COUNT)
    ]
    assert {recording.name for recording in recordings} == {"recording"}
    assert (
        len({recording.notes for recording in recordings})
        == len({recording.time_s.tobytes() for recording in recordings})
        == 1
    )
    words = {*catalogue(), *OUTSIDE, "theta", "nothing", "outside"}
    for path in (concealed_set / "recordings").iterdir():
        assert not any(word.encode() in path.read_bytes() for word in words)


def test_a_set_is_the_same_when_it_is_made_again_and_what_is_there_is_not_made_again(
    concealed_set: Path, tmp_path: Path
) -> None:
    plan = plans(SEED, COUNT)[2]
    again = concealed(plan, SKIN, quick_run)
    stored = storage.load(seals.recording_path(concealed_set, "003"), Recording)
    np.testing.assert_array_equal(again.recording.force_n, stored.force_n)
    assert json.loads(json.dumps(again.key)) == seals.read_keys(concealed_set)["003"]

    def never(_: Plan) -> Concealed:
        raise AssertionError("a full run of what is there")

    assert conceal(concealed_set, SEED, COUNT, make=never, run_all=one_by_one) == 0
    for seed, only in ((SEED + 1, ()), (SEED, ["nothing"])):
        with pytest.raises(InputError, match="a set with the settings"):
            conceal(concealed_set, seed, COUNT, only, make=never, run_all=one_by_one)


def test_what_was_missing_of_a_set_is_made_in_any_order_by_processes(
    concealed_set: Path, tmp_path: Path
) -> None:
    copy = Path(shutil.copytree(concealed_set, tmp_path / "copy"))
    (copy / "recordings" / "002.h5").unlink()
    (copy / "seals" / "004.json").write_text("{}")
    told: list[tuple[float, str]] = []
    assert conceal(copy, SEED, COUNT, tell=lambda *now: told.append(now), make=quickly, run_all=local(2)) == 2
    assert told == [(0.75, "3 of 4"), (1.0, "4 of 4")]
    assert seals.read_keys(copy) == seals.read_keys(concealed_set)
    for number in ("002", "004"):
        again, first = (seals.recording_path(folder, number).read_bytes() for folder in (copy, concealed_set))
        assert again == first


def test_a_case_that_cannot_be_made_is_told_and_those_before_it_are_kept(tmp_path: Path) -> None:
    def fails_later(plan: Plan) -> Concealed | tuple[str, str, str]:
        return quickly(plan) if plan.numbers[-1] < 2 else ("proof: x", "8 runs failed", "use another seed")

    with pytest.raises(InputError, match="proof: x: 8 runs failed; use another seed"):
        conceal(tmp_path, SEED, COUNT, make=fails_later, run_all=one_by_one)
    assert list(seals.read_index(tmp_path)) == ["001", "002"]


def test_a_run_that_fails_is_drawn_anew() -> None:
    tried: list[Case] = []

    def fails_first(case: Case, names, change: Change) -> Simulation:
        tried.append(case)
        run = quick_run(case, names, change)
        return replace(run, status="failed") if len(tried) == 1 else run

    recording = concealed(Plan("nothing", "nothing", (), "", False, (9, 1, 0)), SKIN, fails_first)
    assert recording.key["attempt"] == 1
    assert recording.key["theta"] == tried[-1].theta != tried[0].theta
    assert recording.key["size"] < 1e-6


def test_the_screen_adds_what_mechanisms_change_and_marks_a_run_that_fails() -> None:
    """Compares the screen, which uses the shipped reduced model, with the full model."""
    screen = shipped_screen()
    theta = np.array([THETA[name] for name in screen.refit.surrogate.space.names])[None]
    alone_n = screen.refit.force(theta)
    shifted_n = screen.force(["force-offset"], theta, {"F0": np.array([-0.03])})
    np.testing.assert_allclose(shifted_n, alone_n - 0.03, atol=1e-5)
    relaxing = {"g_1": 0.5, "tau_1": 5.0, "g_2": 0.0, "tau_2": 60.0}
    more_n = screen.force(["solid-viscoelasticity"], theta, {n: np.array([v]) for n, v in relaxing.items()})
    law = laws([catalogue()["solid-viscoelasticity"]])
    relaxes, plain = (
        simulate(ModelSpec(refinement=0), MOTION, values, laws=some).bin_means(EDGES_S)
        for values, some in (({**THETA, **relaxing}, law), (THETA, []))
    )
    change_n = relaxes - plain
    np.testing.assert_allclose(more_n - alone_n, [change_n], atol=0.02 * np.ptp(change_n))
    failed = Simulation({}, *np.zeros((3, 1)), np.ones(1, dtype=bool), "failed", "the skin folds", {}, "")
    with mock.patch("bayeskin.proof.screen.simulate_reduced", return_value=failed):
        assert np.isnan(screen.force(["force-offset"], theta, {"F0": np.array([-0.03])})).all()


@pytest.mark.slow
def test_a_full_run_is_concealed_with_a_size_of_the_order_that_was_aimed_at() -> None:
    plan = Plan("preconditioning", "alone", ("preconditioning",), "", True, (3, 1, 0))
    key = concealed(plan, shipped_screen(), full_run).key
    assert key["mesh_n"] < 2e-3
    assert key["target"] / 3 < key["size"] < 3 * key["target"]  # a few mN of an effect of 0.2 N
    assert key["sizes"]["preconditioning"] == pytest.approx(key["size_n"])
    assert key["windows"]
