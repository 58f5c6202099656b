"""A stage is run again when, and only when, what it was made from has changed."""

import contextlib
import dataclasses
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from bayeskin.errors import InputError
from bayeskin.inference import Bands, Verdict
from bayeskin.workflow import folder
from bayeskin.workflow.engine import STANDINGS, CannotGoOn, Run, Silent, Stage, open_run, run_stages, standing
from bayeskin.workflow.posterior import with_surrogate_error

CONFIG = 'seed = {seed}\n[recording]\nfile = "input.txt"\n'


def a_run(where: Path, seed: int = 1, text: str = "as measured") -> Run:
    (where / "input.txt").write_text(text)
    (where / "case.toml").write_text(CONFIG.format(seed=seed))
    return open_run(where / "case.toml", Silent())


def writes(name: str, value: Callable[[Run], str]) -> Callable[[Run], dict[str, str]]:
    def work(run: Run) -> dict[str, str]:
        run.at(name, "out.txt").write_text(value(run))
        return {"wrote": value(run)}

    return work


def stages() -> dict[str, Stage]:
    """read -> twice -> end, and a side branch that reads the seed."""

    def text(stage: str) -> Callable[[Run], str]:
        return lambda run: run.at(stage, "out.txt").read_text()

    def source(run: Run) -> Path:
        return run.beside("input.txt")

    stages = [
        Stage(
            "read",
            "reads",
            (),
            ("recording",),
            writes("read", lambda run: source(run).read_text().strip()),
            lambda run: [source(run)],
        ),
        Stage("twice", "doubles", ("read",), (), writes("twice", lambda run: 2 * text("read")(run))),
        Stage("seeded", "draws", ("read",), ("seed",), writes("seeded", lambda run: str(run.config.seed))),
        Stage("end", "ends", ("twice",), (), writes("end", text("twice"))),
    ]
    return {stage.name: stage for stage in stages}


def ran(run: Run, last: str | None = None, of: dict[str, Stage] | None = None) -> list[str]:
    return [o.stage for o in run_stages(run, of or stages(), last) if not o.skipped]


def test_stages_run_once_and_are_then_skipped(tmp_path: Path) -> None:
    run = a_run(tmp_path)
    assert ran(run) == ["read", "twice", "seeded", "end"]
    assert ran(run) == []
    assert run.folder == tmp_path / "case"
    assert run.summary("twice") == {"wrote": "as measuredas measured"}


def test_one_stage_brings_only_what_it_needs(tmp_path: Path) -> None:
    assert ran(a_run(tmp_path), "end") == ["read", "twice", "end"]


def test_a_change_reruns_what_is_made_from_it_and_nothing_else(tmp_path: Path) -> None:
    ran(a_run(tmp_path))
    assert ran(a_run(tmp_path, seed=2)) == ["seeded"]
    assert ran(a_run(tmp_path, seed=2, text="new")) == ["read", "twice", "seeded", "end"]
    assert ran(a_run(tmp_path, seed=2, text="new ")) == ["read"]  # its output is as it was


def test_a_damaged_or_missing_output_is_made_again(tmp_path: Path) -> None:
    run = a_run(tmp_path)
    ran(run)
    run.at("twice", "out.txt").write_text("cut sho")
    assert ran(run) == ["twice"]
    run.at("end", "out.txt").unlink()
    assert ran(run) == ["end"]


def test_an_interrupted_stage_keeps_its_files_unless_its_inputs_change(tmp_path: Path) -> None:
    def interrupted(run: Run) -> dict[str, str]:
        kept = run.at("twice", "half.txt")
        if kept.exists():
            return {"went_on": True}
        kept.write_text("half")
        raise KeyboardInterrupt

    these = stages()
    these["twice"] = dataclasses.replace(these["twice"], work=interrupted)
    with pytest.raises(KeyboardInterrupt):
        ran(a_run(tmp_path), "twice", these)
    assert ran(a_run(tmp_path), "twice", these) == ["twice"]
    assert a_run(tmp_path).summary("twice") == {"went_on": True}
    (tmp_path / "case" / "twice" / "half.txt").write_text("half of something else")
    with pytest.raises(KeyboardInterrupt):
        ran(a_run(tmp_path, text="other inputs"), "twice", these)
    (tmp_path / "case" / "twice" / "stage.json").unlink()
    with pytest.raises(InputError, match="other files"):  # nothing says that the half file is a run's
        ran(a_run(tmp_path), "twice", these)


