"""The proof: what is concealed stays so, is what its key says, and is scored by what was said of it."""

from __future__ import annotations

import ast
import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from scipy.signal import lfilter

import bayeskin
from bayeskin import report, storage
from bayeskin.design import default_space
from bayeskin.errors import InputError
from bayeskin.execution.local import local, run_parallel
from bayeskin.finite_element import ModelSpec, simulate
from bayeskin.finite_element.lagrangian import LagrangianModel
from bayeskin.finite_element.mesh import brick_mesh
from bayeskin.finite_element.problem import build_problem, material
from bayeskin.mechanisms import catalogue, laws, observed
from bayeskin.mechanisms.binned import BinnedForces
from bayeskin.mechanisms.mechanism import Instrument
from bayeskin.proof import closed, conceal, score, seals
from bayeskin.proof.cases import CONCEALED, Case, Plan, Screen, draw, plans, shipped_screen
from bayeskin.proof.conceal import Concealed, concealed, full_run
from bayeskin.proof.curves import curve
from bayeskin.proof.noise import floor_after, noise
from bayeskin.proof.outside import OUTSIDE, Change
from bayeskin.proof.protocol import EDGES_S, HELD_OUT_FROM_S, KINDS, MOTION, SURROGATE, kind_at, samples_s
from bayeskin.proof.refit_residual import Refit, rms, windows
from bayeskin.proof.score import (
    CLEAR,
    group_of,
    is_listed,
    judge,
    overlap,
    share,
    share_of_parts,
    stands_for,
)  # fmt: skip
from bayeskin.recordings import bin_recording, read_recording, segment, uniform_edges
from bayeskin.report import half_in_words
from bayeskin.shipped import shipped
from bayeskin.surrogates import load_manifest, load_surrogate
from bayeskin.types import PadMotion, Prediction, Recording, Simulation
from bayeskin.workflow import proof as pipeline
from bayeskin.workflow.diagnosing_sources import imported
from bayeskin.workflow.engine import Silent
from bayeskin.workflow.folder import locked
from bayeskin.workflow.recording import pad_motion
from bayeskin.workflow.shipping import motion_sha256

SEED, COUNT = 5, 4
PACKAGE = Path(bayeskin.__file__).parent
THETA = {"E_c": 60e3, "E_s": 20e3, "k_c": 1e-14, "k_s": 5e-13, "p_init": 0.0}


class QuickSkin:
    """A surrogate of two moduli and two relaxations, each with its share of the force."""

    space, edges_s, provenance = default_space(), EDGES_S, {}

    def predict(self, theta) -> Prediction:
        e_c, e_s, k_c, k_s = np.atleast_2d(theta).T[:4, :, None]
        middle = 0.5 * (EDGES_S[1:] + EDGES_S[:-1])
        u = MOTION.at(middle) / 1e-2
        late = lfilter([0.1], [1.0, -0.9], u)
        relaxing = 0.02 * (np.log(k_c / 1e-14) + 2.0 * np.log(k_s / 1e-14)) * late
        mean = (4e-6 * e_c + 1e-5 * e_s) * u * (1.0 + 0.05 * u * e_s / (e_c + e_s)) + 0.05 * relaxing
        return Prediction(mean, np.zeros((*mean.shape, 1)), np.zeros_like(mean))

    def predict_mean(self, theta):
        return self.predict(theta).mean


class QuickScreen(Screen):
    """What the instrument makes of `QuickSkin`; mechanisms of the tissue do nothing."""

    def force(self, names, theta, values):
        mean_n = self.refit.force(theta)
        seen = [self.known[name] for name in names if isinstance(self.known[name].act, Instrument)]
        forces = BinnedForces(EDGES_S, MOTION, seen)
        return mean_n + forces.change(partial(observed, seen, values, MOTION), mean_n)


SKIN = QuickScreen(Refit(QuickSkin()), None, catalogue())


def quick_run(case: Case, names, change: Change) -> Simulation:
    """`QuickSkin` in the place of the full model."""
    theta = np.array([[case.theta[name] for name in SKIN.refit.surrogate.space.names]])
    values = {name: np.array([value]) for name, value in case.values.items()}
    force_n = SKIN.force(names, theta, values)[0]
    time_s = np.concatenate([[0.0], 0.5 * (EDGES_S[1:] + EDGES_S[:-1]), MOTION.time_s[-1:]])
    force_n = np.concatenate([[0.0], force_n, force_n[-1:]])
    corner = np.ones(len(time_s), dtype=bool)  # straight between
    return Simulation(case.theta, time_s, MOTION.at(time_s), force_n, corner, "ok", "", {}, "")


def quickly(plan: Plan) -> Concealed:
    return concealed(plan, SKIN, quick_run)


def one_by_one(function, items):
    yield from ((index, function(item)) for index, item in enumerate(items))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("set")
    assert conceal(folder, SEED, COUNT, make=quickly, run_all=one_by_one) == COUNT
    return folder


def nothing_found(path: Path, reporter) -> dict:
    return {"verdict": "nothing-missing", "located": [], "mechanisms": [], "fit": {"after": {}}}


# Cases


