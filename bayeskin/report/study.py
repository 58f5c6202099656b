"""Draws the result of a study: values of all recordings, ratios of groups, and spreads of the population."""

from __future__ import annotations

from collections.abc import Sequence
from string import ascii_lowercase

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from bayeskin.number_format import number, probability
from bayeskin.report.style import (
    ACCENT,
    FAINT,
    GREY,
    INK,
    MODEL,
    PAGE_IN,
    axis_values,
    literal,
    new_figure,
    panel_title,
    parameter_colors,
    parameter_label,
    plain_log,
    state_finding,
    styled,
    symbol,
)
from bayeskin.study import (
    Contrast,
    Estimate,
    ParameterOfPopulation,
    Population,
    Shrunk,
    Spread,
    clearest_contrast,
    contrast_sentence,
    percentage,
)
from bayeskin.types import Array

_GROUPS = (MODEL, ACCENT, "#009E73", "#CC79A7", "#E69F00", "#56B4E9", INK)  # some are colours of Okabe & Ito
_ROW_IN, _HIGHEST_IN = 0.115, 8.5  # height of one recording, and largest height of all of them
_LEGIBLE_IN = 0.1  # distance of two labels
_MARGIN = 0.35  # space beside the shrunk estimates, as a share of their range
_CV_AXIS = (2.0, 300.0)  # range of coefficients of variation that is drawn [%]
LineStyle = str | tuple[float, tuple[float, ...]]
_WITHIN: LineStyle = (0.0, (2.0, 1.0))


@styled
def figure_recordings(population: Population) -> Figure:
    """Returns a forest plot: each recording's values by itself and given all recordings, by group."""
    layout = population.layout
    groups = layout.group.values if layout.group else (None,)
    blocks = [
        [recording for recording in population.recordings if recording.group == group] for group in groups
    ]
    for block in blocks:
        block.sort(key=lambda recording: layout.subjects.index(recording.subject))
    height = min(_ROW_IN * (len(population.recordings) + len(blocks)), _HIGHEST_IN)
    figure = new_figure(PAGE_IN, height + 1.5)
    axes = figure.subplots(1, len(population.parameters), sharey=True, squeeze=False)[0]
    for column, (ax, letter) in enumerate(zip(axes, ascii_lowercase, strict=False)):
        _draw_column(ax, column, population, blocks)
        panel_title(ax, letter, symbol(population.parameters[column].parameter.name))
    _label_rows(axes[0], blocks, height)
    _name_groups(axes[-1], blocks)
    caption = (
        "Dots and lines: medians and 90 % intervals. Grey: each recording by itself; lines may leave the "
        "axes. Coloured: given all recordings of the study. Bands: 90 % interval of the median of the "
        f"{'group' if layout.group else 'population'}. Rows of one subject stand together."
    )
    state_finding(figure, _narrowing(population), caption)
    return figure


@styled
def figure_population(population: Population) -> Figure:
    """Returns a figure of the ratios between groups and sites, and of the spreads of each parameter."""
    pairs = [(summary, contrast) for summary in population.parameters for contrast in summary.contrasts]
    height = 1.4 + 0.2 * max(len(pairs), 2 * len(population.parameters))
    figure = new_figure(PAGE_IN if pairs else 0.6 * PAGE_IN, height)
    panels = figure.subplots(1, 2 if pairs else 1, squeeze=False)[0]
    if pairs:
        _draw_ratios(panels[0], pairs)
        for ax, letter in zip(panels, ascii_lowercase, strict=False):
            panel_title(ax, letter)
    _draw_spreads(panels[-1], population.parameters)
    caption = (
        "Dots and lines: medians and 90 % intervals. An arrow marks a spread that cannot be told from zero; "
        "it ends at the upper end of the interval."
    )
    if population.layout.repetition == "none":
        caption += " Each subject has one recording, so the spread within a subject is not known."
    state_finding(figure, _finding(population), caption)
    return figure


