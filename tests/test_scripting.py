"""bayeskin from a script: the documented blocks run, and give what a run gives."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import arviz as az
import matplotlib as mpl
import numpy as np
import pytest
from toys.coarse_proposals import propose_coarsely

import bayeskin as bk
from bayeskin import scripting
from bayeskin.config import config_of, load_config, to_toml
from bayeskin.errors import InputError
from bayeskin.finite_element import ModelSpec, simulate
from bayeskin.inference import draws_of
from bayeskin.types import PadMotion, Recording, Simulation
from bayeskin.workflow import diagnosing

mpl.use("Agg")
ROOT = Path(__file__).parents[1]
BLOCKS = re.findall(
    r"(?<!-->\n)^```python\n(.*?)^```", (ROOT / "docs" / "scripting.md").read_text(), re.M | re.S
)


@pytest.fixture(scope="module")
def said() -> dict[str, Any]:
    """The names that the documentation's blocks leave, run on a coarse mesh and with coarse proposals."""

    def coarsely(spec: ModelSpec, motion: PadMotion, theta: Mapping[str, float]) -> Simulation:
        return simulate(replace(spec, refinement=0, tolerance=1e-2), motion, theta)

    names: dict[str, Any] = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        patch.setattr(scripting, "run_model", coarsely)
        propose_coarsely(patch)
        for block in BLOCKS:
            exec(compile(block, "docs/scripting.md", "exec"), names)
    return names


def test_a_file_that_does_not_decide_is_read_with_what_a_script_states(tmp_path: Path) -> None:
    rows = "".join(f"{0.1 * i:.1f};{36 + 0.01 * i:.2f};{0.1 * i:.2f}\n" for i in range(80))
    (tmp_path / "bare.csv").write_text("clock;place;cell\n" + rows)
    recording = bk.load_recording(
        tmp_path / "bare.csv",
        columns={"time": "clock", "displacement": "place", "force": "3"},
        units={"time": "s", "displacement": "mm", "force": "gf"},
        zero=True,
    )
    assert recording.displacement_m[-1] == pytest.approx(0.79e-3)
    assert recording.force_n[-1] == pytest.approx(7.9 * 9.80665e-3)
    for wrong in ({"columns": {"load": "3"}}, {"units": {"mass": "kg"}}, {"units": {"force": "psi"}}):
        with pytest.raises(InputError):
            bk.load_recording(tmp_path / "bare.csv", **wrong)


def test_the_first_block_is_a_posterior_in_fifteen_lines() -> None:
    assert len([line for line in BLOCKS[0].splitlines() if line.strip()]) <= 15


def test_the_documented_posterior_is_an_inference_data_of_the_recording(said: dict[str, Any]) -> None:
    posterior, recording = said["posterior"], said["recording"]
    assert {"posterior", "prior", "posterior_predictive", "log_likelihood"} <= set(posterior.groups())
    assert posterior.attrs["recording_sha256"] == recording.sha256
    space, draws = draws_of(posterior)
    assert space.contains(draws).all()
    peak = posterior["posterior_predictive"]["mean"].max(dim="time").mean().item()
    assert peak == pytest.approx(recording.force_n.max(), rel=0.1)
    assert set(json.loads(posterior.attrs["map"])) == set(space.names)


def test_arviz_compares_the_documented_posteriors_by_phase(said: dict[str, Any]) -> None:
    """A stiff subcutis predicts phases nearly as well: chains as short as these leave the order open."""
    posteriors = {"shipped": said["posterior"], "stiff": said["stiff"]}
    table = az.compare(posteriors)
    assert set(table.index) == set(posteriors)
    for name, posterior in posteriors.items():
        loo = az.loo(posterior)
        assert loo.n_data_points == posterior_phases(said)
        assert table.elpd_loo[name] == pytest.approx(loo.elpd_loo)
    assert table.elpd_diff.max() < 10.0


def posterior_phases(said: dict[str, Any]) -> int:
    return said["posterior"]["log_likelihood"]["phases"].sizes["phase"]


def test_settings_reach_the_posterior_and_its_provenance(said: dict[str, Any]) -> None:
    assert said["stiff"]["posterior"]["E_s"].min() >= 50e3
    config = json.loads(said["stiff"].attrs["provenance"])["config"]
    assert config["parameters"]["E_s"]["lower"] == 50e3
    assert (config["seed"], config["surrogate"]["file"]) == (2, "demo.h5")


def test_the_full_model_weighs_the_documented_draws(said: dict[str, Any]) -> None:
    assert said["run"].status == "ok"
    weighed = said["weighed"]
    assert len(weighed.theta) == 8
    assert weighed.weights.sum() == pytest.approx(1.0)
    assert np.isfinite(weighed.log_ratio).all()