def stands(run: Run, of: dict[str, Stage] | None = None) -> list[str]:
    return [word for word, _ in standing(run, of or stages()).values()]


def test_how_stages_stand_is_told_without_running_them(tmp_path: Path) -> None:
    def failing(run: Run) -> dict[str, str]:
        raise CannotGoOn("too little")

    def interrupted(run: Run) -> dict[str, str]:
        raise KeyboardInterrupt

    assert stands(a_run(tmp_path)) == ["not run"] * 4
    assert not (tmp_path / "case").exists()
    ran(a_run(tmp_path))
    assert stands(a_run(tmp_path)) == ["done"] * 4
    assert stands(a_run(tmp_path, seed=2)) == ["done", "done", "out of date", "done"]
    assert stands(a_run(tmp_path, text="new")) == ["out of date"] * 4  # what is made from it is so too
    run = a_run(tmp_path)
    run.at("twice", "out.txt").write_text("cut sho")
    assert stands(run) == ["done", "out of date", "done", "out of date"]
    for work, word in ((failing, "failed"), (interrupted, "not finished")):
        these = stages()
        these["twice"] = dataclasses.replace(these["twice"], work=work)
        with contextlib.suppress(KeyboardInterrupt):
            ran(a_run(tmp_path), "twice", these)
        assert stands(a_run(tmp_path)) == ["done", word, "done", "out of date"]
    assert set(STANDINGS) == {"done", "not run", "out of date", "failed", "not finished"}


def test_a_folder_serves_one_process_and_is_free_when_that_is_killed(tmp_path: Path) -> None:
    code = (
        "import sys, time, pathlib; from bayeskin.workflow import folder\n"
        "with folder.locked(pathlib.Path(sys.argv[1])): print('held', flush=True); time.sleep(60)"
    )
    holder = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE)
    holder.stdout.readline()
    said = rf"another bayeskin \(process {holder.pid}\)"
    with pytest.raises(InputError, match=said), folder.locked(tmp_path):
        pass
    os.kill(holder.pid, signal.SIGKILL)
    holder.wait()
    with folder.locked(tmp_path):
        pass


def test_json_knows_no_nan_and_no_numpy(tmp_path: Path) -> None:
    value = {"a": np.float64("nan"), "b": np.arange(2), "c": (1.5, np.inf), "d": np.bool_(True), 3: tmp_path}
    folder.write_json(tmp_path / "x.json", value)
    expected = {"a": None, "b": [0, 1], "c": [1.5, None], "d": True, "3": str(tmp_path)}
    assert json.loads((tmp_path / "x.json").read_text()) == expected
    with pytest.raises(TypeError):
        folder.write_json(tmp_path / "x.json", {"a": object()})
    assert json.loads((tmp_path / "x.json").read_text()) == expected
    assert list(tmp_path.iterdir()) == [tmp_path / "x.json"]


def bands_with(surrogate_n: float, noise_n: float) -> Bands:
    constant = {"model": 0.0, "surrogate": surrogate_n, "noise": noise_n}
    blank = {f.name: np.zeros(4) for f in dataclasses.fields(Bands)}
    return Bands(**{**blank, **{f"sd_{part}_n": np.full(4, sd) for part, sd in constant.items()}})


def test_a_posterior_in_the_surrogates_error_is_not_trusted():
    converged = Verdict(True, ("5000 effective samples",))
    good = with_surrogate_error(converged, bands_with(1e-3, 3e-3), np.arange(4))
    assert good.trusted
    assert good.reasons[0] == "5000 effective samples"
    bad = with_surrogate_error(converged, bands_with(23e-3, 8e-3), np.arange(4))
    assert not bad.trusted
    assert bad.reasons[0].startswith("surrogate's sd 23 mN in the fitted bins; at most the noise's sd of 8")
    assert not with_surrogate_error(Verdict(False, ("stuck",)), bands_with(0.0, 1.0), np.arange(4)).trusted
