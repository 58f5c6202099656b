"""Puts facts of the stages' summaries into words, for the terminal and for the page of a run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bayeskin.inference.identify import Informed, grade_of
from bayeskin.number_format import interval, number, percent, quantity

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


def faint_in_words(diagnosis: Mapping[str, Any]) -> list[str]:
    """Returns a sentence about the mechanisms that improve the fit although none could be named.

    There is no sentence where the verdict is another, or where no set fits better.
    """
    if diagnosis["verdict"] != "nothing-missing" or not diagnosis["best_set"]:
        return []
    better = ", ".join(diagnosis["best_set"])
    return [
        f"The model fits better with {better}, but too little or too uncertainly to name it. The skin's "
        "parameters depend on whether it acts, so do not rely on them."
    ]


def where_in_words(diagnosis: Mapping[str, Any]) -> str:
    """Returns where recording and model differ: the windows' phases, and the window that differs most."""
    windows = diagnosis["located"]
    if not windows:
        return "Recording and model differ nowhere by more than is allowed."
    by_cycle: dict[str, list[str]] = {}
    for window in windows:
        by_cycle.setdefault(_cycle_in_words(window), []).append(window["phase"])
    where = "; ".join(", ".join(dict.fromkeys(phases)) + cycle for cycle, phases in by_cycle.items())
    worst = max(windows, key=lambda window: abs(window["mean_residual"]))
    side = "above" if worst["mean_residual"] > 0.0 else "below"
    plural = "s" * (len(windows) != 1)
    return (
        f"Recording and model differ in {len(windows)} window{plural}: {where}. They differ most in the "
        f"{worst['phase']}{_cycle_in_words(worst)}, from {number(worst['t0'])} to {number(worst['t1'])} s, "
        f"where the recording lies {quantity(abs(worst['mean_residual']), 'N')} {side} the model on average."
    )


def _cycle_in_words(window: Mapping[str, Any]) -> str:
    """Returns the cycle of a window, if it has begun, and the recording, where there are several."""
    cycle = "" if window["cycle"] == 0 else f" of cycle {window['cycle']}"
    return cycle + (f" in {window['recording']}" if "recording" in window else "")


def named_in_words(diagnosis: Mapping[str, Any]) -> list[str]:
    """Returns each mechanism that was named, with its probability and its statement."""
    return [
        f"{mechanism['name']} (probability {mechanism['probability']:.2f}): {mechanism['statement']}"
        for mechanism in diagnosis["mechanisms"]
    ]


def better_fit_in_words(diagnosis: Mapping[str, Any]) -> str:
    """Returns how well the model fits without and with the best set of mechanisms."""
    before, after = (diagnosis["fit"][when] for when in ("before", "after"))
    if not diagnosis["best_set"]:
        return f"The RMSE of the model is {quantity(before['rmse'], 'N')}."
    return (
        f"The RMSE is {quantity(before['rmse'], 'N')} without and {quantity(after['rmse'], 'N')} with "
        f"{', '.join(diagnosis['best_set'])}, and the 90 % band holds {percent(before['coverage90'])} of the "
        f"recording without and {percent(after['coverage90'])} with."
    )


def diagnosis_in_words(diagnosis: Mapping[str, Any]) -> list[str]:
    """Returns where recording and model differ, what was missing, and how much better the fit is."""
    missing = {
        "nothing-missing": "Nothing that could be named is missing.",
        "unknown": "Something is missing that could not be named.",
        "named": f"This was missing: {' '.join(named_in_words(diagnosis))}",
    }[diagnosis["verdict"]]
    return [where_in_words(diagnosis), missing, better_fit_in_words(diagnosis)]


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
