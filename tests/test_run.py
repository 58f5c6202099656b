"""A whole run on a recording of the toy: every stage does its part, goes on, and is skipped when done."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from html import unescape
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from toys import stand_in_model
from toys.closed_form_model import MOTION, SPACE, toy_force
from toys.coarse_proposals import propose_coarsely

from bayeskin import inference, report, storage
from bayeskin.design_files import load_design
from bayeskin.errors import InputError
from bayeskin.execution.local import here
from bayeskin.inference import Convergence, LogPosterior, Posterior, Verdict, load_inference_data
from bayeskin.number_format import interval
from bayeskin.report.page.prose import prose
from bayeskin.types import Design, PadMotion, Recording, Simulation
from bayeskin.workflow import executor, maximum, model, stages, waves
from bayeskin.workflow.calibration import refined_posterior
from bayeskin.workflow.checking import checked_posterior, with_full_model
from bayeskin.workflow.engine import Silent, open_run
from bayeskin.workflow.exporting import export
from bayeskin.workflow.indices import nearby

TRUE = {"E_c": 200e3, "E_s": 30e3, "k_c": 1e-14, "k_s": 1e-13, "p_init": 300.0}
CONFIG = """
[recording]
file = "measured.h5"
[fit]
bin_width_s = 1.0
windows_s = [[0.0, 75.0]]
[design]
points = [24, 12]
held_out = 6
workers = 1
[sample]
ensembles = 2
walkers = 24
max_steps = {steps}
effective_samples = 100
[check]
draws = 8
[map]
starts = 1
evaluations = 400
[sobol]
samples = 64
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the run was interrupted at the full model's check, and then finished."""
    where = tmp_path_factory.mktemp("toy")
    time_s = np.arange(0.0, 130.001, 0.1)
    force_n = stand_in_model.SCALE * toy_force(np.array([list(TRUE.values())]), time_s)[0]
    noise_n = 0.003 * np.random.default_rng(5).standard_normal(len(time_s))
    recording = Recording(time_s, MOTION.at(time_s), force_n + noise_n, "toy", "0" * 64)
    storage.save(where / "measured.h5", recording)
    (where / "case.toml").write_text(CONFIG.format(steps=500))

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    def drawn(figure: object, stem: Path, provenance: str) -> None:
        stem.with_suffix(".png").write_text(provenance)
        stem.with_suffix(".svg").write_text('<svg xmlns="http://www.w3.org/2000/svg"/>')

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report, "save_figure", drawn)  # rendering is most of a small run's time
        propose_coarsely(patch)
        patch.setattr(inference, "profiles", partial(inference.profiles, points=3))
        patch.setattr(model, "FullModel", stand_in_model.ToyModel)
        patch.setattr(executor, "local", lambda workers: here)  # starts no process
        patch.setattr(maximum, "simulate", interrupted)
        with pytest.raises(KeyboardInterrupt):
            stages.run(where / "case.toml", None, Silent())
        patch.setattr(maximum, "simulate", stand_in_model.simulate)
        patch.setattr(waves, "run_wave", interrupted)  # must not be needed again
        answer = stages.run(where / "case.toml", None, Silent())
    (where / "answer.json").write_text(json.dumps(answer, allow_nan=False))
    return where


def test_an_interrupted_run_goes_on_without_repeating_what_was_done(folder: Path) -> None:
    answer = json.loads((folder / "answer.json").read_text())
    assert answer["skipped"] == ["recording", "design", "train"]
    again = stages.run(folder / "case.toml", None, Silent())
    assert again["skipped"] == [*(stage.name for stage in stages.BEFORE_REPORT), "report"]
    assert again["posterior"] == answer["posterior"]


def test_the_summary_answers_what_a_reader_asks(folder: Path) -> None:
    summary = json.loads((folder / "case" / "summary.json").read_text())
    assert list(summary["posterior"])[:5] == list(SPACE.names)
    for name, row in summary["posterior"].items():
        assert row["low_90"] < row["median"] < row["high_90"], name
    assert summary["verdict"] == "not trusted"  # 500 steps cannot be enough, and it says so
    reasons = json.loads((folder / "case" / "sample" / "stage.json").read_text())["summary"]["reasons"]
    assert any("needed" in reason for reason in reasons)
    assert summary["because"][-1] == reasons[0]
    assert summary["rmse"]["full_model_at_map"]["fitted_n"] > 0
    assert summary["rmse"]["full_model_at_map"]["not_fitted_n"] > 0
    assert summary["rmse"]["full_model_at_map"]["article_holds_n"] is None  # the toy ends before
    assert [line.split(":")[0] for line in summary["identifiability"]][:5] == list(SPACE.names)
    assert set(summary["seconds"]) == {stage.name for stage in stages.BEFORE_REPORT}
    shares = summary["sobol"].pop("posterior")["shares"]
    assert sum(part["share"] for part in shares.values()) == pytest.approx(1.0)
    for table in summary["sobol"].values():
        assert "uniform" in table["distribution"]
        stiff = [table["aggregated"][name]["total"] for name in ("E_c", "E_s")]
        assert max(stiff) > 0.1  # near the maximum either, wherever on their ridge that lies
        assert len(table["pairs"]) == 10


