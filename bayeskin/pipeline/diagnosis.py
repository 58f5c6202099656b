"""What the model leaves out of a recording: located, candidates tried, named, shown before and after."""

from __future__ import annotations

import json
import re
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import bayeskin
from bayeskin import inference, storage
from bayeskin.config import Config, RecordingConfig, SurrogateConfig
from bayeskin.errors import InputError
from bayeskin.inference import LogPosterior
from bayeskin.inference.noise_model import bins_in_windows
from bayeskin.inference.straighten import find_shear
from bayeskin.mechanisms import Mechanism, catalogue
from bayeskin.mechanisms.mechanism import Instrument
from bayeskin.mismatch.contributions import contributions
from bayeskin.mismatch.discrepancy import discrepancy
from bayeskin.mismatch.discretised import Discretised
from bayeskin.mismatch.fit import Fit, instrument_noise, restored, stored, surrogate_limit
from bayeskin.mismatch.form import propose_form
from bayeskin.mismatch.full_fit import FullFit, fit_full
from bayeskin.mismatch.locate import MODEL_ERROR, Located, locate
from bayeskin.mismatch.observed import ObservedSurrogate
from bayeskin.mismatch.resample import Resampled, resample
from bayeskin.mismatch.search import Build, Search, search
from bayeskin.mismatch.verdict import Diagnosis, judge
from bayeskin.model.accuracy import mesh_error
from bayeskin.model.simulate import ModelSpec
from bayeskin.pipeline import design, recording, training
from bayeskin.pipeline.diagnosis_outputs import (
    Found,
    FullResult,
    Remainder,
    candidates,
    draw,
    in_words,
    mechanism,
    unexplained,
    window,
)
from bayeskin.pipeline.effects import effect_files, effects_of
from bayeskin.pipeline.engine import Reporter, Run, Silent, Stage, open_run, run_stages
from bayeskin.pipeline.folder import plain, read_lines, sha256_of, write_json
from bayeskin.pipeline.model import model_spec
from bayeskin.pipeline.provenance import caption
from bayeskin.pipeline.reported import FullForce
from bayeskin.pipeline.shipping import shipped_for
from bayeskin.pipeline.training import base_surrogate
from bayeskin.recordings import read_recording, segment
from bayeskin.surrogates import Effect, with_effects
from bayeskin.types import Array, BinnedForce, PadMotion, Surrogate
from bayeskin.workers import Lost, run_parallel

PREDICTIVE_DRAWS = 300
BEND = 2.0 * MODEL_ERROR  # of which half is left after one factor on the force
FULL_RUNS = 5  # of the full model, at most, to take up a fit of the surrogate


@dataclass(frozen=True)
class Workbench:
    """All that a search needs of a run: its bins and protocol, the base's surrogate, what is known."""

    run: Run
    binned: BinnedForce
    motion: PadMotion
    base: Surrogate
    effects: tuple[Effect, ...]
    known: Mapping[str, Mechanism]

    @cached_property
    def spec(self) -> ModelSpec:
        """The full model."""
        return model_spec(self.run)

    def posterior(self, until_s: float | None, names: Sequence[str]) -> LogPosterior:
        """The posterior with a set of mechanisms, fitted up to a time (None: to the end)."""
        asked = {name: bounds for name, bounds in self.run.config.noise if bounds is not None}
        parts = [effect for effect in self.effects if effect.mechanism in names]
        skin: Surrogate = with_effects(self.base, parts)  # type: ignore[arg-type]
        error = mesh_error(self.spec.mesh_hash) if self.spec.observation == "reaction" else None
        if error is not None:
            skin = Discretised(
                skin, self.motion, error.rms, 2.0 * MODEL_ERROR
            )  # half is left after one factor
        instrument = tuple(self.known[n] for n in names if isinstance(self.known[n].act, Instrument))
        seen = ObservedSurrogate(skin, instrument, self.motion) if instrument else skin
        return LogPosterior(
            seen, self.binned, None if until_s is None else ((0.0, until_s),),
            replace(instrument_noise(self.binned), **asked), sure_within_n=surrogate_limit(self.binned),
        )  # fmt: skip


