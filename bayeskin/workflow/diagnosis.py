"""Diagnoses a recording of any protocol and device: locates mismatches, names mechanisms, and shows fits."""

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

POSSIBLE = 1e-6  # probability of a set below which it is not fitted to the recording's beginning
PREDICTIVE_DRAWS = 300  # number of posterior draws from which predictive bands are computed
REACH = 0.5  # distance from a run within which its tangent is sampled, as a share of the prior's width
KNOWN = "pads that only open, no further and no faster than in the training of the reduced model"
NAME = "diagnose"


def diagnose(source: Path, reporter: Reporter, device: Path | None = None) -> dict[str, Any]:
    """Returns the answer of `bayeskin diagnose` for a configuration's run, or for a single recording.

    Outputs go to the run's folder, or for a single recording to STEM-diagnosis in the recording's folder.

    source : configuration or recording; device : file of the device with which a single recording was made
    Raises InputError for bad input, and for a device without a reduced model.
    """
    run = opened(source, reporter, device)
    _files(run)  # a device without a reduced model is refused before anything is written
    outcome = run_stages(run, stages_of(run.config))[-1]
    answer = {**outcome.record.summary, "ok": outcome.ok, "folder": run.folder / NAME}
    text = in_words(answer) if outcome.record.done else f"{outcome.stage}: failed: {answer['message']}"
    return plain({**answer, "text": text})


def opened(source: Path, reporter: Reporter, device: Path | None = None) -> Run:
    """Returns the run of a configuration, or of a single recording that was made with the device of a file.

    Raises InputError for bad input, and for a device file together with a configuration, which states its
    own device.
    """
    if source.suffix == ".toml":
        if device is not None:
            raise InputError(
                "--device", f"{device} together with a configuration", "its sections [device] and [tissue]"
            )
        return open_run(source, reporter)
    read_recording(source)
    sections: dict[str, Any] = {} if device is None else dict(load_device_file(device))
    name = re.sub(r"[^A-Za-z0-9._-]", "-", f"run-{source.stem}")
    config = Config(name=name, recording=RecordingConfig(file=source.name), **sections)
    return Run(config, source, source.resolve().with_name(f"{source.stem}-diagnosis"), reporter)


def stages_of(config: Config) -> dict[str, Stage]:
    """Returns the stages of a diagnosis by name, in their order."""
    earlier = {stage.name: stage for stage in (recording.STAGE, design.STAGE, training.STAGE)}
    own_stage = stage_of(config)
    return {name: earlier[name] for name in own_stage.needs} | {NAME: own_stage}


def source_of(run: Run) -> ContextSource:
    """Returns the files and settings from which the context of a run's diagnosis is opened.

    The files exist once the earlier stages are done. Raises InputError for a device without a reduced model.
    """
    spec, reduced = model_spec(run), _files(run)
    model = reduced[0] if reduced else run.at("train", "surrogate.h5")
    stated = tuple((name, bounds) for name, bounds in run.config.noise if bounds is not None)
    base = parameter_space(run.config, run.config_path)
    return ContextSource(run.folder / "recording", model, spec, run.config.seed, base, stated)


def context_of(run: Run, source: ContextSource) -> DiagnosisContext:
    """Returns the context of a run's diagnosis.

    Raises InputError for a protocol outside the training range of the reduced model.
    """
    context = open_context(source)
    if isinstance(context.forward, ReducedForward):
        outside = protocol_outside(context.forward.model.trained.protocols, context.motion)
        if outside:
            problem = f"a protocol that {source.model.name} was not trained for: {outside[0]}"
            raise InputError(run.config_path, problem, KNOWN)
    return context


def searched(run: Run, context: DiagnosisContext, ask: AnswerTasks) -> SearchResult:
    """Returns the result of a run's search for mechanisms.

    After a diagnosis it needs no model runs, because all answers to its tasks have been kept.
    """
    tell = partial(_tell, run)
    known, solves = context.known, context.forward.solves
    return search(ask, context.binned, context.base, known, solves, context.noise, run.config.seed, tell)


