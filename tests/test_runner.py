"""A design's file: the same rows whatever the workers, the order, the failures or the kills."""

from __future__ import annotations

import os
import subprocess
import sys
import time
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
from bayeskin.design_files import load_design, load_waves
from bayeskin.errors import InputError
from bayeskin.execution import local as workers
from bayeskin.execution.local import local
from bayeskin.journal import Journal
from bayeskin.runner import add_points, run_design
from bayeskin.types import Design

HERE = Path(__file__).parent


def assert_one_file(path: Path) -> None:
    assert [p.name for p in path.parent.iterdir()] == [path.name]


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
    unreliable_models.main(str(path), workers=1, seconds=0.0)
    assert_one_file(path)
    return load_design(path)


def test_rows_are_the_points_and_the_models_bin_means(whole: Design) -> None:
    n = len(WAVE.theta)
    np.testing.assert_array_equal(whole.theta[:n], WAVE.theta)
    np.testing.assert_array_equal(whole.held_out[:n], WAVE.held_out)
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
    assert_one_file(path)


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


def test_a_design_killed_at_random_moments_ends_as_if_it_had_not_been(tmp_path: Path, whole: Design) -> None:
    kill_until_done(tmp_path / "design.h5", workers=2, kills=4, rng=np.random.default_rng(0))
    assert_same_rows(load_design(tmp_path / "design.h5"), whole)
    assert_one_file(tmp_path / "design.h5")


@pytest.mark.slow
def test_fifty_kills_leave_no_trace(tmp_path: Path, whole: Design) -> None:
    rng = np.random.default_rng(1)
    for attempt in range(5):
        path = tmp_path / str(attempt) / "design.h5"
        kill_until_done(path, workers=1 + attempt % 2, kills=10, rng=rng)
        assert_same_rows(load_design(path), whole)
        assert_one_file(path)


class Killed(BaseException):
    """Stands for a kill: nothing in the package may catch it."""


@pytest.mark.usefixtures("serial")
@pytest.mark.parametrize("when", ["before", "after"])
@pytest.mark.parametrize("step", ["storage.save", "os.replace", "Journal.forget"])
def test_a_kill_at_each_step_of_the_fold_loses_nothing(
    tmp_path: Path, whole: Design, monkeypatch: pytest.MonkeyPatch, step: str, when: str
) -> None:
    owner, name = {
        "storage.save": (storage, "save"),
        "os.replace": (storage.os, "replace"),
        "Journal.forget": (Journal, "forget"),
    }[step]
    original = getattr(owner, name)

    def dies(*args: object, **options: object) -> None:
        if when == "after":
            original(*args, **options)
        raise Killed

    path, calls = tmp_path / "design.h5", tmp_path / "calls"
    calls.mkdir()
    simulate = partial(unreliable_models.counted, folder=str(calls))
    first = replace(WAVE, theta=WAVE.theta[:3], held_out=WAVE.held_out[:3])
    with monkeypatch.context() as patch:
        patch.setattr(owner, name, dies)
        with pytest.raises(Killed):
            run(path, first, simulate)
    if path.exists():
        load_design(path)  # whole at every moment
    design = run(path, first, simulate)
    assert_same_rows(design, load_design(path))
    np.testing.assert_array_equal(design.force_n, whole.force_n[:3])
    assert len(load_waves(path)) == 1
    assert len(list(calls.iterdir())) == 3, "no point is run twice"


def test_a_worker_that_dies_loses_only_its_own_point_which_is_run_again(
    tmp_path: Path, whole: Design
) -> None:
    simulate = partial(unreliable_models.deadly, folder=str(tmp_path), deaths=2)
    design = run(tmp_path / "out" / "design.h5", SHORT, simulate, workers=2)
    assert len(list(tmp_path.glob("*.*"))) == 2 * np.sum(SHORT.theta[:, 0] > 3e5) > 0, "workers did die"
    np.testing.assert_array_equal(design.force_n, whole.force_n[: len(SHORT.theta)])
    assert design.ok.all()


def test_a_point_that_kills_three_workers_is_a_failed_row(tmp_path: Path) -> None:
    simulate = partial(unreliable_models.deadly, folder=str(tmp_path), deaths=99)
    design = run(tmp_path / "out" / "design.h5", SHORT, simulate)
    stiff = SHORT.theta[:, 0] > 3e5
    assert stiff.any()
    np.testing.assert_array_equal(design.ok, ~stiff)
    for row in np.flatnonzero(stiff):
        assert "signal 9" in design.messages[row]
        assert len(list(tmp_path.glob(f"{float(SHORT.theta[row, 0])!r}.*"))) == 3


@pytest.mark.usefixtures("serial")
def test_failed_runs_are_rows_with_their_message(tmp_path: Path) -> None:
    path = tmp_path / "design.h5"
    design = run(path, first_wave(SPACE, 24, 0, seed=1), unreliable_models.failing)
    e_c, e_s = design.theta[:, 0], design.theta[:, 1]
    expected = np.where(
        e_c < 3e4, "Newton stalled",
        np.where(e_c > 7e5, "ZeroDivisionError: singular tangent", np.where(e_s < 5e3, "not finite", "")),
    )  # fmt: skip
    assert set(expected) == {"Newton stalled", "ZeroDivisionError: singular tangent", "not finite", ""}
    assert all(want in found for want, found in zip(expected, design.messages, strict=True))
    np.testing.assert_array_equal(design.ok, expected == "")
    assert np.isnan(design.force_n[~design.ok]).all()
    assert np.isfinite(design.force_n[design.ok]).all()
    assert not (design.training & ~design.ok).any()
    assert_same_rows(load_design(path), design)
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
    path, calls = tmp_path / "design.h5", tmp_path / "calls"
    calls.mkdir()
    simulate = partial(unreliable_models.counted, folder=str(calls))
    run(path, SHORT, simulate)
    repeated = replace(WAVE, theta=np.tile(WAVE.theta, (2, 1)), held_out=np.tile(WAVE.held_out, 2))
    design = run(path, repeated, simulate)
    assert len(list(calls.iterdir())) == len(WAVE.theta)
    np.testing.assert_array_equal(design.theta, WAVE.theta)
    np.testing.assert_array_equal(design.force_n, whole.force_n[: len(WAVE.theta)])