def test_a_seed_decides_which_cases_there_are_and_another_gives_others() -> None:
    assert plans(7, 64) == plans(7, 64)
    assert [p.label for p in plans(7, 64)] != [p.label for p in plans(8, 64)]


@pytest.mark.parametrize("name", ["proof", "sizes", "nothing", "development"])
def test_the_seed_of_a_committed_set_draws_what_it_conceals(name: str) -> None:
    """Whatever the catalogue has since."""
    folder = Path(__file__).parents[1] / "data" / name / seals.SEALS
    asked = seals.read_json(folder / seals.SET)
    drawn = plans(asked["seed"], asked["count"], asked.get("only", ()))
    for number, plan in enumerate(drawn, 1):
        kept = seals.read_json(folder / f"{number:03d}.json")
        assert (kept["label"], kept["outside"]) == (plan.label, plan.outside)
        assert (tuple(kept["mechanisms"]), tuple(kept["numbers"])) == (plan.mechanisms, plan.numbers)
        assert (kept["kind"], kept["tetrahedra"]) == (plan.kind, plan.tetrahedra)


def test_a_set_of_64_has_every_mechanism_alone_and_at_least_15_effects_outside() -> None:
    found = plans(3, 64)
    of = {kind: [p for p in found if p.kind == kind] for kind in ("nothing", "alone", "pair", "outside")}
    assert {kind: len(some) for kind, some in of.items()} == {
        "nothing": 20,
        "alone": 22,
        "pair": 7,
        "outside": 15,
    }
    assert {p.label for p in of["alone"]} == set(CONCEALED)
    assert set(CONCEALED) <= set(catalogue())
    assert len({p.outside for p in of["outside"]}) == 15
    assert len(OUTSIDE) >= 15
    assert not set(OUTSIDE) & set(CONCEALED)
    assert sum(p.tetrahedra for p in found) >= 64 / 3


def test_a_set_of_what_was_asked_for_has_each_as_often_with_sizes_even_in_logarithm() -> None:
    found = plans(3, 18, ["nothing", "friction-creep", "breathing"])
    of = {name: [p for p in found if p.label == name] for name in ("nothing", "friction-creep", "breathing")}
    assert [len(some) for some in of.values()] == [6, 6, 6]
    assert {p.kind for p in of["nothing"]} == {"nothing"}
    assert {p.mechanisms for p in of["friction-creep"]} == {("device-friction", "friction-creep")}
    assert {p.outside for p in of["breathing"]} == {"breathing"}
    targets = sorted(p.target for p in of["friction-creep"])
    np.testing.assert_allclose(np.diff(np.log(targets)), np.log(30.0) / 6)
    assert (targets[0] * targets[-1]) == pytest.approx(30.0)
    assert len({p.numbers for p in found}) == 18
    assert sum(p.tetrahedra for p in found) == 7
    assert draw(of["friction-creep"][0], 0, SKIN).target == of["friction-creep"][0].target
    with pytest.raises(InputError, match=r"--only: found pad-slop; expected nothing, or one of backlash"):
        plans(3, 18, ["pad-slop"])


def test_the_order_of_a_set_tells_nothing_of_its_kinds() -> None:
    kinds = [p.kind for p in plans(3, 64)]
    assert max(kinds[:20].count("nothing"), kinds[-20:].count("nothing")) < 15


def test_a_pair_is_no_pair_of_look_alikes() -> None:
    for plan in plans(11, 256):
        if plan.kind == "pair":
            first, second = plan.mechanisms
            assert second not in group_of(first)


def test_a_draw_is_its_plan_s_alone_and_an_attempt_later_another() -> None:
    plan = Plan("force-offset", "alone", ("force-offset",), "", False, (1, 1, 0))
    screen = SKIN
    case = draw(plan, 0, screen)
    assert case == draw(plan, 0, screen)
    assert case.theta != draw(plan, 1, screen).theta
    space = screen.refit.surrogate.space
    assert space.contains([case.theta[name] for name in space.names])
    assert -0.15 <= case.values["F0"] <= 0.05


# What remains of an effect


def test_nothing_remains_of_what_the_base_parameters_can_do() -> None:
    screen = SKIN
    theta = np.array([THETA[name] for name in screen.refit.surrogate.space.names])
    other = theta * [1.3, 0.8, 1.5, 0.7, 1.0]
    left = screen.refit.residual(screen.refit.force(other[None])[0], theta)
    assert rms(left) < 1e-6
    effect = screen.refit.force((theta * [1.002, 1.0, 1.0, 1.0, 1.0])[None]) - screen.refit.force(theta[None])
    assert rms(screen.refit.linear(effect, theta[None]))[0] < 1e-2 * rms(effect)[0]


def test_windows_are_where_the_remaining_effect_exceeds_the_floor() -> None:
    left = np.array([0.0, 3.0, -3.0, 0.5, 3.0])
    assert windows(left, 1.0, np.arange(6.0)) == [(1.0, 3.0), (4.0, 5.0)]
    assert windows(0.5 * np.ones(3), 1.0, np.arange(4.0)) == []


# Recordings


def test_a_recording_comes_back_with_the_protocol_of_the_shipped_surrogate(made: Path) -> None:
    recording = read_recording(seals.recording_path(made, "001"))
    phases = segment(recording)
    motion = pad_motion("reaction", recording, phases, "idealised")
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