def test_priors_with_their_sources_and_what_the_data_says_are_printed(folder: Path) -> None:
    summary = json.loads((folder / "case" / "summary.json").read_text())
    for stage in (None, "sample"):
        text = stages.run(folder / "case.toml", stage, Silent())["text"]
        for name, parameter in summary["posterior"].items():
            prior = parameter["prior"]
            bounds = interval(prior["lower"], prior["upper"], parameter["unit"])
            assert f"  {name}: {prior['kind']}, {bounds}; {prior['source']}" in text
        assert [line for line in summary["identifiability"] if f"  {line}" not in text] == []
    assert set(summary["profiles"]) == set(SPACE.names)


def test_what_the_fit_leaves_is_tested_and_said(folder: Path) -> None:
    said = json.loads((folder / "case" / "sample" / "stage.json").read_text())["summary"]
    residuals = said["residuals"]
    assert sum(kind["bins"] for kind in residuals["by_kind"].values()) == 75  # those fitted
    assert residuals["passes"] == (residuals["sentence"] not in said["remarks"])
    shown = (folder / "case" / "report.html").read_text()
    assert str(prose(residuals["sentence"])) in shown
    assert len(residuals["autocorrelation"]) == 10


def test_the_design_holds_each_wave_with_its_labels(folder: Path) -> None:
    stored = load_design(folder / "case" / "design" / "design.h5")
    training, testing = stored.training, stored.testing
    assert [int((training & (stored.wave == w)).sum()) for w in (0, 1)] == [24, 12]
    assert [int((testing & (stored.wave == w)).sum()) for w in (0, 1)] == [6, 6]
    records = json.loads((folder / "case" / "design" / "waves.json").read_text())
    assert records[1]["kept_fraction"] < records[0]["kept_fraction"] == 1.0


def model_check(folder: Path) -> list[str]:
    """The figure of the full model at draws, where more than one of them carries weight."""
    said = json.loads((folder / "case" / "sample" / "stage.json").read_text())["summary"]
    return [] if said["corrected"] is None else ["model_check"]


def test_each_stage_draws_its_figures_and_says_where_they_come_from(folder: Path) -> None:
    expected = {
        "recording": ["recording"],
        "design": ["waves"],
        "train": ["validation", "prior_predictive"],
        "map": ["map_check"],
        "sample": [
            *("posterior", "posterior_noise", "fit", "traces", "profiles", "residuals"),
            *model_check(folder),
        ],
        "sobol": ["sobol_prior_gp", "sobol_prior_chaos", "sobol_near_map"],
    }
    for stage, names in expected.items():
        for name in names:
            assert "bayeskin 0" in (folder / "case" / stage / f"{name}.png").read_text()


def test_the_page_shows_the_whole_run(folder: Path) -> None:
    shown = (folder / "case" / "report.html").read_text()
    drawn = [path.stem for path in (folder / "case").rglob("*.svg")]
    assert len(drawn) == 14 + len(model_check(folder))
    for name in drawn:
        assert f'-{name}"'.replace("_", "-") in shown, name
    for parameter in SPACE.parameters:
        assert parameter.description in unescape(shown)
    assert "not trusted" in shown
    assert "The stage diagnose has not been run." in shown
    charts = [json.loads(part.split("</script>")[0]) for part in shown.split('type="application/json">')[1:]]
    said = charts[0]["says"]
    assert len(charts) == 5  # force, residual, Sobol' indices
    assert len(said) == 130
    assert sum("not fitted" not in line for line in said) == 75


def test_the_posterior_is_an_inference_data_with_its_origin(folder: Path) -> None:
    idata = load_inference_data(folder / "case" / "sample" / "posterior.nc")
    assert {"posterior", "log_likelihood", "posterior_predictive", "observed_data"} <= set(idata.groups())
    assert idata.attrs["recording_sha256"] == "0" * 64
    assert idata["constant_data"]["fitted"].values.sum() == 75


