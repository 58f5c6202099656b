"""Makes the last two sections of a page: the checks of a run, and its provenance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from bayeskin.number_format import interval, number, percent, quantity
from bayeskin.report.page.facts import RunFacts, StageFacts
from bayeskin.report.page.figures import pictures
from bayeskin.report.page.parts import Block, Cell, Facts, Folded, Heading, Section, Source, Table, Text, row
from bayeskin.report.page.sections import absent, cell
from bayeskin.report.words import polished_in_words


def checks(facts: RunFacts) -> Section:
    """Returns the section on checks: convergence, residuals, the full model, held-out runs, the design."""
    parts = (
        ("Sampling", _convergence(facts, facts.said("sample"))),
        ("Residuals", _residuals(facts, facts.said("sample"))),
        ("The full model at the most probable point", _full_model(facts, facts.said("map"))),
        ("The full model at draws of the posterior", _at_draws(facts, facts.said("sample"))),
        ("The surrogate on held-out runs", _held_out(facts, facts.said("train"))),
        ("The design", _design(facts, facts.said("design"))),
    )
    blocks: list[Block] = []
    for title, part in parts:
        blocks += [Heading(title), *part]
    return Section("checks", "Checks", blocks)


def _convergence(facts: RunFacts, said: Mapping[str, Any]) -> list[Block]:
    if not said:
        return absent(facts, "sample")
    rows = [
        row(
            (
                name,
                Cell(f"{parameter['ess']:.0f}", parameter["ess"]),
                Cell(f"{parameter['rhat']:.4f}", parameter["rhat"]),
            )
        )
        for name, parameter in said["parameters"].items()
        if parameter["ess"] is not None and parameter["rhat"] is not None
    ]
    head = ("parameter", "effective samples", "R-hat across ensembles")
    return [
        Text([f"Sampling: {said['verdict']}, {said['steps']} steps, {said['draws']} draws kept."]),
        Text(said["reasons"], listed=True),
        Folded("Convergence of each parameter", [Table("Convergence", head, rows, symbols=True)]),
        *pictures(facts, "sample", ["traces"]),
    ]


def _residuals(facts: RunFacts, said: Mapping[str, Any]) -> list[Block]:
    if not said:
        return absent(facts, "sample")
    residuals = said["residuals"]
    rows = [
        row(
            (
                kind,
                Cell(str(check["bins"]), check["bins"]),
                Cell(number(check["sd"]), check["sd"]),
                Cell(number(check["p_sd"]), check["p_sd"]),
                Cell(number(check["correlation"]), check["correlation"]),
                Cell(number(check["p_correlation"]), check["p_correlation"]),
            )
        )
        for kind, check in residuals["by_kind"].items()
    ]
    head = ("phase", "bins", "sd (1 if as assumed)", "p", "correlation of neighbours (0 if as assumed)", "p")
    return [
        Text([residuals["sentence"]]),
        Folded("By kind of phase", [Table("Residuals by kind of phase", head, rows)]),
        *pictures(facts, "sample", ["residuals"]),
    ]


def _full_model(facts: RunFacts, said: Mapping[str, Any]) -> list[Block]:
    if not said:
        return absent(facts, "map")
    rows = [
        row(
            (
                Cell(str(i), i),
                "passes" if check["passes"] else "does not pass",
                cell(check["rms_n"], "N"),
                cell(check["max_n"], "N"),
                Cell(number(check["rms_z"]), check["rms_z"]),
                cell(check["seconds_of_full_run"], "s"),
            )
        )
        for i, check in enumerate(said["checks"], start=1)
    ]
    head = ("run", "check", "RMS difference", "largest", "in the surrogate's sd", "time of the full run")
    lines = [f"Most probable point: {said['message']}.", *polished_in_words(said["polished"])]
    table = Table("The full model against the surrogate at the most probable point", head, rows)
    return [Text(lines), table, *pictures(facts, "map")]


def _at_draws(facts: RunFacts, said: Mapping[str, Any]) -> list[Block]:
    if not said:
        return absent(facts, "sample")
    if not said["full_model"]:
        return [Text(["The full model was not run at draws of the posterior (check.draws = 0)."])]
    lines = [f"Round {i}: {check['message']}." for i, check in enumerate(said["full_model"], start=1)]
    blocks: list[Block] = [Text(lines, listed=len(lines) > 1)]
    if said["corrected"] is not None:
        rows = [
            row(
                (
                    name,
                    *_median(said["parameters"][name], said["parameters"][name]["unit"]),
                    *_median(full, said["parameters"][name]["unit"]),
                    Cell(f"{number(full['shift_sd'])} ± {number(full['shift_error_sd'])}", full["shift_sd"]),
                )
            )
            for name, full in said["corrected"].items()
        ]
        head = (
            "parameter", "median, surrogate", "90 % interval", "median, full model", "90 % interval",
            "shift in sd",
        )  # fmt: skip
        blocks.append(Table("The posterior after weighting by the full model", head, rows, symbols=True))
    return [*blocks, *pictures(facts, "sample", ["model_check"])]


def _median(parameter: Mapping[str, Any], unit: str) -> tuple[Cell, Cell]:
    """Returns the cells of a parameter's median and 90 % interval."""
    low, high = parameter["low_90"], parameter["high_90"]
    return cell(parameter["median"], unit), Cell(interval(low, high, unit), low)