def test_nothing_in_a_recording_tells_what_it_conceals(made: Path) -> None:
    found = [storage.load(seals.recording_path(made, f"{i + 1:03d}"), Recording) for i in range(COUNT)]
    assert {one.name for one in found} == {"recording"}
    assert len({one.notes for one in found}) == len({one.time_s.tobytes() for one in found}) == 1
    words = {*catalogue(), *OUTSIDE, "theta", "nothing", "outside"}
    for path in (made / "recordings").iterdir():
        assert not any(word.encode() in path.read_bytes() for word in words)


def test_a_set_is_the_same_when_it_is_made_again_and_what_is_there_is_not_made_again(
    made: Path, tmp_path: Path
) -> None:
    plan = plans(SEED, COUNT)[2]
    again = concealed(plan, SKIN, quick_run)
    stored = storage.load(seals.recording_path(made, "003"), Recording)
    np.testing.assert_array_equal(again.recording.force_n, stored.force_n)
    assert json.loads(json.dumps(again.key)) == seals.read_keys(made)["003"]

    def never(_: Plan) -> Concealed:
        raise AssertionError("a full run of what is there")

    assert conceal(made, SEED, COUNT, make=never, run_all=one_by_one) == 0
    for seed, only in ((SEED + 1, ()), (SEED, ["nothing"])):
        with pytest.raises(InputError, match="another making"):
            conceal(made, seed, COUNT, only, make=never, run_all=one_by_one)


def test_what_was_missing_of_a_set_is_made_in_any_order_by_processes(made: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(made, tmp_path / "copy"))
    (copy / "recordings" / "002.h5").unlink()
    (copy / "seals" / "004.json").write_text("{}")
    told: list[tuple[float, str]] = []
    assert conceal(copy, SEED, COUNT, tell=lambda *now: told.append(now), make=quickly, run_all=local(2)) == 2
    assert told == [(0.75, "3 of 4"), (1.0, "4 of 4")]
    assert seals.read_keys(copy) == seals.read_keys(made)
    for number in ("002", "004"):
        again, first = (seals.recording_path(one, number).read_bytes() for one in (copy, made))
        assert again == first


def test_a_case_that_cannot_be_made_is_told_and_those_before_it_are_kept(tmp_path: Path) -> None:
    def fails_later(plan: Plan) -> Concealed | tuple[str, str, str]:
        return quickly(plan) if plan.numbers[-1] < 2 else ("proof: x", "8 runs that failed", "one that ends")

    with pytest.raises(InputError, match="proof: x: found 8 runs that failed; expected one that ends"):
        conceal(tmp_path, SEED, COUNT, make=fails_later, run_all=one_by_one)
    assert list(seals.read_index(tmp_path)) == ["001", "002"]


def test_a_run_that_fails_is_drawn_anew() -> None:
    tried: list[Case] = []

    def fails_first(case: Case, names, change: Change) -> Simulation:
        tried.append(case)
        found = quick_run(case, names, change)
        return replace(found, status="failed") if len(tried) == 1 else found

    one = concealed(Plan("nothing", "nothing", (), "", False, (9, 1, 0)), SKIN, fails_first)
    assert one.key["attempt"] == 1
    assert one.key["theta"] == tried[-1].theta != tried[0].theta
    assert one.key["size"] < 1e-6


def test_the_screen_adds_what_mechanisms_change_and_marks_a_run_that_fails() -> None:
    """By the shipped reduced model, beside the full one."""
    screen = shipped_screen()
    theta = np.array([THETA[name] for name in screen.refit.surrogate.space.names])[None]
    alone_n = screen.refit.force(theta)
    shifted_n = screen.force(["force-offset"], theta, {"F0": np.array([-0.03])})
    np.testing.assert_allclose(shifted_n, alone_n - 0.03, atol=1e-5)
    relaxing = {"g_1": 0.5, "tau_1": 5.0, "g_2": 0.0, "tau_2": 60.0}
    more_n = screen.force(["solid-viscoelasticity"], theta, {n: np.array([v]) for n, v in relaxing.items()})
    law = laws([catalogue()["solid-viscoelasticity"]])
    relaxes, plain = (
        simulate(ModelSpec(refinement=1), MOTION, values, laws=some).bin_means(EDGES_S)
        for values, some in (({**THETA, **relaxing}, law), (THETA, []))
    )
    change_n = relaxes - plain
    np.testing.assert_allclose(more_n - alone_n, [change_n], atol=0.02 * np.ptp(change_n))
    failed = Simulation({}, *np.zeros((3, 1)), np.ones(1, dtype=bool), "failed", "the skin folds", {}, "")
    with mock.patch("bayeskin.proof.cases.simulate_reduced", return_value=failed):
        assert np.isnan(screen.force(["force-offset"], theta, {"F0": np.array([-0.03])})).all()


@pytest.mark.slow
def test_a_full_run_is_concealed_with_a_size_of_the_order_that_was_aimed_at() -> None:
    plan = Plan("preconditioning", "alone", ("preconditioning",), "", True, (3, 1, 0))
    key = concealed(plan, shipped_screen(), full_run).key
    assert key["mesh_n"] < 2e-3
    assert key["target"] / 3 < key["size"] < 3 * key["target"]  # a few mN of an effect of 0.2 N
    assert key["sizes"]["preconditioning"] == pytest.approx(key["size_n"])
    assert key["windows"]