def test_the_full_model_weighs_draws_of_the_posterior(folder: Path) -> None:
    said = json.loads((folder / "case" / "sample" / "stage.json").read_text())["summary"]
    assert len(said["full_model"]) == 1  # chains that have not converged add nothing to the design
    point = said["full_model"][0]
    assert (point["draws"], point["failed"]) == (8, 0)
    assert point["message"] in said["reasons"]
    assert point["effective"] >= 1.0
    assert said["corrected"] is None or set(said["corrected"]) == set(said["parameters"])


@dataclass(frozen=True)
class Steeper(stand_in_model.ToyModel):
    """The toy whose force depends more on E_c."""

    about_pa: float
    power: float

    def __call__(self, motion: PadMotion, theta: Mapping[str, float]) -> Simulation:
        run = super().__call__(motion, theta)
        return dataclasses.replace(run, force_n=(theta["E_c"] / self.about_pa) ** self.power * run.force_n)


@pytest.mark.parametrize(("power", "rounds"), [(0.0, 1), (300.0, 3)])
def test_draws_join_the_design_where_the_full_model_is_elsewhere(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, power: float, rounds: int
) -> None:
    shutil.copytree(folder, tmp_path / "run")
    run = open_run(tmp_path / "run" / "case.toml", Silent())
    shutil.rmtree(run.folder / "finished")  # of the model as it was
    problem, asked = refined_posterior(run), []
    theta = run.summary("map")["theta"]
    monkeypatch.setattr(model, "FullModel", partial(Steeper, about_pa=theta["E_c"], power=power))
    monkeypatch.setattr(executor, "local", lambda workers: here)
    large = {
        name: 0.05 for name in problem.names if name.startswith("sd_")
    }  # beside the toy surrogate's error
    best = problem.vector({**theta, **large, "tau_noise": 1.0})
    noise = np.random.default_rng(1).standard_normal((400, problem.dim))
    low, high = problem.bounds
    near = problem.from_sampling(np.clip(best + 1e-4 * (high - low) * noise, low, high))
    trusted = dataclasses.replace(settled(problem.dim), verdict=Verdict(True, ("yes",)))

    def draws_of(log_posterior: LogPosterior) -> Posterior:
        asked.append(log_posterior.surrogate)
        return Posterior(problem.space, near.reshape(2, 200, -1), np.zeros((2, 200)), trusted, 1)

    checked = checked_posterior(run, problem, draws_of)
    before = storage.load(run.at("map", "design.h5"), Design)
    assert len(checked.rounds) == len(asked) == rounds
    assert checked.log_posterior.surrogate is asked[-1]
    assert run.at("sample", "surrogate.h5").is_file() == (rounds > 1)
    if rounds > 1:
        after = storage.load(run.at("sample", "design.h5"), Design)
        assert len(after.theta) == len(before.theta) + 8 * (rounds - 1)
        assert not with_full_model(Verdict(True, ()), checked).trusted


def settled(dim: int) -> Convergence:
    """A convergence whose numbers nobody asks for."""
    each = np.ones(dim)
    return Convergence(400, 100, 1, np.ones((2, dim)), each, each, np.ones(2), (), Verdict(True, ()))


