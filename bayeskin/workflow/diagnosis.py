"""Diagnosis of a recording of any protocol and device: mismatches located, mechanisms named, fits shown."""

from __future__ import annotations

import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bayeskin import inference, report
from bayeskin.config import Config, RecordingConfig, parameter_space
from bayeskin.device import load_device_file
from bayeskin.errors import InputError
from bayeskin.forward.reduced import ReducedForward, stands_for
from bayeskin.inference.noise_model import bins_in_windows
from bayeskin.json_files import plain, write_json
from bayeskin.mechanisms import Mechanism
from bayeskin.mismatch.context import DiagnosisContext
from bayeskin.mismatch.contributions import Contribution, contributions
from bayeskin.mismatch.discrepancy import discrepancy
from bayeskin.mismatch.emulate import EmulatedPosterior, emulate
from bayeskin.mismatch.fit import Fit
from bayeskin.mismatch.form import propose_form
from bayeskin.mismatch.held_out import end_of_second_hold, fit_beginning
from bayeskin.mismatch.hypotheses import Evidences, Family, Judgement, judge_family
from bayeskin.mismatch.locate import Located, locate
from bayeskin.mismatch.resample import PosteriorDraws, resample
from bayeskin.mismatch.search import search
from bayeskin.mismatch.search_context import noise_of
from bayeskin.mismatch.search_record import SearchResult
from bayeskin.mismatch.tasks import AnswerTasks, FullRunTask, RunTask, Task
from bayeskin.mismatch.trust_region import SetFit, within
from bayeskin.recordings import read_recording
from bayeskin.reduced.region import protocol_outside
from bayeskin.surrogates import train
from bayeskin.types import Array, BinnedForce, Design, Surrogate
from bayeskin.workflow import design, recording, training
from bayeskin.workflow.diagnosis_outputs import (
    DiagnosisFigures,
    DrawnFit,
    Remainder,
    candidates,
    draw,
    unexplained,
    window,
)
from bayeskin.workflow.diagnosis_tasks import ContextSource, asked, open_context, searches_file
from bayeskin.workflow.engine import CannotGoOn, Reporter, Run, Stage, open_run, run_stages
from bayeskin.workflow.model import model_spec
from bayeskin.workflow.provenance import caption
from bayeskin.workflow.reducing import reduced_file

POSSIBLE = 1e-6  # probability of a set, below which it is not fitted to the beginning
PREDICTIVE_DRAWS = 300
REACH = 0.5  # of the prior's width on either side of a run, within which its tangent is sampled
KNOWN = "pads that open, by what and as fast as the reduced model was trained on"
NAME = "diagnose"


def diagnose(source: Path, reporter: Reporter, device: Path | None = None) -> dict[str, Any]:
    """Returns the answer of `bayeskin diagnose` on a configuration's run, or on a recording by itself.

    device : file of the device that a recording by itself was made with

    Outputs go to the run's folder, or to STEM-diagnosis beside the recording. Raises InputError for bad
    input, among it a device without a reduced model.
    """
    run = opened(source, reporter, device)
    _files(run)  # a device without a reduced model is refused before anything is written
    outcome = run_stages(run, stages_of(run.config))[-1]
    answer = {**outcome.record.summary, "ok": outcome.ok, "folder": run.folder / NAME}
    text = in_words(answer) if outcome.record.done else f"{outcome.stage}: failed: {answer['message']}"
    return plain({**answer, "text": text})


def opened(source: Path, reporter: Reporter, device: Path | None = None) -> Run:
    """Returns a configuration's run, or that of a recording by itself, made with the device of a file.

    Raises InputError for bad input, and for a device beside a configuration, which states its own.
    """
    if source.suffix == ".toml":
        if device is not None:
            raise InputError(
                "--device", f"{device} beside a configuration", "the device in [device] and [tissue]"
            )
        return open_run(source, reporter)
    read_recording(source)
    sections: dict[str, Any] = {} if device is None else dict(load_device_file(device))
    name = re.sub(r"[^A-Za-z0-9._-]", "-", f"run-{source.stem}")
    config = Config(name=name, recording=RecordingConfig(file=source.name), **sections)
    return Run(config, source, source.resolve().with_name(f"{source.stem}-diagnosis"), reporter)


