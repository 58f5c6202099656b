"""All stages in order, the summary of a run, and the answers of the commands that run stages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bayeskin.config import Config
from bayeskin.json_files import plain, write_json
from bayeskin.number_format import at_edge
from bayeskin.report.conclusion import conclusion_of
from bayeskin.report.words import markers_in_words, polished_in_words, prior_in_words
from bayeskin.workflow import design, diagnosis, indices, maximum, posterior, recording, training
from bayeskin.workflow.engine import Outcome, Reporter, Run, Stage, open_run, run_stages, standing
from bayeskin.workflow.executor import with_scheduler
from bayeskin.workflow.folder import read_record
from bayeskin.workflow.further_tests import judged_tests
from bayeskin.workflow.page import write_page

BEFORE_REPORT = (
    recording.STAGE, design.STAGE, training.STAGE, maximum.STAGE, posterior.STAGE, indices.STAGE,
)  # fmt: skip


def _mesh_or_forward(run: Run) -> dict[str, str]:
    """Returns the mesh, or the forward model of the user's own."""
    forward = run.config.model.forward
    return {"mesh": run.config.model.mesh} if forward is None else {"forward": forward}


def doubts_of(run: Run) -> list[str]:
    """Returns the reasons why a run's posterior is not to be trusted; there are none where it is trusted."""
    best, sampled = run.summary("map"), run.summary("sample")
    doubts = [] if best["ok"] else [best["checks"][-1]["message"]]
    return doubts + ([] if sampled["ok"] else [sampled["reasons"][0]])


def _write_summary(run: Run) -> Mapping[str, Any]:
    """Writes and returns the result of a run, for people and programs, from the summaries of its stages."""
    summaries = {stage.name: run.summary(stage.name) for stage in BEFORE_REPORT}
    sampled, map_summary = summaries["sample"], summaries["map"]
    checked, doubts = map_summary["checks"][-1], doubts_of(run)
    records = {stage.name: read_record(run.folder / stage.name) for stage in BEFORE_REPORT}
    summary = {
        "ok": not doubts,
        "verdict": "not trusted" if doubts else "trusted",
        "because": doubts or list(sampled["reasons"]),
        "remarks": list(sampled["remarks"]),
        "name": run.config.name,
        "recording": {
            key: summaries["recording"][key] for key in ("name", "sha256", "samples", "duration_s")
        },
        "model": {"observation": run.config.model.observation, **_mesh_or_forward(run)},
        "posterior": sampled["parameters"],
        "identifiability": [*sampled["identifiability"], *sampled["ridges"]],
        "learned": sampled["learned"],
        "lengths": sampled["lengths"],
        "profiles": sampled["profiles"],
        "full_model_at_draws": sampled["full_model"],
        "corrected": sampled["corrected"],
        "map": {
            "theta": map_summary["theta"],
            "message": map_summary["message"],
            "surrogate_error": checked,
            "polished": map_summary["polished"],
        },
        "rmse": {
            "posterior_mean": sampled["rmse"],
            "full_model_at_map": map_summary["rmse_of_full_model"],
        },
        **({"on_skin": sampled["on_skin"]} if "on_skin" in sampled else {}),
        "coverage_90": {"whole": sampled["coverage_90"], "fitted": sampled["coverage_90_fitted"]},
        "rms_sd_n": sampled["rms_sd_n"],
        "sobol": summaries["sobol"],
        "surrogate": summaries["train"],
        "design": {key: summaries["design"][key] for key in ("runs", "failed", "seconds_of_runs")},
        "seconds": {name: record.seconds for name, record in records.items() if record is not None},
    }
    write_json(run.at("report", "summary.json"), summary)
    write_json(run.folder / "summary.json", summary)
    return summary


REPORT = Stage(
    "report", "writes summary.json", tuple(stage.name for stage in BEFORE_REPORT), ("model",), _write_summary
)
STAGES = {stage.name: stage for stage in (*BEFORE_REPORT, REPORT, diagnosis.STAGE)}


def stages_of(config: Config) -> Mapping[str, Stage]:
    """Returns all stages of a configuration; the stages that a diagnosis needs depend on its model."""
    return {**STAGES, diagnosis.NAME: diagnosis.stage_of(config)}


def run(
    config: Path,
    last: str | None,
    reporter: Reporter,
    stages: Mapping[str, Stage] | None = None,
    scheduler: str | None = None,
) -> dict[str, Any]:
    """Runs a configuration up to the stage `last` (None: up to the report), and returns the command's answer.

    `scheduler` is the address of a Dask scheduler that makes the full runs; it replaces `design.scheduler`. A
    run up to the report ends with the HTML page, even if an earlier stage failed.
    """
    opened = open_run(config, reporter)
    stages = stages or stages_of(opened.config)
    if scheduler is not None:
        opened = with_scheduler(opened, scheduler)
    outcomes = run_stages(opened, stages, last or "report")
    answer = outcomes[-1]
    text = _in_words(answer, outcomes, opened.folder)
    document = {
        **answer.record.summary,
        "ok": answer.ok,
        "stage": answer.stage,
        "folder": opened.folder,
        "skipped": [outcome.stage for outcome in outcomes if outcome.skipped],
    }
    if last in (None, "report"):
        document["page"] = write_page(opened, stages)
        text = "\n".join([text, *_diagnosis_lines(opened, stages), f"report: {document['page']}"])
    return plain({**document, "text": text})


