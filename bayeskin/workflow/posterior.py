"""Fifth stage: the posterior, its verdict, and what it predicts."""

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
from bayeskin.types import PadMotion, Provenance, Recording
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
from bayeskin.workflow.model import model_spec
from bayeskin.workflow.provenance import caption
from bayeskin.workflow.shipping import shipped_files

PREDICTIVE_DRAWS = 1000
PROFILED_DRAWS = 2000  # among which a profile looks for where to begin


def _sample(run: Run) -> Mapping[str, Any]:
    config = run.config
    best = run.summary("map")["theta"]
    checked = checked_posterior(run, refined_posterior(run), partial(_draws_of, run, best))
    log_posterior, posterior = checked.log_posterior, checked.posterior
    recording = storage.load(run.at("recording", "recording.h5"), Recording)
    provenance = provenance_of(run, log_posterior, recording.sha256)
    rng = np.random.default_rng([config.seed, 1])
    idata = inference.to_inference_data(log_posterior, posterior, provenance, rng, PREDICTIVE_DRAWS)
    inference.save_inference_data(run.at("sample", "posterior.nc"), idata)
    drawn = inference.predictive_draws(log_posterior, inference.evenly(posterior.flat, PREDICTIVE_DRAWS), rng)
    profiles = inference.profiles(log_posterior, best, inference.evenly(posterior.flat, PROFILED_DRAWS))
    residuals = _residuals(checked)
    _draw_posterior(run, checked, best, drawn, profiles, residuals)
    bands = inference.bands_of(log_posterior.binned.time_s, drawn)
    write_json(run.at("sample", "bands.json"), _history(log_posterior, bands))
    return {**_sampled(checked, bands, residuals), "profiles": {one.name: _profiled(one) for one in profiles}}


def _residuals(checked: Checked) -> inference.ResidualCheck:
    """What the most probable of the draws leaves."""
    log_posterior, posterior = checked.log_posterior, checked.posterior
    best = posterior.flat[int(np.argmax(posterior.log_prob))]
    return inference.check_residuals(log_posterior, log_posterior.to_sampling(best))


def _left(residuals: inference.ResidualCheck) -> dict[str, Any]:
    """A check of residuals in a summary."""
    return {
        "passes": residuals.passes,
        "sentence": residuals.sentence,
        "p_law": residuals.p_law,
        "p_correlation": residuals.p_correlation,
        "autocorrelation": residuals.autocorrelation,
        "by_kind": {
            one.kind: {
                "bins": one.bins, "sd": one.sd, "p_sd": one.p_sd,
                "correlation": one.correlation, "p_correlation": one.p_correlation,
            }
            for one in residuals.kinds
        },
    }  # fmt: skip


def _profiled(profile: inference.Profile) -> dict[str, Any]:
    """A profile likelihood in a summary; an interval is open where the prior ends before the fit does."""
    low, high = profile.interval
    return {
        "low_90": low, "high_90": high, "open_below": profile.open_below, "open_above": profile.open_above,
        "flat": profile.flat, "values": profile.values, "drop_nats": profile.drop_nats,
    }  # fmt: skip


def provenance_of(run: Run, log_posterior: LogPosterior, recording_sha256: str) -> Provenance:
    """What a posterior was made from, its configuration included."""
    config = run.config
    told = config.model_dump(mode="json", exclude_none=True)
    if config.surrogate.file is not None:
        ready = shipped_files(run).surrogate
        if ready == run.config_path.resolve().parent / config.surrogate.file:  # the configuration may move
            told["surrogate"]["file"] = str(ready)
    extra = {
        "surrogate": dict(log_posterior.surrogate.provenance),
        "config": told,
        "identity": log_posterior.identity,
    }
    return Provenance(
        bayeskin.__version__, config.sha256, recording_sha256, model_spec(run).hash, config.seed, extra
    )


def _draws_of(run: Run, best: Mapping[str, float], log_posterior: LogPosterior) -> Posterior:
    """Draws of a posterior, from about its most probable point."""
    folder = chains_folder(run, log_posterior)
    settings, tell = settings_of(run.config), partial(_tell_sampling, run)
    threads = run.config.design.workers
    return inference.sample(log_posterior, folder, run.config.seed, best, settings, tell, threads)


def _history(log_posterior: LogPosterior, bands: inference.Bands) -> dict[str, Any]:
    """The recorded bins and what is predicted for them, for whoever draws or reads them; (m,) each, SI."""
    (low_50, high_50), (low_90, high_90) = bands.interval(0.5), bands.interval(0.9)
    fitted = np.isin(np.arange(len(bands.time_s)), log_posterior.chain.bins)
    return {
        "time_s": bands.time_s, "recorded_n": log_posterior.binned.force_n, "fitted": fitted,
        "median_n": bands.quantiles_n[2], "low_50_n": low_50, "high_50_n": high_50,
        "low_90_n": low_90, "high_90_n": high_90,
    }  # fmt: skip


