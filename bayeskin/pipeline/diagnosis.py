"""What the model leaves out of a recording: located, candidates tried, named, shown before and after."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bayeskin import inference, report, storage
from bayeskin.inference import LogPosterior
from bayeskin.inference.noise_model import bins_in_windows
from bayeskin.mechanisms import Mechanism, catalogue
from bayeskin.mechanisms.mechanism import Instrument
from bayeskin.mismatch.fit import Fit, instrument_noise, surrogate_limit
from bayeskin.mismatch.locate import Located, locate
from bayeskin.mismatch.observed import ObservedSurrogate
from bayeskin.mismatch.search import Search, search
from bayeskin.mismatch.verdict import judge
from bayeskin.pipeline.effects import effects_of
from bayeskin.pipeline.engine import Reporter, Run, open_run, run_stages
from bayeskin.pipeline.folder import plain, write_json
from bayeskin.pipeline.provenance import caption
from bayeskin.pipeline.stages import STAGES
from bayeskin.pipeline.training import base_surrogate
from bayeskin.surrogates import Effect, with_effects
from bayeskin.types import Array, BinnedForce, PadMotion, Surrogate


@dataclass(frozen=True)
class Workbench:
    """All that a search needs of a run: its bins and protocol, the base's surrogate, what is known."""

    run: Run
    binned: BinnedForce
    motion: PadMotion
    base: Surrogate
    effects: tuple[Effect, ...]
    known: Mapping[str, Mechanism]

    def posterior(self, windows: Sequence[tuple[float, float]] | None, names: Sequence[str]) -> LogPosterior:
        """The posterior with a set of mechanisms, fitted in `windows`."""
        asked = {name: bounds for name, bounds in self.run.config.noise if bounds is not None}
        noise = replace(instrument_noise(self.binned), **asked)
        parts = [effect for effect in self.effects if effect.mechanism in names]
        skin: Surrogate = with_effects(self.base, parts)  # type: ignore[arg-type]
        instrument = tuple(self.known[n] for n in names if isinstance(self.known[n].act, Instrument))
        seen = ObservedSurrogate(skin, instrument, self.motion) if instrument else skin
        return LogPosterior(
            seen, self.binned, None if windows is None else tuple(windows), noise,
            sure_within_n=surrogate_limit(self.binned),
        )  # fmt: skip


def diagnose(config: Path, reporter: Reporter) -> dict[str, Any]:
    """The answer of `bayeskin diagnose` on a configuration's run. Raises InputError for bad input."""
    started = time.monotonic()
    opened = open_run(config, reporter)
    run_stages(opened, STAGES, "train")
    bench = _workbench(opened)
    whole = _searched(bench, None, "whole recording")
    split_s = _end_of_second_hold(bench.binned)
    begun = None if split_s is None else _searched(bench, ((0.0, split_s),), "up to the second hold's end")
    before, after = locate(whole.base, opened.config.seed), locate(whole.best, opened.config.seed)
    found = judge(whole, bench.known, before, after)
    answer = {
        "ok": True,
        "verdict": found.verdict,
        "located": [_window(one) for one in before.windows],
        "remaining": [_window(one) for one in after.windows],
        "explained": found.explained,
        "mechanisms": [_mechanism(one) for one in found.named],
        "candidates": _candidates(whole, bench.known),
        "fit": {
            "before": _fit(bench, whole.base, begun.base if begun else None, split_s),
            "after": _fit(bench, whole.best, begun.best if begun else None, split_s),
        },
        "best_set": list(whole.best.names),
        "held_out_set": list(begun.best.names) if begun else [],
        "seconds": time.monotonic() - started,
    }
    folder = opened.folder / "diagnosis"
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / "diagnosis.json", answer)
    figures = _draw(bench, whole, before, after, answer, folder)
    return plain({**answer, "figures": figures, "text": _in_words(answer, folder)})


def _workbench(run: Run) -> Workbench:
    binned = storage.load(run.at("recording", "binned.h5"), BinnedForce)
    motion = storage.load(run.at("recording", "motion.h5"), PadMotion)
    effects = effects_of(run) if run.config.model.observation == "reaction" else []
    learnt = {effect.mechanism for effect in effects}
    known = {n: m for n, m in catalogue().items() if isinstance(m.act, Instrument) or n in learnt}
    return Workbench(run, binned, motion, base_surrogate(run), tuple(effects), known)


def _searched(bench: Workbench, windows: Sequence[tuple[float, float]] | None, label: str) -> Search:
    reporter, seed = bench.run.reporter, bench.run.config.seed
    build = partial(bench.posterior, windows)
    reporter.log(f"{label}: {len(bench.known)} mechanisms to try")
    found = search(build, bench.known, seed, lambda share, note: reporter.progress(label, share, note))
    reporter.log(f"{label}: {', '.join(found.best.names) or 'nothing'}")
    return found


