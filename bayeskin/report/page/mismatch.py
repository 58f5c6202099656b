"""The section on what the model leaves out, from the diagnosis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from bayeskin.report.mismatch import faint_in_words
from bayeskin.report.page.facts import RunFacts
from bayeskin.report.page.figures import pictures
from bayeskin.report.page.numbers import number, percent, quantity
from bayeskin.report.page.parts import Block, Cell, Folded, Heading, Section, Table, Text, row
from bayeskin.report.page.sections import absent, cell

_VERDICTS = {
    "nothing-missing": "The model leaves nothing out that the recording shows.",
    "named": "The recording shows physics that the model leaves out, and it has been named.",
    "unknown": "The model leaves something out, and no mechanism is likely enough to be named.",
}


def mismatch(facts: RunFacts) -> Section:
    said = facts.said("diagnose")
    blocks: list[Block] = list(absent(facts, "diagnose"))
    if said:
        verdict = _VERDICTS[said["verdict"]]
        blocks.append(Text([f"{verdict} {faint}" if (faint := faint_in_words(said)) else verdict]))
        if said["mechanisms"]:
            blocks.append(_mechanisms(said["mechanisms"]))
        blocks += [_fits(said["fit"]), Text([_checked(said["full_model"])])]
        blocks += pictures(facts, "diagnose")
        if said["mechanisms"]:
            blocks.append(Folded("Parameters of the mechanisms", [_parameters(said["mechanisms"])]))
        blocks += [
            Folded("All candidates", [_candidates(said["candidates"])]),
            Folded(
                f"Windows: {len(said['located'])} before, {len(said['remaining'])} after",
                [_windows("Before", said["located"]), _windows("After", said["remaining"])],
            ),
            *_unexplained(said["unexplained"]),
            *_experiments(facts),
        ]
    return Section("mismatch", "Mismatch", blocks)


def _mechanisms(found: Sequence[Mapping[str, Any]]) -> Table:
    rows = [
        row(
            (
                one["name"],
                one["statement"],
                Cell(number(one["probability"]), one["probability"]),
                cell(one["contribution_n"], "N"),
                ", ".join(name for name in one["group"] if name != one["name"]) or "none",
            )
        )
        for one in found
    ]
    head = ("mechanism", "what it does here", "probability", "moves the force by", "look-alikes")
    return Table("Mechanisms that were named", head, rows)


def _parameters(found: Sequence[Mapping[str, Any]]) -> Table:
    rows = [
        row((one["name"], name, cell(p["mean"], p["unit"]), cell(p["sd"], p["unit"])))
        for one in found
        for name, p in one["parameters"].items()
    ]
    return Table("Parameters of the mechanisms", ("mechanism", "parameter", "mean", "sd"), rows)


def _fits(fit: Mapping[str, Mapping[str, Any]]) -> Table:
    kinds = list(fit["before"]["rmse_by_phase"])
    rows = [
        row(
            (
                when,
                cell(one["rmse"], "N"),
                cell(one["rmse_held_out"], "N"),
                *(cell(one["rmse_by_phase"].get(kind), "N") for kind in kinds),
                Cell(percent(one["coverage90"]), one["coverage90"]),
            )
        )
        for when, one in fit.items()
    ]
    head = ("fit", "whole recording", "held out", *kinds, "90 % band holds")
    title = (
        "RMSE without and with the mechanisms; held out: after the second hold, by a fit to what is before it"
    )
    return Table(title, head, rows)


def _checked(full: Mapping[str, Any]) -> str:
    """What a run of the full model at the best values shows."""
    if "message" in full:
        return f"The full model fails at the best values: {full['message']}"
    return (
        f"A run of the full model at the best values leaves {quantity(full['rmse'], 'N')} RMSE; the "
        f"model that was fitted is off by {quantity(full['fit_off_by'], 'N')} there."
    )


def _candidates(candidates: Sequence[Mapping[str, Any]]) -> Table:
    rows = [
        row(
            (
                one["name"],
                Cell(number(one["delta_score"]), one["delta_score"]),
                Cell(number(one["standard_error"]), one["standard_error"]),
            )
        )
        for one in candidates
    ]
    head = ("mechanism", "log evidence gained [nats]", "standard error")
    return Table("Each mechanism added to the model alone", head, rows)


def _unexplained(left: Mapping[str, Any] | None) -> list[Block]:
    """Section on the residual that a smooth process describes: its size, variable and form."""
    if left is None:
        return []
    if not left["noticeable"]:
        return [
            Heading("What is left"),
            Text(["Nothing beyond the noise and what the models are allowed to be off by."]),
        ]
    form = left["form"]
    rows = [
        row(
            (
                term["name"],
                Cell(number(term["coefficient"]), term["coefficient"]),
                Cell(number(term["standard_error"]), term["standard_error"]),
                term["unit"],
                ", ".join(term["alike"]) or "none",
            )
        )
        for term in form["terms"]
    ]
    head = ("term", "coefficient", "standard error", "unit", "not told from")
    shares = ", ".join(f"{percent(share)} with {name}" for name, share in left["share"].items())
    lines = [
        f"{quantity(left['size_n'], 'N')} RMS beyond what parameters take up; it varies {shares}.",
        *left["features"],
        form["sentence"],
    ]
    return [
        Heading("What is left"),
        Text(lines, listed=True),
        *([Table("The form that predicts it in phases left out", head, rows)] if rows else []),
    ]


def _experiments(facts: RunFacts) -> list[Block]:
    """Further tests by what they are expected to tell; nothing where nobody has asked."""
    asked = facts.said("experiment")
    if not asked:
        return []
    title = Heading("Which further test would tell the explanations apart")
    if len(asked["sets"]) < 2:
        return [title, Text(["Nothing competes with what explains the recording best."])]
    rows = [
        row(
            (
                one["protocol"],
                one["sentence"],
                cell(one["seconds"], "s"),
                Cell(number(one["gain_bits"]), one["gain_bits"]),
                Cell(number(one["standard_error"]), one["standard_error"]),
                Cell(percent(one["named"]), one["named"]),
            )
        )
        for one in asked["experiments"]
    ]
    possible = asked["experiments"][0]["possible_bits"]
    told = f"tells, of {number(possible)} bits"
    head = ("protocol", "what is done", "takes", told, "±", "the true one is then named")
    sets = "; or ".join(", ".join(names) for names in asked["sets"])
    return [
        title,
        Text([f"Taken as equally probable: {sets}."]),
        Table("Further tests, the most informative first", head, rows),
        *pictures(facts, "experiment"),
    ]


def _windows(when: str, windows: Sequence[Mapping[str, Any]]) -> Table:
    rows = [
        row(
            (
                f"{one['phase']} of cycle {one['cycle']}",
                cell(one["t0"], "s"),
                cell(one["t1"], "s"),
                Cell(quantity(one["mean_residual"], "N"), one["mean_residual"]),
                Cell(number(one["significance"]), one["significance"]),
            )
        )
        for one in windows
    ]
    head = ("window", "from", "to", "recorded minus model", "chance of one such by noise")
    return Table(f"{when}: where the recording leaves what the model allows", head, rows)
