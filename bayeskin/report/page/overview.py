"""Draws the first figure of a diagnosis: recording and model before and after, with the mismatch marked."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from bayeskin.number_format import number
from bayeskin.report.page.facts import RunFacts
from bayeskin.report.page.parts import Chart, Key
from bayeskin.report.page.plot import Frame, Phases, Plot, drawing, moments
from bayeskin.types import Array

# Frames of the force and of the residual, by the width of the screen.
_FRAMES = {
    "wide": (
        Frame(height=300, top=22, bottom=132, ticks=(10, 3)),
        Frame(height=300, top=160, bottom=260, ticks=(10, 3)),
    ),
    "narrow": (
        Frame(width=380, height=256, right=372, top=20, bottom=112, ticks=(5, 3)),
        Frame(width=380, height=256, right=372, top=140, bottom=218, ticks=(5, 3)),
    ),
}
_KEYS = {
    "recorded": Key("recorded", "dots"),
    "before": Key("model before", "before"),
    "after": Key("model after", "line"),
    "windows": Key("recording and model differ", "window"),
}


def overview_charts(facts: RunFacts) -> list[Chart]:
    """Returns the first figure of a diagnosis for wide and for narrow screens, and none without a diagnosis.

    One of several recordings is shown: the one with the largest mismatch.
    """
    if not facts.forces:
        return []
    sizes = [_mismatch_ns(forces) for forces in facts.forces]
    shown = sizes.index(max(sizes))
    recording = facts.said("recording")
    phases = recording.get("recordings", [recording])[shown].get("phases", ())
    return [_chart(screen, facts.forces[shown], phases) for screen in _FRAMES]


def _mismatch_ns(forces: Mapping[str, Any]) -> float:
    """Returns the size of a mismatch: mean residuals of its windows, times their durations [N s]."""
    return sum(abs(w["mean_n"]) * (w["end_s"] - w["start_s"]) for w in forces["windows"])


def _chart(screen: str, forces: Mapping[str, Any], phases: Phases) -> Chart:
    """Returns the figure of a recording for one width of the screen."""
    series = {name: np.array(forces[f"{name}_n"], dtype=float) for name in ("recorded", "before", "after")}
    time_s, upper, lower = np.array(forces["time_s"], dtype=float), *_FRAMES[screen]
    left_mn = {name: 1e3 * (series["recorded"] - series[name]) for name in ("before", "after")}
    plots = Plot(time_s, list(series.values()), upper), Plot(time_s, list(left_mn.values()), lower)
    parts = [
        *(plot.span(start_s, end_s, "window", share)
          for start_s, end_s, share in _windows(forces) for plot in plots),
        plots[0].axes("force [N]", timed=False),
        plots[1].axes("recorded − model [mN]"),
        plots[0].dots(series["recorded"], np.isfinite(series["recorded"]), "recorded"),
        *(plot.line(values[name], mark)
          for name, mark in (("before", "before"), ("after", "median"))
          for plot, values in zip(plots, (series, left_mn), strict=True)),
    ]  # fmt: skip
    key = f"overview-{screen}"
    says = list(_says(time_s, series, phases))
    upper_dots = plots[0].numbers([series["before"], series["after"]], says)
    lower_dots = plots[1].numbers([left_mn["before"], left_mn["after"]], says)
    data = {**upper_dots, "dots": [*upper_dots["dots"], *lower_dots["dots"]], "bottom": lower.bottom}
    title = "Recording and model, before and after the diagnosis"
    title += f" (recording {forces['name']})" if forces["name"] else ""
    keys = [key for name, key in _KEYS.items() if name != "windows" or forces["windows"]]
    return Chart(
        key, title, drawing(key, lower, "".join(parts), len(data["dots"])), data,
        _alt(left_mn, forces["windows"]), keys, screen,
    )  # fmt: skip


def _windows(forces: Mapping[str, Any]) -> Iterator[tuple[float, float, float]]:
    """Yields start, end and size of each window; the size is a share of the largest mean residual."""
    largest_n = max((abs(window["mean_n"]) for window in forces["windows"]), default=1.0)
    for window in forces["windows"]:
        yield window["start_s"], window["end_s"], abs(window["mean_n"]) / largest_n


def _says(time_s: Array, series: Mapping[str, Array], phases: Phases) -> Iterator[str]:
    """Yields the read-out at each time."""
    for moment, *values in zip(moments(time_s, phases), *series.values(), strict=True):
        recorded, before, after = (f"{number(1e3 * value, 4)} mN" for value in values)
        yield f"{moment}: recorded {recorded}; model before {before}, after {after}"


def _alt(left_mn: Mapping[str, Array], windows: Sequence[Mapping[str, Any]]) -> str:
    """Returns the figure's content in words."""
    most = [number(float(np.nanmax(np.abs(values))), 2) for values in left_mn.values()]
    spans = ", ".join(f"{number(w['start_s'])} to {number(w['end_s'])} s" for w in windows)
    marked = f"Marked: {spans}." if windows else "No window is marked."
    return (
        f"Recorded and modelled force over time, and their difference: at most {most[0]} mN before and "
        f"{most[1]} mN after. {marked}"
    )
