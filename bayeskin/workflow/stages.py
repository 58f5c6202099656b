"""All stages in their order, what a run's summary says, and the answers of the commands that run them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bayeskin.config import Config
from bayeskin.json_files import plain, write_json
from bayeskin.number_format import at_edge
from bayeskin.workflow import design, diagnosis, indices, maximum, posterior, recording, training
from bayeskin.workflow.engine import Outcome, Reporter, Run, Stage, open_run, run_stages, standing
from bayeskin.workflow.executor import made_by
from bayeskin.workflow.folder import read_record
from bayeskin.workflow.page import write_page

BEFORE_REPORT = (
    recording.STAGE, design.STAGE, training.STAGE, maximum.STAGE, posterior.STAGE, indices.STAGE,
)  # fmt: skip


def _whose(run: Run) -> dict[str, str]:
    """The mesh, or the model of one's own."""
    own = run.config.model.forward
    return {"mesh": run.config.model.mesh} if own is None else {"forward": own}


def _summarise(run: Run) -> Mapping[str, Any]:
    """The answer of a run, for people and programs, from what its stages said."""
    said = {stage.name: run.summary(stage.name) for stage in BEFORE_REPORT}
    sampled, found = said["sample"], said["map"]
    checked = found["checks"][-1]
    doubts = [] if found["ok"] else [checked["message"]]
    doubts += [] if sampled["ok"] else [sampled["reasons"][0]]
    records = {stage.name: read_record(run.folder / stage.name) for stage in BEFORE_REPORT}
    summary = {
        "ok": not doubts,
        "verdict": "not trusted" if doubts else "trusted",
        "because": doubts or list(sampled["reasons"]),
        "remarks": list(sampled["remarks"]),
        "name": run.config.name,
        "recording": {key: said["recording"][key] for key in ("name", "sha256", "samples", "duration_s")},
        "model": {"observation": run.config.model.observation, **_whose(run)},
        "posterior": sampled["parameters"],
        "identifiability": [*sampled["identifiability"], *sampled["ridges"]],
        "learned": sampled["learned"],
        "lengths": sampled.get("lengths", {}),
        "profiles": sampled["profiles"],
        "full_model_at_draws": sampled["full_model"],
        "corrected": sampled["corrected"],
        "map": {
            "theta": found["theta"],
            "message": found["message"],
            "surrogate_error": checked,
            "polished": found["polished"],
        },
        "rmse": {
            "posterior_mean": sampled["rmse"],
            "full_model_at_map": found["rmse_of_full_model"],
        },
        "coverage_90": {"whole": sampled["coverage_90"], "fitted": sampled["coverage_90_fitted"]},
        "rms_sd_n": sampled["rms_sd_n"],
        "sobol": said["sobol"],
        "surrogate": said["train"],
        "design": {key: said["design"][key] for key in ("runs", "failed", "seconds_of_runs")},
        "seconds": {name: record.seconds for name, record in records.items() if record is not None},
    }
    write_json(run.at("report", "summary.json"), summary)
    write_json(run.folder / "summary.json", summary)
    return summary


REPORT = Stage(
    "report", "writes summary.json", tuple(stage.name for stage in BEFORE_REPORT), ("model",), _summarise
)
STAGES = {stage.name: stage for stage in (*BEFORE_REPORT, REPORT, diagnosis.STAGE)}


def stages_of(config: Config) -> Mapping[str, Stage]:
    """Returns all stages of a configuration; what a diagnosis needs goes by its model."""
    return {**STAGES, diagnosis.NAME: diagnosis.stage_of(config)}


def run(
    config: Path,
    last: str | None,
    reporter: Reporter,
    stages: Mapping[str, Stage] | None = None,
    scheduler: str | None = None,
) -> dict[str, Any]:
    """Runs a configuration to the stage `last` (None: to the report) and gives the command's answer.

    `scheduler`: the address of a Dask scheduler that makes the full runs, in the place of `design.scheduler`.
    A run to the report ends with the page, also when a stage before it failed.
    """
    opened = open_run(config, reporter)
    stages = stages or stages_of(opened.config)
    if scheduler is not None:
        opened = made_by(opened, scheduler)
    outcomes = run_stages(opened, stages, last or "report")
    answer = outcomes[-1]
    text = _in_words(answer, outcomes, opened.folder)
    said = {
        **answer.record.summary,
        "ok": answer.ok,
        "stage": answer.stage,
        "folder": opened.folder,
        "skipped": [outcome.stage for outcome in outcomes if outcome.skipped],
    }
    if last in (None, "report"):
        said["page"] = write_page(opened, stages)
        text += f"\nreport: {said['page']}"
    return plain({**said, "text": text})


