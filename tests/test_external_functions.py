"""A function in a file as the forward model: it is fitted, runs a design, and fails in one line."""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from toys.closed_form_model import MOTION
from toys.external_models import PARAMETERS, SPRING, TRUE
from toys.spring_case import NOISE_N, SPACE, configured, refused, spring_case
from toys.worker_functions import hooke

from bayeskin import cli, report, storage
from bayeskin.design import Wave
from bayeskin.design_files import load_design
from bayeskin.execution.local import here, local
from bayeskin.external.model import identity, simulate_with
from bayeskin.runner import run_design
from bayeskin.store import Store
from bayeskin.types import PadMotion, Recording
from bayeskin.workflow import executor, stages
from bayeskin.workflow.diagnosing import diagnose
from bayeskin.workflow.engine import Silent


@pytest.fixture
def case(tmp_path: Path) -> Path:
    return spring_case(tmp_path)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "save_figure", lambda figure, stem, provenance: None)


@pytest.fixture
def quickly(undrawn: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets stages run without drawings and without other processes."""
    monkeypatch.setattr(executor, "local", lambda workers: here)


def test_a_function_in_a_file_is_fitted_with_parameters_of_its_own(case: Path, quickly: None) -> None:
    answer = stages.run(case, "map", Silent())
    assert answer["ok"], answer["text"]
    assert answer["polished"] is None
    assert list(answer["theta"])[:3] == list(TRUE)
    for name, value in TRUE.items():
        assert answer["theta"][name] == pytest.approx(value, rel=0.05), name
    assert answer["rmse_of_full_model"]["fitted_n"] < NOISE_N


@pytest.mark.slow
def test_a_diagnosis_solves_what_acts_on_the_force_beside_a_model_of_one_s_own(case: Path) -> None:
    file = case.parent / "measured.h5"
    measured = storage.load(file, Recording)
    storage.save(file, dataclasses.replace(measured, force_n=measured.force_n - 0.03))
    said = diagnose(case, Silent())
    (mechanism,) = said["mechanisms"]
    assert mechanism["name"] == "force-offset"
    offset = mechanism["parameters"]["F0"]
    assert abs(offset["mean"] + 0.03) < 4.0 * offset["sd"] < 0.01
    assert said["full_model"]["rmse"] < NOISE_N
    for name, value in TRUE.items():
        low, high = said["fit"]["after"]["theta"][name]["interval90"]
        assert 0.9 * low < value < 1.1 * high, name


def test_a_change_of_what_the_file_does_makes_the_runs_again_and_nothing_else(
    case: Path, undrawn: None
) -> None:
    assert stages.run(case, "design", Silent())["skipped"] == []
    assert stages.run(case, "design", Silent())["skipped"] == ["recording", "design"]
    before = load_design(case.parent / "case" / "design" / "design.h5")
    reworded = SPRING.replace("parallel.", "parallel:").replace("    pull =", "    # Hooke\n    pull =")
    (case.parent / "spring.py").write_text(reworded)
    assert stages.run(case, "design", Silent())["skipped"] == ["recording", "design"]
    assert identity(f"{case.parent / 'spring.py'}:force") == before.model_hash
    (case.parent / "spring.py").write_text(SPRING.replace("return pull", "return 2 * pull"))
    assert stages.run(case, "design", Silent())["skipped"] == ["recording"]
    after = load_design(case.parent / "case" / "design" / "design.h5")
    assert before.model_hash != after.model_hash
    np.testing.assert_array_equal(before.theta, after.theta)
    assert not np.allclose(before.force_n, after.force_n)


def test_any_callable_runs_through_the_runner(tmp_path: Path) -> None:
    edges_s, theta = (
        np.arange(0.0, 130.5, 1.0),
        SPACE.from_unit(np.random.default_rng(1).uniform(size=(3, 3))),
    )
    wave = Wave(SPACE, theta, np.zeros(3, bool), 0, 1)
    run = partial(simulate_with, hooke, MOTION, model_hash="mine")
    with Store(tmp_path / "a.store", "mine") as store:
        design = run_design(store, wave, edges_s, run, "mine", local(1))
    middle_s = edges_s[:-1] + 0.5
    assert design.ok.all()
    np.testing.assert_allclose(
        design.force_n[:, 20:40], np.outer(theta[:, 0], MOTION.at(middle_s[20:40])), rtol=1e-9
    )


def test_a_function_that_raises_is_a_run_that_failed() -> None:
    def raising(theta, time_s, displacement_m):
        raise ValueError("too\nstiff")

    run = simulate_with(raising, MOTION, TRUE)
    assert run.status == "failed"
    assert run.message.startswith("ValueError: too stiff (test_external_functions.py, line ")


def test_a_function_is_asked_for_no_time_twice() -> None:
    asked: list[np.ndarray] = []
    motion = PadMotion(
        np.array([0.0, 3 * 0.1, 1.0, 9.600000000000001, 20.0]), np.array([0, 0, 1e-3, 1e-3, 0])
    )
    simulate_with(lambda theta, time_s, d: asked.append(time_s) or d, motion, TRUE)
    assert np.diff(asked[0]).min() > 1e-3
    assert set(motion.time_s) <= set(asked[0])
    assert np.diff(asked[0]).max() < 0.1 + 1e-9


@pytest.mark.parametrize(
    ("forward", "more", "says"),
    [
        ("absent.py:force", PARAMETERS, "absent.py"),
        ("spring.py:absent", PARAMETERS, "no function absent"),
        ("spring.py:number", PARAMETERS, "no function number"),
        ("spring.py", PARAMETERS, "write FILE.py:FUNCTION"),
        ("nowhere.at.all:force", PARAMETERS, "name a Python file or module"),
        ("broken.py:force", PARAMETERS, "SyntaxError"),
        ("spring.py:raising", PARAMETERS, "ZeroDivisionError: division by zero (spring.py, line "),
        ("spring.py:short", PARAMETERS, "its forces is (3,); it must be (1"),
        ("spring.py:endless", PARAMETERS, "not finite"),
        ("spring.py:force", "", "KeyError: 'stiffness'"),
        ("spring.py:force", "[parameters.stiffness]\nlower = 1.0\n", "stiffness.upper: there is no value"),
        ("spring.py:force", PARAMETERS + '[surrogate]\nfile = "demo.h5"\n', "it belongs to another model"),
        ("ftp://here", PARAMETERS, "http://HOST:PORT"),
        ("http://here:port", PARAMETERS, "http://HOST:PORT"),
        ("http://127.0.0.1:9", PARAMETERS, "no server answers"),
    ],
)
def test_what_cannot_be_used_is_told_in_one_line(
    case: Path, capsys: pytest.CaptureFixture[str], forward: str, more: str, says: str, quickly: None
) -> None:
    (case.parent / "broken.py").write_text("def force(:\n")
    assert says in refused(capsys, "design", configured(case, forward, more))
    assert not list((case.parent / "case").glob("finished/*"))


def test_own_and_full_models_are_not_mixed(case: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = case.parent / "f.csv"
    for option in (("--fields", "f"), ("--figures", "f"), ("--mechanism", "force-offset")):
        assert "leave out fields, figures and mechanisms" in refused(
            capsys, "simulate", case, *option, "-o", out
        )
    assert "a model of your own" in refused(capsys, "simulate", case, "--mesh", "bricks", "-o", out)
    case.write_text(case.read_text().replace('forward = "spring.py:force"', 'observation = "own"'))
    assert "it must be 'own' with model.forward" in refused(capsys, "simulate", case, "-o", out)


def test_simulate_runs_it(case: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = case.parent / "f.csv"
    with pytest.raises(SystemExit) as stop:
        cli.main(["simulate", str(case), "--set", "share=0", "--set", "stiffness=50", "-o", str(out)])
    assert stop.value.code == 0
    assert "no error estimate: this is a model of your own" in capsys.readouterr().out
    _, displacement_m, force_n = np.loadtxt(out, delimiter=",", skiprows=1).T
    np.testing.assert_allclose(force_n, 50.0 * displacement_m, atol=1e-12)