def _work(run: Run) -> Mapping[str, Any]:
    """Diagnoses a run: writes the answer and the figures, and returns the answer.

    Raises CannotGoOn where no set of mechanisms has an evidence.
    """
    started, seed = time.monotonic(), run.config.seed
    source = source_of(run)
    context = context_of(run, source)
    answers_file = searches_file(run.folder, context)
    with asked(source, context, answers_file, run.config.design.workers) as ask:
        search_result = searched(run, context, ask)
        if not search_result.evidences:
            raise CannotGoOn("no set of mechanisms could be assessed")
        evidences, family, best = search_result.evidences, search_result.family, search_result.chosen
        explained = _explained_share(context.binned, search_result.fits[()].fit, search_result.fits[best].fit)
        judgement = judge_family(family, context.known, explained)
        split_s = end_of_second_hold(context.binned)
        possible_sets = [names for names in evidences
                         if not names or family.probability_of_set(names) > POSSIBLE]  # fmt: skip
        beginning = fit_beginning(ask, [search_result.fits[names] for names in possible_sets], split_s)
        run.reporter.log("runs in the region of the posterior, and draws from it")
        maxima = [search_result.fits[best], *search_result.others_of(best)]
        emulated = _posterior_by_emulator(context, ask, maxima, seed)
    base, chosen = search_result.fits[()].fit, emulated.fit
    before, after = (
        locate(fit, {**fit.theta, **_noise_values(fit, chosen.theta)}, seed) for fit in (base, chosen)
    )
    drawn = {best: emulated.draws}
    if best != ():
        drawn[()] = _draws_near_run(base, seed)
    figure_data = {
        names: _figure_data(fit, windows, drawn[names], fitted)
        for names, fit, windows, fitted in (
            ((), base, before, None if beginning is None else beginning.base),
            (best, chosen, after, None if beginning is None else beginning.best),
        )
    }  # fmt: skip
    parts = contributions(best, chosen.theta, context.reported, context.known)
    remainder = None
    if judgement.verdict == "unknown" or (judgement.named and after.windows):
        unnamed = discrepancy(search_result.fits[best].fit, context.motion)
        remainder = Remainder(unnamed, propose_form(chosen, context.motion, seed))
    answer: dict[str, Any] = {
        "verdict": judgement.verdict,
        "nothing_probability": judgement.nothing_probability,
        "smooth_probability": judgement.smooth_probability,
        "explained": explained,
        "located": [window(located) for located in before.windows],
        "remaining": [window(located) for located in after.windows],
        "mechanisms": _mechanism_entries(judgement, chosen, drawn[best].summary, context.known, parts),
        "unexplained": None if remainder is None else unexplained(remainder),
        "candidates": candidates(
            {names: set_fit.fit for names, set_fit in search_result.fits.items()}, context.known
        ),
        "sets": [_set_entry(names, search_result, both, family) for names, both in evidences.items()],
        "fit": {
            "before": _fit_entry(context.binned, base, drawn[()], figure_data[()], split_s),
            "after": {
                **_fit_entry(context.binned, chosen, drawn[best], figure_data[best], split_s),
                "emulator": {
                    "runs": emulated.runs, "off_by": emulated.error_n, "settled": emulated.settled,
                },
            },
        },
        "best_set": list(best),
        "held_out_set": None if beginning is None else list(beginning.best.names),
        "full_model": _full_model_entry(context, search_result, best),
        "seconds": time.monotonic() - started,
    }  # fmt: skip
    write_json(run.at(NAME, "diagnosis.json"), answer)
    figures = draw(
        run.folder / NAME, caption(run), context.binned, context.motion,
        DiagnosisFigures(
            figure_data[()], figure_data[best], None if beginning is None else split_s,
            context.base.parameters, parts, remainder,
        ),
        answer["candidates"],
    )  # fmt: skip
    return {**answer, "figures": [figure.name for figure in figures]}


def _explained_share(binned: BinnedForce, base: Fit, best: Fit) -> float:
    """Returns the share of the base fit's squared misfit that another fit explains."""
    usable = bins_in_windows(binned, None) >= 0
    before, after = (_rms((binned.force_n - fit.force_n)[usable]) for fit in (base, best))
    return 1.0 - after**2 / before**2


def _tell(run: Run, text: str) -> None:
    """Reports a line of progress of the search."""
    run.reporter.log(f"search: {text}")


def _noise_values(fit: Fit, values: Mapping[str, float]) -> dict[str, float]:
    """Returns the values of a fit's noise parameters, taken from values of all parameters."""
    space = fit.log_posterior.surrogate.space.names
    return {name: values[name] for name in fit.log_posterior.names if name not in space}


