"""InferenceData of a posterior: what it holds, that ArviZ works on it, and its file."""

import dataclasses
import json
from pathlib import Path

import arviz as az
import matplotlib as mpl
import numpy as np
import pytest
from toys.inference_problems import NOISE, TRUTH, around_truth, toy_problem

from bayeskin.errors import InputError
from bayeskin.inference import (
    Convergence,
    Posterior,
    Verdict,
    draws_of,
    load_inference_data,
    save_inference_data,
    to_inference_data,
)
from bayeskin.inference.inference_data import posterior_attributes
from bayeskin.types import Correlation, ParameterSpace, Provenance

mpl.use("Agg")


def some_posterior(n: int = 120) -> Posterior:
    problem = toy_problem()
    draws = around_truth(2 * n, 0.02).reshape(2, n, -1)
    log_prob = problem.log_prob(problem.to_sampling(draws.reshape(2 * n, -1))).reshape(2, n)
    dim = problem.dim
    convergence = Convergence(
        500, 100, 4, np.full((2, dim), 4.0), np.full(dim, 200.0), np.ones(dim), np.full(2, 0.3), (),
        Verdict(False, ("200 effective samples of E_c; 5000 needed",)),
    )  # fmt: skip
    return Posterior(problem.space, draws, log_prob, convergence, 3)


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> tuple[Posterior, az.InferenceData]:
    problem, posterior = toy_problem(), some_posterior()
    idata = to_inference_data(
        problem, posterior, Provenance("1.2", recording_sha256="abc"), np.random.default_rng(0), 100
    )
    path = tmp_path_factory.mktemp("nc") / "posterior.nc"
    save_inference_data(path, idata)
    assert [p.name for p in path.parent.iterdir()] == ["posterior.nc"]
    return posterior, load_inference_data(path)


def test_inference_data_survives_its_file(stored: tuple[Posterior, az.InferenceData]) -> None:
    posterior, idata = stored
    space, draws = draws_of(idata)
    assert space == posterior.space
    tied = ParameterSpace(
        tuple(dataclasses.replace(p, prior="normal", centre=p.lower) for p in space.parameters[:2]),
        (Correlation(*space.names[:2], 0.5),),
    )
    c = posterior.convergence
    c = dataclasses.replace(c, ess=c.ess[:2], rhat=c.rhat[:2], tau_steps=c.tau_steps[:, :2])
    attributes = posterior_attributes(
        dataclasses.replace(posterior, space=tied, convergence=c), Provenance("1")
    )
    assert draws_of(az.InferenceData(posterior=idata.posterior, attrs=attributes))[0] == tied
    assert np.array_equal(draws, posterior.flat)
    assert {"sample_stats", "log_likelihood", "posterior_predictive", "prior", "observed_data",
            "constant_data"} <= set(idata.groups())  # fmt: skip
    assert idata.posterior["E_c"].attrs["units"] == "Pa"
    assert idata.sample_stats["lp"].values == pytest.approx(posterior.log_prob)
    assert idata.posterior_predictive["force"].shape == (2, 50, 130)
    assert idata.attrs["recording_sha256"] == "abc"
    assert int(idata.attrs["trusted"]) == 0
    assert json.loads(idata.attrs["verdict"]) == ["200 effective samples of E_c; 5000 needed"]
    assert list(idata.log_likelihood["phase"].values[:3]) == ["rest 0", "load 1", "hold 1"]


def test_arviz_works_on_it(stored: tuple[Posterior, az.InferenceData]) -> None:
    _, idata = stored
    table = az.summary(idata)
    assert set(table.index) == {*TRUTH, *NOISE}
    loo = az.loo(idata)
    assert loo.n_data_points == 9
    assert np.isfinite(loo.elpd_loo)
    assert az.plot_trace(idata, var_names=["E_c", "sd_hold"]).shape == (2, 2)
    az.plot_ppc(idata, num_pp_samples=5)


def test_a_broken_write_leaves_the_earlier_file(
    tmp_path: Path, stored: tuple[Posterior, az.InferenceData], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "posterior.nc"
    path.write_bytes(b"earlier")

    def broken(self: az.InferenceData, filename: str, **_: object) -> None:
        Path(filename).write_bytes(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(az.InferenceData, "to_netcdf", broken)
    with pytest.raises(OSError, match="disk full"):
        save_inference_data(path, stored[1])
    assert path.read_bytes() == b"earlier"
    assert [p.name for p in tmp_path.iterdir()] == ["posterior.nc"]
    for bad in (path, tmp_path / "none.nc"):
        with pytest.raises(InputError):
            load_inference_data(bad)
