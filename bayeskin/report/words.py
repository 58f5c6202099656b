"""Puts facts of the stages' summaries into words, for the terminal and for the page of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from bayeskin.inference.identify import Informed, grade_of
from bayeskin.number_format import interval, number, quantity

ADDS = 1.2  # a recording adds something where an interval would be wider by this factor without it


def prior_in_words(prior: Mapping[str, Any], unit: str) -> str:
    """Returns the kind, the centre and the bounds of a prior, from the table of the stage `sample`."""
    about = f" about {quantity(prior['centre'], unit)}" if "centre" in prior else ""
    return f"{prior['kind']}{about}, {interval(prior['lower'], prior['upper'], unit)}"


def polished_in_words(polished: Mapping[str, Any] | None) -> list[str]:
    """Returns a sentence about the maximum of the full model itself, and none if it was not computed."""
    if polished is None:
        return []
    return [f"Refined with the full model: {number(polished['gained'])} nats gained, {polished['message']}."]


def markers_in_words(on_skin: Mapping[str, Any]) -> list[str]:
    """Returns sentences about the markers of a fit: their residuals, their noise, and what they add."""
    count, total = on_skin["significant"], on_skin["points"]
    where = (
        f"At {count} of {total} markers the skin moves otherwise than the model says"
        if count
        else f"All {total} markers move as the model says"
    )
    rms, sd = (f"{number(1e3 * on_skin[key], 2)} mm" for key in ("rms_m", "sd_m"))
    adds = [f"{name} {number(factor, 2)}" for name, factor in on_skin["widens"].items() if factor >= ADDS]
    wider = f"would be wider by these factors: {', '.join(adds)}" if adds else "would hardly be wider"
    return [
        f"{where} (residual of {rms} RMS at the largest opening, {on_skin['images']} images).",
        f"The noise of a marker's coordinate has an sd of {sd}.",
        f"Without the markers, the intervals {wider}.",
    ]


def markers_unused_in_words(work: str, names: Sequence[str]) -> str:
    """Returns a sentence about recordings whose markers some work, such as "a study", does not use."""
    begin = f"{work[0].upper()}{work[1:]}"
    return f"{begin} infers from the force alone, so it does not use the markers of {', '.join(names)}."


def full_run_in_words(full: Mapping[str, Any]) -> str:
    """Returns a sentence about the run of the full model at the best values of a diagnosis."""
    if "message" in full:
        return f"The full model fails at the best values: {full['message']}"
    return (
        "A run of the full model at the best values, without allowances for its mesh and the load cell, has "
        f"an RMSE of {quantity(full['rmse'], 'N')}. The fitted model differs from it by "
        f"{quantity(full['fit_off_by'], 'N')} there."
    )


def agreement_in_words(recording: Mapping[str, Any]) -> str:
    """Returns how well one of several recordings agrees with the others."""
    name, rms_n, tension = recording["name"], recording["rms_n"], recording["tension"]
    residual = f"RMS residual {1e3 * rms_n:.1f} mN, {rms_n / recording['noise_n']:.1f} sd of its noise"
    if tension is None:
        return f"{name}: {residual}; it could not be fitted alone"
    verb = "contradicts" if recording["contradicts"] else "agrees with"
    return f"{name} {verb} the others, by {max(tension, 0.0):.1f} sd: {residual}"


def informed_in_words(recording: Mapping[str, Any]) -> str:
    """Returns what one of several recordings says about the skin, and what it adds to the others."""
    grades: dict[Informed, list[str]] = {grade: [] for grade in Informed}
    for name, sd in recording["sd_alone"].items():
        grades[grade_of(1.0 - sd**2)].append(name)
    well, weakly = grades[Informed.WELL], grades[Informed.WEAKLY]
    informs = [", ".join(well)] if well else []
    informs += [f"weakly {', '.join(weakly)}"] if weakly else []
    adds = [f"{name} {factor:.1f}" for name, factor in recording["widens"].items() if factor >= ADDS]
    line = f"{recording['name']} alone informs {' and '.join(informs) or 'no parameter of the skin'}"
    if not adds:
        return f"{line}; without it, no interval would be much wider"
    return f"{line}; without it, the intervals would be wider by these factors: {', '.join(adds)}"