@pytest.mark.usefixtures("serial")
def test_added_points_are_training_points_of_the_next_wave(whole: Design, tmp_path: Path) -> None:
    assert whole.wave.tolist() == [0] * len(WAVE.theta) + [1]
    assert not whole.held_out[-1]
    path = tmp_path / "design.h5"
    run(path)
    add_points(path, whole.theta[-1:], toy_simulate, "most probable point", local(1))
    again = add_points(path, whole.theta[-1:], toy_simulate, "again", local(1))
    assert_same_rows(again, whole)
    assert [w["rule"] for w in load_waves(path)] == [WAVE.record["rule"], "most probable point"]


@pytest.mark.usefixtures("serial")
def test_progress_counts(tmp_path: Path) -> None:
    seen = []
    run(tmp_path / "design.h5", progress=lambda *now: seen.append(now))
    n = len(WAVE.theta)
    assert seen == [(i, n, 0) for i in range(n + 1)]


@pytest.mark.usefixtures("serial")
def test_a_damaged_journal_beside_a_design_is_run_again(tmp_path: Path, whole: Design) -> None:
    path = tmp_path / "design.h5"

    def interrupted(done: int, *_: object) -> None:
        if done == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(path, progress=interrupted)
    journal = tmp_path / "design.h5.journal"
    lines = journal.read_bytes().splitlines(keepends=True)
    assert len(lines) == 5
    journal.write_bytes(lines[0] + b"\0" * 4096 + lines[2][:-300])
    design = run(path)
    np.testing.assert_array_equal(design.force_n, whole.force_n[: len(WAVE.theta)])
    assert_one_file(path)


@pytest.mark.usefixtures("serial")
def test_what_a_killed_process_was_writing_is_cleared_away(tmp_path: Path) -> None:
    path = tmp_path / "design.h5"
    for name in (".design.h5.4711.partial", ".design.h5.journal.partial"):
        (tmp_path / name).write_bytes(b"half a file")
    run(path)
    assert_one_file(path)


@pytest.mark.usefixtures("serial")
def test_one_process_at_a_time(tmp_path: Path) -> None:
    path = tmp_path / "design.h5"
    held = Journal(tmp_path / "design.h5.journal", "a", bins=3)
    with pytest.raises(InputError, match="another process"):
        run(path)
    assert not path.exists()
    held.__exit__()
    run(path)


@pytest.mark.usefixtures("serial")
def test_a_file_of_another_design_is_refused_and_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "design.h5"
    run(path, first_wave(SPACE, 2, 0, seed=1))
    before = path.read_bytes()
    wider = replace(SPACE.parameters[0], upper=3e6)
    other = first_wave(replace(SPACE, parameters=(wider, *SPACE.parameters[1:])), 2, 0, seed=1)
    with pytest.raises(InputError, match="parameters"):
        run(path, other)
    with pytest.raises(InputError, match="model"):
        run_design(path, WAVE, COARSE_S, toy_simulate, "another")
    with pytest.raises(InputError, match="bins"):
        run_design(path, WAVE, COARSE_S[:-1], toy_simulate, "toy")
    outside = replace(WAVE, theta=WAVE.theta * np.array([1, 1, 1, 1e6, 1]))
    with pytest.raises(InputError, match="row 0"):
        run(path, outside)
    assert path.read_bytes() == before
    assert_one_file(path)
    path.write_bytes(b"not HDF5")
    with pytest.raises(InputError):
        run(path)
    assert path.read_bytes() == b"not HDF5"


@pytest.mark.usefixtures("serial")
def test_a_simulate_of_another_model_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="model toy"):
        run_design(tmp_path / "design.h5", WAVE, COARSE_S, toy_simulate, "another")
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("serial")
def test_bins_beyond_the_run_are_failures_not_extrapolations(tmp_path: Path) -> None:
    wave = first_wave(SPACE, 1, 0, seed=1)
    design = run_design(tmp_path / "d.h5", wave, np.linspace(0, 200, 5), toy_simulate, "toy")
    assert "covers 0..130 s" in design.messages[0]


def test_a_design_file_is_an_ordinary_file_of_the_project(tmp_path: Path, whole: Design) -> None:
    storage.save(tmp_path / "copy.h5", whole)
    assert_same_rows(load_design(tmp_path / "copy.h5"), whole)
    assert load_waves(tmp_path / "copy.h5") == ()
    with pytest.raises(InputError, match="no such file"):
        load_design(tmp_path / "absent.h5")


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("theta", np.zeros((3, 2)), r"theta: found shape \(3, 2\); expected shape"),
        ("messages", ("",), "messages: found 1 messages"),
        ("edges_s", np.zeros((2, 2)), "edges_s: found shape"),
        ("theta", np.full(WAVE.theta.shape, np.nan), "values that are not finite"),
    ],
)
def test_a_design_whose_arrays_do_not_belong_together_is_refused(
    serial: None, tmp_path: Path, name: str, value: object, says: str
) -> None:
    made = run(tmp_path / "design.h5")
    storage.save(tmp_path / "other.h5", replace(made, **{name: value}))
    with pytest.raises(InputError, match=says):
        load_design(tmp_path / "other.h5")
