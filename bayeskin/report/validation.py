"""Draws tests of the surrogate against runs of the full model on which it was not trained."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike
from scipy.special import ndtri

from bayeskin.number_format import number
from bayeskin.report.style import (
    ACCENT,
    GREY,
    INK,
    MODEL,
    PAGE_IN,
    RECORDED,
    new_figure,
    panel_title,
    plain_log,
    state_finding,
    styled,
)
from bayeskin.report.timeline import phase_legend, shade_phases
from bayeskin.types import Array, BinnedForce, Prediction

_NOMINAL = np.array([0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99])


@styled
def figure_validation(
    edges_s: ArrayLike,
    true_n: ArrayLike,
    prediction: Prediction,
    noise_sd_n: ArrayLike,
    wave_error: ArrayLike,
    corrected: bool = False,
) -> Figure:
    """Returns a figure of the surrogate's errors on held-out runs: amplitude, coverage, waves, over time.

    edges_s (m+1,) : edges of the bins
    true_n (n, m) : bin means [N] of the full model's held-out runs
    prediction : of the surrogate at the same points
    noise_sd_n (m,) : sd [N] of the recording's bins, which is its noise floor
    wave_error (w, q) : relative error of q held-out points after each of w waves; NaN where it is unknown
    corrected : with True, the last row of wave_error belongs to the surrogate of all waves after its
        correction by a finer model
    """
    edges, true = np.asarray(edges_s, dtype=float), np.atleast_2d(np.asarray(true_n, dtype=float))
    noise = np.asarray(noise_sd_n, dtype=float)
    figure = new_figure(PAGE_IN, 4.9)
    grid = figure.add_gridspec(2, 3, height_ratios=(1, 1))
    amplitude, cover, waves = (figure.add_subplot(grid[0, k]) for k in range(3))
    over_time = figure.add_subplot(grid[1, :])
    _draw_amplitude(amplitude, true, prediction)
    _draw_coverage(cover, true, prediction)
    _draw_waves(waves, np.atleast_2d(np.asarray(wave_error, dtype=float)), corrected)
    error = np.abs(prediction.mean - true)
    _draw_error(over_time, 0.5 * (edges[1:] + edges[:-1]), error, prediction.sd(), noise)
    titles = ("error of the peak force", "coverage of intervals", "error by wave", "error over time")
    for ax, letter, title in zip((amplitude, cover, waves, over_time), "abcd", titles, strict=True):
        panel_title(ax, letter, title)
    below = np.mean(np.sqrt(np.mean(error**2, axis=0)) <= noise)
    inside = coverage(true, prediction, np.array([0.9]))[0][0]
    finding = (
        f"The RMS error is below the recording's noise in {100 * below:.0f} % of bins; "
        f"90 % intervals hold {100 * inside:.0f} % of the held-out forces"
    )
    caption = (
        f"{len(true)} held-out runs of the full model. Noise floor: one sd of a recorded bin's mean. "
        "Bars in a and c: 90 % intervals; band in b: 95 %, each run counted as one observation."
    )
    state_finding(figure, finding, caption)
    return figure


@styled
def figure_map_check(
    binned: BinnedForce, full_n: ArrayLike, surrogate_n: ArrayLike, surrogate_sd_n: ArrayLike
) -> Figure:
    """Returns a figure of full model, surrogate and recording at the MAP, and of the surrogate's error.

    full_n, surrogate_n (m,) : bin means [N]
    surrogate_sd_n (m,) : sd [N] that the surrogate states for its own error

    The error is drawn in mN and in units of this sd.
    """
    full, surrogate, sd = (np.asarray(v, dtype=float) for v in (full_n, surrogate_n, surrogate_sd_n))
    time_s, error = binned.time_s, surrogate - full
    figure = new_figure(PAGE_IN, 4.6)
    grid = figure.add_gridspec(3, 1, height_ratios=(1.7, 1, 1))
    force = figure.add_subplot(grid[0])
    in_mn, in_sd = (figure.add_subplot(grid[k], sharex=force) for k in (1, 2))
    for ax in (force, in_mn, in_sd):
        shade_phases(ax, binned.phases, cycles=ax is force)
        ax.tick_params(labelbottom=ax is in_sd)
    phase_legend(force, binned.phases)
    force.plot(time_s, binned.force_n, ".", ms=2.2, color=RECORDED, label="recorded")
    force.plot(time_s, full, color=MODEL, label="full model at the MAP")
    force.plot(time_s, surrogate, color=ACCENT, ls=(0, (4, 2)), label="surrogate at the MAP")
    force.margins(y=0.16)
    force.legend(loc="lower left", bbox_to_anchor=(0.02, 1), ncols=3, columnspacing=1.2)
    noise_mn = 1e3 * np.sqrt(binned.variance_n2)
    for sign in (-1, 1):
        label = "noise of a bin, ±1 sd" if sign > 0 else None
        in_mn.plot(time_s, sign * noise_mn, color=GREY, lw=0.8, ls=(0, (4, 2)), label=label)
    in_mn.plot(time_s, 1e3 * error, color=ACCENT, label="surrogate − full model")
    in_mn.legend(loc="lower right", bbox_to_anchor=(1, 0.97), ncols=2)
    # Where the force is known exactly (rest before the test), the sd is zero and the ratio is undefined.
    known = sd > 1e-9 * max(np.max(np.abs(full)), 1e-12)
    ratio = np.where(known, error / np.where(known, sd, 1.0), np.nan)
    for level in (-2, 2):
        in_sd.axhline(level, color=GREY, lw=0.8, ls=(0, (4, 2)))
    in_sd.plot(time_s, ratio, color=INK, lw=0.9)
    for ax in (in_mn, in_sd):
        ax.axhline(0, color=GREY, lw=0.6)
    force.set_ylabel("force [N]")
    in_mn.set_ylabel("error [mN]")
    in_sd.set(xlabel="time [s]", ylabel="error [surrogate sd]")
    for ax, letter, title in zip(
        (force, in_mn, in_sd), "abc", ("", "surrogate's error", "error over the surrogate's sd; dashed: ±2"),
        strict=True,
    ):  # fmt: skip
        panel_title(ax, letter, title)
    in_its_sd = f" (at most {number(np.nanmax(np.abs(ratio)), 2)} of its sd)" if known.any() else ""
    misfit_n = np.sqrt(np.nanmean((binned.force_n - full) ** 2))
    finding = (
        f"At the MAP the surrogate's error is {number(1e3 * np.sqrt(np.mean(error**2)), 2)} mN RMS"
        f"{in_its_sd}; the full model's residual is {number(1e3 * misfit_n, 2)} mN RMS"
    )
    state_finding(figure, finding)
    return figure


def coverage(true_n: Array, prediction: Prediction, nominal: Array) -> tuple[Array, Array]:
    """Returns the actual coverage (k,) of central intervals, and its standard error (k,).

    true_n (n, m) : bin means [N] of n runs
    prediction : of the surrogate at the same points
    nominal (k,) : nominal coverage of the intervals

    For the standard error, each run is one cluster. Bins in which the surrogate states no error at all (a
    force known to be zero) are left out.
    """
    sd = prediction.sd()
    known = sd > 1e-9 * max(float(np.max(np.abs(true_n))), 1e-12)
    z = np.abs(prediction.mean - true_n) / np.where(known, sd, 1.0)
    weight = known.sum(axis=1)
    inside = np.array([np.sum((z <= ndtri(0.5 + p / 2)) & known, axis=1) for p in nominal])  # (k, n)
    total, n = max(int(weight.sum()), 1), len(true_n)
    share = inside.sum(axis=1) / total
    spread = ((inside - share[:, None] * weight) ** 2).sum(axis=1) / total**2
    return share, np.sqrt(spread * n / max(n - 1, 1))


def _draw_amplitude(ax: Axes, true: Array, prediction: Prediction) -> None:
    rows = np.arange(len(true))
    peak = np.argmax(np.abs(true), axis=1)
    amplitude = true[rows, peak]
    used = amplitude != 0
    percent = 100 / amplitude[used]
    error = percent * (prediction.mean[rows, peak] - amplitude)[used]
    spread = ndtri(0.95) * np.abs(percent) * prediction.sd()[rows, peak][used]
    ax.axhline(0, color=GREY, lw=0.8)
    ax.errorbar(
        np.abs(amplitude[used]), error, yerr=spread, fmt=".", ms=3.5, color=MODEL, elinewidth=0.6, alpha=0.8
    )
    if used.any():
        ax.set_xscale("log")
        plain_log(ax.xaxis)
    ax.set(xlabel="peak of the full model [N]", ylabel="surrogate − full model [%]")


def _draw_coverage(ax: Axes, true: Array, prediction: Prediction) -> None:
    share, error = coverage(true, prediction, _NOMINAL)
    ax.plot([0, 1], [0, 1], color=GREY, lw=0.8)
    ax.fill_between(_NOMINAL, np.clip(share - 1.96 * error, 0, 1), np.clip(share + 1.96 * error, 0, 1),
                    color=MODEL, alpha=0.25, lw=0)  # fmt: skip
    ax.plot(_NOMINAL, share, ".-", color=MODEL)
    ax.text(0.05, 0.93, "too wide", color=GREY, fontsize=6.5)
    ax.text(0.95, 0.05, "too narrow", color=GREY, fontsize=6.5, ha="right")
    ax.set(xlim=(0, 1.01), ylim=(0, 1.03), xlabel="nominal coverage", ylabel="actual coverage")


def _draw_waves(ax: Axes, wave_error: Array, corrected: bool) -> None:
    for wave, row in enumerate(wave_error):
        errors = 100 * row[np.isfinite(row)]
        if len(errors) == 0:
            continue
        low, middle, high = np.quantile(errors, [0.05, 0.5, 0.95])
        ax.plot([wave, wave], [low, high], color=MODEL, lw=2.5, alpha=0.4, solid_capstyle="butt")
        ax.plot(wave, middle, "o", color=MODEL, ms=4.5)
        ax.text(wave + 0.12, middle, f"{number(middle, 2)}", va="center", fontsize=6.5)
    ax.set_xlim(-0.5, len(wave_error) - 0.2)
    labels = [str(wave) for wave in range(len(wave_error))]
    ax.set_xticks(range(len(labels)), [*labels[:-1], "corrected"] if corrected else labels)
    if np.nanmin(np.where(wave_error > 0, wave_error, np.nan), initial=np.inf) < np.inf:
        ax.set_yscale("log")
        plain_log(ax.yaxis)
    ax.set(xlabel="wave", ylabel="relative error [%]")


def _draw_error(ax: Axes, time_s: Array, error: Array, sd: Array, noise: Array) -> None:
    high = 1e3 * np.quantile(error, 0.95, axis=0)
    ax.fill_between(time_s, 1e-12, high, color=MODEL, alpha=0.2, lw=0, label="95 % of runs")
    ax.plot(time_s, 1e3 * np.sqrt(np.mean(error**2, axis=0)), color=MODEL, label="RMS error")
    claimed = 1e3 * np.sqrt(np.mean(sd**2, axis=0))
    ax.plot(time_s, claimed, color=ACCENT, ls=(0, (4, 2)), lw=0.9, label="RMS of the stated sd")
    ax.plot(time_s, 1e3 * noise, color=INK, lw=0.9, label="noise floor of the recording")
    drawn = np.concatenate([1e3 * noise, high])
    if (drawn > 0).any():
        ax.set_yscale("log")
        ax.set_ylim(max(1e-4 * drawn.max(), 0.3 * np.quantile(drawn[drawn > 0], 0.05)), 2 * drawn.max())
        plain_log(ax.yaxis)
    ax.set_xlim(time_s[0], time_s[-1])
    ax.legend(loc="lower right", bbox_to_anchor=(1, 0.98), ncols=4, columnspacing=1.0)
    ax.set(xlabel="time [s]", ylabel="error [mN]")
