"""Makes the sections of a page below its answer: recording, fit and posterior."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from bayeskin.number_format import interval, number, percent, quantity, scale
from bayeskin.report.page.charts import history_chart, residual_chart
from bayeskin.report.page.facts import RunFacts
from bayeskin.report.page.figures import pictures
from bayeskin.report.page.markers import marker_blocks
from bayeskin.report.page.parts import Block, Cell, Facts, Folded, Missing, Section, Table, Text, row
from bayeskin.report.words import prior_in_words

_WHY = {
    "not run": "has not been run",
    "not finished": "was begun and is not finished",
    "failed": "failed",
    "out of date": "is out of date: configuration, inputs or version have changed since",
}


def absent(facts: RunFacts, stage: str) -> list[Block]:
    """Returns a block that says why a stage is not done and how to run it, and no block when it is done."""
    state = facts.stage(stage)
    if state.done:
        return []
    message = state.summary.get("message") if state.standing == "failed" else None
    reason = _WHY[state.standing] + (f": {message}" if message else "")
    return [Missing(f"The stage {stage} {reason}.", facts.command(stage))]


def cell(value: float | None, unit: str) -> Cell:
    """Returns a cell with a number and its unit, which is sorted by the value in SI."""
    return Cell(quantity(value, unit), value)


def recording(facts: RunFacts) -> Section:
    """Returns the section on the recording."""
    summary = facts.said("recording")
    blocks: list[Block] = list(absent(facts, "recording"))
    if summary:
        force, displacement = summary["force_n"], summary["displacement_m"]
        blocks += [
            Facts(
                [
                    ("name", summary["name"]),
                    ("duration", f"{number(summary['duration_s'])} s, {summary['samples']} samples"),
                    ("rate", f"{number(summary['sampling_hz'])} Hz"),
                    ("cycles", str(summary["cycles"])),
                    ("displacement", interval(displacement["min"], displacement["max"], "m")),
                    ("force", interval(force["min"], force["max"], "N")),
                ]
            ),
            *pictures(facts, "recording"),
            Folded("Phases and their noise", [_phases(summary["phases"])]),
        ]
        if summary["notes"]:
            blocks.append(Folded("How the file was read", [Text(summary["notes"], listed=True)]))
    return Section("recording", "Recording", blocks)


def _phases(phases: Sequence[Mapping[str, Any]]) -> Table:
    head = (
        "phase",
        "cycle",
        "from",
        "to",
        "travel",
        "noise sd",
        "correlation time",
        "spikes",
        "steps of the zero",
    )
    rows = [
        row(
            (
                p["kind"],
                Cell(str(p["cycle"]), p["cycle"]),
                cell(p["start_s"], "s"),
                cell(p["end_s"], "s"),
                Cell(interval(p["start_m"], p["end_m"], "m"), p["end_m"] - p["start_m"]),
                cell(p["noise_sd_n"], "N"),
                cell(p["noise_correlation_time_s"], "s"),
                Cell(str(p["spikes"]), p["spikes"]),
                Cell(str(len(p["steps"])), len(p["steps"])),
            )
        )
        for p in phases
    ]
    return Table("Phases of the recording", head, rows)


def fit(facts: RunFacts) -> Section:
    """Returns the section on the fit."""
    summary = facts.said("sample")
    blocks: list[Block] = list(absent(facts, "sample"))
    if summary:
        if facts.history is not None:
            blocks += [chart(facts.history, phases_of(facts)) for chart in (history_chart, residual_chart)]
        tables = {"posterior mean": summary["rmse"], "full model, most probable point": None}
        tables["full model, most probable point"] = facts.said("map").get("rmse_of_full_model")
        blocks += [_rmse(tables), _bands(summary), *pictures(facts, "sample", ["fit"])]
        markers = {"fit": summary["on_skin"]} if "on_skin" in summary else {}
        blocks += marker_blocks(markers, pictures(facts, "sample", ["on_skin"]))
    return Section("fit", "Fit", blocks)


def phases_of(facts: RunFacts) -> Sequence[Mapping[str, Any]]:
    """Returns the phases of the recording, or nothing where it was not read."""
    phases: Sequence[Mapping[str, Any]] = facts.said("recording").get("phases", ())
    return phases


def _rmse(tables: Mapping[str, Mapping[str, Any] | None]) -> Table:
    known = {name: rmse for name, rmse in tables.items() if rmse is not None}
    kinds = list(dict.fromkeys(kind for rmse in known.values() for kind in rmse["by_kind_n"]))
    rows = [
        row(
            (
                name,
                *(cell(rmse[key], "N") for key in ("whole_n", "fitted_n", "not_fitted_n")),
                *(cell(rmse["by_kind_n"].get(kind), "N") for kind in kinds),
            )
        )
        for name, rmse in known.items()
    ]
    return Table(
        "RMSE between predicted and recorded force",
        ("force of", "whole", "fitted", "not fitted", *kinds),
        rows,
    )


def _bands(said: Mapping[str, Any]) -> Facts:
    parts = said["rms_sd_n"]
    return Facts(
        [
            ("90 % band holds, of all bins", percent(said["coverage_90"])),
            ("of the fitted bins", percent(said["coverage_90_fitted"])),
            ("sd of the force without noise", quantity(parts["model"], "N")),
            ("sd of the noise", quantity(parts["noise"], "N")),
            ("sd that the surrogate states for its error", quantity(parts["surrogate"], "N")),
        ]
    )


def posterior(facts: RunFacts) -> Section:
    """Returns the section on the posterior."""
    summary = facts.said("sample")
    blocks: list[Block] = list(absent(facts, "sample"))
    if summary:
        blocks += [_parameters(facts, summary["parameters"]), *pictures(facts, "sample", ["posterior"])]
        if summary["ridges"]:
            blocks.insert(1, Text([f"{ridge}." for ridge in summary["ridges"]], listed=True))
        blocks += [
            *_information_gained(summary),
            *_length_shares(summary),
            *pictures(facts, "sample", ["profiles", "posterior_noise"]),
        ]
        sources = [
            f"{name}: {parameter['prior']['source']}." for name, parameter in summary["parameters"].items()
        ]
        blocks.append(Folded("Where the priors come from", [Text(sources, listed=True)]))
        blocks += pictures(facts, "train", ["prior_predictive"])
    return Section("posterior", "Posterior", blocks)


def _information_gained(said: Mapping[str, Any]) -> list[Block]:
    """Returns sentences and a table of three measures that say what the test taught about each parameter."""
    rows = []
    for name, profile in said["profiles"].items():
        learned, unit = said["learned"][name], said["parameters"][name]["unit"]
        fit_interval = interval(profile["low_90"], profile["high_90"], unit) + (
            " (all of the prior)" if profile["flat"] else ""
        )
        rows.append(
            row(
                (
                    name,
                    Cell(number(learned["contraction"]), learned["contraction"]),
                    Cell(number(learned["gain_nats"]), learned["gain_nats"]),
                    fit_interval,
                )
            )
        )
    head = ("parameter", "contraction", "information gained [nats]", "90 % interval from the fit alone")
    learned_sentences = [said["learned"][name]["sentence"] for name in said["profiles"]]
    return [
        Text(learned_sentences, listed=True),
        Table("What the test shows", head, rows, symbols=True),
    ]


def _length_shares(said: Mapping[str, Any]) -> list[Block]:
    """Returns the shares of posterior variances that uncertain lengths explain, if there are such lengths."""
    explained = said["lengths"]
    if not explained:
        return []
    rows = [
        row((name, Cell(percent(length["share"]), length["share"]))) for name, length in explained.items()
    ]
    table = Table(
        "Share of the posterior variance that uncertain lengths explain", ("parameter", "share"), rows,
        symbols=True,
    )  # fmt: skip
    return [Text([length["sentence"] for length in explained.values()], listed=True), table]


def _parameters(facts: RunFacts, table: Mapping[str, Mapping[str, Any]]) -> Table:
    best, known = facts.said("map").get("theta", {}), facts.said("sample")["learned"]
    numbers = ("median", "5 %", "95 %", "unit", "most probable")
    head = ("parameter", "meaning", "prior", *numbers, "what the data says")
    rows = []
    for name, summary in table.items():
        values = [*(summary[key] for key in ("median", "low_90", "high_90")), best.get(name)]
        factor, unit = scale(values[:3], summary["unit"])
        cells = [Cell(number(None if v is None else factor * v), v) for v in values]
        meaning = facts.parameters.get(name) or summary.get("meaning", "")
        prior, outcome = prior_in_words(summary["prior"], summary["unit"]), known[name]["outcome"]
        rows.append(row((name, meaning, prior, *cells[:3], unit, cells[3], outcome)))
    return Table("Parameters: prior, posterior, and what the data says about each", head, rows, symbols=True)