def diagnose(source: Path, reporter: Reporter) -> dict[str, Any]:
    """The answer of `bayeskin diagnose` on a configuration's run, or on a recording by itself.

    Outputs go to the run's folder, or to STEM-diagnosis beside the recording. Raises InputError for bad
    input, among it a recording whose protocol no shipped surrogate knows.
    """
    run = opened(source, reporter)
    stages = {stage.name: stage for stage in (recording.STAGE, design.STAGE, training.STAGE, STAGE)}
    outcome = run_stages(run, stages)[-1]
    answer = {**outcome.record.summary, "ok": outcome.ok, "folder": run.folder / STAGE.name}
    text = in_words(answer) if outcome.record.done else f"{outcome.stage}: failed: {answer['message']}"
    return plain({**answer, "text": text})


def opened(source: Path, reporter: Reporter) -> Run:
    """A configuration's run, or that of a recording by itself beside it. Raises InputError as `diagnose`."""
    if source.suffix == ".toml":
        return open_run(source, reporter)
    found = read_recording(source)
    surrogate = shipped_for(recording.pad_motion("reaction", found, segment(found), "idealised"))
    if surrogate is None:
        raise InputError(
            source, "a protocol that no shipped surrogate was trained on",
            "a configuration with a design of its own: bayeskin diagnose CONFIG.toml",
        )  # fmt: skip
    config = Config(
        name=re.sub(r"[^A-Za-z0-9._-]", "-", f"run-{source.stem}"),
        recording=RecordingConfig(file=source.name), surrogate=SurrogateConfig(file=surrogate.name),
    )  # fmt: skip
    return Run(config, source, source.resolve().with_name(f"{source.stem}-diagnosis"), reporter)


def _work(run: Run) -> Mapping[str, Any]:
    started = time.monotonic()
    bench = workbench(run)
    split_s = _end_of_second_hold(bench.binned)
    beside = None if split_s is None else _search_beside(run, split_s)
    whole = _searched(bench, None)
    if beside is not None:
        run.reporter.log("waiting for the search on the recording's beginning")
        beside.join()
    begun = None if split_s is None else _searched(bench, split_s)
    before, after = (locate(one, whole.best.theta, run.config.seed) for one in (whole.base, whole.best))
    found = judge(whole, bench.known, before, after)
    parts = contributions(whole.best, partial(bench.posterior, None))
    remainder = _remainder(bench, found, whole.best, after)
    taken = _taken_up(bench, [whole.base, whole.best])
    answer: dict[str, Any] = {
        "verdict": found.verdict,
        "located": [window(one) for one in before.windows],
        "remaining": [window(one) for one in after.windows],
        "explained": found.explained,
        "mechanisms": [
            mechanism(one, bench.known[one.name], parts, taken[1].draws.summary) for one in found.named
        ],
        "unexplained": None if remainder is None else unexplained(remainder),
        "candidates": candidates(whole, bench.known),
        "unsure": sorted({name for names in whole.unsure for name in names if len(names) == 1}),
        "fit": {
            "before": _fit(bench, whole.base, taken[0], begun.base if begun else None, split_s),
            "after": _fit(bench, whole.best, taken[1], begun.best if begun else None, split_s),
        },
        "best_set": list(whole.best.names),
        "held_out_set": list(begun.best.names) if begun else [],
        "seconds": time.monotonic() - started,
    }
    write_json(run.at(STAGE.name, "diagnosis.json"), answer)
    figures = draw(
        run.folder / STAGE.name, caption(run), bench.binned, bench.motion,
        Found(whole, [one.full for one in taken], before, after, parts, remainder), answer["candidates"],
    )  # fmt: skip
    return {**answer, "figures": [figure.name for figure in figures]}


def _remainder(bench: Workbench, found: Diagnosis, best: Fit, after: Located) -> Remainder | None:
    """What is left, where the mismatch is unknown or windows remain beside what is named."""
    if found.verdict == "nothing-missing" or (found.verdict == "named" and not after.windows):
        return None
    motion, seed = bench.motion, bench.run.config.seed
    return Remainder(discrepancy(best, motion), propose_form(best, motion, seed))