# Effects outside the catalogue


@pytest.fixture(scope="module")
def problem():
    return build_problem(brick_mesh(1))


@pytest.mark.parametrize("name", ["hardening", "strain-softening"])
def test_the_tangent_of_a_law_outside_is_the_derivative_of_its_residual(problem, name: str) -> None:
    change = OUTSIDE[name].change(0.3)
    bound = tuple(bind(THETA, problem.sites) for bind in change.laws)
    still = PadMotion(np.array([0.0, 1.0]), np.zeros(2))
    model = LagrangianModel(problem, material(THETA, problem.mesh.cutis), still, bound)
    rng, n = np.random.default_rng(0), 3 * problem.space.n_nodes
    x, direction = (
        np.concatenate([s * rng.standard_normal(n), 1e3 * rng.standard_normal(problem.space.n_corners)])
        for s in (2e-5, 2e-5)
    )
    old, free = model.initial_state(0.0), problem.pattern.free
    free_free, free_fixed = model.tangent(x, 0.7, old, 100.0)
    slope = free_free @ direction[free] + free_fixed @ direction[problem.pattern.fixed]
    step = 1e-4
    ends = [model.residual(x + sign * step * direction, 0.7, old, 100.0).residual for sign in (1, -1)]
    difference = (ends[0] - ends[1])[free] / (2 * step)
    np.testing.assert_allclose(slope, difference, rtol=0, atol=1e-5 * np.abs(difference).max())


def test_every_effect_outside_changes_something() -> None:
    none = Change()
    for name, outside in OUTSIDE.items():
        low, high = outside.strengths
        changes = [outside.change(strength) for strength in (low, high)]
        assert 0.0 < low < high, name
        for change in changes:
            parts = [
                getattr(change, part) != getattr(none, part)
                for part in ("constants", "geometry", "deep", "laws")
            ]
            time_s = np.linspace(0.0, 347.0, 701)
            force = change.reported(lambda t: np.atleast_2d(100.0 * MOTION.at(t)))(time_s)
            parts.append(not np.allclose(force, 100.0 * MOTION.at(time_s)))
            parts.append(not np.allclose(change.moved(MOTION).at(time_s), MOTION.at(time_s)))
            assert sum(parts) == 1, name


# Seals


def test_a_key_or_a_recording_that_was_changed_shows(made: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(made, tmp_path / "copy"))
    path = copy / "seals" / "002.json"
    path.write_text(path.read_text().replace('"floor_n"', '"floor_N"'))
    with pytest.raises(InputError, match=r"002\.json: found other contents"):
        seals.read_keys(copy)


def test_while_it_is_diagnosed_no_key_can_be_opened(made: Path, tmp_path: Path) -> None:
    def peeks(path: Path, reporter) -> dict:
        assert path.parent != made / "recordings"
        with pytest.raises(PermissionError):
            (made / "seals" / "001.json").read_text()
        with pytest.raises(PermissionError):
            os.listdir(made / "seals")
        return nothing_found(path, reporter)

    copy = Path(shutil.copytree(made, tmp_path / "copy"))
    with closed(made):
        document = pipeline.prove(copy, Silent(), diagnose=peeks)
    assert document["scoreboard"]["judged"] == COUNT
    assert (made / "seals" / "001.json").read_text()


def opens(path: str) -> bool:
    try:
        return bool(Path(path).read_text())
    except PermissionError:
        return False


def test_nor_by_a_worker_that_is_started_meanwhile(made: Path, tmp_path: Path) -> None:
    made = Path(shutil.copytree(made, tmp_path / "set:1, odd"))
    key_path = str(made / "seals" / "001.json")
    with closed(made):
        assert dict(run_parallel(opens, [key_path, str(made / "index.json")], 1)) == {0: False, 1: True}
    assert dict(run_parallel(opens, [key_path], 1)) == {0: True}


def test_a_diagnosis_that_fails_ends_no_set(made: Path, tmp_path: Path) -> None:
    def fails(path: Path, reporter) -> dict:
        failing = len(seen)
        seen.append(path)
        if failing == 0:
            raise InputError("priors", "none but impossible skins", "others")
        if failing == 2:
            raise np.linalg.LinAlgError("singular")
        return (
            {"ok": False, "message": "design: all runs failed"}
            if failing == 1
            else nothing_found(path, reporter)
        )

    seen: list[Path] = []
    copy = Path(shutil.copytree(made, tmp_path / "copy"))
    board = pipeline.prove(copy, Silent(), diagnose=fails)["scoreboard"]
    assert (len(seen), board["judged"]) == (COUNT, COUNT)
    assert [one["answer"] for one in board["each"]][:3] == ["failed", "failed", "failed"]
    again = pipeline.prove(copy, Silent(), diagnose=fails)[
        "scoreboard"
    ]  # those three once more, and no other
    assert len(seen) == COUNT + 3
    assert "failed" not in [one["answer"] for one in again["each"]]