def stages_of(config: Config) -> dict[str, Stage]:
    """Returns the stages of a diagnosis, in their order."""
    before = {stage.name: stage for stage in (recording.STAGE, design.STAGE, training.STAGE)}
    own = stage_of(config)
    return {name: before[name] for name in own.needs} | {NAME: own}


def source_of(run: Run) -> ContextSource:
    """Returns what the context of a run's diagnosis is opened from, once the stages before are done.

    Raises InputError for a device without a reduced model.
    """
    spec, reduced = model_spec(run), _files(run)
    model = reduced[0] if reduced else run.at("train", "surrogate.h5")
    stated = tuple((name, bounds) for name, bounds in run.config.noise if bounds is not None)
    base = parameter_space(run.config, run.config_path)
    return ContextSource(run.folder / "recording", model, spec, run.config.seed, base, stated)


def context_of(run: Run, source: ContextSource) -> DiagnosisContext:
    """Returns the context of a run's diagnosis. Raises InputError for a protocol outside of the training."""
    context = open_context(source)
    if isinstance(context.forward, ReducedForward):
        beyond = protocol_outside(context.forward.model.trained.protocols, context.motion)
        if beyond:
            found = f"a protocol that {source.model.name} does not know: {beyond[0]}"
            raise InputError(run.config_path, found, KNOWN)
    return context


def searched(run: Run, context: DiagnosisContext, ask: AnswerTasks) -> SearchResult:
    """Returns the search of a run; after a diagnosis all its answers are kept."""
    tell = partial(_tell, run)
    known, solves = context.known, context.forward.solves
    return search(ask, context.binned, context.base, known, solves, context.noise, run.config.seed, tell)


def _work(run: Run) -> Mapping[str, Any]:
    started, seed = time.monotonic(), run.config.seed
    source = source_of(run)
    context = context_of(run, source)
    kept = searches_file(run.folder, context)
    with asked(source, context, kept, run.config.design.workers) as ask:
        found = searched(run, context, ask)
        if not found.evidences:
            raise CannotGoOn("no set of mechanisms could be weighed")
        evidences, family, best = found.evidences, found.family, found.chosen
        explained = _explained(context.binned, found.fits[()].fit, found.fits[best].fit)
        judged = judge_family(family, context.known, explained)
        split_s = end_of_second_hold(context.binned)
        possible = [names for names in evidences
                    if not names or family.probability_of_set(names) > POSSIBLE]  # fmt: skip
        begun = fit_beginning(ask, [found.fits[names] for names in possible], split_s)
        run.reporter.log("runs where the posterior is, and draws of it")
        maxima = [found.fits[best], *found.others_of(best)]
        emulated = _emulated(context, ask, maxima, seed)
    base, chosen = found.fits[()].fit, emulated.fit
    before, after = (
        locate(fit, {**fit.theta, **_noise_of(fit, chosen.theta)}, seed) for fit in (base, chosen)
    )
    drawn = {best: emulated.draws}
    if best != ():
        drawn[()] = _drawn(base, seed)
    pictured = {
        names: _shown(fit, windows, drawn[names], fitted)
        for names, fit, windows, fitted in (
            ((), base, before, None if begun is None else begun.base),
            (best, chosen, after, None if begun is None else begun.best),
        )
    }  # fmt: skip
    parts = contributions(best, chosen.theta, context.reported, context.known)
    remainder = None
    if judged.verdict == "unknown" or (judged.named and after.windows):
        left = discrepancy(found.fits[best].fit, context.motion)
        remainder = Remainder(left, propose_form(chosen, context.motion, seed))
    answer: dict[str, Any] = {
        "verdict": judged.verdict,
        "nothing_probability": judged.nothing_probability,
        "smooth_probability": judged.smooth_probability,
        "explained": explained,
        "located": [window(one) for one in before.windows],
        "remaining": [window(one) for one in after.windows],
        "mechanisms": _mechanisms(judged, chosen, drawn[best].summary, context.known, parts),
        "unexplained": None if remainder is None else unexplained(remainder),
        "candidates": candidates({names: one.fit for names, one in found.fits.items()}, context.known),
        "sets": [_set(names, found, said, family) for names, said in evidences.items()],
        "fit": {
            "before": _fit(context.binned, base, drawn[()], pictured[()], split_s),
            "after": {
                **_fit(context.binned, chosen, drawn[best], pictured[best], split_s),
                "emulator": {
                    "runs": emulated.runs, "off_by": emulated.error_n, "settled": emulated.settled,
                },
            },
        },
        "best_set": list(best),
        "held_out_set": None if begun is None else list(begun.best.names),
        "full_model": _checked(context, found, best),
        "seconds": time.monotonic() - started,
    }  # fmt: skip
    write_json(run.at(NAME, "diagnosis.json"), answer)
    figures = draw(
        run.folder / NAME, caption(run), context.binned, context.motion,
        DiagnosisFigures(
            pictured[()], pictured[best], None if begun is None else split_s, context.base.parameters, parts,
            remainder,
        ),
        answer["candidates"],
    )  # fmt: skip
    return {**answer, "figures": [figure.name for figure in figures]}