@dataclass(frozen=True)
class TakenUp:
    """What follows a search's fit: draws of its posterior, and the full model's own fit from there."""

    draws: Resampled
    full: FullResult


def _taken_up(bench: Workbench, fits: Sequence[Fit]) -> list[TakenUp]:
    """Each fit sampled, and taken up by the full model itself (by the article's, not), in two processes."""
    run = bench.run
    run.reporter.log("posterior, and the full model, without and with what was found")
    apart: list[partial[Any]] = [partial(_fit_full_apart, run.config_path, stored(one)) for one in fits]
    apart += [partial(_resample_apart, run.config_path, stored(one)) for one in fits]
    if run.config.model.observation != "reaction":
        apart = apart[len(fits) :]
    done = dict(run_parallel(_call, apart, 2))
    found = [done[i] for i in range(len(apart))]
    full = found[: -len(fits)] or [None] * len(fits)
    draws = [_resample_apart(run.config_path, stored(fits[i])) if isinstance(one, Lost) else one
             for i, one in enumerate(found[-len(fits) :])]  # fmt: skip
    return [TakenUp(d, f.reason if isinstance(f, Lost) else f) for d, f in zip(draws, full, strict=True)]


def _call(task: partial[Any]) -> Any:
    return task()


def _fit_full_apart(source: Path, plain: Mapping[str, Any]) -> FullFit | str:
    """In a process of its own: mechanisms have no copies."""
    bench, names = workbench(opened(source, Silent())), plain["names"]
    run_it = FullForce(bench.spec, bench.motion, bench.binned.edges_s)
    beyond = [bench.known[name] for name in names if bench.known[name].act.bind is None]
    exact = [p.name for mechanism in beyond for p in mechanism.parameters]
    return fit_full(
        bench.posterior(None, names), plain["theta"], lambda point: run_it((names, point)), exact, FULL_RUNS,
        bench.run.config.seed,
    )  # fmt: skip


def _resample_apart(source: Path, plain: Mapping[str, Any]) -> Resampled:
    bench = workbench(opened(source, Silent()))
    alone, wide = bench.posterior(None, ()), bench.posterior(None, plain["names"])
    shear = find_shear(alone)
    among = shear.among(alone.names, wide.names) if shear else None
    return resample(restored(plain, wide), among, alone.surrogate.space.dim, bench.run.config.seed)


def _search_beside(run: Run, split_s: float) -> threading.Thread:
    """The search on the beginning in a process of its own that ends with this one; its fits go to a file."""
    search_it = partial(_search_apart, run.config_path)
    thread = threading.Thread(target=lambda: list(run_parallel(search_it, [split_s], 1)), daemon=True)
    thread.start()
    return thread


def _search_apart(source: Path, split_s: float) -> None:
    _searched(workbench(opened(source, Silent())), split_s)


def workbench(run: Run) -> Workbench:
    """Of a run whose stages up to `train` are done."""
    binned = storage.load(run.at("recording", "binned.h5"), BinnedForce)
    motion = storage.load(run.at("recording", "motion.h5"), PadMotion)
    effects = effects_of(run) if run.config.model.observation == "reaction" else []
    learnt = {effect.mechanism for effect in effects}
    known = {n: m for n, m in catalogue().items() if isinstance(m.act, Instrument) or n in learnt}
    return Workbench(run, binned, motion, base_surrogate(run), tuple(effects), known)


def fits_of(bench: Workbench) -> list[Fit]:
    """All sets that the search on the whole recording has tried so far."""
    build = partial(bench.posterior, None)
    return _fits_in(_search_file(bench, build), build)


def _search_file(bench: Workbench, build: Build) -> Path:
    """Where a search keeps its fits, by what they are of."""
    identity = sha256_of(
        [bayeskin.__version__, bench.run.config.seed, build(()).identity, repr(build(()).noise_priors),
         [repr(mechanism.parameters) for mechanism in bench.known.values()],
         [[effect.part, dict(effect.surrogate.provenance)] for effect in bench.effects]]
    )  # fmt: skip
    return bench.run.folder / "searches" / f"{identity[:16]}.jsonl"