def _draws_near_run(fit: Fit, seed: int) -> PosteriorDraws:
    """Returns draws of the posterior near a fit's run, up to the distance `REACH` from it."""
    posterior = fit.log_posterior
    near = within(posterior, np.clip(posterior.vector(fit.theta), *posterior.bounds), REACH)
    return resample(replace(fit, log_posterior=near), seed)


def _posterior_by_emulator(
    context: DiagnosisContext, ask: AnswerTasks, maxima: Sequence[SetFit], seed: int
) -> EmulatedPosterior:
    """Returns the posterior of a set from an emulator, which learns from runs in the region of the posterior.

    If all runs of the first wave fail, the posterior near the fit's run is returned instead.

    maxima : fits of the set at its known maxima, the likeliest first
    """
    best = maxima[0]
    names, space = best.fit.names, context.space(best.fit.names)

    def forces(points: Array, count: int) -> tuple[list[Any], list[Any]]:
        thetas = [dict(zip(space.names, map(float, row), strict=True)) for row in points]
        tasks: list[Task] = [FullRunTask(names, theta) for theta in thetas[:count]]
        answers: list[Any] = ask([*tasks, *(RunTask(names, theta) for theta in thetas)])
        return answers[count:], answers[:count]

    learn = partial(_trained_emulator, seed=seed)
    emulated = emulate(maxima, forces, learn, noise_of(context.binned), seed)
    if isinstance(emulated, str):
        return EmulatedPosterior(best.fit, _draws_near_run(best.fit, seed), 0, None, False)
    return emulated


def _trained_emulator(design: Design, seed: int) -> Surrogate:
    """Returns a Gaussian process that is trained on a design."""
    return train(design, "gp", seed)[0]


def _mechanism_entries(
    judged: Judgement, chosen: Fit, values: Mapping[str, Mapping[str, Any]],
    known: Mapping[str, Mechanism], parts: Sequence[Contribution],
) -> list[dict[str, Any]]:  # fmt: skip
    """Returns the entries of the named mechanisms in the JSON.

    values : summaries of the parameters' draws; parts : contributions of the mechanisms to the force
    """
    sizes = {part.name: part.size_n for part in parts}
    rows = []
    for named in judged.named:
        mechanism = known[named.name]
        rows.append({
            "name": named.name, "probability": named.probability, "group": list(named.group),
            "group_probability": named.group_probability, "contribution_n": sizes.get(named.name),
            "parameters": {p.name: {**values[p.name], "unit": p.unit}
                           for p in mechanism.parameters if p.name in values},
            "statement": mechanism.statement({**mechanism.neutral, **chosen.theta}),
        })  # fmt: skip
    return rows


def _set_entry(
    names: tuple[str, ...], search_result: SearchResult, evidences: Evidences, family: Family
) -> dict[str, Any]:
    """Returns the entry of a compared set in the JSON."""
    set_fit: SetFit = search_result.fits[names]
    return {
        "mechanisms": list(names), "probability": family.probability_of_set(names),
        "log_evidence": set_fit.fit.log_evidence, "log_evidence_alone": evidences.alone,
        "log_evidence_with_smooth": evidences.with_discrepancy,
        "settled": set_fit.settled, "runs": set_fit.runs,
    }  # fmt: skip


def _fit_entry(
    binned: BinnedForce, fit: Fit, drawn: PosteriorDraws, figure_data: DrawnFit, split_s: float | None
) -> dict[str, Any]:
    """Returns the entry of a fit in the JSON: its errors, its coverage and its parameters.

    split_s : end of the part of the recording [s] to which the held-out prediction was fitted
    """
    usable, held_out = bins_in_windows(binned, None) >= 0, None
    if figure_data.held_out_n is not None and split_s is not None:
        after_split = bins_in_windows(binned, ((split_s, float(binned.edges_s[-1])),)) >= 0
        held_out = _rms((binned.force_n - figure_data.held_out_n)[after_split])
    return {
        "rmse": _rms((binned.force_n - fit.force_n)[usable]),
        "rmse_of_mean": _rms((binned.force_n - fit.mean_n)[usable]),
        "rmse_by_phase": dict(inference.rmse(binned, fit.force_n).by_kind_n),
        "rmse_held_out": held_out,
        "coverage90": inference.coverage(binned, *figure_data.band_n),
        "log_evidence": fit.log_evidence,
        "theta": drawn.summary,
        "sampled": {"settled": drawn.settled, "rhat": drawn.rhat, "effective": drawn.effective},
    }