def test_a_set_is_worked_on_by_one_process(made: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(made, tmp_path / "set"))
    with locked(copy):
        with pytest.raises(InputError, match=r"in use by another bayeskin \(process \d+\)"):
            pipeline.prove(copy, Silent(), diagnose=nothing_found)
        with pytest.raises(InputError, match="in use by another bayeskin"):
            pipeline.conceal(copy, SEED, COUNT, Silent())
    assert pipeline.prove(copy, Silent(), diagnose=nothing_found)["scoreboard"]["judged"] == COUNT
    with locked(copy):  # nothing is left to be diagnosed, and a score takes no turns
        assert pipeline.prove(copy, Silent(), diagnose=nothing_found)["scoreboard"]["judged"] == COUNT


def test_a_set_that_is_no_set_is_told(tmp_path: Path) -> None:
    for text in ("[]", '{"recordings": []}', '{"recordings": {"001": {}}}'):
        (tmp_path / "index.json").write_text(text)
        with pytest.raises(InputError, match="index"):
            pipeline.prove(tmp_path, Silent(), diagnose=nothing_found)


def test_a_set_without_its_seals_is_not_made_again(made: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(made, tmp_path / "copy"))
    shutil.rmtree(copy / "seals")
    before = (copy / "index.json").read_text()
    with pytest.raises(InputError, match="without its seals"):
        pipeline.conceal(copy, SEED, COUNT, Silent())
    assert (copy / "index.json").read_text() == before


