"""The force over time as a drawing in the page itself, and the numbers that a cross-hair reads from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator

from bayeskin.report.page.parts import Chart
from bayeskin.report.timeline import runs_of
from bayeskin.types import Array
from bayeskin.words import number

WIDTH, HEIGHT = 760, 320
LEFT, RIGHT, TOP, BOTTOM = 54, 10, 24, 40
_DIGITS = 6  # of a force in newton: a micronewton


class _Frame:
    """From seconds and newtons to the drawing's own units."""

    def __init__(self, time_s: Array, low_n: float, high_n: float) -> None:
        self.t0, self.t1 = float(time_s[0]), float(time_s[-1])
        margin = 0.04 * ((high_n - low_n) or 1.0)
        self.low, self.high = low_n - margin, high_n + margin

    def x(self, time_s: Any) -> Any:
        return LEFT + (np.asarray(time_s) - self.t0) / ((self.t1 - self.t0) or 1.0) * (WIDTH - LEFT - RIGHT)

    def y(self, force_n: Any) -> Any:
        share = (np.asarray(force_n) - self.low) / (self.high - self.low)
        return HEIGHT - BOTTOM - share * (HEIGHT - TOP - BOTTOM)


def history_chart(history: Mapping[str, Any], phases: Sequence[Mapping[str, Any]]) -> Chart:
    """Recorded bins, predicted median, 50 and 90 % bands of the stage `sample`'s bands.json.

    phases : kind, cycle, start_s and end_s of each, as the stage `recording` says.
    """
    series = {
        name: np.array(values, dtype=float) for name, values in history.items() if name != "fitted"
    }  # None becomes NaN
    fitted = np.array(history["fitted"], dtype=bool)
    everything = np.concatenate([values for name, values in series.items() if name != "time_s"])
    frame = _Frame(series["time_s"], float(np.nanmin(everything)), float(np.nanmax(everything)))
    parts = [
        _phases(frame, phases),
        _axes(frame),
        _band(frame, series, 90),
        _band(frame, series, 50),
        f'<path class="median" d="{_line(frame, series["time_s"], series["median_n"])}"/>',
        _dots(frame, series, fitted, "recorded"),
        _dots(frame, series, ~fitted, "recorded unfitted"),
        '<g class="cross" hidden=""><line class="hair"/><circle r="4"/></g>',
    ]
    drawing = (
        f'<svg id="history" xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" '
        f'role="img" aria-labelledby="history-alt">{"".join(parts)}</svg>'
    )
    return Chart(drawing, _numbers(frame, series, fitted, phases), _alt(series, fitted))


def _numbers(
    frame: _Frame, series: Mapping[str, Array], fitted: Array, phases: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """What the cross-hair shows, bin by bin; x and y are where it stands."""
    named = [
        {"from": p["start_s"], "to": p["end_s"], "name": f"{p['kind']} of cycle {p['cycle']}"} for p in phases
    ]
    plain = {
        name: [None if np.isnan(v) else round(float(v), _DIGITS) for v in values]
        for name, values in series.items()
        if name in ("time_s", "recorded_n", "median_n", "low_90_n", "high_90_n")
    }
    where = {
        "x": np.round(frame.x(series["time_s"]), 1).tolist(),
        "y": np.round(frame.y(series["median_n"]), 1).tolist(),
    }
    frames = {"top": TOP, "bottom": HEIGHT - BOTTOM, "width": WIDTH}
    return {**plain, **where, **frames, "fitted": fitted.tolist(), "phases": named}


def _line(frame: _Frame, time_s: Array, force_n: Array) -> str:
    """An SVG path, interrupted where there is no force."""
    pieces = []
    for start, end in runs_of(np.isfinite(force_n)):
        points = zip(frame.x(time_s[start:end]), frame.y(force_n[start:end]), strict=True)
        pieces.append("M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points))
    return "".join(pieces)


def _band(frame: _Frame, series: Mapping[str, Array], level: int) -> str:
    time_s, low, high = series["time_s"], series[f"low_{level}_n"], series[f"high_{level}_n"]
    around = np.concatenate([time_s, time_s[::-1]]), np.concatenate([high, low[::-1]])
    return f'<path class="band band-{level}" d="{_line(frame, *around)}Z"/>'


def _dots(frame: _Frame, series: Mapping[str, Array], chosen: Array, name: str) -> str:
    """Points as a path of lines without length, which round caps make visible."""
    kept = chosen & np.isfinite(series["recorded_n"])
    points = zip(frame.x(series["time_s"][kept]), frame.y(series["recorded_n"][kept]), strict=True)
    path = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in points)
    return f'<path class="{name}" d="{path}"/>' if path else ""


def _phases(frame: _Frame, phases: Sequence[Mapping[str, Any]]) -> str:
    tinted = [
        f'<rect class="phase {escape(p["kind"])}" x="{a:.1f}" y="{TOP}" width="{max(b - a, 0.0):.1f}" '
        f'height="{HEIGHT - TOP - BOTTOM}"/>'
        for p in phases
        if p["kind"] != "rest"
        for a, b in [np.clip(frame.x([p["start_s"], p["end_s"]]), LEFT, WIDTH - RIGHT)]
    ]
    return "".join(tinted)


def _axes(frame: _Frame) -> str:
    bottom = HEIGHT - BOTTOM
    parts = [f'<line class="axis" x1="{LEFT}" y1="{bottom}" x2="{WIDTH - RIGHT}" y2="{bottom}"/>']
    for tick in _ticks(frame.t0, frame.t1, 8):
        x = frame.x(tick)
        parts.append(f'<line class="axis" x1="{x:.1f}" y1="{bottom}" x2="{x:.1f}" y2="{bottom + 4}"/>')
        parts.append(f'<text x="{x:.1f}" y="{bottom + 17}" text-anchor="middle">{tick:g}</text>')
    for tick in _ticks(frame.low, frame.high, 6):
        y = frame.y(tick)
        parts.append(f'<line class="grid" x1="{LEFT}" y1="{y:.1f}" x2="{WIDTH - RIGHT}" y2="{y:.1f}"/>')
        label = f"{tick:g}".replace("-", "−")
        parts.append(f'<text x="{LEFT - 7}" y="{y + 4:.1f}" text-anchor="end">{label}</text>')
    middle = 0.5 * (LEFT + WIDTH - RIGHT)
    parts.append(f'<text x="{middle}" y="{HEIGHT - 4}" text-anchor="middle">time [s]</text>')
    parts.append(f'<text x="4" y="{TOP - 9}">force [N]</text>')
    return "".join(parts)


def _ticks(low: float, high: float, most: int) -> list[float]:
    found = MaxNLocator(most, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high)
    return [float(f"{tick:.9g}") for tick in found if low <= tick <= high]


def _alt(series: Mapping[str, Array], fitted: Array) -> str:
    recorded = series["recorded_n"]
    part = "" if fitted.all() else f", {int(fitted.sum())} of them fitted"
    return (
        f"Force over {series['time_s'][-1]:.0f} s: {len(recorded)} recorded means{part}, from "
        f"{number(np.nanmin(recorded), 3)} to {number(np.nanmax(recorded), 3)} N, with the predicted median "
        "and the 50 and 90 % bands around it."
    )
