"""Draws the interactive charts over time: force, residual, and Sobol' indices.

A cross-hair shows their values as text.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayeskin.number_format import number
from bayeskin.report.page.parts import Chart, Key
from bayeskin.report.page.plot import Phases, Plot, moments
from bayeskin.report.style import parameter_colors
from bayeskin.sensitivity.result import SobolResult
from bayeskin.types import Array, Recording

_STRIPES = 700  # the width of a chart in stripes; a stripe shows its smallest and its largest sample
_BANDS = Key("50 and 90 % bands", "band")
_PHASES = tuple(Key(kind, f"phase {kind}") for kind in ("load", "hold", "unload"))


def history_chart(history: Mapping[str, Any], phases: Phases) -> Chart:
    """Returns the chart of recorded bins, predicted median, and 50 and 90 % bands over time.

    history : content of bands.json, which the stage `sample` writes
    phases : kind, cycle, start_s and end_s of each phase, as the stage `recording` writes them
    """
    series, fitted = _series(history)
    plot = Plot(series["time_s"], [values for name, values in series.items() if name != "time_s"])
    parts = [
        *(plot.band(series[f"low_{level}_n"], series[f"high_{level}_n"], "") for level in (90, 50)),
        plot.line(series["median_n"], "median"),
        plot.dots(series["recorded_n"], fitted, "recorded"),
        plot.dots(series["recorded_n"], ~fitted, "recorded unfitted"),
    ]
    return Chart(
        "history",
        "Force over time",
        plot.svg("history", "force [N]", phases, parts, 1),
        plot.numbers([series["median_n"]], list(_forces(series, fitted, phases))),
        _alt(series, fitted),
        (Key("recorded", "dots"), Key("predicted median", "line"), _BANDS),
    )


def residual_chart(history: Mapping[str, Any], phases: Phases) -> Chart:
    """Returns the chart of the recorded bins minus the predicted median [mN] over time, with the bands."""
    series, fitted = _series(history)
    median_n, residual_mn = series["median_n"], 1e3 * (series["recorded_n"] - series["median_n"])
    names = ("low_90", "high_90", "low_50", "high_50")
    ends = {name: 1e3 * (series[f"{name}_n"] - median_n) for name in names}
    plot = Plot(series["time_s"], [residual_mn, *ends.values()])
    parts = [
        *(plot.band(ends[f"low_{level}"], ends[f"high_{level}"], "") for level in (90, 50)),
        plot.line(np.zeros_like(median_n), "median"),
        plot.dots(residual_mn, fitted, "recorded"),
        plot.dots(residual_mn, ~fitted, "recorded unfitted"),
    ]
    low, high = (number(end, 3) for end in (np.nanmin(residual_mn), np.nanmax(residual_mn)))
    alt = f"Recorded minus predicted force over time, from {low} to {high} mN, with the 50 and 90 % bands."
    return Chart(
        "residual",
        "Residual over time",
        plot.svg("residual", "recorded − predicted [mN]", phases, parts, 1),
        plot.numbers([residual_mn], list(_residuals(series, fitted, phases))),
        alt,
        (Key("recorded − predicted median", "dots"), _BANDS),
    )


def recording_charts(recording: Recording, phases: Phases) -> tuple[Chart, Chart]:
    """Returns the charts of a recording's displacement [mm] and force [N] over time, as measured.

    phases : kind, cycle, start_s and end_s of each phase
    """
    displacement_mm = 1e3 * recording.displacement_m
    duration_s = recording.time_s[-1] - recording.time_s[0]
    alt = f"over {number(duration_s, 4)} s, as measured, from {{}} to {{}} {{}}, with the phases shaded."
    charts = []
    for key, name, values, unit in (
        ("displacement", "Displacement", displacement_mm, "mm"),
        ("force", "Force", recording.force_n, "N"),
    ):
        shown = _extremes(recording.time_s, values)
        time_s, values = recording.time_s[shown], values[shown]
        plot = Plot(time_s, [values])
        says = [
            f"{moment}: {number(value, 4)} {unit}"
            for moment, value in zip(moments(time_s, phases), values, strict=True)
        ]
        svg = plot.svg(key, f"{name.lower()} [{unit}]", phases, [plot.line(values, "median")], 1)
        low, high = (number(float(end), 3) for end in (values.min(), values.max()))
        title, described = f"{name} over time", f"{name} {alt.format(low, high, unit)}"
        charts.append(Chart(key, title, svg, plot.numbers([values], says), described, _PHASES))
    return charts[0], charts[1]


def _extremes(time_s: Array, values: Array) -> NDArray[np.int64]:
    """Returns which samples (k,) show a line over time: the smallest and the largest of each stripe."""
    edges = np.linspace(time_s[0], time_s[-1], _STRIPES + 1)
    starts = np.unique(np.searchsorted(time_s, edges[:-1]))
    ends = [*starts[1:], len(time_s)]
    chosen = {0, len(time_s) - 1}
    for start, end in zip(starts, ends, strict=True):
        stripe = values[start:end]
        chosen |= {int(start + stripe.argmin()), int(start + stripe.argmax())}
    return np.array(sorted(chosen), dtype=np.int64)


def indices_chart(key: str, title: str, result: SobolResult, phases: Phases) -> Chart:
    """Returns the chart of Sobol' indices over time.

    First-order indices are solid lines, total indices are dashed, and each parameter has its own colour.
    """
    time_s = 0.5 * (result.edges_s[1:] + result.edges_s[:-1])
    plot = Plot(time_s, [*result.first, *result.total, np.array([0.0, 1.0])])
    colors = parameter_colors(result.names)
    parts = [
        plot.line(values, name, color)
        for series, name in ((result.total, "index total"), (result.first, "index"))
        for values, color in zip(series, colors, strict=True)
    ]
    keys = [Key(name, "line", color) for name, color in zip(result.names, colors, strict=True)]
    return Chart(
        key,
        f"Sobol' indices over time, {title}",
        plot.svg(key, "share of the force's variance", phases, parts, len(result.names)),
        plot.numbers(list(result.first), list(_shares(time_s, result, phases))),
        f"Sobol' indices of {', '.join(result.names)} over time, first order and total, {title}.",
        (*keys, Key("total, with all interactions", "dashed")),
    )


def _series(history: Mapping[str, Any]) -> tuple[dict[str, Array], NDArray[np.bool_]]:
    """Returns arrays (m,) by name, with NaN where there is no value, and which bins (m,) were fitted."""
    series = {name: np.array(values, dtype=float) for name, values in history.items() if name != "fitted"}
    return series, np.array(history["fitted"], dtype=bool)


def _forces(series: Mapping[str, Array], fitted: NDArray[np.bool_], phases: Phases) -> Iterator[str]:
    """Yields the text of the cross-hair of the force chart for each bin."""
    for i, moment in enumerate(moments(series["time_s"], phases)):
        median, low, high = (_millinewton(series[name][i]) for name in ("median_n", "low_90_n", "high_90_n"))
        recorded = series["recorded_n"][i]
        value = "nothing recorded" if np.isnan(recorded) else f"recorded {_millinewton(recorded)}"
        value += "" if fitted[i] else " (not fitted)"
        yield f"{moment}: {value}; predicted {median}, 90 % band {low} to {high}"


def _residuals(series: Mapping[str, Array], fitted: NDArray[np.bool_], phases: Phases) -> Iterator[str]:
    """Yields the text of the cross-hair of the residual chart for each bin."""
    median_n = series["median_n"]
    for i, moment in enumerate(moments(series["time_s"], phases)):
        residual = series["recorded_n"][i] - median_n[i]
        low, high = (_millinewton(series[name][i] - median_n[i]) for name in ("low_90_n", "high_90_n"))
        value = "nothing recorded" if np.isnan(residual) else f"residual {_millinewton(residual)}"
        yield f"{moment}: {value}{'' if fitted[i] else ' (not fitted)'}; 90 % band {low} to {high}"


def _shares(time_s: Array, result: SobolResult, phases: Phases) -> Iterator[str]:
    """Yields the text of the cross-hair of the chart of Sobol' indices for each bin."""
    for i, moment in enumerate(moments(time_s, phases)):
        indices = zip(result.names, result.first[:, i], result.total[:, i], strict=True)
        values = [
            f"{name} {_share(first)} ({_share(total)})"
            for name, first, total in indices
            if not np.isnan(first)
        ]
        yield f"{moment}: " + (
            f"first order (total): {', '.join(values)}" if values else "the force does not vary"
        )


def _millinewton(force_n: float) -> str:
    return f"{1e3 * force_n + 0.0:.1f} mN".replace("-", "−")


def _share(index: float) -> str:
    return f"{round(index, 2) + 0.0:.2f}".replace("-", "−")


def _alt(series: Mapping[str, Array], fitted: NDArray[np.bool_]) -> str:
    recorded = series["recorded_n"]
    part = "" if fitted.all() else f", {int(fitted.sum())} of them fitted"
    return (
        f"Force over {series['time_s'][-1]:.0f} s: {len(recorded)} recorded means{part}, from "
        f"{number(np.nanmin(recorded), 3)} to {number(np.nanmax(recorded), 3)} N, with the predicted median "
        "and the 50 and 90 % bands around it."
    )
