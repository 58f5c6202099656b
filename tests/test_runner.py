"""A design: the same rows whatever the workers, the order, the failures or the kills."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from toys import unreliable_models
from toys.closed_form_model import SPACE, toy_bin_means, toy_simulate
from toys.design_runs import SHORT, assert_same_rows, run
from toys.unreliable_models import COARSE_S, WAVE

from bayeskin import storage
from bayeskin.design import first_wave
from bayeskin.design_files import load_design
from bayeskin.errors import InputError
from bayeskin.execution import local as workers
from bayeskin.execution.local import local
from bayeskin.runner import run_design
from bayeskin.store import Store
from bayeskin.types import Design, Simulation

HERE = Path(__file__).parent


@pytest.fixture
def serial(monkeypatch: pytest.MonkeyPatch) -> None:
    """No worker processes, where a test is about something else: they take a second to start."""
    monkeypatch.setattr(
        workers, "run_parallel", lambda function, items, _: ((i, function(x)) for i, x in enumerate(items))
    )


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Design:
    """The program of unreliable_models, never interrupted, with one worker."""
    path = tmp_path_factory.mktemp("whole") / "design.h5"
    return unreliable_models.main(str(path), workers=1, seconds=0.0)


def test_rows_are_the_points_and_the_models_bin_means(whole: Design) -> None:
    np.testing.assert_array_equal(whole.theta, WAVE.theta)
    np.testing.assert_array_equal(whole.held_out, WAVE.held_out)
    assert whole.wave.tolist() == [0] * len(WAVE.theta)
    assert whole.ok.all()
    # The toy is sampled every 0.5 s and interpolated, hence not to the last digit.
    exact = toy_bin_means(whole.theta, COARSE_S)
    np.testing.assert_allclose(whole.force_n, exact, atol=2e-3 * exact.max())
    simulated = toy_simulate(dict(zip(SPACE.names, whole.theta[5].tolist(), strict=True)))
    np.testing.assert_array_equal(whole.force_n[5], simulated.bin_means(COARSE_S))


def test_order_and_workers_leave_no_trace(tmp_path: Path, whole: Design) -> None:
    path = tmp_path / "design.h5"
    unreliable_models.main(str(path), workers=3, seconds=0.02)
    assert_same_rows(load_design(path), whole)


def kill_until_done(path: Path, workers: int, kills: int, rng: np.random.Generator) -> None:
    """Starts the program, kills it at a random moment, again and again; at last lets it finish."""
    paths = os.pathsep.join([str(HERE), str(HERE.parent)])
    command = [sys.executable, str(HERE / "toys/unreliable_models.py"), str(path), str(workers), "0.15"]
    environment = {**os.environ, "PYTHONPATH": paths}
    for _ in range(kills):
        program = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE)
        time.sleep(rng.uniform(0.4, 1.6))
        program.kill()
        program.communicate()
    subprocess.run(command, env=environment, check=True)


@pytest.mark.slow
def test_a_design_killed_at_random_moments_ends_as_if_it_had_not_been(tmp_path: Path, whole: Design) -> None:
    kill_until_done(tmp_path / "design.h5", workers=2, kills=4, rng=np.random.default_rng(0))
    assert_same_rows(load_design(tmp_path / "design.h5"), whole)
    assert {p.name for p in tmp_path.iterdir()} == {"design.h5", "design.store"}


@pytest.mark.slow
def test_fifty_kills_leave_no_trace(tmp_path: Path, whole: Design) -> None:
    rng = np.random.default_rng(1)
    for attempt in range(5):
        path = tmp_path / str(attempt) / "design.h5"
        kill_until_done(path, workers=1 + attempt % 2, kills=10, rng=rng)
        assert_same_rows(load_design(path), whole)


class Killed(BaseException):
    """Stands for a kill: nothing in the package may catch it."""


@pytest.mark.usefixtures("serial")
@pytest.mark.parametrize(("when", "calls"), [("before", 5), ("after", 4)])
def test_a_kill_beside_the_write_of_a_run_costs_this_run_at_most(
    tmp_path: Path, whole: Design, monkeypatch: pytest.MonkeyPatch, when: str, calls: int
) -> None:
    add = Store.add

    def dies(store: Store, computed_from: object, result: object) -> None:
        third = np.array_equal(computed_from[1], SHORT.theta[2])
        if when == "after" or not third:
            add(store, computed_from, result)
        if third:
            raise Killed

    path, log = tmp_path / "a.store", tmp_path / "calls"
    log.mkdir()
    simulate = partial(unreliable_models.counted, folder=str(log))
    with monkeypatch.context() as patch:
        patch.setattr(Store, "add", dies)
        with pytest.raises(Killed):
            run(path, SHORT, simulate)
    design = run(path, SHORT, simulate)
    np.testing.assert_array_equal(design.force_n, whole.force_n[: len(SHORT.theta)])
    assert len(list(log.iterdir())) == calls


def test_a_worker_that_dies_loses_only_its_own_point_which_is_run_again(
    tmp_path: Path, whole: Design
) -> None:
    simulate = partial(unreliable_models.deadly, folder=str(tmp_path), deaths=2)
    design = run(tmp_path / "out" / "a.store", SHORT, simulate, local(2))
    assert len(list(tmp_path.glob("*.*"))) == 2 * np.sum(SHORT.theta[:, 0] > 3e5) > 0, "workers did die"
    np.testing.assert_array_equal(design.force_n, whole.force_n[: len(SHORT.theta)])
    assert design.ok.all()


def test_a_point_that_kills_three_workers_is_a_failed_row(tmp_path: Path) -> None:
    simulate = partial(unreliable_models.deadly, folder=str(tmp_path), deaths=99)
    design = run(tmp_path / "out" / "a.store", SHORT, simulate, local(1))
    stiff = SHORT.theta[:, 0] > 3e5
    assert stiff.any()
    np.testing.assert_array_equal(design.ok, ~stiff)
    for row in np.flatnonzero(stiff):
        assert "signal 9" in design.messages[row]
        assert len(list(tmp_path.glob(f"{float(SHORT.theta[row, 0])!r}.*"))) == 3


@pytest.mark.usefixtures("serial")
def test_failed_runs_are_rows_with_their_message(tmp_path: Path) -> None:
    path = tmp_path / "a.store"
    design = run(path, first_wave(SPACE, 24, 0, seed=1), unreliable_models.failing)
    e_c, e_s = design.theta[:, 0], design.theta[:, 1]
    expected = np.where(
        e_c < 3e4, "Newton stalled",
        np.where(e_c > 7e5, "ZeroDivisionError: singular tangent", np.where(e_s < 5e3, "not finite", "")),
    )  # fmt: skip
    assert set(expected) == {"Newton stalled", "ZeroDivisionError: singular tangent", "not finite", ""}
    assert all(want in message for want, message in zip(expected, design.messages, strict=True))
    np.testing.assert_array_equal(design.ok, expected == "")
    assert np.isnan(design.force_n[~design.ok]).all()
    assert np.isfinite(design.force_n[design.ok]).all()
    assert not (design.training & ~design.ok).any()
    seen = []
    run(
        path,
        first_wave(SPACE, 24, 0, seed=1),
        unreliable_models.failing,
        progress=lambda *now: seen.append(now),
    )
    assert seen == [(24, 24, int((~design.ok).sum()))], "failures are remembered, not run again"


@pytest.mark.usefixtures("serial")
def test_a_longer_wave_runs_only_what_is_new(tmp_path: Path, whole: Design) -> None:
    path, calls = tmp_path / "a.store", tmp_path / "calls"
    calls.mkdir()
    simulate = partial(unreliable_models.counted, folder=str(calls))
    run(path, SHORT, simulate)
    again, held_out = np.concatenate([WAVE.theta, WAVE.theta[:3]]), np.arange(len(WAVE.theta) + 3) > 6
    design = run(path, replace(WAVE, theta=again, held_out=held_out, number=1), simulate)
    assert len(list(calls.iterdir())) == len(WAVE.theta)
    np.testing.assert_array_equal(design.theta, again)
    np.testing.assert_array_equal(design.force_n, np.concatenate([whole.force_n, whole.force_n[:3]]))
    np.testing.assert_array_equal(design.held_out, held_out)
    assert design.wave.tolist() == [1] * len(again)


@pytest.mark.usefixtures("serial")
def test_progress_counts(tmp_path: Path) -> None:
    seen = []
    run(tmp_path / "a.store", progress=lambda *now: seen.append(now))
    n = len(WAVE.theta)
    assert seen == [(i, n, 0) for i in range(n + 1)]


@pytest.mark.usefixtures("serial")
def test_damaged_runs_of_an_interrupted_design_are_run_again(tmp_path: Path, whole: Design) -> None:
    path, calls = tmp_path / "a.store", tmp_path / "calls"
    calls.mkdir()

    def interrupted(done: int, *_: object) -> None:
        if done == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(path, progress=interrupted)
    lines = path.read_bytes().splitlines(keepends=True)
    assert len(lines) == 1 + 5
    path.write_bytes(b"".join(lines[:2]) + b"\0" * 4096 + b"".join(lines[3:5]) + lines[5][:-30])
    design = run(path, simulate=partial(unreliable_models.counted, folder=str(calls)))
    assert_same_rows(design, whole)
    assert len(list(calls.iterdir())) == len(WAVE.theta) - 2


@pytest.mark.usefixtures("serial")
def test_runs_of_other_models_bins_and_parameters_are_no_runs_of_this_design(tmp_path: Path) -> None:
    def fails(theta: Mapping[str, float]) -> Simulation:
        return replace(toy_simulate(theta), status="failed", message="not the same", model_hash="")

    path = tmp_path / "a.store"
    run(path)
    with Store(path, "toy") as store:
        assert run_design(store, WAVE, COARSE_S, fails, "toy", local(1)).ok.all()
        assert not run_design(store, WAVE, COARSE_S, fails, "another", local(1)).ok.any()
        assert not run_design(store, WAVE, COARSE_S[:-1], fails, "toy", local(1)).ok.any()
        first = replace(SPACE.parameters[0], name="E")
        renamed = replace(WAVE, space=replace(SPACE, parameters=(first, *SPACE.parameters[1:])))
        assert not run_design(store, renamed, COARSE_S, fails, "toy", local(1)).ok.any()


@pytest.mark.usefixtures("serial")
def test_a_point_outside_the_box_is_refused_before_any_run(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="row 0"):
        run(tmp_path / "a.store", replace(WAVE, theta=WAVE.theta * np.array([1, 1, 1, 1e6, 1])))
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("serial")
def test_a_simulate_of_another_model_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="model toy"), Store(tmp_path / "a.store", "toy") as store:
        run_design(store, WAVE, COARSE_S, toy_simulate, "another")
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("serial")
def test_bins_beyond_the_run_are_failures_not_extrapolations(tmp_path: Path) -> None:
    wave = first_wave(SPACE, 1, 0, seed=1)
    with Store(tmp_path / "a.store", "toy") as store:
        design = run_design(store, wave, np.linspace(0, 200, 5), toy_simulate, "toy")
    assert "covers 0..130 s" in design.messages[0]


def test_a_design_file_is_an_ordinary_file_of_the_project(tmp_path: Path, whole: Design) -> None:
    storage.save(tmp_path / "copy.h5", whole)
    assert_same_rows(load_design(tmp_path / "copy.h5"), whole)
    with pytest.raises(InputError, match="no such file"):
        load_design(tmp_path / "absent.h5")


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("theta", np.zeros((3, 2)), r"theta: its shape is \(3, 2\); it must be"),
        ("messages", ("",), "messages: the number of messages is 1"),
        ("edges_s", np.zeros((2, 2)), "edges_s: its shape"),
        ("theta", np.full(WAVE.theta.shape, np.nan), "some values are not finite"),
    ],
)
def test_a_design_whose_arrays_do_not_belong_together_is_refused(
    serial: None, tmp_path: Path, name: str, value: object, says: str
) -> None:
    design = run(tmp_path / "a.store")
    storage.save(tmp_path / "other.h5", replace(design, **{name: value}))
    with pytest.raises(InputError, match=says):
        load_design(tmp_path / "other.h5")