def _draw_column(ax: Axes, column: int, population: Population, blocks: Sequence[Sequence[Shrunk]]) -> None:
    """Draws one parameter of all recordings."""
    summary = population.parameters[column]
    top = 0
    for block, color, group in zip(blocks, _colors(len(blocks)), summary.medians, strict=True):
        rows = top + np.arange(len(block))
        ends = axis_values(summary.parameter, [summary.medians[group].low, summary.medians[group].high])
        ax.fill_betweenx([rows[0] - 0.6, rows[-1] + 0.6], *ends, color=color, alpha=0.18, lw=0)
        alone = _ends(summary, [recording.alone[column] for recording in block if recording.alone])
        shrunk = _ends(summary, [recording.shrunk[column] for recording in block])
        ax.hlines(rows - 0.18, alone[1], alone[2], color=FAINT, lw=1.1)
        ax.plot(alone[0], rows - 0.18, "o", ms=2.2, color=GREY, mfc="white", mew=0.6)
        ax.hlines(rows + 0.18, shrunk[1], shrunk[2], color=color, lw=1.1)
        ax.plot(shrunk[0], rows + 0.18, "o", ms=2.4, color=color)
        top += len(block) + 1
    estimates = [
        *(recording.shrunk[column] for recording in population.recordings),
        *summary.medians.values(),
    ]
    ends = _ends(summary, estimates)
    low, high = ends[1].min(), ends[2].max()
    margin = _MARGIN * (high - low)
    bounds = axis_values(summary.parameter, [summary.parameter.lower, summary.parameter.upper])
    ax.set_xlim(max(low - margin, bounds[0]), min(high + margin, bounds[1]))
    ax.set_ylim(top - 1.2, -1.0)
    ax.set_xlabel(parameter_label(summary.parameter))
    ax.xaxis.set_major_locator(MaxNLocator(4))
    ax.tick_params(axis="y", length=0)


def _label_rows(ax: Axes, blocks: Sequence[Sequence[Shrunk]], height_in: float) -> None:
    """Labels the first row of each subject, or of some subjects where the rows are narrow."""
    at, names, top = list[int](), list[str](), 0
    for block in blocks:
        for row, recording in enumerate(block):
            if not row or block[row - 1].subject != recording.subject:
                at.append(top + row)
                names.append(recording.subject)
        top += len(block) + 1
    every = max(1, int(np.ceil(_LEGIBLE_IN * len(at) / height_in)))
    ax.set_yticks(at[::every], [literal(name) for name in names[::every]])


def _name_groups(ax: Axes, blocks: Sequence[Sequence[Shrunk]]) -> None:
    """Writes the name of each group beside its rows, in its colour."""
    top = 0
    for block, color in zip(blocks, _colors(len(blocks)), strict=True):
        ax.annotate(
            literal(block[0].group or ""), (1.0, top + 0.5 * (len(block) - 1)),
            xycoords=("axes fraction", "data"), xytext=(5, 0), textcoords="offset points",
            rotation=270, va="center", color=color, fontweight="bold",
        )  # fmt: skip
        top += len(block) + 1


def _draw_ratios(ax: Axes, pairs: Sequence[tuple[ParameterOfPopulation, Contrast]]) -> None:
    colors = dict(
        zip(names := [summary.parameter.name for summary, _ in pairs], parameter_colors(names), strict=True)
    )
    for row, (summary, contrast) in enumerate(pairs):
        ratio, color = contrast.ratio, colors[summary.parameter.name]
        ax.plot([ratio.low, ratio.high], [row, row], color=color, lw=1.4)
        ax.plot(ratio.median, row, "o", ms=4, color=color)
        ax.annotate(
            probability(contrast.probability), (1.0, row), xycoords=("axes fraction", "data"),
            xytext=(4, 0), textcoords="offset points", va="center", fontsize=7,
        )  # fmt: skip
    ax.annotate(
        "probability\nabove 1", (1.0, 1.0), xycoords="axes fraction", xytext=(4, 2), va="bottom", ha="center",
        textcoords="offset points", fontsize=6.5, color=GREY,
    )  # fmt: skip
    ax.axvline(1.0, color=GREY, lw=0.8)
    labels = [
        f"{symbol(summary.parameter.name)}: {literal(c.second)} / {literal(c.first)}" for summary, c in pairs
    ]
    ax.set_yticks(range(len(pairs)), labels)
    ax.set_ylim(len(pairs) - 0.5, -0.5)
    ax.set(xscale="log", xlabel="ratio of the medians")
    plain_log(ax.xaxis)


