"""A new device is prepared through the page: the reduced model is built, stopped, finished, and used."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from toys.app_page import DEVICE, Visitor, served, until
from toys.laboratory_exports import NUMBERS
from toys.laboratory_files import text

from bayeskin.app import jobs
from bayeskin.app.jobs import State
from bayeskin.reduced.files import load_reduced

# Every process of a job begins with this: a model of few runs on 80 bricks, with one mechanism.
SMALL = """
import dataclasses
from bayeskin.reduced.build import BuildSettings
from bayeskin.reduced.cases import Protocols
from bayeskin.types import ParameterSpace
from bayeskin.workflow import reducing

sizes = dict(base_runs=3, runs=3, first_base_runs=2, first_runs=2, base=(10, 8), each=(4, 3),
             base_points=60, set_points=90, base_shadows=2, set_shadows=2, first_base_shadows=2)
whole = reducing.trained_for

def small(geometry):
    trained = whole(geometry)
    base = tuple(dataclasses.replace(p, **{"E_c": {"lower": 50e3}, "E_s": {"upper": 100e3}}.get(p.name, {}))
                 for p in trained.base.parameters)
    kept = {"solid-viscoelasticity": trained.mechanisms["solid-viscoelasticity"]}
    return dataclasses.replace(trained, base=ParameterSpace(base), mechanisms=kept,
                               protocols=Protocols(holds_s=(2.0, 20.0)))

reducing.trained_for, reducing.REFINEMENT = small, 0
reducing.BuildSettings = lambda: BuildSettings(**sizes)
"""
CSV = text([["time (s)", "displacement (mm)", "force (N)"], *NUMBERS], ";")


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets the commands of jobs build small models."""
    (tmp_path / "start").mkdir()
    (tmp_path / "start" / "sitecustomize.py").write_text(SMALL)
    paths = [str(tmp_path / "start"), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, paths)))


@pytest.mark.slow
@pytest.mark.usefixtures("small")
def test_a_device_is_prepared_stopped_and_finished_and_then_serves_both_questions(tmp_path: Path) -> None:
    with served(tmp_path / "recordings") as page:
        owner = Visitor(page)
        owner.enter()
        assert owner.drop("arm.csv", CSV).status == 200
        folder, at = page.folder / "arm", "/recordings/arm"
        assert owner.fill(f"{at}/device", **{**DEVICE, "cutis_sd": ""}).status == 303
        shown = owner.ask("GET", at).text
        assert "Prepare this device" in shown
        assert f"{at}/ask/missing" not in shown
        model = folder / "device-reduced.h5"
        assert owner.fill(f"{at}/ask/prepare").status == 303
        until(lambda: "<progress" in owner.ask("GET", f"{at}/job").text, 100.0)
        until(model.is_file, 300.0)
        assert owner.fill(f"{at}/stop").status == 303
        until(lambda: jobs.job_of(folder / "job").state is State.STOPPED, 60.0)
        shown = owner.ask("GET", at).text
        assert f"{at}/ask/missing" in shown  # a first model can be used
        assert f"{at}/ask/prepare" in shown  # and a better one be built
        assert owner.fill(f"{at}/ask/prepare").status == 303
        until(lambda: not jobs.job_of(folder / "job").running, 300.0)
        job = jobs.job_of(folder / "job")
        assert job.state is State.DONE, "\n".join(job.lines)
        assert list(load_reduced(model).trained.mechanisms) == ["solid-viscoelasticity"]
        assert not (folder / "device-reduced-training").exists()
        shown = owner.ask("GET", at).text
        assert f"{at}/ask/missing" in shown
        assert f"{at}/ask/prepare" not in shown
