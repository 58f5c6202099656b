"""The fifth stage: samples the posterior, gives a verdict on it, and predicts the force."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import bayeskin
from bayeskin import inference, report, storage
from bayeskin.config import Config
from bayeskin.hashing import sha256_of
from bayeskin.inference import LogPosterior, Posterior, Verdict
from bayeskin.json_files import write_json
from bayeskin.mismatch.on_skin import on_skin
from bayeskin.number_format import quantity
from bayeskin.types import Array, PadMotion, Provenance, Recording
from bayeskin.types.joint import figure_name
from bayeskin.workflow.calibration import refined_posterior, rmse_table
from bayeskin.workflow.checking import (
    Checked,
    checked_posterior,
    corrected_table,
    said_of,
    says_something,
    with_full_model,
)
from bayeskin.workflow.engine import Run, Stage
from bayeskin.workflow.marker_answer import on_skin_entry
from bayeskin.workflow.model import model_spec
from bayeskin.workflow.provenance import caption
from bayeskin.workflow.shipping import shipped_files

PREDICTIVE_DRAWS = 1000
PROFILED_DRAWS = 2000  # draws among which a profile likelihood finds its starting points


def _sample_posterior(run: Run) -> Mapping[str, Any]:
    """Samples and checks the posterior, writes it with its figures, and returns the stage's summary."""
    config = run.config
    best = run.summary("map")["theta"]
    checked = checked_posterior(run, refined_posterior(run), partial(_draws, run, best))
    log_posterior, posterior = checked.log_posterior, checked.posterior
    recording = storage.load(run.at("recording", "recording.h5"), Recording)
    provenance = provenance_of(run, log_posterior, recording.sha256)
    rng = np.random.default_rng([config.seed, 1])
    idata = inference.to_inference_data(log_posterior, posterior, provenance, rng, PREDICTIVE_DRAWS)
    inference.save_inference_data(run.at("sample", "posterior.nc"), idata)
    drawn = inference.predictive_draws(log_posterior, inference.evenly(posterior.flat, PREDICTIVE_DRAWS), rng)
    profiles = inference.profiles(log_posterior, best, inference.evenly(posterior.flat, PROFILED_DRAWS))
    residuals = _residuals(checked)
    _draw_figures(run, checked, best, drawn, profiles, residuals)
    of_markers = _of_markers(run, checked)
    bands = inference.bands_of(log_posterior.binned.time_s, drawn)
    write_json(run.at("sample", "bands.json"), _bands_by_bin(log_posterior, bands))
    return {
        **_posterior_summary(checked, bands, residuals),
        **({} if of_markers is None else {"on_skin": of_markers}),
        "profiles": {profile.name: _profile_summary(profile) for profile in profiles},
    }


def _residuals(checked: Checked) -> inference.ResidualCheck:
    """Returns the check of the residuals at the most probable draw."""
    log_posterior = checked.log_posterior
    return inference.check_residuals(log_posterior, log_posterior.to_sampling(_best_draw(checked)))


def _best_draw(checked: Checked) -> Array:
    """Returns the most probable draw (D,)."""
    posterior = checked.posterior
    return np.asarray(posterior.flat[int(np.argmax(posterior.log_prob))])


def _of_markers(run: Run, checked: Checked) -> dict[str, Any] | None:
    """Returns the entry of the markers at the most probable draw, and draws their residuals on the skin.

    The result is None for a recording without markers.
    """
    log_posterior, motion = checked.log_posterior, storage.load(run.at("recording", "motion.h5"), PadMotion)
    theta = dict(zip(log_posterior.names, map(float, _best_draw(checked)), strict=True))
    located = on_skin(log_posterior, theta, motion)
    if located is None:
        return None
    figure = report.figure_on_skin(located, run.config.geometry(run.config_path).geometry)
    report.save_figure(figure, run.at("sample", "on_skin"), caption(run))
    return on_skin_entry(log_posterior, theta, located)


def _residual_summary(residuals: inference.ResidualCheck) -> dict[str, Any]:
    """Returns a check of residuals as plain values for the summary."""
    return {
        "passes": residuals.passes,
        "sentence": residuals.sentence,
        "p_law": residuals.p_law,
        "p_correlation": residuals.p_correlation,
        "autocorrelation": residuals.autocorrelation,
        "by_kind": {
            kind.kind: {
                "bins": kind.bins, "sd": kind.sd, "p_sd": kind.p_sd,
                "correlation": kind.correlation, "p_correlation": kind.p_correlation,
            }
            for kind in residuals.kinds
        },
    }  # fmt: skip