def _explained(binned: BinnedForce, base: Fit, best: Fit) -> float:
    """Returns the share of the base fit's squared misfit that another fit explains."""
    usable = bins_in_windows(binned, None) >= 0
    before, after = (_rms((binned.force_n - one.force_n)[usable]) for one in (base, best))
    return 1.0 - after**2 / before**2


def _tell(run: Run, text: str) -> None:
    run.reporter.log(f"search: {text}")


def _noise_of(fit: Fit, values: Mapping[str, float]) -> dict[str, float]:
    """Values of the noise's parameters among others'."""
    space = fit.log_posterior.surrogate.space.names
    return {name: values[name] for name in fit.log_posterior.names if name not in space}


def _drawn(fit: Fit, seed: int) -> PosteriorDraws:
    """Draws of the posterior about a fit's run, as far from it as `REACH`."""
    about = fit.log_posterior
    near = within(about, np.clip(about.vector(fit.theta), *about.bounds), REACH)
    return resample(replace(fit, log_posterior=near), seed)


def _emulated(
    context: DiagnosisContext, ask: AnswerTasks, maxima: Sequence[SetFit], seed: int
) -> EmulatedPosterior:
    """A set's posterior from reduced runs where it is; about the fit's run where none of them finishes."""
    found = maxima[0]
    names, space = found.fit.names, context.space(found.fit.names)

    def forces(points: Array, count: int) -> tuple[list[Any], list[Any]]:
        values = [dict(zip(space.names, map(float, row), strict=True)) for row in points]
        tasks: list[Task] = [FullRunTask(names, one) for one in values[:count]]
        answers: list[Any] = ask([*tasks, *(RunTask(names, one) for one in values)])
        return answers[count:], answers[:count]

    learn = partial(_learnt, seed=seed)
    emulated = emulate(maxima, forces, learn, noise_of(context.binned), seed)
    if isinstance(emulated, str):
        return EmulatedPosterior(found.fit, _drawn(found.fit, seed), 0, None, False)
    return emulated


def _learnt(design: Design, seed: int) -> Surrogate:
    return train(design, "gp", seed)[0]


def _mechanisms(
    judged: Judgement, chosen: Fit, values: Mapping[str, Mapping[str, Any]],
    known: Mapping[str, Mechanism], parts: Sequence[Contribution],
) -> list[dict[str, Any]]:  # fmt: skip
    sizes = {part.name: part.size_n for part in parts}
    rows = []
    for one in judged.named:
        mechanism = known[one.name]
        rows.append({
            "name": one.name, "probability": one.probability, "group": list(one.group),
            "group_probability": one.group_probability, "contribution_n": sizes.get(one.name),
            "parameters": {p.name: {**values[p.name], "unit": p.unit}
                           for p in mechanism.parameters if p.name in values},
            "statement": mechanism.statement({**mechanism.neutral, **chosen.theta}),
        })  # fmt: skip
    return rows


def _set(names: tuple[str, ...], found: SearchResult, said: Evidences, family: Family) -> dict[str, Any]:
    one: SetFit = found.fits[names]
    return {
        "mechanisms": list(names), "probability": family.probability_of_set(names),
        "log_evidence": one.fit.log_evidence, "log_evidence_alone": said.alone,
        "log_evidence_with_smooth": said.with_discrepancy,
        "settled": one.settled, "runs": one.runs,
    }  # fmt: skip


