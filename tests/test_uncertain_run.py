"""A run with uncertain lengths of the tissue: its parameters, what it says of them, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from bayeskin import cli, storage
from bayeskin.config import load_config, parameter_space
from bayeskin.design import default_space
from bayeskin.errors import InputError
from bayeskin.finite_element.simulate import ModelSpec, simulate
from bayeskin.forward.design_model import FullModel
from bayeskin.inference import due_to_lengths, identifiability
from bayeskin.report.style import axis_values, parameter_label
from bayeskin.shipped import shipped
from bayeskin.surrogates import Similarity
from bayeskin.types import PadMotion, Parameter, ParameterSpace, Recording
from bayeskin.workflow import stages
from bayeskin.workflow.engine import Silent, open_run, standing
from bayeskin.workflow.new import new_config

UNCERTAIN = "[tissue]\ncutis_mm = { mean = 2.0, sd = 0.2 }\narm_radius_mm = { mean = 48, sd = 8 }\n"
TRUE = {"E_c": 120e3, "E_s": 20e3, "k_c": 3e-14, "k_s": 3e-13, "p_init": 300.0}
MOTION = PadMotion(
    np.array([0.0, 5.0, 9.0, 25.0, 29.0, 40.0]), 1e-3 * np.array([0.0, 0.0, 5.0, 5.0, 0.0, 0.0])
)


def written(folder: Path, text: str) -> Path:
    (folder / "case.toml").write_text('[recording]\nfile = "skin.h5"\n' + text)
    return folder / "case.toml"


def recorded(folder: Path) -> None:
    """A recording that the coarsest full model made, on a cutis of 2.2 mm."""
    time_s = np.arange(0.0, 40.0, 0.1)
    run = simulate(ModelSpec(refinement=0), MOTION, TRUE | {"cutis_m": 2.2e-3})
    force_n = run.at(time_s) + 1e-2 * np.random.default_rng(1).standard_normal(len(time_s))
    storage.save(folder / "skin.h5", Recording(time_s, MOTION.at(time_s), force_n, "skin", "0" * 64))


def test_uncertain_lengths_are_parameters_with_normal_priors(tmp_path: Path) -> None:
    space = parameter_space(load_config(written(tmp_path, UNCERTAIN)))
    assert space.names == (*default_space().names, "cutis_m", "arm_radius_m")
    cutis, radius = space.parameters[-2:]
    assert (cutis.prior, cutis.centre, cutis.spread, cutis.unit) == ("normal", 2e-3, 0.2e-3, "m")
    assert (cutis.lower, cutis.upper) == pytest.approx((1.4e-3, 2.6e-3))
    assert radius.upper == pytest.approx(72e-3)
    assert radius.lower == pytest.approx(84e-3 / np.pi, rel=2e-3)  # below, the skin would meet itself
    assert Similarity(space).dim == space.dim - 1


def test_a_prior_of_a_length_can_be_stated(tmp_path: Path) -> None:
    prior = '[parameters.cutis_m]\nprior = "uniform"\nlower = 1e-3\nupper = 3e-3\n'
    cutis = parameter_space(load_config(written(tmp_path, UNCERTAIN + prior))).parameters[-2]
    assert (cutis.prior, cutis.lower, cutis.upper) == ("uniform", 1e-3, 3e-3)


@pytest.mark.parametrize(
    ("more", "says"),
    [
        (
            "[parameters.cutis_m]\nupper = 0.02\n",
            "parameters.cutis_m: its prior reaches from 1.4 to 20 mm, too far; it must be 0.3 to 10 mm",
        ),
        (
            "[parameters.arm_radius_m]\nlower = 0.02\n",
            "parameters.arm_radius_m: its prior reaches from 20 to 72 mm, too far; it must be at least",
        ),
        ("[parameters.subcutis_m]\nupper = 0.01\n", "parameters.subcutis_m: this parameter is not known"),
        (
            '[model]\nmesh = "skin.msh"\n',
            "tissue.cutis_mm: 'skin.msh' in [model] does not allow a mean and an sd",
        ),
        (
            '[model]\nmesh = "skin.msh"\nobservation = "article"\n',
            "'article' in [model] does not allow a mean and an sd",
        ),
        ('[model]\nforward = "own.py:force"\n', "'own' in [model] does not allow a mean and an sd"),
    ],
)
def test_what_cannot_be_uncertain_is_refused(tmp_path: Path, more: str, says: str) -> None:
    with pytest.raises(InputError) as refused:
        load_config(written(tmp_path, UNCERTAIN + more))
    assert says in str(refused.value)


def test_a_shipped_surrogate_knows_no_length(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "skin.h5").write_bytes(shipped("data/demo.h5").read_bytes())
    case = written(tmp_path, UNCERTAIN + '[surrogate]\nfile = "demo.h5"\n')
    with pytest.raises(SystemExit) as end:
        cli.main(["run", str(case)])
    assert end.value.code == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert "surrogate.file demo.h5: it has no parameter cutis_m" in last


def test_new_writes_a_configuration_that_runs(tmp_path: Path) -> None:
    (tmp_path / "skin.h5").write_bytes(shipped("data/demo.h5").read_bytes())
    (tmp_path / "device.toml").write_text(UNCERTAIN)
    new_config([tmp_path / "skin.h5"], tmp_path / "case.toml", tmp_path / "device.toml")
    run = open_run(tmp_path / "case.toml", Silent())
    assert run.config.surrogate.file is None
    assert run.config.design.coarse == "reduced"
    assert parameter_space(run.config).names[-2:] == ("cutis_m", "arm_radius_m")


def test_the_share_of_a_variance_is_that_of_the_regression() -> None:
    rng = np.random.default_rng(0)
    moduli = tuple(p for p in default_space().parameters if p.name in ("E_c", "E_s", "k_c"))
    length = Parameter(
        "cutis_m", "m", 1e-3, 3e-3, "normal", "thickness of the cutis", centre=2e-3, spread=2e-4
    )
    space = ParameterSpace((*moduli, length))
    z = rng.standard_normal((4, 200_000))
    draws = np.exp([11.0 - 0.3 * z[0] + 0.4 * z[1], 10.0 + 0.1 * z[2], -30.0 + 0.1 * z[3], 0.0 * z[0]]).T
    draws[:, 3] = 2e-3 + 2e-4 * z[0]
    shares = due_to_lengths(space, draws)
    assert [parameter.name for parameter in shares] == ["E_c", "E_s"]  # of k_c nothing notable
    assert shares[0].share == pytest.approx(0.36, abs=0.01)
    assert shares[1].share == pytest.approx(0.0, abs=1e-3)
    assert shares[0].sentence == (
        "The uncertain thickness of the cutis explains 36 % of the posterior variance of log E_c."
    )
    assert "less than 1 %" in shares[1].sentence
    assert due_to_lengths(ParameterSpace(moduli), draws[:, :3]) == ()


def test_lengths_are_shown_in_millimetres() -> None:
    length = Parameter("arm_radius_m", "m", 40e-3, 56e-3, "normal", "radius", centre=48e-3, spread=3e-3)
    assert parameter_label(length) == "arm radius\n[mm]"
    np.testing.assert_allclose(axis_values(length, [48e-3]), [48.0])
    draws = np.random.default_rng(0).uniform(47e-3, 49e-3, (4000, 1))
    (said,) = identifiability(ParameterSpace((length,)), draws).parameters
    assert "median 48 mm, 90 % interval 47.1 to 48.9 mm" in said.statement
    assert "about 48 mm" in said.sentence
    assert said.quantiles[1] == pytest.approx(48e-3, rel=1e-2)


def test_a_design_s_model_moves_the_nodes() -> None:
    model = FullModel(ModelSpec(refinement=0))
    thin, thick = (model(MOTION, TRUE | {"cutis_m": cutis_m}) for cutis_m in (1.6e-3, 2.4e-3))
    assert thick.force_n.max() > 1.1 * thin.force_n.max()


@pytest.mark.slow
def test_a_run_infers_a_thickness(tmp_path: Path) -> None:
    recorded(tmp_path)
    settings = (
        "[tissue]\ncutis_mm = { mean = 2.0, sd = 0.2 }\n[model]\nrefinement = 0\n"
        "[parameters.E_s]\nlower = 15e3\nupper = 25e3\n[parameters.k_c]\nlower = 1e-14\nupper = 1e-13\n"
        "[parameters.k_s]\nlower = 1e-13\nupper = 1e-12\n"
        "[design]\npoints = [60, 30]\nheld_out = 10\nworkers = 1\n[map]\nstarts = 2\nevaluations = 2000\n"
        "[sample]\nensembles = 2\neffective_samples = 400\nmax_steps = 600\n"
        "[check]\ndraws = 8\n[sobol]\nsamples = 64\n"
    )
    said = stages.run(written(tmp_path, settings), None, Silent())
    cutis = said["posterior"]["cutis_m"]
    assert 1.4e-3 < cutis["low_90"] < cutis["median"] < cutis["high_90"] < 2.6e-3
    assert said["lengths"]["E_c"]["share"] > 0.2
    assert said["lengths"]["E_c"]["sentence"] in said["text"]
    assert said["map"]["polished"]["full_runs"] >= 1
    assert "cutis_m" in said["sobol"]["prior_gp"]["aggregated"]
    page = Path(said["page"]).read_text()
    assert "of the posterior variance of log" in page
    assert json.loads((tmp_path / "case" / "summary.json").read_text())["lengths"] == said["lengths"]
    case = written(tmp_path, settings.replace("sd = 0.2", "sd = 0.3"))
    stands = {name: stand for name, (stand, _) in standing(open_run(case, Silent()), stages.STAGES).items()}
    assert stands["recording"] == "done"
    assert {stands[name] for name in ("design", "map", "sample", "report")} == {"out of date"}