def _searched(bench: Workbench, until_s: float | None) -> Search:
    """The search up to a time, going on from the fits that one stopped before has left."""
    run, build = bench.run, partial(bench.posterior, until_s)
    label = "whole recording" if until_s is None else f"up to {until_s:.1f} s"
    file = _search_file(bench, build)
    done = {one.names: one for one in _fits_in(file, build)}
    file.parent.mkdir(parents=True, exist_ok=True)
    with open(file, "a", encoding="utf-8") as handle:

        def on_fit(found: Fit) -> None:
            handle.write(json.dumps(stored(found)) + "\n")
            handle.flush()

        return search(
            build, bench.known, run.config.seed,
            lambda share, note: run.reporter.progress(label, share, note), done, on_fit,
        )  # fmt: skip


def _fits_in(file: Path, build: Build) -> list[Fit]:
    """Fits of a search that was stopped."""
    return [restored(said, build(said["names"])) for said in read_lines(file)]


def _end_of_second_hold(binned: BinnedForce) -> float | None:
    """Where the held-out part starts: the end of the second hold, if something follows it."""
    holds = [phase for phase in binned.phases if phase.kind == "hold"]
    return holds[1].end_s if len(holds) > 2 else None


def _fit(
    bench: Workbench, found: Fit, taken: TakenUp, begun: Fit | None, split_s: float | None
) -> dict[str, Any]:
    """RMSE [N] of a fit to the whole recording, by phase, of one to its beginning on the rest; coverage."""
    binned = bench.binned
    by_phase = inference.rmse(binned, found.force_n)
    held_out = None
    if begun is not None and split_s is not None:
        rest = bins_in_windows(binned, ((split_s, float(binned.edges_s[-1])),)) >= 0
        held_out = float(np.sqrt(np.mean((binned.force_n[rest] - begun.force_n[rest]) ** 2)))
    draws = taken.draws.draws
    some = inference.evenly(draws, PREDICTIVE_DRAWS)
    bands = inference.bands(found.log_posterior, some, np.random.default_rng(bench.run.config.seed))
    usable = bins_in_windows(binned, None) >= 0
    return {
        "rmse": float(np.sqrt(np.mean((binned.force_n[usable] - found.force_n[usable]) ** 2))),
        "rmse_by_phase": dict(by_phase.by_kind_n),
        "rmse_held_out": held_out,
        "full_model": _full(taken.full, found.force_n, binned, usable),
        "coverage90": inference.coverage(binned, *bands.interval(0.9)),
        "log_evidence": found.log_evidence,
        "theta": taken.draws.summary,
        "sampled": {
            "settled": taken.draws.settled,
            "rhat": taken.draws.rhat,
            "effective": taken.draws.effective,
        },
    }


def _full(
    full: FullResult, force_n: Array, binned: BinnedForce, usable: NDArray[np.bool_]
) -> dict[str, Any] | None:
    """RMSE [N] of the full model where its own fit ended, and how far the surrogate's is off from it."""
    if not isinstance(full, FullFit):
        return None if full is None else {"message": full}

    def rms(values: Array) -> float:
        return float(np.sqrt(np.mean(values[usable] ** 2)))

    return {
        "rmse": rms(binned.force_n - full.force_n),
        "rmse_by_phase": dict(inference.rmse(binned, full.force_n).by_kind_n),
        "fit_off_by": rms(force_n - full.force_n),
        "runs": full.runs,
        "gained": full.gained,
        "theta": dict(full.theta),
    }


def _files(run: Run) -> list[Path]:
    return effect_files(run) if run.config.model.observation == "reaction" else []


STAGE = Stage(
    "diagnose",
    "finds what the model leaves out",
    ("recording", "design", "train"),
    ("seed", "model", "parameters", "noise", "surrogate"),
    _work,
    _files,
)
