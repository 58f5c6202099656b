"""Makes the section on the physics that the model leaves out, from the diagnosis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from bayeskin.number_format import number, percent, quantity, unit_text
from bayeskin.report.page.facts import RunFacts
from bayeskin.report.page.figures import pictures
from bayeskin.report.page.markers import marker_blocks
from bayeskin.report.page.parts import Block, Cell, Folded, Heading, Section, Table, Text, row
from bayeskin.report.page.sections import absent, cell
from bayeskin.report.words import full_run_in_words, informed_in_words

_ON_SKIN = {"before": "on_skin_before", "after": "on_skin_after"}


def mismatch(facts: RunFacts) -> Section:
    """Returns the section on the physics that the model leaves out."""
    diagnosis = facts.said("diagnose")
    blocks: list[Block] = list(absent(facts, "diagnose"))
    if diagnosis:
        if diagnosis["mechanisms"]:
            blocks.append(_mechanisms(diagnosis["mechanisms"]))
        if diagnosis["recordings"]:
            blocks.append(_recordings(diagnosis["recordings"]))
            blocks.append(Text([f"{informed_in_words(recording)}." for recording in diagnosis["recordings"]]))
        blocks += [_fits(diagnosis["fit"]), Text([full_run_in_words(diagnosis["full_model"])])]
        blocks += [*pictures(facts, "diagnose", without=_ON_SKIN.values()), *_on_skin(facts, diagnosis)]
        if diagnosis["mechanisms"]:
            blocks.append(Folded("Parameters of the mechanisms", [_parameters(diagnosis["mechanisms"])]))
        blocks += [
            Folded("All candidates", [_candidates(diagnosis["candidates"])]),
            Folded(
                f"Windows: {len(diagnosis['located'])} before, {len(diagnosis['remaining'])} after",
                [_windows("Before", diagnosis["located"]), _windows("After", diagnosis["remaining"])],
            ),
            *_unexplained(diagnosis["unexplained"]),
            *_experiments(facts),
        ]
    return Section("mismatch", "Mismatch", blocks)


def _on_skin(facts: RunFacts, diagnosis: Mapping[str, Any]) -> list[Block]:
    """Returns blocks about the markers before and after; both are the same where no mechanism acts."""
    labels = [label for label in _ON_SKIN if label == "after" or diagnosis["best_set"]]
    shown = {label: diagnosis["fit"][label] for label in labels}
    fits = {label: fit["on_skin"] for label, fit in shown.items() if "on_skin" in fit}
    return marker_blocks(fits, pictures(facts, "diagnose", [_ON_SKIN[label] for label in fits]))


def _mechanisms(named: Sequence[Mapping[str, Any]]) -> Table:
    rows = [
        row(
            (
                mechanism["name"],
                mechanism["statement"],
                Cell(number(mechanism["probability"]), mechanism["probability"]),
                cell(mechanism["contribution_n"], "N"),
                ", ".join(name for name in mechanism["group"] if name != mechanism["name"]) or "none",
            )
        )
        for mechanism in named
    ]
    head = ("mechanism", "effect in this recording", "probability", "changes the force by", "look-alikes")
    return Table("Mechanisms that were named", head, rows)


def _recordings(recordings: Sequence[Mapping[str, Any]]) -> Table:
    rows = []
    for recording in recordings:
        ratio, tension = recording["rms_n"] / recording["noise_n"], recording["tension"]
        distance = "not known" if tension is None else Cell(number(max(tension, 0.0)), tension)
        result = "contradicts them" if recording["contradicts"] else "agrees with them"
        size = cell(recording["rms_n"], "N")
        rows.append(row((recording["name"], size, Cell(number(ratio), ratio), distance, result)))
    head = ("recording", "RMS residual", "in sd of its noise", "distance from the others [sd]", "result")
    return Table("Each recording beside the others", head, rows)


def _parameters(named: Sequence[Mapping[str, Any]]) -> Table:
    rows = [
        row((mechanism["name"], name, cell(p["mean"], p["unit"]), cell(p["sd"], p["unit"])))
        for mechanism in named
        for name, p in mechanism["parameters"].items()
    ]
    return Table("Parameters of the mechanisms", ("mechanism", "parameter", "mean", "sd"), rows)


def _fits(fit: Mapping[str, Mapping[str, Any]]) -> Table:
    kinds = list(fit["before"]["rmse_by_phase"])
    tested = any(summary["rmse_held_out"] is not None for summary in fit.values())
    rows = [
        row(
            (
                when,
                cell(summary["rmse"], "N"),
                *([cell(summary["rmse_held_out"], "N")] if tested else []),
                *(cell(summary["rmse_by_phase"].get(kind), "N") for kind in kinds),
                Cell(percent(summary["coverage90"]), summary["coverage90"]),
            )
        )
        for when, summary in fit.items()
    ]
    head = ("fit", "whole recording", *(["held out"] if tested else []), *kinds, "90 % band holds")
    explained = "; held out: after the second hold, by a fit to what precedes" if tested else ""
    return Table(f"RMSE without and with the mechanisms{explained}", head, rows)


def _candidates(candidates: Sequence[Mapping[str, Any]]) -> Table:
    rows = [
        row(
            (
                candidate["name"],
                Cell(number(candidate["delta_score"]), candidate["delta_score"]),
                Cell(number(candidate["standard_error"]), candidate["standard_error"]),
            )
        )
        for candidate in candidates
    ]
    head = ("mechanism", "gain in log-evidence [nats]", "standard error")
    return Table("Each mechanism added to the model alone", head, rows)


def _unexplained(left: Mapping[str, Any] | None) -> list[Block]:
    """Returns blocks on the residual that a smooth process describes: its size, variables and form."""
    if left is None:
        return []
    if not left["noticeable"]:
        return [
            Heading("The unexplained force"),
            Text(["Nothing is left beyond the noise and the allowed errors of the models."]),
        ]
    form = left["form"]
    rows = [
        row(
            (
                term["name"],
                Cell(number(term["coefficient"]), term["coefficient"]),
                Cell(number(term["standard_error"]), term["standard_error"]),
                unit_text(term["unit"]),
                ", ".join(term["alike"]) or "none",
            )
        )
        for term in form["terms"]
    ]
    head = ("term", "coefficient", "standard error", "unit", "not distinguishable from")
    shares = ", ".join(f"{percent(share)} with {name}" for name, share in left["share"].items())
    lines = [
        f"{quantity(left['size_n'], 'N')} RMS that the parameters cannot explain; it varies {shares}.",
        *left["features"],
        form["sentence"],
    ]
    return [
        Heading("The unexplained force"),
        Text(lines, listed=True),
        *([Table("The form that predicts it in held-out phases", head, rows)] if rows else []),
    ]


def _experiments(facts: RunFacts) -> list[Block]:
    """Returns blocks on further tests and their expected information, if these have been computed."""
    summary = facts.said("experiment")
    if not summary:
        return []
    title = Heading("Which further test would distinguish the explanations")
    if len(summary["sets"]) < 2:
        return [title, Text(["No other explanation competes with the best one."])]
    rows = [
        row(
            (
                experiment["protocol"],
                experiment["sentence"],
                cell(experiment["seconds"], "s"),
                Cell(number(experiment["gain_bits"]), experiment["gain_bits"]),
                Cell(number(experiment["standard_error"]), experiment["standard_error"]),
                Cell(percent(experiment["named"]), experiment["named"]),
            )
        )
        for experiment in summary["experiments"]
    ]
    possible = summary["experiments"][0]["possible_bits"]
    information = f"information, of {number(possible)} bits"
    head = ("protocol", "description", "duration", information, "±", "expected probability of the true one")
    sets = "; or ".join(", ".join(names) for names in summary["sets"])
    return [
        title,
        Text([f"Explanations, taken as equally probable: {sets}."]),
        Table("Further tests, the most informative first", head, rows),
        *pictures(facts, "experiment"),
    ]


def _windows(when: str, windows: Sequence[Mapping[str, Any]]) -> Table:
    rows = [
        row(
            (
                f"{window['phase']} of cycle {window['cycle']}",
                cell(window["t0"], "s"),
                cell(window["t1"], "s"),
                Cell(quantity(window["mean_residual"], "N"), window["mean_residual"]),
                Cell(number(window["significance"]), window["significance"]),
            )
        )
        for window in windows
    ]
    head = ("window", "from", "to", "recorded minus model", "probability of such a window by noise")
    return Table(f"{when}: windows where the recording leaves the range that the model allows", head, rows)