def _held_out(facts: RunFacts, said: Mapping[str, Any]) -> list[Block]:
    if not said:
        return absent(facts, "train")
    return [
        Facts(
            [
                ("surrogate", f"{said['kind']}, {said['training_rows']} training runs"),
                (f"relative error, {said['error_source']}", percent(said["relative_error"])),
                ("median run", percent(said["median_point_relative_error"])),
                ("worst run", percent(said["worst_point_relative_error"])),
                ("its 90 % band holds", percent(said["coverage_90"])),
            ]
        ),
        *pictures(facts, "train", ["validation"]),
    ]


def _design(facts: RunFacts, said: Mapping[str, Any]) -> list[Block]:
    if not said:
        return absent(facts, "design")
    pairs = [
        ("full runs", f"{said['runs']}, {said['failed']} failed"),
        ("time of all runs", quantity(said["seconds_of_runs"], "s")),
        ("median run", quantity(said["median_seconds_a_run"], "s")),
    ]
    blocks: list[Block] = [Facts(pairs), Folded("Waves of the design", [_waves(said["waves"])])]
    if said["failures"]:
        rows = [row((text, Cell(str(count), count))) for text, count in said["failures"].items()]
        blocks.append(Table("Why full runs failed", ("message", "runs"), rows))
    return [*blocks, *pictures(facts, "design")]


def _waves(waves: Sequence[Mapping[str, Any]]) -> Table:
    rows = [
        row(
            (
                Cell(str(wave["wave"] + 1), wave["wave"]),
                Cell(str(wave["training"]), wave["training"]),
                Cell(str(wave["held_out"]), wave["held_out"]),
                Cell(percent(wave["kept_fraction"]), wave["kept_fraction"]),
                wave["rule"],
            )
        )
        for wave in waves
    ]
    return Table("Waves", ("wave", "training runs", "held out", "of the prior's volume", "where"), rows)


def provenance(facts: RunFacts) -> Section:
    """Returns the section on provenance: version, configuration, hashes, seed, and state of each stage."""
    pairs = [
        ("bayeskin", facts.version),
        ("configuration" if facts.config_text else "recording", facts.config_path),
        ("sha256 of the configuration", facts.config_sha256),
        ("recording's sha256", str(facts.said("recording").get("sha256", "–"))),
        ("model", f"{facts.observation} on {facts.mesh}"),
        ("model's hash", str(facts.said("design").get("model_hash", "–"))),
        ("seed", str(facts.seed)),
    ]
    head = ("stage", "state", "time")
    rows = [row((stage.name, stage.standing, _seconds(stage))) for stage in facts.stages.values()]
    return Section(
        "provenance",
        "Provenance",
        [
            Facts(pairs),
            Table("Stages", head, rows),
            *([Source("The configuration file", facts.config_text)] if facts.config_text else []),
        ],
    )


def _seconds(stage: StageFacts) -> Cell:
    return cell(stage.seconds, "s")