def report(config: Path, reporter: Reporter, stages: Mapping[str, Stage] | None = None) -> dict[str, Any]:
    """The page of whatever stages are done, and the command's answer; runs nothing but the summary.

    Raises InputError for a configuration that is wrong or whose recording is not there.
    """
    opened = open_run(config, reporter)
    stages = stages or stages_of(opened.config)
    opened.beside(opened.config.recording.file)
    stands = {name: one[0] for name, one in standing(opened, stages).items()}
    missing = [name for name in stages["report"].needs if stands[name] != "done"]
    if not missing:
        return run(config, None, reporter, stages)
    page = write_page(opened, stages)
    text = "\n".join(
        [
            f"{opened.config.name}: not finished",
            *(f"{name}: {stands[name]}" for name in missing),
            f"report: {page}",
        ]
    )
    failed = any(stands[name] == "failed" for name in missing)
    said = {"ok": not failed, "stage": "report", "verdict": "not finished", "missing": missing}
    return plain({**said, "folder": opened.folder, "page": page, "text": text})


def _in_words(answer: Outcome, outcomes: Sequence[Outcome], folder: Path) -> str:
    said = answer.record.summary
    if not answer.record.done:
        return f"{answer.stage}: failed: {said['message']}"
    if answer.stage == "report":
        return _summary_in_words(said, folder)
    seconds = sum(outcome.record.seconds for outcome in outcomes)
    head = f"{answer.stage}: done, {seconds:.1f} s to here"
    lines = {
        "design": lambda: f"{said['runs']} runs, {said['failed']} failed",
        "train": lambda: (
            f"{said['kind']}, relative error {said['relative_error']:.3g} ({said['error_source']})"
        ),
        "map": lambda: "\n".join(
            [said["message"], said["checks"][-1]["message"], *_polish(said["polished"])]
        ),
        "sample": lambda: "\n".join(
            [
                *(said["verdict"], *said["reasons"], *said["remarks"]),
                *_table(said["parameters"]),
                *_identified([*said["identifiability"], *said["ridges"], *_lengths(said.get("lengths", {}))]),
                *_priors(said["parameters"]),
            ]
        ),
        "sobol": lambda: "\n".join(one["sentence"] for one in said.values()),
    }
    return f"{head}\n{lines[answer.stage]()}\noutputs in {folder / answer.stage}"


def _polish(polished: Mapping[str, Any] | None) -> list[str]:
    if polished is None:
        return []
    return [f"polished on the full model: {polished['gained']:.2f} nats gained, {polished['message']}"]


def _summary_in_words(said: Mapping[str, Any], folder: Path) -> str:
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
            *_table(said["posterior"]),
            *_identified([*said["identifiability"], *_lengths(said.get("lengths", {}))]),
            *_priors(said["posterior"]),
            *said["remarks"],
            f"{model}: RMSE {', '.join(off)}",
            error["message"],
            f"outputs in {folder}, {sum(said['seconds'].values()):.0f} s in all",
        ]
    )


def _identified(sentences: Sequence[str]) -> list[str]:
    return ["what the data says of each:", *(f"  {sentence}" for sentence in sentences)]


def _lengths(due: Mapping[str, Mapping[str, Any]]) -> list[str]:
    return [one["sentence"] for one in due.values()]


def _priors(parameters: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Each prior with its bounds and where it comes from."""
    return ["priors:", *(f"  {name}: {_prior(p['prior'], p['unit'])}" for name, p in parameters.items())]


def _prior(prior: Mapping[str, Any], unit: str) -> str:
    factor, unit = at_edge(unit)
    about = f" about {factor * prior['centre']:.4g} {unit}" if prior["kind"].endswith("normal") else ""
    low, high = factor * prior["lower"], factor * prior["upper"]
    return f"{prior['kind']}{about}, {low:.4g} to {high:.4g} {unit}; {prior['source']}"


def _table(parameters: Mapping[str, Mapping[str, Any]]) -> list[str]:
    rows: list[tuple[str, ...]] = [("", "unit", "mean", "sd", "median", "5 %", "95 %")]
    for name, p in parameters.items():
        factor, unit = at_edge(p["unit"])
        values = (factor * p[key] for key in ("mean", "sd", "median", "low_90", "high_90"))
        rows.append((name, unit, *(f"{value:.4g}" for value in values)))
    return ["  ".join(f"{cell:>{10 if i else 9}}" for i, cell in enumerate(row)) for row in rows]