def test_a_folder_keeps_the_chains_and_the_same_call_repeats_the_draws(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The settings contain numbers of NumPy."""
    propose_coarsely(monkeypatch)
    recording = bk.load_recording(ROOT / "data" / "demo.h5")
    small = {
        "sample": {"ensembles": np.int64(2), "walkers": 24, "max_steps": 500},
        "map": {"starts": 1, "evaluations": 200},
        "fit": {"windows_s": np.array([[0.0, 40.0]])},
        "seed": np.int64(3),
    }
    posterior = bk.calibrate(
        recording, folder=tmp_path, **small
    )  # the shipped surrogate that knows the protocol
    files = {f: f.stat().st_mtime_ns for f in tmp_path.rglob("ensemble_*.h5")}
    again = bk.calibrate(recording, folder=tmp_path, **small)
    assert len(files) == 2
    assert files == {f: f.stat().st_mtime_ns for f in tmp_path.rglob("ensemble_*.h5")}
    np.testing.assert_array_equal(draws_of(posterior)[1], draws_of(again)[1])
    config = json.loads(posterior.attrs["provenance"])["config"]
    assert (config["seed"], config["fit"]["windows_s"]) == (3, [[0.0, 40.0]])


def test_a_diagnosis_takes_the_posteriors_settings(
    said: dict[str, Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    asked: list[Path] = []
    monkeypatch.setattr(
        diagnosing, "diagnose", lambda sources, reporter: asked.extend(sources) or {"ok": True}
    )
    assert bk.diagnose(said["recording"], said["stiff"], folder=tmp_path) == {"ok": True}
    config = load_config(asked[0])
    assert config.parameters["E_s"].lower == 50e3
    assert config.surrogate.file == "demo.h5"
    assert (asked[0].parent / config.each_recording[0].file).is_file()


def test_draws_by_another_surrogate_are_not_weighed(said: dict[str, Any]) -> None:
    posterior = said["posterior"].copy()
    made_of = json.loads(posterior.attrs["provenance"])
    made_of["identity"]["surrogate"] = "of a run that has trained on"
    posterior.attrs["provenance"] = json.dumps(made_of)
    with pytest.raises(InputError, match="posterior: it was made with another surrogate"):
        bk.check(said["recording"], posterior, 8)


def test_the_recording_s_section_is_a_setting_too(said: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=r"recording\.protocol"):
        bk.simulate(said["recording"], recording={"protocol": "straight"})


def test_a_script_that_diagnoses_needs_no_guard(tmp_path: Path) -> None:
    (tmp_path / "unguarded.py").write_text(
        "import math, sys\n"
        "import bayeskin as bk\n"
        "from bayeskin.workflow import diagnosing\n"
        "from bayeskin.execution.local import run_parallel\n"
        "print('once')\n"
        "diagnosing.diagnose = lambda source, reporter: dict(run_parallel(math.sqrt, [4.0], 1))\n"
        f"print(bk.diagnose(bk.load_recording({str(ROOT / 'data' / 'demo.h5')!r})))\n"
        "print(sys.modules['__main__'].bk is bk)\n"
    )
    done = subprocess.run(
        [sys.executable, tmp_path / "unguarded.py"], capture_output=True, text=True, cwd=ROOT
    )
    assert (done.returncode, done.stdout.split()) == (0, ["once", "{0:", "2.0}", "True"]), done.stderr


def test_wrong_input_is_one_line() -> None:
    for call in (bk.calibrate, bk.simulate, bk.diagnose):
        with pytest.raises(InputError, match=r"'data/demo.h5' has the type str; use a recording of bk.load"):
            call("data/demo.h5")
    recording = bk.load_recording(ROOT / "data" / "demo.h5")
    with pytest.raises(InputError, match=r"settings: sample.walker: this key is not known"):
        bk.calibrate(recording, "demo.h5", sample={"walker": 3})
    with pytest.raises(InputError, match="theta: E_x is not known; use some of E_c"):
        bk.simulate(recording, {"E_x": 1.0})
    time_s = np.linspace(0.0, 60.0, 601)
    ramp = np.interp(time_s, [0, 10, 20, 40, 50, 60], [0, 0, 5e-3, 5e-3, 0, 0])
    other = Recording(time_s, ramp, 40 * ramp, "other", "1" * 64)
    with pytest.raises(InputError, match="no shipped surrogate"):
        bk.calibrate(other)


def test_a_posterior_of_another_recording_is_refused(said: dict[str, Any]) -> None:
    time_s = np.linspace(0.0, 60.0, 601)
    other = Recording(time_s, 1e-4 * time_s, 0.01 * time_s, "other", "1" * 64)
    with pytest.raises(InputError, match="belongs to another recording than other"):
        bk.check(other, said["posterior"])


def test_a_configuration_written_out_reads_back_the_same(tmp_path: Path) -> None:
    plain = {
        "name": "case", "recording": {"file": 'a "b".h5'}, "fit": {"windows_s": [[0.0, 10.5], [20.0, 30.0]]},
        "parameters": {"E_c": {"lower": 2e4}, "k_c": {"upper": 1e-13}}, "slurm": {"jobs": 3},
    }  # fmt: skip
    config = config_of(plain, "test")
    (tmp_path / "case.toml").write_text(to_toml(config))
    assert load_config(tmp_path / "case.toml") == config


def test_importing_the_package_loads_nothing_heavy() -> None:
    code = "import sys, bayeskin; print([m for m in ('numpy', 'arviz', 'numba') if m in sys.modules])"
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert process.stdout.strip() == "[]"
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = bk.nothing
