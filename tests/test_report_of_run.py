"""The report that a run leaves behind, and that `report` makes again."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from toys.finished_run import FORCES, HISTORY, drawing, summaries

from bayeskin import storage
from bayeskin.report.conclusion import conclusion_of
from bayeskin.report.page.figures import FIGURES
from bayeskin.types import Recording
from bayeskin.workflow import diagnosing, diagnosis, folder, page, stages
from bayeskin.workflow.engine import CannotGoOn, Run, Silent, Stage, open_run, run_stages

CONFIG = 'seed = {seed}\n[recording]\nfile = "r.csv"\n'


def stubs(fails: str = "") -> dict[str, Stage]:
    """The stages by name and need, each of which writes its figures and says what a finished run's would."""

    def working(name: str) -> Any:
        def work(run: Run) -> dict[str, Any]:
            if name == fails:
                raise CannotGoOn("too few runs; narrow the prior box")
            for of, figure in FIGURES:
                if of == name:
                    run.at(name, f"{figure}.svg").write_text(drawing(figure))
            if name == "sample":
                folder.write_json(run.at(name, "bands.json"), HISTORY)
            if name == "diagnose":
                folder.write_json(run.at(name, "forces.json"), FORCES)
            return summaries().get(name, {})

        return work

    return {
        name: Stage(name, "does", stage.needs, ("seed",), stage.work if name == "report" else working(name))
        for name, stage in stages.STAGES.items()
    }


def configured(where: Path, seed: int = 1) -> Path:
    (where / "r.csv").write_text("as measured")
    (where / "case.toml").write_text(CONFIG.format(seed=seed))
    return where / "case.toml"


def test_a_run_ends_with_its_page_and_report_makes_it_again(tmp_path: Path) -> None:
    config = configured(tmp_path)
    said = stages.run(config, None, Silent(), stubs())
    path = tmp_path / "case" / page.FILE
    assert said["page"] == str(path)
    first = path.read_bytes()
    assert b'id="sample-posterior"' in first
    path.unlink()
    assert said["text"].endswith(f"report: {path}")
    run_stages(open_run(config, Silent()), stubs(), "diagnose")
    lines = stages.run(config, None, Silent(), stubs())["text"].splitlines()
    sentences = conclusion_of(summaries()["diagnose"]).sentences
    assert lines[-5:] == ["The model lacks device-friction.", *sentences, f"report: {path}"]
    first = path.read_bytes()
    path.unlink()
    again = stages.report(config, Silent(), stubs())
    assert (again["ok"], again["page"]) == (True, str(path))
    assert path.read_bytes() == first


def test_a_diagnosis_ends_with_its_page_also_without_a_configuration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    time_s = np.arange(0.0, 60.0, 0.1)
    u_m = np.interp(time_s, [0.0, 5.0, 9.0, 30.0, 34.0, 60.0], [0.0, 0.0, 3e-3, 3e-3, 6e-3, 6e-3])
    storage.save(tmp_path / "arm.h5", Recording(time_s, u_m, 30.0 * u_m, "arm", "0" * 64))
    own = {name: stage for name, stage in stubs().items() if name in ("recording", "diagnose")}
    monkeypatch.setattr(diagnosis, "stages_of", lambda config: own)
    said = diagnosing.diagnose([tmp_path / "arm.h5"], Silent())
    path = tmp_path / "arm-diagnosis" / page.FILE
    assert said["page"] == str(path)
    assert f"report: {path}" in said["text"]
    alone = path.read_text()
    assert '<h1 id="question">The model lacks device-friction</h1>' in alone
    assert "has not been run" not in alone
    # With a configuration, the page also has the stages that were run before.
    monkeypatch.setattr(stages, "stages_of", lambda config: stubs())
    config = configured(tmp_path)
    stages.run(config, None, Silent(), stubs())
    diagnosing.diagnose([config], Silent())
    both = (tmp_path / "case" / page.FILE).read_text()
    assert "The model lacks device-friction</h1>" in both
    assert 'id="sample-posterior"' in both


def test_report_runs_nothing_and_names_what_is_missing(tmp_path: Path) -> None:
    config = configured(tmp_path)
    said = stages.report(config, Silent(), stubs())
    assert (said["ok"], said["verdict"]) == (True, "not finished")
    assert said["missing"] == ["recording", "design", "train", "map", "sample", "sobol"]
    assert [path.name for path in (tmp_path / "case").iterdir()] == [page.FILE]
    stages.run(config, "train", Silent(), stubs())
    assert stages.report(config, Silent(), stubs())["missing"] == ["map", "sample", "sobol"]
    assert "Phases of the recording" in (tmp_path / "case" / page.FILE).read_text()


def test_a_changed_configuration_puts_what_was_made_before_it_out_of_date(tmp_path: Path) -> None:
    stages.run(configured(tmp_path), None, Silent(), stubs())
    text = stages.report(configured(tmp_path, seed=2), Silent(), stubs())["text"]
    assert "sample: out of date" in text
    shown = (tmp_path / "case" / page.FILE).read_text()
    assert "out of date" in shown
    assert "50.8" not in shown  # nothing of the other configuration's answer


def test_a_run_that_fails_leaves_a_page_that_says_where(tmp_path: Path) -> None:
    said = stages.run(configured(tmp_path), None, Silent(), stubs(fails="train"))
    assert said["ok"] is False
    shown = (tmp_path / "case" / page.FILE).read_text()
    assert "The stage train failed: too few runs; narrow the prior box." in shown
    assert stages.report(tmp_path / "case.toml", Silent(), stubs(fails="train"))["ok"] is False


def test_a_summary_in_an_earlier_format_is_out_of_date_with_all_that_follows(tmp_path: Path) -> None:
    config, now = configured(tmp_path), stubs()
    stages.run(config, None, Silent(), now)
    now["sample"] = dataclasses.replace(now["sample"], format=2)
    assert stages.report(config, Silent(), now)["missing"] == ["sample", "sobol"]
    assert 'id="sample-fit"' not in (tmp_path / "case" / page.FILE).read_text()
    assert stages.run(config, None, Silent(), now)["skipped"] == ["recording", "design", "train", "map"]
    assert stages.report(config, Silent(), now)["ok"] is True