def _profile_summary(profile: inference.Profile) -> dict[str, Any]:
    """Returns a profile likelihood as plain values for the summary.

    Its interval is open where the prior ends before the likelihood has dropped enough.
    """
    low, high = profile.interval
    return {
        "low_90": low, "high_90": high, "open_below": profile.open_below, "open_above": profile.open_above,
        "flat": profile.flat, "values": profile.values, "drop_nats": profile.drop_nats,
    }  # fmt: skip


def provenance_of(run: Run, log_posterior: LogPosterior, recording_sha256: str) -> Provenance:
    """Returns the origin of a posterior, which contains its configuration."""
    config = run.config
    settings = config.model_dump(mode="json", exclude_none=True)
    if config.surrogate.file is not None:
        file = shipped_files(run).surrogate
        # An absolute path stays valid if the configuration is moved.
        if file == run.config_path.resolve().parent / config.surrogate.file:
            settings["surrogate"]["file"] = str(file)
    extra = {
        "surrogate": dict(log_posterior.surrogate.provenance),
        "config": settings,
        "identity": log_posterior.identity,
    }
    return Provenance(
        bayeskin.__version__, config.sha256, recording_sha256, model_spec(run).hash, config.seed, extra
    )


def _draws(run: Run, best: Mapping[str, float], log_posterior: LogPosterior) -> Posterior:
    """Returns draws of a posterior; the chains start near its most probable point."""
    folder = chains_folder(run, log_posterior)
    settings, tell = settings_of(run.config), partial(_tell_sampling, run)
    threads = run.config.design.workers
    return inference.sample(log_posterior, folder, run.config.seed, best, settings, tell, threads)


def _bands_by_bin(log_posterior: LogPosterior, bands: inference.Bands) -> dict[str, Any]:
    """Returns the recorded bins and the predicted bands, (m,) each in SI units, for figures and programs."""
    (low_50, high_50), (low_90, high_90) = bands.interval(0.5), bands.interval(0.9)
    fitted = np.isin(np.arange(len(bands.time_s)), log_posterior.chain.bins)
    return {
        "time_s": bands.time_s, "recorded_n": log_posterior.binned.force_n, "fitted": fitted,
        "median_n": bands.quantiles_n[2], "low_50_n": low_50, "high_50_n": high_50,
        "low_90_n": low_90, "high_90_n": high_90,
    }  # fmt: skip


def chains_folder(run: Run, log_posterior: LogPosterior) -> Path:
    """Returns the folder of a posterior's chains.

    Its name depends on the posterior, the seed and the number of walkers. A change of the stopping criteria
    thus does not discard the chains.
    """
    identity = {**log_posterior.identity, "seed": run.config.seed, "walkers": run.config.sample.walkers}
    return run.folder / "chains" / sha256_of(identity)[:16]


def settings_of(config: Config) -> inference.SampleSettings:
    """Returns the sampler's settings of a configuration."""
    limits = inference.Limits(effective_samples=float(config.sample.effective_samples))
    return inference.SampleSettings(
        config.sample.ensembles, config.sample.walkers, config.sample.max_steps, limits
    )


def _tell_sampling(run: Run, share: float, text: str) -> None:
    """Reports the progress of the sampler."""
    run.reporter.progress("sampling", share, text)


def _posterior_summary(
    checked: Checked, bands: inference.Bands, residuals: inference.ResidualCheck
) -> dict[str, Any]:
    """Returns the stage's summary."""
    log_posterior, posterior, c = checked.log_posterior, checked.posterior, checked.posterior.convergence
    low, high = bands.interval(0.9)
    learned = inference.identifiability(posterior.space, posterior.flat)
    verdict = with_full_model(with_surrogate_error(c.verdict, bands, log_posterior.chain.bins), checked)
    return {
        "ok": verdict.trusted,
        "verdict": "trusted" if verdict.trusted else "not trusted",
        "reasons": list(verdict.reasons),
        "remarks": [*inference.noise_remarks(learned), *([] if residuals.passes else [residuals.sentence])],
        "residuals": _residual_summary(residuals),
        "steps": c.steps,
        "draws": len(posterior.flat),
        "parameters": _table(posterior),
        "identifiability": [parameter.statement for parameter in learned.parameters],
        "ridges": [ridge.statement for ridge in learned.ridges],
        "learned": {
            parameter.name: {
                "contraction": parameter.contraction,
                "gain_nats": parameter.gain_nats,
                "informed": parameter.informed,
                "leans_on": parameter.leans_on,
                "ranges": parameter.ranges,
                "outcome": parameter.outcome,
                "sentence": parameter.sentence,
            }
            for parameter in learned.parameters
        },
        "lengths": {
            length.name: {"share": length.share, "sentence": length.sentence}
            for length in inference.due_to_lengths(posterior.space, posterior.flat)
        },
        "full_model": [said_of(weighed) for weighed in checked.rounds],
        "corrected": corrected_table(checked),
        "rmse": rmse_table(log_posterior, bands.mean_n),
        "coverage_90": inference.coverage(log_posterior.binned, low, high),
        "coverage_90_fitted": inference.coverage(log_posterior.binned, low, high, log_posterior.fit_windows),
        "rms_sd_n": {
            part: float(np.sqrt(np.mean(getattr(bands, f"sd_{part}_n") ** 2)))
            for part in ("model", "surrogate", "noise")
        },
    }


