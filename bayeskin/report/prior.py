"""Draws the forces that the prior predicts before the recording is used."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from bayeskin.number_format import number
from bayeskin.report.style import (
    GREY,
    MODEL,
    PAGE_IN,
    RECORDED,
    new_figure,
    panel_title,
    plain_log,
    state_finding,
    styled,
)
from bayeskin.report.timeline import LEVELS, draw_bands, phase_legend, shade_phases
from bayeskin.types import Array, BinnedForce


@styled
def figure_prior_predictive(binned: BinnedForce, draws_n: ArrayLike) -> Figure:
    """Returns a figure of the forces that the prior predicts, with the recorded bins, and of their peaks.

    draws_n (s, m) : forces [N] in the bins, for draws from the prior
    """
    draws = np.atleast_2d(np.asarray(draws_n, dtype=float))
    figure = new_figure(PAGE_IN, 2.9)
    grid = figure.add_gridspec(1, 2, width_ratios=(2.4, 1))
    fan, peaks = figure.add_subplot(grid[0]), figure.add_subplot(grid[1])
    tails = np.array([(1 - level) / 2 for level in LEVELS])
    shade_phases(fan, binned.phases, cycles=True)
    phase_legend(fan, binned.phases)
    fan.plot(binned.time_s, draws[:8].T, color=GREY, lw=0.35, alpha=0.7)
    draw_bands(fan, binned.time_s, np.quantile(draws, tails, 0), np.quantile(draws, 1 - tails, 0))
    fan.plot(binned.time_s, np.median(draws, axis=0), color=MODEL)
    fan.plot(binned.time_s, binned.force_n, color=RECORDED, lw=1.0)
    # Forces span decades and cross zero. The axis is therefore linear below about a tenth of the recorded
    # peak and logarithmic above.
    recorded_peak = float(np.nanmax(binned.force_n))
    threshold = 10.0 ** np.floor(np.log10(0.2 * (np.nanmax(np.abs(binned.force_n)) or 1.0)))
    fan.set_yscale("symlog", linthresh=threshold)
    fan.yaxis.set_major_formatter(lambda value, _: f"{value:g}".replace("-", "−"))
    bottom = min(float(np.quantile(draws, tails[1], axis=0).min()), float(np.nanmin(binned.force_n)), 0.0)
    fan.set_ylim(1.3 * bottom - 0.3 * threshold, 6 * max(float(draws.max()), recorded_peak, threshold))
    fan.set(xlabel="time [s]", ylabel="force [N]")
    peak_n = draws.max(axis=1)
    share = np.mean(peak_n < recorded_peak)
    _draw_peaks(peaks, peak_n, recorded_peak)
    panel_title(fan, "a")
    panel_title(peaks, "b", "the prior's peak forces")
    finding = (
        f"The recorded peak of {number(recorded_peak, 3)} N (a bin's mean) lies above "
        f"{100 * share:.0f} % of the peaks that the prior predicts"
    )
    caption = (
        f"Black: recorded. Blue: median, 50 % and 90 % band of {len(draws)} draws from the prior; grey: "
        f"single draws. Force axis linear below {threshold:g} N and logarithmic above."
    )
    state_finding(figure, finding, caption)
    return figure


def _draw_peaks(ax: Axes, peak_n: Array, recorded_peak_n: float) -> None:
    positive = peak_n[peak_n > 0]
    if len(positive):
        low, high = np.log10([positive.min() / 1.1, positive.max() * 1.1])
        ax.hist(positive, bins=np.logspace(low, high, 25).tolist(), color=MODEL, alpha=0.45)
        ax.set_xscale("log")
        plain_log(ax.xaxis)
    ax.axvline(recorded_peak_n, color=RECORDED, lw=1.2)
    ax.margins(y=0.2)
    ax.annotate(
        "recorded", (recorded_peak_n, 1), xycoords=ax.get_xaxis_transform(), xytext=(3, -2),
        textcoords="offset points", va="top",
    )  # fmt: skip
    ax.set(xlabel="peak force [N]", ylabel="draws")
