"""The report that a run leaves behind, and that `report` makes again."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from toys.finished_run import HISTORY, drawing, summaries

from bayeskin.report.page.figures import FIGURES
from bayeskin.workflow import folder, page, stages
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
    again = stages.report(config, Silent(), stubs())
    assert (again["ok"], again["page"]) == (True, str(path))
    assert path.read_bytes() == first


def test_the_report_of_a_diagnosed_run_ends_with_where_what_and_how_much(tmp_path: Path) -> None:
    config = configured(tmp_path)
    assert "This was missing" not in stages.run(config, None, Silent(), stubs())["text"]
    run_stages(open_run(config, Silent()), stubs(), "diagnose")
    said = stages.report(config, Silent(), stubs())
    assert said["text"].splitlines()[-4:] == [
        "Recording and model differ in 1 window: rest. They differ most in the rest, from 0 to 9.5 s, where "
        "the recording lies 58.6 mN below the model on average.",
        "This was missing: device-friction (probability 0.98): The slide rubs: 60 mN.",
        "The RMSE is 80 mN without and 24.7 mN with device-friction, and the 90 % band holds 90 % of the "
        "recording without and 90 % with.",
        f"report: {said['page']}",
    ]


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