def with_surrogate_error(verdict: Verdict, bands: inference.Bands, fitted: NDArray[np.int64]) -> Verdict:
    """Returns the verdict with one more criterion: the surrogate's error in the fitted bins.

    Where the surrogate's sd exceeds the noise's, it can hide a bad fit, and the posterior moves to where this
    sd is largest.
    """
    surrogate, noise = (
        float(np.sqrt(np.mean(sd[fitted] ** 2))) for sd in (bands.sd_surrogate_n, bands.sd_noise_n)
    )
    statement = (
        f"surrogate's sd {quantity(surrogate, 'N')} in the fitted bins; "
        f"at most the noise's sd of {quantity(noise, 'N')} allowed"
    )
    if surrogate <= noise:
        return Verdict(verdict.trusted, (*verdict.reasons, statement))
    return Verdict(
        False, (f"{statement}: run the full model in the region of the posterior", *verdict.reasons)
    )


def _table(posterior: Posterior) -> dict[str, dict[str, Any]]:
    """Returns for each parameter its posterior, its convergence and its prior as plain values."""
    c, table = posterior.convergence, {}
    for j, p in enumerate(posterior.space.parameters):
        draws = posterior.flat[:, j]
        low, median, high = np.quantile(draws, [0.05, 0.5, 0.95])
        table[p.name] = {
            "meaning": p.description, "unit": p.unit, "mean": draws.mean(), "sd": draws.std(ddof=1),
            "median": median, "low_90": low, "high_90": high, "ess": c.ess[j], "rhat": c.rhat[j],
            "prior": {
                "kind": p.prior, "lower": p.lower, "upper": p.upper, "source": p.source,
                **({"centre": p.centre, "spread": p.spread} if p.peaked else {}),
            },
        }  # fmt: skip
    return table


def _draw_figures(
    run: Run,
    checked: Checked,
    best: Mapping[str, float],
    drawn: inference.ForceDraws,
    profiles: Sequence[inference.Profile],
    residuals: inference.ResidualCheck,
) -> None:
    """Draws the figures of the stage."""
    log_posterior, posterior = checked.log_posterior, checked.posterior
    binned = log_posterior.binned
    motion = storage.load(run.at("recording", "motion.h5"), PadMotion)
    fitted = np.isin(np.arange(len(binned.force_n)), log_posterior.chain.bins)
    convergence = posterior.convergence
    folder, ensembles = chains_folder(run, log_posterior), run.config.sample.ensembles
    chains = inference.load_chains(folder, log_posterior, ensembles)[
        :, convergence.burn_in : convergence.steps
    ]
    material = posterior.space.names[: log_posterior.surrogate.space.dim]
    noise = posterior.space.names[len(material) :]
    figures = {
        "posterior": report.figure_posterior(posterior.space, posterior.flat, best, material),
        "posterior_noise": report.figure_posterior(posterior.space, posterior.flat, best, noise),
        "profiles": report.figure_profiles(posterior.space, posterior.flat, profiles),
        "residuals": report.figure_residuals(residuals),
        "traces": report.figure_traces(
            posterior.space, chains, convergence.verdict, settings_of(run.config).limits
        ),
    }
    for number, (bins, part) in enumerate(zip(binned.slices, binned.parts, strict=True)):
        figures[figure_name("fit", number)] = report.figure_fit(
            part, motion.parts[number].at(part.time_s), fitted[bins],
            mean_n=drawn.mean_n[:, bins], surrogate_sd_n=drawn.surrogate_sd_n[:, bins],
            noise_sd_n=drawn.noise_sd_n[:, bins], force_n=drawn.force_n[:, bins],
        )  # fmt: skip
    if checked.rounds and says_something(checked.rounds[-1]):
        weighed = checked.rounds[-1]
        moved = inference.corrected(weighed, posterior.flat)
        figures["model_check"] = report.figure_model_check(weighed, moved)
    for name, figure in figures.items():
        report.save_figure(figure, run.at("sample", name), caption(run))


STAGE = Stage(
    "sample",
    "samples the posterior",
    ("recording", "map"),
    ("seed", "sample", "check", "fit", "noise", "parameters", "model", "surrogate", "design"),
    _sample_posterior,
    format=2,
)
