"""Draws the residuals of a fit beside the noise that the likelihood assumes."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import beta, norm

from bayeskin.inference import ResidualCheck
from bayeskin.number_format import number
from bayeskin.report.style import (
    ACCENT,
    FAINT,
    GREY,
    MODEL,
    PAGE_IN,
    new_figure,
    panel_title,
    state_finding,
    styled,
)

_LEVEL = 0.95


@styled
def figure_residuals(check: ResidualCheck) -> Figure:
    """Returns a figure of the residuals' quantiles and autocorrelation, with limits for the assumed noise.

    The residuals are drawn as scores, which are standard normal if the noise is as assumed.
    """
    figure = new_figure(PAGE_IN, 2.9)
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.4))
    _quantiles(left, check)
    panel_title(left, "a", f"distribution: Kolmogorov-Smirnov p = {number(check.p_law, 2)}")
    _correlation(right, check)
    panel_title(right, "b", f"correlation: Ljung-Box p = {number(check.p_correlation, 2)}")
    reasons = f" The residual differs from this noise: {'; '.join(check.failures)}." if check.failures else ""
    caption = (
        "Residuals of the fitted bins, without the assumed correlation and transformed from the assumed "
        "distribution to a standard normal one. Grey: 95 % of points lie here if the noise is as assumed."
        + reasons
    )
    state_finding(figure, check.outcome, caption)
    return figure


def _quantiles(ax: Axes, check: ResidualCheck) -> None:
    count = len(check.scores)
    rank = np.arange(1, count + 1)
    expected = norm.ppf((rank - 0.5) / count)
    tails = ((1.0 - _LEVEL) / 2, (1.0 + _LEVEL) / 2)
    low, high = (norm.ppf(beta.ppf(tail, rank, count + 1 - rank)) for tail in tails)
    ax.fill_between(expected, low, high, color=FAINT, alpha=0.6, lw=0)
    ax.plot(expected, expected, color=GREY, lw=0.8)
    ax.plot(expected, np.sort(check.scores), ".", color=MODEL, ms=3)
    ax.set(xlabel="assumed noise [sd]", ylabel="residual [sd]")


def _correlation(ax: Axes, check: ResidualCheck) -> None:
    limit = norm.ppf(0.5 * (1.0 + _LEVEL)) / np.sqrt(len(check.scores))
    lags = np.arange(1, len(check.autocorrelation) + 1)
    ax.axhspan(-limit, limit, color=FAINT, alpha=0.6, lw=0)
    ax.axhline(0.0, color=GREY, lw=0.8)
    outside = np.abs(check.autocorrelation) > limit
    for chosen, color in ((~outside, MODEL), (outside, ACCENT)):
        ax.vlines(lags[chosen], 0.0, check.autocorrelation[chosen], color=color, lw=1.5)
        ax.plot(lags[chosen], check.autocorrelation[chosen], "o", color=color)
    reach = 1.15 * max(2.0 * limit, np.abs(check.autocorrelation).max(initial=0.0))
    ax.set(xlabel="bins apart", ylabel="autocorrelation", ylim=(-reach, reach))
    ax.set_xlim(0.5, max(len(lags), 1) + 0.5)
    ax.set_xticks(lags)