def test_another_verdict_is_a_failure_of_the_same_sources_only(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def other(path: Path, reporter) -> dict:
        return {**nothing_found(path, reporter), "verdict": "unknown"}

    copy = Path(shutil.copytree(made, tmp_path / "copy"))
    pipeline.prove(copy, Silent(), diagnose=nothing_found)
    again = pipeline.prove(copy, Silent(), rediagnose=1, diagnose=other)
    assert (again["ok"], list(again["rediagnosed_the_same"].values())) == (False, [False])
    assert "ANOTHER VERDICT" in again["text"]
    assert pipeline.prove(copy, Silent(), rediagnose=2, diagnose=nothing_found)["ok"]
    monkeypatch.setattr(pipeline, "diagnosing_sources", lambda: "others")
    compared = pipeline.prove(copy, Silent(), rediagnose=1, diagnose=other)
    assert (compared["ok"], list(compared["rediagnosed_of_these_sources"].values())) == (True, [False])
    assert "another verdict than that stored, which other sources gave" in compared["text"]


def test_a_scoring_by_another_scorer_is_recorded(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = Path(shutil.copytree(made, tmp_path / "copy"))

    def recorded() -> int:
        pipeline.prove(copy, Silent(), diagnose=nothing_found)
        return len(json.loads((copy / "scorings.json").read_text()))

    once = recorded()
    assert recorded() == once
    hashed = pipeline.sha256_of_input
    monkeypatch.setattr(
        pipeline, "sha256_of_input", lambda path: "other" if path.name == "score.py" else hashed(path)
    )
    assert recorded() == once + 1


def test_a_verdict_is_of_all_modules_that_a_diagnosis_loads_and_of_no_others() -> None:
    package = Path(bayeskin.__file__).parent
    script = (
        "import sys\nfrom bayeskin.workflow import diagnosis\n"
        "print(*(m.__file__ for n, m in sys.modules.items() if n.split('.')[0] == 'bayeskin'), sep='\\n')"
    )
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    loaded = {Path(line).relative_to(package).as_posix() for line in ended.stdout.split()}
    counted = {file.relative_to(package).as_posix() for file in imported(package / "pipeline/diagnosis.py")}
    assert {file for file in loaded if not file.startswith(("report/", "proof/"))} <= counted
    assert {"mismatch/search.py", "model/lagrangian.py", "surrogates/files.py"} <= counted
    assert not counted & {"cli.py", "pipeline/proof.py", "pipeline/serve.py", "scripting.py", "shapley.py"}


def test_a_diagnosis_in_a_process_that_refuses_the_seals_goes_through(made: Path) -> None:
    """The diagnosing code is loaded, and a recording read and binned, where no path under seals/ opens."""
    script = (
        "import sys\n"
        "def refuse(event, arguments):\n"
        "    if event == 'open' and '/seals/' in str(arguments[0]):\n"
        "        raise PermissionError(arguments[0])\n"
        "sys.addaudithook(refuse)\n"
        "from pathlib import Path\n"
        "from bayeskin.workflow import diagnosis\n"
        "from bayeskin.recordings import read_recording, segment\n"
        f"assert len(segment(read_recording(Path({str(seals.recording_path(made, '001'))!r})))) == 14\n"
        "assert not [name for name in sys.modules if name.startswith('bayeskin.proof')]\n"
        f"open({str(made / 'seals' / '001.json')!r})\n"
    )
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert ended.returncode == 1
    assert ended.stderr.strip().splitlines()[-1].startswith("PermissionError")


def test_what_diagnoses_mentions_neither_proof_nor_seals() -> None:
    for path in [*(PACKAGE / "mismatch").rglob("*.py"), *(PACKAGE / "workflow").glob("diagnosis*.py")]:
        tree = ast.parse(path.read_text())
        words = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
        words |= {
            node.value
            for node in ast.walk(tree)
            if isinstance(node, ast.Constant) and isinstance(node.value, str)
        }
        assert not [word for word in words if word in ("proof", "seals") or "data/proof" in word], path


# Verdicts


def test_prove_goes_on_where_it_was_interrupted_and_records_one_scoring(made: Path, tmp_path: Path) -> None:
    copy, seen = Path(shutil.copytree(made, tmp_path / "copy")), []

    def stops_at_third(path: Path, reporter) -> dict:
        seen.append(path)
        if len(seen) == 3:
            raise KeyboardInterrupt
        return nothing_found(path, reporter)

    with pytest.raises(KeyboardInterrupt):
        pipeline.prove(copy, Silent(), diagnose=stops_at_third)
    assert sorted(p.name for p in (copy / "verdicts").iterdir()) == ["001.json", "002.json"]
    document = pipeline.prove(copy, Silent(), diagnose=stops_at_third)
    assert len(seen) == COUNT + 1
    assert document["ok"]
    assert document["verdicts_of_these_sources"] == COUNT
    pipeline.prove(copy, Silent(), diagnose=stops_at_third)
    assert len(json.loads((copy / "scorings.json").read_text())) == 1
    assert len(seen) == COUNT + 1


# Scores


def key(label: str, kind: str = "alone", size: float = 5.0, **more) -> dict:
    mechanisms = [] if kind in ("nothing", "outside") else label.split(" + ")
    base = {
        "label": label, "kind": kind, "mechanisms": mechanisms, "size": size, "floor_n": 2e-3,
        "windows": [(10.0, 20.0)], "theta": THETA, "values": {},
        "sizes": dict.fromkeys(mechanisms, 2e-3 * size),
    }  # fmt: skip
    return base | more


def said(*names: str, **more) -> dict:
    mechanisms = [{"name": name, "probability": 0.9, "group": [name], "parameters": {}} for name in names]
    verdict = "named" if names else "nothing-missing"
    return {"verdict": verdict, "mechanisms": mechanisms, "located": [], "fit": {"after": {}}} | more


@pytest.mark.parametrize(
    ("truth", "names", "right", "group"),
    [
        ("pad-slip", ["pad-slip"], True, True),
        ("pad-slip", ["slow-recovery"], False, True),
        ("pad-slip", ["backlash"], False, False),
        ("pad-slip", ["pad-slip", "backlash"], False, False),
        ("pad-slip", ["pad-slip", "slow-recovery"], False, False),
        ("pad-slip", [], False, False),
        ("pre-stretch", ["force-offset", "strain-stiffening"], False, True),
        ("pre-stretch", ["force-offset"], False, False),
        ("strain-stiffening", ["pre-stretch"], False, False),
        ("force-offset", ["device-friction"], False, True),
        ("force-offset", ["strain-stiffening"], False, False),
        ("pad-slip + sensor-drift", ["sensor-drift", "pad-slip"], True, True),
        ("pad-slip + sensor-drift", ["sensor-drift", "preconditioning"], False, True),
        ("pad-slip + sensor-drift", ["sensor-drift"], False, False),
    ],
)
def test_a_name_is_right_alone_or_as_a_look_alike(truth, names, right, group) -> None:
    kind = "pair" if "+" in truth else "alone"
    found = judge("001", key(truth, kind), said(*names))
    assert (found.right, found.right_group) == (right, group)


def test_a_group_larger_than_what_is_known_to_look_alike_is_wrong() -> None:
    answer = said("pad-slip")
    answer["mechanisms"][0]["group"] = ["pad-slip", "slow-recovery", "backlash"]
    found = judge("001", key("pad-slip"), answer)
    assert (found.right, found.right_group) == (False, False)
    answer = said("device-friction")
    answer["mechanisms"][0]["group"] = ["viscous-drag", "force-offset"]  # each in one of its groups
    found = judge("001", key("device-friction"), answer)
    assert (found.right, found.right_group) == (False, False)


def test_the_probability_of_a_pair_is_that_of_its_less_probable_part() -> None:
    both = key("pad-slip + sensor-drift", "pair")
    assert judge("001", both, said("pad-slip")).probability == 0.0
    assert judge("001", both, said("pad-slip", "sensor-drift")).probability == 0.9


def test_of_a_pair_each_mechanism_that_adds_enough_counts_and_each_name() -> None:
    both = key("pad-slip + sensor-drift", "pair", sizes={"pad-slip": 8e-3, "sensor-drift": 5e-3})
    found = judge("001", both, said("pad-slip", "backlash"))
    assert found.found == {"pad-slip": True}  # of the other 2.5 floors remain
    assert found.there == {"pad-slip": True, "backlash": False}
    other = judge("002", key("nothing", "nothing", 0.0), said("backlash"))
    assert (other.found, other.there) == ({}, {"backlash": False})
    keys = {"001": both, "002": key("nothing", "nothing", 0.0), "003": key("sensor-drift")}
    answers = {"001": said("pad-slip", "backlash"), "002": said("backlash"), "003": said()}
    board = score(keys, answers)
    counts = [board[name] for name in ("clear_mechanisms_named", "named_mechanisms_there")]
    assert [(one["hits"], one["of"]) for one in counts] == [(1, 2), (1, 3)]


def test_an_interval_of_parameters_counts_recordings() -> None:
    one, many = share([True, False]), share_of_parts([{"a": True, "b": True}, {"a": False, "b": False}, {}])
    assert (many["hits"], many["of"]) == (2, 4)
    assert (many["share"], many["low"], many["high"]) == (one["share"], one["low"], one["high"])


def test_what_is_held_out_has_a_floor_of_its_own() -> None:
    time_s = samples_s()
    made_n = noise(np.random.default_rng(1), time_s, 2e-3)
    quiet = np.abs(made_n - np.median(made_n)) < 10e-3  # no spikes
    bins = np.digitize(time_s, EDGES_S) - 1
    means = np.array([made_n[quiet & (bins == i)].mean() for i in range(len(EDGES_S) - 1)])
    late = EDGES_S[:-1] > HELD_OUT_FROM_S
    ratio = np.sqrt(np.mean(means[late] ** 2) / np.mean(means**2))
    assert floor_after(1.0, HELD_OUT_FROM_S) == pytest.approx(ratio, rel=0.05)


def test_the_catalogue_s_own_groups_are_allowed_and_mutual() -> None:
    for name, mechanism in catalogue().items():
        assert is_listed(name, mechanism.group), name
    assert stands_for({"viscous-drag"}, {"device-friction"})
    assert stands_for({"device-friction"}, {"viscous-drag"})


def test_steps_of_the_cell_have_no_order() -> None:
    truth = {"event_1_at": 0.2, "event_1_step": 0.01, "event_2_at": 0.7, "event_2_step": -0.02}
    answer = said("sensor-events")
    swapped = {"event_1_at": 0.7, "event_1_step": -0.02, "event_2_at": 0.2, "event_2_step": 0.01}
    answer["mechanisms"][0]["parameters"] = {
        name: {"mean": value, "sd": 1e-3, "unit": "-"} for name, value in swapped.items()
    }
    assert all(judge("001", key("sensor-events", values=truth), answer).inside.values())


def test_overlap_is_intersection_over_union_of_bins() -> None:
    assert overlap([(0.0, 10.0)], [(5.0, 15.0)]) == pytest.approx(1 / 3)
    assert overlap([(0.0, 10.0)], []) == 0.0
    assert overlap([], []) is None


def test_wilson_s_interval_is_that_of_the_books() -> None:
    found = share([True] * 9 + [False])
    assert (found["hits"], found["of"], found["share"]) == (9, 10, 0.9)
    assert found["low"] == pytest.approx(0.6526, abs=2e-3)
    assert found["high"] == pytest.approx(0.9774, abs=2e-3)
    assert share([])["share"] is None


def test_a_scoreboard_of_made_up_verdicts_counts_as_it_should() -> None:
    keys, answers = made_up()
    board = score(keys, answers)
    assert board["judged"] == len(keys)
    assert (board["false_alarms"]["hits"], board["false_alarms"]["of"]) == (1, 3)
    assert (board["named"]["clear"]["hits"], board["named"]["clear"]["of"]) == (2, 4)
    assert board["named_up_to_look_alikes"]["clear"]["hits"] == 3
    assert (board["named"]["below"]["hits"], board["named"]["below"]["of"]) == (0, 1)
    assert (board["unknown_outside"]["clear"]["hits"], board["unknown_outside"]["clear"]["of"]) == (1, 2)
    assert (board["effect_in_interval"]["clear"]["hits"], board["effect_in_interval"]["clear"]["of"]) == (
        1,
        2,
    )
    assert (board["base_in_interval"]["clear"]["hits"], board["base_in_interval"]["clear"]["of"]) == (1, 2)
    floor_n = floor_after(2e-3, HELD_OUT_FROM_S)
    assert board["held_out_over_floor"]["clear"]["median"] == pytest.approx(2.5e-3 / floor_n)
    assert board["location_overlap"]["clear"]["median"] == 0.0
    assert board["confusion"]["nothing"] == {"nothing-missing": 2, "sensor-drift": 1}
    assert board["confusion"]["outside"] == {"unknown": 1, "strain-stiffening": 1}
    assert sum(row["named"]["of"] for row in board["detectability"]) == 5
    assert json.loads(json.dumps(board, allow_nan=False)) == board


@pytest.mark.parametrize(
    ("full", "rmse_n"),
    [
        (None, 3e-3),
        ({"message": "failed"}, 3e-3),
        ({"rmse_held_out": None}, 3e-3),
        ({"rmse_held_out": 2e-3}, 2e-3),
    ],
)
def test_held_out_is_the_full_model_s_where_it_has_a_fit(full: dict | None, rmse_n: float) -> None:
    answer = said("force-offset", fit={"after": {"rmse_held_out": 3e-3, "full_model": full}})
    found = judge("001", key("force-offset"), answer)
    assert found.held_out == pytest.approx(rmse_n / floor_after(2e-3, HELD_OUT_FROM_S))


def test_a_group_larger_than_one_listed_is_no_answer_of_the_confusion_matrix() -> None:
    answer = said("device-friction")
    assert judge("001", key("device-friction"), answer).answer == "device-friction"
    answer["mechanisms"][0]["group"] = ["device-friction", "pad-slip", "backlash"]
    found = judge("001", key("device-friction"), answer)
    assert (found.right, found.answer) == (False, "group too large")


def made_up() -> tuple[dict, dict]:
    fit = {
        "after": {
            "rmse_held_out": 2.5e-3,
            "theta": {"E_c": {"mean": 60e3, "sd": 1e3}, "E_s": {"mean": 30e3, "sd": 1e3}, "k_c": 1e-14},
        }
    }
    sure = said("force-offset", fit=fit, located=[{"t0": 10.0, "t1": 20.0}])
    sure["mechanisms"][0]["parameters"] = {"F0": {"mean": -0.05, "sd": 0.01, "unit": "N"}}
    off = said("sensor-drift")
    off["mechanisms"][0]["parameters"] = {"drift": {"mean": 1e-4, "sd": 1e-6, "unit": "N/s"}}
    pairs = [
        (key("nothing", "nothing", 0.0, windows=[]), said()),
        (key("nothing", "nothing", 0.0, windows=[]), said()),
        (key("nothing", "nothing", 0.0, windows=[]), said("sensor-drift")),
        (key("force-offset", values={"F0": -0.045}), sure),
        (key("sensor-drift", size=CLEAR, values={"drift": 2e-4}), off),
        (key("device-friction", size=12.0), said("viscous-drag")),
        (key("fluid-leakage", size=4.0), said()),
        (key("fluid-leakage", size=1.2), said()),
        (key("thick-arm", "outside", 6.0), said(verdict="unknown")),
        (key("peeling", "outside", 6.0), said("strain-stiffening")),
    ]
    numbered = {f"{i + 1:03d}": pair for i, pair in enumerate(pairs)}
    return {n: k for n, (k, _) in numbered.items()}, {n: a for n, (_, a) in numbered.items()}


def test_nine_of_ten_curves_have_the_half_that_their_answers_were_drawn_with() -> None:
    rng, inside = np.random.default_rng(4), 0
    for _ in range(60):
        sizes = np.exp(rng.uniform(np.log(0.5), np.log(30.0), 30))
        named = rng.random(30) < 1.0 / (1.0 + (3.0 / sizes) ** 2.5)
        half = curve(sizes.tolist(), named.tolist())["half"]
        inside += half["low"] < 3.0 < half["high"]
    assert 48 <= inside <= 60


def test_a_curve_of_many_answers_is_the_share_that_they_were_drawn_with() -> None:
    rng = np.random.default_rng(5)
    sizes = np.exp(rng.uniform(np.log(0.5), np.log(30.0), 1000))
    found = curve(sizes.tolist(), (rng.random(1000) < 1.0 / (1.0 + (3.0 / sizes) ** 2.5)).tolist())
    at, mean = np.array(found["at"]), np.array(found["mean"])
    np.testing.assert_allclose(mean, 1.0 / (1.0 + (3.0 / at) ** 2.5), atol=0.1)
    assert np.all(np.array(found["low"]) <= mean)
    assert np.all(mean <= np.array(found["high"]))


def test_a_curve_of_few_answers_is_wide_and_those_alike_say_one_side_only() -> None:
    few, all_named = curve([1.0, 2.0, 4.0, 8.0], [False, False, True, True]), curve([2.0] * 4, [True] * 4)
    assert few["half"]["low"] < 2.0
    assert few["half"]["high"] > 4.0
    assert all_named["half"]["high"] < 3.0
    assert all_named["half"]["low"] < 0.2


def test_only_mechanisms_with_several_recordings_have_a_curve() -> None:
    keys = {f"{i:03d}": key("device-friction", size=float(i)) for i in (1, 2, 4, 8)}
    keys["009"] = key("pad-slip")
    answers = {number: said("device-friction" if number > "002" else "viscous-drag") for number in keys}
    found = score(keys, answers)["by_mechanism"]
    assert list(found) == ["device-friction"]
    one = found["device-friction"]
    assert (one["sizes"], one["right"]) == ([1.0, 2.0, 4.0, 8.0], [False, False, True, True])
    assert one["up_to"] == [True] * 4
    assert half_in_words(one).endswith(")")


def test_no_half_is_told_beyond_the_sizes_that_there_were() -> None:
    def words(named: bool) -> str:
        return half_in_words({"sizes": [2.0, 4.0], "curve": curve([2.0, 4.0], [named] * 2)})

    assert words(True).startswith("below")
    assert words(False).startswith("above")


def test_the_figure_of_sizes_is_drawn(tmp_path: Path) -> None:
    sizes, right = [1.0, 2.0, 4.0, 8.0], [False, False, True, True]
    one = {"sizes": sizes, "right": right, "up_to": [True, False, True, True], "curve": curve(sizes, right)}
    figure = report.figure_detectability({name: one for name in ("pad-slip", "pre-stretch", "a", "b")})
    png, _ = report.save_figure(figure, tmp_path / "sizes", "test")
    assert png.stat().st_size > 10_000


def test_the_scoreboard_s_figure_is_drawn(tmp_path: Path) -> None:
    png, svg = report.save_figure(report.figure_proof(score(*made_up())), tmp_path / "board", "test")
    assert png.stat().st_size > 10_000
    assert svg.is_file()