def _fit(
    binned: BinnedForce, fit: Fit, drawn: PosteriorDraws, shown: DrawnFit, split_s: float | None
) -> dict[str, Any]:
    usable, held_out = bins_in_windows(binned, None) >= 0, None
    if shown.held_out_n is not None and split_s is not None:
        rest = bins_in_windows(binned, ((split_s, float(binned.edges_s[-1])),)) >= 0
        held_out = _rms((binned.force_n - shown.held_out_n)[rest])
    return {
        "rmse": _rms((binned.force_n - fit.force_n)[usable]),
        "rmse_of_mean": _rms((binned.force_n - fit.mean_n)[usable]),
        "rmse_by_phase": dict(inference.rmse(binned, fit.force_n).by_kind_n),
        "rmse_held_out": held_out,
        "coverage90": inference.coverage(binned, *shown.band_n),
        "log_evidence": fit.log_evidence,
        "theta": drawn.summary,
        "sampled": {"settled": drawn.settled, "rhat": drawn.rhat, "effective": drawn.effective},
    }


def _shown(fit: Fit, located: Located, drawn: PosteriorDraws, begun: Fit | None) -> DrawnFit:
    some = inference.evenly(drawn.draws, PREDICTIVE_DRAWS)
    band_n = inference.bands(fit.log_posterior, some, np.random.default_rng(1)).interval(0.9)
    return DrawnFit(fit.force_n, band_n, None if begun is None else begun.force_n, located, drawn.summary)


def _checked(context: DiagnosisContext, found: SearchResult, names: tuple[str, ...]) -> dict[str, Any]:
    """Returns how far the reduced model and the recording are from a full run at a set's fit."""
    check, fit = found.checks.get(names), found.fits[names].fit
    if check is None or isinstance(check.full_n, str):
        return {"message": "no run was made" if check is None else check.full_n}
    full_n = context.reported_of(names, fit.theta, check.full_n)
    usable = bins_in_windows(context.binned, None) >= 0
    return {"fit_off_by": check.off, "rmse": _rms((context.binned.force_n - full_n)[usable])}


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def in_words(answer: Mapping[str, Any]) -> str:
    """The answer as text."""
    lines = [f"verdict: {answer['verdict']}"]
    lines += [f"  {one['name']} (probability {one['probability']:.2f}): {one['statement']}"
              for one in answer["mechanisms"]]  # fmt: skip
    lines.append(f"  nothing is missing: probability {answer['nothing_probability']:.2f}")
    lines.append(
        f"  something smooth that is not in the catalogue: probability {answer['smooth_probability']:.2f}"
    )
    if faint := report.faint_in_words(answer):
        lines.append(f"  {faint}")
    lines.append(
        f"The model leaves the recording in {len(answer['located'])} windows, "
        f"and in {len(answer['remaining'])} with {', '.join(answer['best_set']) or 'no mechanism'}."
    )
    for when in ("before", "after"):
        held = answer["fit"][when]["rmse_held_out"]
        rest = "" if held is None else f", {1e3 * held:.1f} mN on what follows the second hold, not fitted"
        lines.append(f"{when}: RMSE {1e3 * answer['fit'][when]['rmse']:.1f} mN{rest}")
    full = answer["full_model"]
    if "message" in full:
        lines.append(f"The full model fails at the best values: {full['message']}")
    else:
        lines.append(
            f"A run of the full model at the best values, without what is allowed for its mesh and the load "
            f"cell: RMSE {1e3 * full['rmse']:.1f} mN. The model that was fitted is off "
            f"by {1e3 * full['fit_off_by']:.2f} mN there."
        )
    after = answer["fit"]["after"]
    if not (after["emulator"]["settled"] and after["sampled"]["settled"]):
        lines.append("The intervals are rough: the runs or the draws that they rest on did not settle.")
    best = ", ".join(f"{one['name']} {one['delta_score']:+.1f}" for one in answer["candidates"][:5])
    if best:
        lines.append(f"log evidence that single mechanisms gain: {best}")
    lines.append(f"outputs in {answer['folder']}")
    return "\n".join(lines)


def _files(run: Run) -> list[Path]:
    spec = model_spec(run)
    return [reduced_file(spec.geometry, [run.config_path])] if stands_for(spec) else []


STAGE = Stage(
    NAME,
    "finds what the model leaves out",
    ("recording",),
    ("seed", "model", "parameters", "noise"),
    _work,
    _files,
)


def stage_of(config: Config) -> Stage:
    """Returns the stage; a model that no reduced one stands for needs a surrogate before it."""
    if (config.model.observation, config.model.mesh) == ("reaction", "bricks"):
        return STAGE
    return replace(STAGE, needs=("recording", "design", "train"))