def _figure_data(fit: Fit, located: Located, drawn: PosteriorDraws, beginning: Fit | None) -> DrawnFit:
    """Returns the data of a fit that figures show.

    beginning : fit of a set to the recording's beginning, if there is one
    """
    draws = inference.evenly(drawn.draws, PREDICTIVE_DRAWS)
    band_n = inference.bands(fit.log_posterior, draws, np.random.default_rng(1)).interval(0.9)
    return DrawnFit(
        fit.force_n, band_n, None if beginning is None else beginning.force_n, located, drawn.summary
    )


def _full_model_entry(
    context: DiagnosisContext, search_result: SearchResult, names: tuple[str, ...]
) -> dict[str, Any]:
    """Returns the entry of the full model in the JSON, from its run at a set's fit.

    It states the difference of the forward model from this run, and the RMSE of this run.
    """
    check, fit = search_result.checks.get(names), search_result.fits[names].fit
    if check is None or isinstance(check.full_n, str):
        return {"message": "no full run was made" if check is None else check.full_n}
    full_n = context.reported_of(names, fit.theta, check.full_n)
    usable = bins_in_windows(context.binned, None) >= 0
    return {"fit_off_by": check.off, "rmse": _rms((context.binned.force_n - full_n)[usable])}


def _rms(values: Array) -> float:
    """Returns the root of the mean square."""
    return float(np.sqrt(np.mean(values**2)))


def in_words(answer: Mapping[str, Any]) -> str:
    """Returns the answer as text."""
    lines = [f"verdict: {answer['verdict']}"]
    lines += [f"  {mechanism['name']} (probability {mechanism['probability']:.2f}): {mechanism['statement']}"
              for mechanism in answer["mechanisms"]]  # fmt: skip
    lines.append(f"  nothing is missing: probability {answer['nothing_probability']:.2f}")
    lines.append(f"  an unnamed smooth discrepancy: probability {answer['smooth_probability']:.2f}")
    if faint := report.faint_in_words(answer):
        lines.append(f"  {faint}")
    lines.append(
        f"The model deviates from the recording in {len(answer['located'])} windows, "
        f"and in {len(answer['remaining'])} with {', '.join(answer['best_set']) or 'no mechanism'}."
    )
    for label in ("before", "after"):
        rmse_held_out = answer["fit"][label]["rmse_held_out"]
        held_out_text = (
            ""
            if rmse_held_out is None
            else f", {1e3 * rmse_held_out:.1f} mN after the second hold, which was not fitted"
        )
        lines.append(f"{label}: RMSE {1e3 * answer['fit'][label]['rmse']:.1f} mN{held_out_text}")
    full = answer["full_model"]
    if "message" in full:
        lines.append(f"The full model fails at the best values: {full['message']}")
    else:
        lines.append(
            f"A run of the full model at the best values, without allowances for its mesh and the load "
            f"cell: RMSE {1e3 * full['rmse']:.1f} mN. The model that was fitted is off "
            f"by {1e3 * full['fit_off_by']:.2f} mN there."
        )
    after = answer["fit"]["after"]
    if not (after["emulator"]["settled"] and after["sampled"]["settled"]):
        lines.append("The intervals are approximate, because their runs or draws have not converged.")
    best = ", ".join(
        f"{candidate['name']} {candidate['delta_score']:+.1f}" for candidate in answer["candidates"][:5]
    )
    if best:
        lines.append(f"gain of log-evidence by single mechanisms: {best}")
    lines.append(f"outputs in {answer['folder']}")
    return "\n".join(lines)


def _files(run: Run) -> list[Path]:
    """Returns the file of the device's reduced model, if a reduced model can replace the full model.

    Raises InputError for a device without a reduced model.
    """
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
    """Returns the stage of a diagnosis.

    If no reduced model can replace the full model, a surrogate must be trained before.
    """
    if stands_for(config.model.spec()):
        return STAGE
    return replace(STAGE, needs=("recording", "design", "train"))