def report(config: Path, reporter: Reporter, stages: Mapping[str, Stage] | None = None) -> dict[str, Any]:
    """Writes the page about the stages that are done, and returns the command's answer.

    It runs no stage but the summary. Raises InputError for a configuration that is wrong, or whose recording
    does not exist.
    """
    opened = open_run(config, reporter)
    stages = stages or stages_of(opened.config)
    for section in opened.config.each_recording:
        opened.beside(section.file)
    states = {name: state[0] for name, state in standing(opened, stages).items()}
    missing = [name for name in stages["report"].needs if states[name] != "done"]
    if not missing:
        return run(config, None, reporter, stages)
    page = write_page(opened, stages)
    text = "\n".join(
        [
            f"{opened.config.name}: not finished",
            *(f"{name}: {states[name]}" for name in missing),
            f"report: {page}",
        ]
    )
    failed = any(states[name] == "failed" for name in missing)
    document = {"ok": not failed, "stage": "report", "verdict": "not finished", "missing": missing}
    return plain({**document, "folder": opened.folder, "page": page, "text": text})


def _diagnosis_lines(run: Run, stages: Mapping[str, Stage]) -> list[str]:
    """Returns the verdict and the three sentences of a run's diagnosis; none where it is not done."""
    state, record = standing(run, stages).get(diagnosis.NAME, ("not run", None))
    if state != "done" or record is None:
        return []
    tests = judged_tests(run)
    conclusion = conclusion_of(record.summary, None if tests is None else tests.summary)
    return [f"{conclusion.verdict}.", *conclusion.sentences]


def _in_words(answer: Outcome, outcomes: Sequence[Outcome], folder: Path) -> str:
    """Returns the answer of a stage's command as text."""
    summary = answer.record.summary
    if not answer.record.done:
        return f"{answer.stage}: failed: {summary['message']}"
    if answer.stage == "report":
        return _summary_in_words(summary, folder)
    seconds = sum(outcome.record.seconds for outcome in outcomes)
    head = f"{answer.stage}: done, {seconds:.1f} s so far"
    lines = {
        "design": lambda: f"{summary['runs']} runs, {summary['failed']} failed",
        "train": lambda: (
            f"{summary['kind']}, relative error {summary['relative_error']:.3g} ({summary['error_source']})"
        ),
        "map": lambda: "\n".join(
            [summary["message"], summary["checks"][-1]["message"], *polished_in_words(summary["polished"])]
        ),
        "sample": lambda: "\n".join(
            [
                *(summary["verdict"], *summary["reasons"], *summary["remarks"]),
                *_posterior_table(summary["parameters"]),
                *_identifiability_lines(
                    [
                        *summary["identifiability"],
                        *summary["ridges"],
                        *_length_sentences(summary["lengths"]),
                    ]
                ),
                *_prior_lines(summary["parameters"]),
            ]
        ),
        "sobol": lambda: "\n".join(result["sentence"] for result in summary.values()),
    }
    return f"{head}\n{lines[answer.stage]()}\noutputs in {folder / answer.stage}"


def _summary_in_words(said: Mapping[str, Any], folder: Path) -> str:
    """Returns the summary of a run as text."""
    error = said["map"]["surrogate_error"]
    full = said["rmse"]["full_model_at_map"]
    model, rmse = (
        ("surrogate at the posterior mean", said["rmse"]["posterior_mean"])
        if full is None
        else ("full model at the most probable point", full)
    )
    off = [f"{1e3 * rmse['whole_n']:.2f} mN over the whole recording"]
    if rmse["not_fitted_n"] is not None:
        off.append(
            f"{1e3 * rmse['fitted_n']:.2f} mN where fitted, {1e3 * rmse['not_fitted_n']:.2f} mN elsewhere"
        )
    return "\n".join(
        [
            f"{said['name']}: {said['verdict']}: {'; '.join(said['because'])}",
            *_posterior_table(said["posterior"]),
            *_identifiability_lines([*said["identifiability"], *_length_sentences(said["lengths"])]),
            *_prior_lines(said["posterior"]),
            *said["remarks"],
            *(markers_in_words(said["on_skin"]) if "on_skin" in said else []),
            f"{model}: RMSE {', '.join(off)}",
            error["message"],
            f"outputs in {folder}, {sum(said['seconds'].values()):.0f} s in all",
        ]
    )


def _identifiability_lines(sentences: Sequence[str]) -> list[str]:
    """Returns sentences about the information on each parameter, with a heading."""
    return ["what the data say about each parameter:", *(f"  {sentence}" for sentence in sentences)]


def _length_sentences(due: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Returns the sentences about uncertain lengths."""
    return [length["sentence"] for length in due.values()]


def _prior_lines(parameters: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Returns each prior with its bounds and its source, with a heading."""
    lines = (
        f"  {name}: {prior_in_words(p['prior'], p['unit'])}; {p['prior']['source']}"
        for name, p in parameters.items()
    )
    return ["priors:", *lines]


def _posterior_table(parameters: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Returns the lines of a table of the parameters' posteriors."""
    rows: list[tuple[str, ...]] = [("", "unit", "mean", "sd", "median", "5 %", "95 %")]
    for name, p in parameters.items():
        factor, unit = at_edge(p["unit"])
        values = (factor * p[key] for key in ("mean", "sd", "median", "low_90", "high_90"))
        rows.append((name, unit, *(f"{value:.4g}" for value in values)))
    return ["  ".join(f"{cell:>{10 if i else 9}}" for i, cell in enumerate(row)) for row in rows]