def chains_folder(run: Run, log_posterior: LogPosterior) -> Path:
    """Where chains are kept by what they are of, so that a change of when to stop does not lose them."""
    identity = {**log_posterior.identity, "seed": run.config.seed, "walkers": run.config.sample.walkers}
    return run.folder / "chains" / sha256_of(identity)[:16]


def settings_of(config: Config) -> inference.SampleSettings:
    limits = inference.Limits(effective_samples=float(config.sample.effective_samples))
    return inference.SampleSettings(
        config.sample.ensembles, config.sample.walkers, config.sample.max_steps, limits
    )


def _tell_sampling(run: Run, share: float, text: str) -> None:
    run.reporter.progress("sampling", share, text)


def _sampled(checked: Checked, bands: inference.Bands, residuals: inference.ResidualCheck) -> dict[str, Any]:
    log_posterior, posterior, c = checked.log_posterior, checked.posterior, checked.posterior.convergence
    low, high = bands.interval(0.9)
    learned = inference.identifiability(posterior.space, posterior.flat)
    verdict = with_full_model(with_surrogate_error(c.verdict, bands, log_posterior.chain.bins), checked)
    return {
        "ok": verdict.trusted,
        "verdict": "trusted" if verdict.trusted else "not trusted",
        "reasons": list(verdict.reasons),
        "remarks": [*inference.noise_remarks(learned), *([] if residuals.passes else [residuals.sentence])],
        "residuals": _left(residuals),
        "steps": c.steps,
        "draws": len(posterior.flat),
        "parameters": _table(posterior),
        "identifiability": [one.statement for one in learned.parameters],
        "ridges": [one.statement for one in learned.ridges],
        "learned": {
            one.name: {
                "contraction": one.contraction,
                "gain_nats": one.gain_nats,
                "sentence": one.sentence,
            }
            for one in learned.parameters
        },
        "lengths": {
            one.name: {"share": one.share, "sentence": one.sentence}
            for one in inference.due_to_lengths(posterior.space, posterior.flat)
        },
        "full_model": [said_of(one) for one in checked.rounds],
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
    """The verdict with one more criterion: what the surrogate leaves open in the fitted bins.

    Where its sd exceeds the noise's, a bad fit hides in it, and the posterior goes where it is largest.
    """
    surrogate, noise = (
        float(np.sqrt(np.mean(sd[fitted] ** 2))) for sd in (bands.sd_surrogate_n, bands.sd_noise_n)
    )
    said = f"surrogate's sd {1e3 * surrogate:.3g} mN where fitted; at most the noise's {1e3 * noise:.3g} mN"
    if surrogate <= noise:
        return Verdict(verdict.trusted, (*verdict.reasons, said))
    return Verdict(False, (f"{said}: run the full model where the posterior is", *verdict.reasons))


def _table(posterior: Posterior) -> dict[str, dict[str, Any]]:
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


def _draw_posterior(
    run: Run,
    checked: Checked,
    best: Mapping[str, float],
    drawn: inference.ForceDraws,
    profiles: Sequence[inference.Profile],
    residuals: inference.ResidualCheck,
) -> None:
    log_posterior, posterior = checked.log_posterior, checked.posterior
    binned = log_posterior.binned
    motion = storage.load(run.at("recording", "motion.h5"), PadMotion)
    fitted = np.isin(np.arange(len(binned.force_n)), log_posterior.chain.bins)
    convergence = posterior.convergence
    folder, ensembles = chains_folder(run, log_posterior), run.config.sample.ensembles
    kept = inference.load_chains(folder, log_posterior, ensembles)[:, convergence.burn_in : convergence.steps]
    material = posterior.space.names[: log_posterior.surrogate.space.dim]
    noise = posterior.space.names[len(material) :]
    figures = {
        "posterior": report.figure_posterior(posterior.space, posterior.flat, best, material),
        "posterior_noise": report.figure_posterior(posterior.space, posterior.flat, best, noise),
        "fit": report.figure_fit(
            binned,
            motion.at(binned.time_s),
            fitted,
            mean_n=drawn.mean_n,
            surrogate_sd_n=drawn.surrogate_sd_n,
            noise_sd_n=drawn.noise_sd_n,
            force_n=drawn.force_n,
        ),
        "profiles": report.figure_profiles(posterior.space, posterior.flat, profiles),
        "residuals": report.figure_residuals(residuals),
        "traces": report.figure_traces(
            posterior.space, kept, convergence.verdict, settings_of(run.config).limits
        ),
    }
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
    _sample,
)
