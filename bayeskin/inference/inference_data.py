"""Converts a posterior to an ArviZ InferenceData, and writes and reads its NetCDF file."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bayeskin.errors import InputError
from bayeskin.inference.bands import predictive_draws
from bayeskin.inference.problem import LogPosterior
from bayeskin.inference.sample import Posterior
from bayeskin.probe import refuse_damaged
from bayeskin.storage import checked, in_a_line, write_bytes
from bayeskin.types import Array, Correlation, Parameter, ParameterSpace, Provenance

if TYPE_CHECKING:
    import arviz

_PRIOR_DRAWS = 2000
_ENGINE = "h5netcdf"
_MEMORY = "/dev/shm"  # folder in memory on Linux


def to_inference_data(
    log_posterior: LogPosterior,
    posterior: Posterior,
    provenance: Provenance,
    rng: np.random.Generator,
    predictive: int = 1000,
) -> arviz.InferenceData:
    """Returns the posterior in SI as an InferenceData, in which each ensemble is a chain.

    It also holds lp, the log-likelihood by phase, predictions, prior draws, data and attributes. `predictive`
    draws, taken evenly from all ensembles, go into posterior_predictive: `force` with noise, its `mean`
    without noise, and `surrogate_sd` [N], the sd of the surrogate's own error. The log-likelihood is that of
    `LogPosterior.block_log_likelihood`, so that az.loo leaves out one phase at a time. Groups differ in
    their number of draws, which ArviZ allows.
    """
    import arviz as az  # imported here, because the import takes seconds and is rarely needed

    space, (ensembles, n, _) = posterior.space, posterior.draws.shape
    prior = space.draw(rng, _PRIOR_DRAWS)
    constant = _constant(log_posterior)
    idata = az.from_dict(
        posterior={name: posterior.draws[..., j] for j, name in enumerate(space.names)},
        sample_stats={"lp": posterior.log_prob},
        log_likelihood={
            "phases": log_posterior.block_log_likelihood(posterior.flat).reshape(ensembles, n, -1)
        },
        posterior_predictive=_predictive(log_posterior, posterior, predictive, rng),
        prior={name: prior[None, :, j] for j, name in enumerate(space.names)},
        observed_data={"force": log_posterior.binned.force_n},
        constant_data=constant,
        coords={"time": log_posterior.binned.time_s, "phase": _labels(log_posterior)},
        dims={"phases": ["phase"], **{k: ["time"] for k in ("force", "mean", "surrogate_sd", *constant)}},
        attrs=posterior_attributes(posterior, provenance),
    )
    for group in ("posterior", "prior"):
        for p in space.parameters:
            idata[group][p.name].attrs = {"units": p.unit, "long_name": p.description}
    return idata


def save_inference_data(path: Path | str, idata: arviz.InferenceData) -> None:
    """Writes a NetCDF file (h5netcdf), completely or not at all; an earlier file stays until then.

    The file is first made in another folder, in memory where the system has one, because libhdf5 ends the
    process on a full disk. Raises InputError where the file cannot be written.
    """
    needed = 2 * sum(idata[group].nbytes for group in idata.groups())
    roomy = os.path.isdir(_MEMORY) and shutil.disk_usage(_MEMORY).free > needed
    with tempfile.TemporaryDirectory(dir=_MEMORY if roomy else None) as folder:
        temporary = Path(folder) / "posterior.nc"
        idata.to_netcdf(str(temporary), engine=_ENGINE)
        write_bytes(Path(path), temporary.read_bytes())


def load_inference_data(path: Path | str) -> arviz.InferenceData:
    """Returns the InferenceData that `save_inference_data` wrote.

    Raises InputError when the file is absent or is not a NetCDF file of ArviZ.
    """
    import arviz as az

    path, expected = Path(path), "a posterior in a NetCDF file"
    refuse_damaged(path, expected)
    try:
        idata = az.from_netcdf(str(path), engine=_ENGINE)
    except Exception as error:  # h5netcdf and xarray raise many kinds of error on a damaged file
        raise InputError(
            path, f"this file cannot be read ({in_a_line(error)})", f"bayeskin needs {expected}"
        ) from None
    if "posterior" not in idata.groups():
        raise InputError(
            path,
            f"it contains {', '.join(idata.groups()) or 'nothing'}, and no group 'posterior'",
            f"bayeskin needs {expected}",
        )
    return idata


def draws_of(idata: arviz.InferenceData) -> tuple[ParameterSpace, Array]:
    """Returns the priors and the draws (s, D) in SI of an InferenceData that `to_inference_data` made.

    Raises InputError for an InferenceData of another origin, or where its parts do not belong together.
    """
    where, remedy = "InferenceData", "use InferenceData that bayeskin made"
    stored = idata.attrs.get("parameters")
    if stored is None:
        raise InputError(where, "it has no attribute 'parameters'", remedy)
    try:
        tied = tuple(Correlation(*entry) for entry in json.loads(idata.attrs.get("correlations", "[]")))
        parameters = tuple(checked(Parameter(**entry), where) for entry in json.loads(stored))
        space = checked(ParameterSpace(parameters, tied), where)
        draws = np.stack([idata["posterior"][name].values.ravel() for name in space.names], axis=-1)
    except InputError:
        raise
    except Exception as error:  # json, xarray and numpy raise many kinds of error on altered contents
        raise InputError(where, f"its contents cannot be read ({in_a_line(error)})", remedy) from None
    if draws.dtype.kind != "f" or not np.isfinite(draws).all():
        raise InputError(f"{where}: posterior", "some draws are not finite numbers", remedy)
    return space, draws


def _predictive(
    log_posterior: LogPosterior, posterior: Posterior, wanted: int, rng: np.random.Generator
) -> dict[str, Array]:
    ensembles, n, dim = posterior.draws.shape
    per_ensemble = min(n, max(1, wanted // ensembles))
    theta = posterior.draws[:, np.linspace(0, n - 1, per_ensemble).astype(int)].reshape(-1, dim)
    draws = predictive_draws(log_posterior, theta, rng)
    columns = {"force": draws.force_n, "mean": draws.mean_n, "surrogate_sd": draws.surrogate_sd_n}
    return {name: value.reshape(ensembles, per_ensemble, -1) for name, value in columns.items()}


def _constant(log_posterior: LogPosterior) -> dict[str, Any]:
    binned = log_posterior.binned
    fitted = np.zeros(len(binned.force_n), dtype=np.int8)
    fitted[log_posterior.chain.bins] = 1
    return {
        "bin_start": binned.edges_s[:-1],
        "bin_end": binned.edges_s[1:],
        "variance": binned.variance_n2,
        "phase_index": binned.phase,
        "fitted": fitted,
    }


def _labels(log_posterior: LogPosterior) -> list[str]:
    phases = [log_posterior.binned.phases[b] for b in log_posterior.blocks]
    names = [f"{p.kind} {p.cycle}" for p in phases]
    return [
        name if names.count(name) == 1 else f"{name} at {p.start_s:g} s"
        for name, p in zip(names, phases, strict=True)
    ]


def posterior_attributes(posterior: Posterior, provenance: Provenance) -> dict[str, Any]:
    """Returns attributes as texts and numbers, which NetCDF can hold; lists and mappings are JSON texts."""
    c = posterior.convergence
    by_name: Sequence[tuple[str, Array]] = (
        ("ess", c.ess), ("rhat", c.rhat), ("tau_steps", c.tau_steps.max(axis=0)),
    )  # fmt: skip
    return {
        "bayeskin_version": provenance.version,
        "config_sha256": provenance.config_sha256,
        "recording_sha256": provenance.recording_sha256,
        "model_hash": provenance.model_hash,
        "seed": posterior.seed,
        "provenance": json.dumps(dict(provenance.extra), sort_keys=True, default=str),
        "parameters": json.dumps([dataclasses.asdict(p) for p in posterior.space.parameters]),
        "correlations": json.dumps(posterior.space.correlations),
        "trusted": int(c.verdict.trusted),
        "verdict": json.dumps(c.verdict.reasons),
        "steps": c.steps,
        "burn_in": c.burn_in,
        "thin": c.thin,
        **{
            key: json.dumps(dict(zip(posterior.space.names, map(float, values), strict=True)))
            for key, values in by_name
        },
    }
