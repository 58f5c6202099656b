"""Draws the figure of benchmarks/markers.py."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayeskin.report.style import (
    ACCENT,
    FAINT,
    GREY,
    INK,
    MODEL,
    PAGE_IN,
    new_figure,
    panel_title,
    state_finding,
    styled,
)

Row = Mapping[str, str]
PARAMETERS = ("E_c", "E_s", "k_c", "k_s")
COLOURS = {"False": GREY, "True": MODEL}
EFFECTS = (
    "fibre-anisotropy", "pre-stretch", "bottom-adherence", "skeleton-compressibility", "strain-stiffening",
)  # fmt: skip


@styled
def figure_markers_add(table: Sequence[Row], truth: Mapping[str, Mapping[str, float]]) -> Figure:
    """Returns the figure: widths of the skin's parameters, and evidence for concealed effects.

    truth : the concealed values of each case
    """
    figure = new_figure(PAGE_IN, 2.9)
    left, right = figure.subplots(1, 2, width_ratios=[1.25, 1.0])
    _draw_widths(left, table, truth)
    _draw_evidence(right, table)
    state_finding(
        figure,
        "25 markers between the pads tell the moduli apart, and show effects that the force hides",
        "Concealed recordings of the full model. a: value over truth, with 90 % intervals by Laplace's "
        "approximation; the last skin's data are from a finer mesh. b: log evidence of the concealed "
        "mechanism over the base model.",
    )
    return figure


def _draw_widths(ax: Axes, table: Sequence[Row], truth: Mapping[str, Mapping[str, float]]) -> None:
    """Draws the intervals of four parameters of each skin."""
    cases = ("usual", "demo", "stiff", "finer mesh")
    rows = {(row["case"], row["markers"]): row for row in table if row["set"] == "" and row["case"] in cases}
    y, ticks = 0.0, []
    for parameter in PARAMETERS:
        for case in cases:
            for markers, colour in COLOURS.items():
                row = rows[case, markers]
                value, sd = (json.loads(row[key])[parameter] for key in ("values", "sds"))
                centre, half = np.log10(value / truth[case][parameter]), 1.645 * sd / np.log(10)
                ax.plot([centre - half, centre + half], [y, y], color=colour, lw=1.6, solid_capstyle="butt")
                ax.plot(centre, y, "o", color=colour, ms=2.5)
                y += 0.45
            ticks.append((y - 0.675, f"{parameter}, {case}"))
            y += 0.25
        y += 0.35
    ax.axvline(0.0, color=FAINT, lw=0.8, zorder=0)
    ax.set(
        yticks=[place for place, _ in ticks], yticklabels=[name for _, name in ticks], xlim=(-2.5, 2.5),
        xlabel="decades from the concealed value",
    )  # fmt: skip
    ax.invert_yaxis()
    ax.tick_params(axis="y", labelsize=5.5, length=0)
    for label, colour in (("force", GREY), ("force and markers", MODEL)):
        ax.plot([], [], color=colour, lw=1.6, label=label)
    ax.legend(loc="upper left")
    panel_title(ax, "a", "the skin")


def _draw_evidence(ax: Axes, table: Sequence[Row]) -> None:
    """Draws the evidence for each concealed mechanism over the base model."""
    nats = {(row["case"], row["set"], row["markers"]): float(row["log_evidence"]) for row in table}
    for place, effect in enumerate(EFFECTS):
        for shift, (markers, colour) in zip((-0.18, 0.18), COLOURS.items(), strict=True):
            gain = nats[effect, effect, markers] - nats[effect, "", markers]
            ax.barh(place + shift, max(gain, 0.0), 0.32, color=colour)
            text = f"{max(gain, 0.0):.0f}"
            ax.annotate(text, (max(gain, 0.0), place + shift), (3, 0), textcoords="offset points",
                        va="center", color=INK, fontsize=6)  # fmt: skip
    ax.axvline(5.0, color=ACCENT, lw=0.8)
    ax.set(
        yticks=range(len(EFFECTS)), yticklabels=[name.replace("-", "-\n", 1) for name in EFFECTS],
        xscale="symlog", xlabel="log evidence over no mechanism [nats]", xlim=(0.0, 3e3),
    )  # fmt: skip
    ax.set_xscale("symlog", linthresh=10.0)
    ax.invert_yaxis()
    panel_title(ax, "b", "effects (line: 5 nats)")