def _end_of_second_hold(binned: BinnedForce) -> float | None:
    """Where the held-out part starts: the end of the second hold, if something follows it."""
    holds = [phase for phase in binned.phases if phase.kind == "hold"]
    return holds[1].end_s if len(holds) > 2 else None


def _window(one: Any) -> dict[str, Any]:
    return {
        "t0": one.start_s, "t1": one.end_s, "phase": one.phase, "cycle": one.cycle,
        "mean_residual": one.mean_n, "significance": one.significance,
    }  # fmt: skip


def _mechanism(one: Any) -> dict[str, Any]:
    parameters = {
        name: {"mean": mean, "sd": sd, "unit": unit} for name, (mean, sd, unit) in one.parameters.items()
    }
    return {
        "name": one.name, "probability": one.probability, "group": list(one.group),
        "group_probability": one.group_probability, "parameters": parameters, "statement": one.statement,
    }  # fmt: skip


def _candidates(found: Search, known: Mapping[str, Mechanism]) -> list[dict[str, Any]]:
    """Each mechanism added to the base alone: gain of log evidence, and the standard error of that sum."""
    rows = []
    for name in known:
        one = next((f for f in found.fits.values() if name in f.names and len(f.names) <= 2), None)
        if one is None:
            continue
        rows.append(
            {
                "name": name,
                "delta_score": one.log_evidence - found.base.log_evidence,
                "standard_error": _score_error(found.base, one),
            }
        )
    return sorted(rows, key=lambda row: -float(row["delta_score"]))


def _score_error(base: Fit, one: Fit) -> float:
    """Of a difference of log likelihoods, from its scatter over the phases."""
    differences = _blocks(one) - _blocks(base)
    return float(np.sqrt(len(differences)) * differences.std(ddof=1)) if len(differences) > 1 else 0.0


def _blocks(found: Fit) -> Array:
    log_posterior = found.log_posterior
    return log_posterior.block_log_likelihood(_theta(found))[0]


def _theta(found: Fit) -> Array:
    log_posterior = found.log_posterior
    return log_posterior.from_sampling(log_posterior.vector(found.theta))[None]


def _force(found: Fit) -> Array:
    return found.log_posterior.predict(_theta(found)).mean[0]


def _fit(bench: Workbench, found: Fit, begun: Fit | None, split_s: float | None) -> dict[str, Any]:
    """RMSE [N] of a fit to the whole recording, by phase, of one to its beginning on the rest; coverage."""
    binned = bench.binned
    by_phase = inference.rmse(binned, _force(found))
    held_out = None
    if begun is not None and split_s is not None:
        rest = bins_in_windows(binned, ((split_s, float(binned.edges_s[-1])),)) >= 0
        held_out = float(np.sqrt(np.mean((binned.force_n[rest] - _force(begun)[rest]) ** 2)))
    draws = found.draws(300, bench.run.config.seed)
    bands = inference.bands(found.log_posterior, draws, np.random.default_rng(bench.run.config.seed))
    usable = bins_in_windows(binned, None) >= 0
    return {
        "rmse": float(np.sqrt(np.mean((binned.force_n[usable] - _force(found)[usable]) ** 2))),
        "rmse_by_phase": dict(by_phase.by_kind_n),
        "rmse_held_out": held_out,
        "coverage90": inference.coverage(binned, *bands.interval(0.9)),
        "log_evidence": found.log_evidence,
        "theta": dict(found.theta),
    }


def _draw(
    bench: Workbench, found: Search, before: Located, after: Located, answer: Mapping[str, Any], folder: Path
) -> list[Path]:
    binned = bench.binned
    figures = {
        "located": report.figure_located(binned, bench.motion, before, _force(found.base)),
        "candidates": report.figure_candidates(answer["candidates"]),
        "before_after": report.figure_before_after(
            binned, bench.motion, _force(found.base), _force(found.best)
        ),
    }
    for name, figure in figures.items():
        report.save_figure(figure, folder / name, caption(bench.run))
    return [folder / f"{name}.{suffix}" for name in figures for suffix in ("png", "svg")]


def _in_words(answer: Mapping[str, Any], folder: Path) -> str:
    fits = answer["fit"]
    lines = [f"verdict: {answer['verdict']}"]
    lines += [
        f"  {one['name']} (probability {one['probability']:.2f}): {one['statement']}"
        for one in answer["mechanisms"]
    ]
    lines.append(f"{len(answer['located'])} windows before, {len(answer['remaining'])} after")
    for when in ("before", "after"):
        held = fits[when]["rmse_held_out"]
        rest = "" if held is None else f", {1e3 * held:.1f} mN on what follows the second hold, not fitted"
        lines.append(f"{when}: RMSE {1e3 * fits[when]['rmse']:.1f} mN{rest}")
    best = ", ".join(f"{one['name']} {one['delta_score']:+.1f}" for one in answer["candidates"][:5])
    lines += [f"candidates alone, log evidence gained: {best}", f"outputs in {folder}"]
    return "\n".join(lines)