def test_longer_sampling_repeats_no_stage_before_it_and_keeps_the_chains(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(report, "save_figure", lambda *arguments: None)
    propose_coarsely(monkeypatch)
    monkeypatch.setattr(inference, "profiles", partial(inference.profiles, points=3))
    monkeypatch.setattr(model, "FullModel", stand_in_model.ToyModel)
    monkeypatch.setattr(executor, "local", lambda workers: here)  # starts no process
    chains = list((folder / "case" / "chains").iterdir())
    (folder / "case.toml").write_text(CONFIG.format(steps=600))
    answer = stages.run(folder / "case.toml", "sample", Silent())
    assert answer["skipped"] == ["recording", "design", "train", "map"]
    assert answer["steps"] == 600
    # Chains that have converged may send the surrogate back to training; what it then samples is added.
    assert set(chains) <= set((folder / "case" / "chains").iterdir())


def test_nearby_is_a_tenth_either_way_inside_the_prior() -> None:
    near = nearby(SPACE, {"E_c": 2e6, "E_s": 1e4, "k_c": 1e-16, "k_s": 1e-13, "p_init": 0.0})
    np.testing.assert_allclose(near.lower[:4], [1.8e6, 0.9e4, 1e-16, 0.9e-13])
    np.testing.assert_allclose(near.upper[:4], [2e6, 1.1e4, 1.1e-16, 1.1e-13])
    assert np.all(near.lower < near.upper)
    assert SPACE.contains([near.lower, near.upper]).all()
    wide = dataclasses.replace(SPACE.parameters[2], upper=1e-8)
    wider = dataclasses.replace(SPACE, parameters=(*SPACE.parameters[:2], wide, *SPACE.parameters[3:]))
    there = nearby(wider, {"E_c": 2e6, "E_s": 1e4, "k_c": 2e-16, "k_s": 1e-13, "p_init": 0.0})
    np.testing.assert_allclose([there.lower[2], there.upper[2]], [1.8e-16, 2.2e-16])
    narrow = dataclasses.replace(SPACE.parameters[0], lower=600e3, upper=650e3)
    space = dataclasses.replace(SPACE, parameters=(narrow, *SPACE.parameters[1:]))
    at = {"E_c": 620e3, "E_s": 1e4, "k_c": 1e-16, "k_s": 1e-13, "p_init": 0.0}
    inside = nearby(space, at)
    assert (inside.lower[0], inside.upper[0]) == (600e3, 650e3)
    for bound in (600e3, 650e3):
        at_bound = nearby(space, {**at, "E_c": bound})
        assert space.contains([at_bound.lower, at_bound.upper]).all()
        assert at_bound.lower[0] < at_bound.upper[0]


def test_a_posterior_is_exported_as_a_table_of_its_draws(folder: Path, tmp_path: Path) -> None:
    answer = export(folder / "case.toml", tmp_path / "draws.csv", Silent())
    header = (tmp_path / "draws.csv").read_text().splitlines()[0].split(",")
    table = np.loadtxt(tmp_path / "draws.csv", delimiter=",", skiprows=1)
    posterior = load_inference_data(folder / "case" / "sample" / "posterior.nc")["posterior"]
    assert header[:2] == ["E_c [Pa]", "E_s [Pa]"]
    assert len(table) == answer["draws"]
    for column, name in zip(table.T, answer["parameters"], strict=True):
        np.testing.assert_array_equal(column, posterior[name].values.ravel())


def test_an_exported_normal_has_the_moments_of_the_draws(folder: Path, tmp_path: Path) -> None:
    export(folder / "case.toml", tmp_path / "normal.json", Silent())
    normal = json.loads((tmp_path / "normal.json").read_text())
    posterior = load_inference_data(folder / "case" / "sample" / "posterior.nc")["posterior"]
    values = []
    for parameter in normal["parameters"]:
        draws = posterior[parameter["name"]].values.ravel()
        assert parameter["median"] == pytest.approx(np.median(draws))
        values.append(np.log(draws) if parameter["normal_in"] == "logarithm" else draws)
        assert parameter["mean"] == pytest.approx(values[-1].mean())
    np.testing.assert_allclose(normal["covariance"], np.cov(values), rtol=1e-10)
    by_name = {parameter["name"]: parameter["normal_in"] for parameter in normal["parameters"]}
    assert (by_name["E_c"], by_name["p_init"]) == ("logarithm", "value")


def test_exported_materials_have_the_medians_in_febio_s_terms(folder: Path, tmp_path: Path) -> None:
    export(folder / "case.toml", tmp_path / "skin.feb", Silent())
    spec = ElementTree.parse(tmp_path / "skin.feb").getroot()
    posterior = load_inference_data(folder / "case" / "sample" / "posterior.nc")["posterior"]
    for layer, letter, solid_share, ratio in (("cutis", "c", 0.8, 0.48), ("subcutis", "s", 0.6, 0.3)):
        material = spec.find(f"./Material/material[@name='{layer}']")
        assert material is not None
        said = [material.findtext(path) for path in ("phi0", "solid/E", "solid/v", "permeability/perm")]
        median = {name: float(np.median(posterior[name])) for name in (f"E_{letter}", f"k_{letter}")}
        expected = [solid_share, median[f"E_{letter}"], ratio, median[f"k_{letter}"] / 5e-3]
        np.testing.assert_allclose([float(text or "nan") for text in said], expected, rtol=1e-9)


def test_a_posterior_that_is_not_there_is_not_exported(folder: Path, tmp_path: Path) -> None:
    shutil.copy(folder / "measured.h5", tmp_path)
    shutil.copy(folder / "case.toml", tmp_path)
    with pytest.raises(InputError, match="not run"):
        export(tmp_path / "case.toml", tmp_path / "skin.feb", Silent())
    with pytest.raises(InputError, match="ending"):
        export(folder / "case.toml", tmp_path / "skin.xml", Silent())
    assert not list(tmp_path.glob("skin.*"))