def _draw_spreads(ax: Axes, parameters: Sequence[ParameterOfPopulation]) -> None:
    colors = parameter_colors([summary.parameter.name for summary in parameters])
    for row, (summary, color) in enumerate(zip(parameters, colors, strict=True)):
        aside = 0.0 if summary.within is None else 0.16
        _draw_spread(ax, summary.between, row - aside, color, "-")
        if summary.within is not None:
            _draw_spread(ax, summary.within, row + aside, color, _WITHIN)
    ax.set_yticks(range(len(parameters)), [symbol(summary.parameter.name) for summary in parameters])
    ax.set_ylim(len(parameters) - 0.5, -0.5)
    ax.set(xscale="log", xlim=_CV_AXIS, xlabel="coefficient of variation [%]")
    plain_log(ax.xaxis)
    handles = [Line2D([], [], color=INK, lw=1.4, label="between subjects")]
    if any(summary.within for summary in parameters):
        handles.append(Line2D([], [], color=INK, lw=1.4, ls=_WITHIN, label="within a subject"))
    ax.legend(handles=handles, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)


def _draw_spread(ax: Axes, spread: Spread, row: float, color: str, line: LineStyle) -> None:
    low, median, high = (100.0 * value for value in (spread.cv.low, spread.cv.median, spread.cv.high))
    if spread.only_upper_bound:
        low = _CV_AXIS[0]
        ax.plot(1.06 * low, row, "<", color=color, ms=3)
        ax.plot(high, row, "|", color=color, ms=6, mew=1.4)
    else:
        ax.plot(median, row, "o", ms=4, color=color)
    ax.plot([low, high], [row, row], color=color, lw=1.4, ls=line)


def _ends(summary: ParameterOfPopulation, estimates: Sequence[Estimate]) -> Array:
    """Returns medians, lower and upper ends (3, n) on the axis of a parameter."""
    values = [[e.median for e in estimates], [e.low for e in estimates], [e.high for e in estimates]]
    return axis_values(summary.parameter, values)


def _colors(count: int) -> list[str]:
    return [_GROUPS[n % len(_GROUPS)] for n in range(count)]


def _narrowing(population: Population) -> str:
    """Returns by which factors the study narrows the intervals of recordings, as medians, in a sentence."""
    if not population.trusted:
        return _finding(population)
    factors = []
    for column, summary in enumerate(population.parameters):
        widths = [
            [np.log(estimate[column].high / estimate[column].low) for estimate in (each.alone, each.shrunk)]
            for each in population.recordings
            if each.alone is not None
        ]
        factor = float(np.median([alone / shrunk for alone, shrunk in widths]))
        factors.append(f"{symbol(summary.parameter.name)} {number(factor, 2)}")
    return f"Factors by which the study narrows the intervals of its recordings: {', '.join(factors)}"


def _finding(population: Population) -> str:
    """Returns the clearest difference of two groups or sites, or the widest spread, as a sentence."""
    if not population.trusted:
        return "These results are not to be trusted: the sampler has not converged, or draws contradict them"
    if (clearest := clearest_contrast(population)) is not None:
        parameter, contrast = clearest
        return contrast_sentence(parameter, contrast, symbol(parameter.name)).rstrip(".")
    known = [summary for summary in population.parameters if summary.informative]
    if not known:
        return "No recording of the study informs any of these parameters"
    widest = max(known, key=lambda summary: summary.between.sd.median)
    cv = percentage(widest.between.cv)
    return f"Subjects differ most in {symbol(widest.parameter.name)}: coefficient of variation {cv}"
