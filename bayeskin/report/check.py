"""Draws how the posterior changes when the full model replaces the surrogate.

The full model runs some draws of the posterior again, and their weights turn the surrogate's posterior into
that of the full model.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from bayeskin.inference import Corrected, Weighed
from bayeskin.report.style import (
    ACCENT,
    GREY,
    MODEL,
    PAGE_IN,
    new_figure,
    panel_title,
    state_finding,
    styled,
    symbol,
)


@styled
def figure_model_check(weighed: Weighed, corrected: Sequence[Corrected]) -> Figure:
    """Returns a figure of the draws' weights and of each parameter's posterior with and without them.

    weighed : the draws that the full model ran again, with their weights
    corrected : each parameter's posterior under the full model
    """
    figure = new_figure(PAGE_IN, 2.9)
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.7))
    count = len(weighed.weights)
    left.bar(np.arange(1, count + 1), np.sort(weighed.weights)[::-1], color=MODEL, alpha=0.7, width=0.8)
    left.axhline(1 / count, color=GREY, lw=0.8)
    left.annotate(
        "equal weights", (1, 1 / count), xycoords=("axes fraction", "data"), xytext=(0, 2),
        textcoords="offset points", ha="right", color=GREY, fontsize=6.5,
    )  # fmt: skip
    left.set(xlabel="draw, largest weight first", ylabel="weight")
    panel_title(left, "a", "weights of the draws")
    position = np.arange(len(corrected))
    ratio = [parameter.sd_ratio for parameter in corrected]
    shift = [parameter.shift_sd for parameter in corrected]
    right.errorbar(
        position - 0.12, np.zeros(len(position)), yerr=1.0, fmt="o", color=MODEL, label="surrogate"
    )
    right.errorbar(position + 0.12, shift, yerr=ratio, fmt="o", color=ACCENT, label="full model")
    error = [parameter.shift_error_sd for parameter in corrected]
    right.errorbar(position + 0.12, shift, yerr=error, fmt="none", color=ACCENT, elinewidth=3.0, alpha=0.5)
    right.axhline(0.0, color=GREY, lw=0.8)
    right.set_xticks(position, [symbol(parameter.name).replace(" ", "\n") for parameter in corrected])
    right.set_ylabel("mean ± sd [surrogate's sd]")
    right.set_ylim(top=1.25 * right.get_ylim()[1])
    right.legend(loc="upper right", ncols=2)
    panel_title(right, "b", "posterior before and after weighting")
    largest = max(corrected, key=lambda parameter: abs(parameter.shift_sd))
    finding = (
        f"Of {count} draws with full runs, {weighed.effective:.0f} are effective; "
        f"{symbol(largest.name)} moves most, by {abs(largest.shift_sd):.2f} of its sd"
    )
    caption = (
        "Thin bars: sd of the posterior. Thick bars: standard error of the full model's mean, because there "
        "are few draws. Both are in units of the sd of the surrogate's posterior; where the prior is "
        "logarithmic, they refer to the logarithm of the parameter."
    )
    state_finding(figure, finding, caption)
    return figure
