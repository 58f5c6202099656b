"""Diagnosis of a recording: mismatches located, mechanisms tried and named, the fit before and after."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import bayeskin
from bayeskin import inference
from bayeskin.config import Config
from bayeskin.errors import InputError
from bayeskin.inference.noise_model import bins_in_windows
from bayeskin.mechanisms import with_one
from bayeskin.mismatch.fit import Fit, much_left, restored, stored
from bayeskin.mismatch.full_fit import FullFit
from bayeskin.mismatch.held_out import end_of_second_hold
from bayeskin.mismatch.locate import Located
from bayeskin.mismatch.search import Build, Made, Search, search
from bayeskin.mismatch.verdict import Diagnosis, judge, set_probability
from bayeskin.pipeline import design, joint_diagnosis, recording, training
from bayeskin.pipeline.diagnosis_outputs import (
    Found,
    candidates,
    draw,
    in_words,
    mechanism,
    shown,
    unexplained,
    window,
)
from bayeskin.pipeline.effects import effect_files
from bayeskin.pipeline.engine import Reporter, Run, Silent, Stage, run_stages
from bayeskin.pipeline.folder import plain, read_lines, sha256_of, write_json
from bayeskin.pipeline.provenance import caption
from bayeskin.pipeline.taking_up import FullResult, TakenUp, take_up, take_up_rivals
from bayeskin.pipeline.workbench import Workbench, opened, workbench
from bayeskin.types import Array, BinnedForce
from bayeskin.workers import Lost, run_parallel


def diagnose(source: Path, reporter: Reporter, device: Path | None = None) -> dict[str, Any]:
    """The answer of `bayeskin diagnose` on a configuration's run, or on a recording by itself.

    `device` is the file of the device that a recording by itself was made with. Outputs go to the run's
    folder, or to STEM-diagnosis beside the recording. Raises InputError for bad input, among it a device
    without a reduced model.
    """
    run = opened(source, reporter, device)
    outcome = run_stages(run, stages_of(run.config))[-1]
    answer = {**outcome.record.summary, "ok": outcome.ok, "folder": run.folder / STAGE.name}
    said = in_words if by_effects(run.config) else joint_diagnosis.in_words
    text = said(answer) if outcome.record.done else f"{outcome.stage}: failed: {answer['message']}"
    return plain({**answer, "text": text})


def by_effects(config: Config) -> bool:
    """Returns whether surrogates of effects are added up, in the place of mechanisms solved together."""
    return config.model.observation == "reaction" and config.design.coarse != "reduced"


def stages_of(config: Config) -> dict[str, Stage]:
    """The stages of a diagnosis, in their order."""
    own = {"diagnose": STAGE} if by_effects(config) else {"diagnose": joint_diagnosis.stage_of(config)}
    before = {stage.name: stage for stage in (recording.STAGE, design.STAGE, training.STAGE)}
    return {name: before[name] for name in own["diagnose"].needs} | own


def _work(run: Run) -> Mapping[str, Any]:
    started = time.monotonic()
    bench = workbench(run)
    split_s = end_of_second_hold(bench.binned)
    beginning = (lambda: None) if split_s is None else _search_beside(run, bench, split_s)
    whole = _searched(bench, None, lambda: found.best if (found := beginning()) else None)
    whole.learnt = bench.learnt
    begun = beginning()
    run.reporter.log("the full model takes up what was found")
    taken, begins = take_up(
        run, _base_and_best(whole), whole.best.theta, _base_and_best(begun) if begun else [], split_s
    )
    held_out = begins or [None]
    before, after = taken[0], taken[-1]
    if after.full is not None and (rivals := whole.rivals(after.full_weight)):
        run.reporter.log("the full model takes up what else it may be")
        judged = take_up_rivals(run, rivals, whole.best.theta, after.full_weight)
        after = _likeliest(whole, before, after, rivals, judged)
    probability = set_probability(whole.best.names, before.evidence, after.evidence)
    found = judge(
        whole, bench.known, before.located, after.located, (before.full_weight, after.full_weight),
        probability, (before.left_out_n, after.left_out_n),
    )  # fmt: skip
    left = after if found.believed else before
    remainder = left.remainder if leaves_something(found, after.located) else None
    best = after.full.theta if isinstance(after.full, FullFit) else whole.best.theta
    answer: dict[str, Any] = {
        "verdict": found.verdict,
        "located": [window(one) for one in before.located.windows],
        "remaining": [window(one) for one in after.located.windows],
        "explained": found.explained,
        "unknown_probability": found.unknown_probability,
        "set_probability": probability if whole.best.names else None,
        "mechanisms": [
            mechanism(one, bench.known[one.name], after.parts, after.draws.summary, best)
            for one in found.named
        ],
        "unexplained": None if remainder is None else unexplained(remainder),
        "candidates": candidates(whole, bench.known),
        "unsure": [
            name
            for name in bench.known
            if (one := whole.unsure.get(with_one((), name, bench.known))) and not bench.refuted(one)
        ],
        "refuted": sorted(
            {name for one in whole.unsure.values() for name in bench.refuted(one)} - {*whole.best.names}
        ),
        "fit": {
            "before": _fit(bench, whole.base, before, begun.base if begun else None, held_out[0], split_s),
            "after": _fit(bench, whole.best, after, begun.best if begun else None, held_out[-1], split_s),
        },
        "best_set": list(whole.best.names),
        "held_out_set": list(begun.best.names) if begun else [],
        "seconds": time.monotonic() - started,
    }
    write_json(run.at(STAGE.name, "diagnosis.json"), answer)
    figures = draw(
        run.folder / STAGE.name, caption(run), bench.binned, bench.motion,
        Found(
            shown(whole.base, before, begun.base if begun else None, held_out[0]),
            shown(whole.best, after, begun.best if begun else None, held_out[-1]),
            split_s, whole.base.log_posterior.surrogate.space.parameters, after.parts, remainder,
        ),
        answer["candidates"],
    )  # fmt: skip
    return {**answer, "figures": [figure.name for figure in figures]}


def _likeliest(
    whole: Search, before: TakenUp, after: TakenUp, rivals: Sequence[Fit],
    judged: Sequence[TakenUp | float | None],
) -> TakenUp:  # fmt: skip
    """Returns what follows the likeliest, by the full model, of the best set and its rivals.

    One that the full model cannot run goes for none that it can run and that leaves much.
    """
    full = {(): before.full_weight, whole.best.names: after.full_weight}
    taken = {(): before, whole.best.names: after}
    for rival, its in zip(rivals, judged, strict=True):
        if its is None or isinstance(its, float):
            full[rival.names] = its
        else:
            full[rival.names], taken[rival.names] = its.full_weight, its
    if after.full_weight is None:
        for names, one in taken.items():
            if isinstance(one.full, FullFit) and much_left(whole.fits[names].log_posterior, one.full.theta):
                full[names] = None
    if any(one is not None for one in full.values()):
        whole.full = {names: -np.inf if one is None else one for names, one in full.items()}
    return taken[whole.best.names]


def _base_and_best(found: Search) -> list[Fit]:
    """One fit where nothing beats the base."""
    return [found.base, found.best] if found.best.names else [found.base]


def leaves_something(found: Diagnosis, after: Located) -> bool:
    """Returns whether the mismatch is unknown, or windows remain beside named mechanisms."""
    return found.verdict == "unknown" or (found.verdict == "named" and bool(after.windows))


def _search_beside(run: Run, bench: Workbench, split_s: float) -> Callable[[], Search]:
    """The search on the beginning in a process of its own that ends with this one; what is returned waits."""
    ended: list[Any] = []
    search_it = partial(_search_apart, run.config_path)
    thread = threading.Thread(target=lambda: ended.extend(run_parallel(search_it, [split_s], 1)), daemon=True)
    thread.start()

    @cache
    def beginning() -> Search:
        if thread.is_alive():
            run.reporter.log("waiting for the search on the recording's beginning")
        thread.join()
        made = _made_in(bench, partial(bench.posterior, split_s))
        whole = ended and not isinstance(ended[0][1], Lost) and any(not one.fit.names for one in made)
        return _as_search(made) if whole else _searched(bench, split_s)

    return beginning


def _search_apart(source: Path, split_s: float) -> None:
    _searched(workbench(opened(source, Silent())), split_s)


def fits_of(bench: Workbench) -> list[Fit]:
    """All sets that the search on the whole recording has tried so far."""
    found = _as_search(_made_in(bench, partial(bench.posterior, None)))
    return [*found.fits.values(), *found.unsure.values()]


def _as_search(made: Sequence[Made]) -> Search:
    found = Search()
    for one in made:
        found.add(one)
    return found


def _search_file(bench: Workbench, build: Build) -> Path:
    """Returns the file in which a search keeps its fits, by all that they depend on."""
    identity = sha256_of(
        [bayeskin.__version__, bench.run.config.seed, build(()).identity, repr(build(()).noise_priors),
         [repr(mechanism.parameters) for mechanism in bench.known.values()],
         [[effect.part, dict(effect.surrogate.provenance)] for effect in bench.effects], vars(bench.jumps)]
    )  # fmt: skip
    return bench.run.folder / "searches" / f"{identity[:16]}-made.jsonl"


def _searched(
    bench: Workbench, until_s: float | None, another: Callable[[], Fit | None] = lambda: None
) -> Search:
    """The search up to a time, going on from the fits that one stopped before has left."""
    run, build = bench.run, partial(bench.posterior, until_s)
    label = "whole recording" if until_s is None else f"up to {until_s:.1f} s"
    file = _search_file(bench, build)
    done = _made_in(bench, build)
    file.parent.mkdir(parents=True, exist_ok=True)
    with open(file, "a", encoding="utf-8") as handle:

        def on_fit(made: Made) -> None:
            handle.write(json.dumps({**stored(made.fit), "counts": made.counts}) + "\n")
            handle.flush()

        return search(
            build, bench.known, run.config.seed,
            lambda share, note: run.reporter.progress(label, share, note), done, on_fit, another,
            lambda one: bool(bench.refuted(one)), exchanges=until_s is None,
        )  # fmt: skip


def _made_in(bench: Workbench, build: Build) -> list[Made]:
    """Returns the fits that a search has made so far, in order."""
    file = _search_file(bench, build)
    rows = read_lines(file)
    try:
        return [Made(restored(said, build(said["names"])), said["counts"]) for said in rows]
    except (KeyError, TypeError):
        raise InputError(file, "no fits of a search", "those that `diagnose` wrote, or no file") from None


def _fit(
    bench: Workbench, found: Fit, taken: TakenUp, begun: Fit | None, held_out: FullResult,
    split_s: float | None,
) -> dict[str, Any]:  # fmt: skip
    """RMSE [N] of a fit: whole, without the surrogate's error (`rmse_of_mean`), by phase, of phases left out;
    of one to the beginning, of what follows."""
    binned = bench.binned
    usable = bins_in_windows(binned, None) >= 0
    rest = usable
    if split_s is not None:
        rest = bins_in_windows(binned, ((split_s, float(binned.edges_s[-1])),)) >= 0
    return {
        "rmse": _rms(binned.force_n - found.force_n, usable),
        "rmse_of_mean": _rms(binned.force_n - found.mean_n, usable),
        "rmse_by_phase": dict(inference.rmse(binned, found.force_n).by_kind_n),
        "rmse_held_out": None if begun is None else _rms(binned.force_n - begun.force_n, rest),
        "full_model": _full(taken, held_out, found.force_n, binned, usable, rest),
        "rmse_left_out": taken.left_out_n,
        "coverage90": inference.coverage(binned, *taken.band_n),
        "log_evidence": found.log_evidence,
        "theta": taken.draws.summary,
        "sampled": {
            "settled": taken.draws.settled,
            "rhat": taken.draws.rhat,
            "effective": taken.draws.effective,
        },
    }


def _full(
    taken: TakenUp, held_out: FullResult, force_n: Array, binned: BinnedForce,
    usable: NDArray[np.bool_], rest: NDArray[np.bool_],
) -> dict[str, Any] | None:  # fmt: skip
    """RMSE [N] of the full model where its own fits ended, with what is allowed for its mesh and the load
    cell (`mesh_n`, RMS) and of the run as it is; how far the surrogate's fit is off from it."""
    full = taken.full
    if not isinstance(full, FullFit):
        return None if full is None else {"message": full}
    begun = held_out if isinstance(held_out, FullFit) else None
    return {
        "rmse": _rms(binned.force_n - full.force_n, usable),
        "rmse_by_phase": dict(inference.rmse(binned, full.force_n).by_kind_n),
        "rmse_held_out": None if begun is None else _rms(binned.force_n - begun.force_n, rest),
        "rmse_of_run": _rms(binned.force_n - full.force_n + full.mesh_n, usable),
        "mesh_n": _rms(full.mesh_n, usable),
        "fit_off_by": _rms(force_n - full.force_n, usable),
        "runs": full.runs,
        "gained": full.gained,
        "settled": full.settled,
        "log_weight": taken.full_weight,
        "theta": dict(full.theta),
    }


def _rms(values: Array, among: NDArray[np.bool_]) -> float:
    return float(np.sqrt(np.mean(values[among] ** 2)))


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
