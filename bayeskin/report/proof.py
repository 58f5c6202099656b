"""Draws the results of the proof, in which recordings with concealed effects are diagnosed.

The figures show which answer each concealed effect received, and how large an effect must be to be named.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from bayeskin.report.style import (
    ACCENT,
    GREY,
    INK,
    MODEL,
    PAGE_IN,
    new_figure,
    panel_title,
    plain_log,
    state_finding,
    styled,
)

_LAST = ("both", "several names", "group too large", "unknown")
_SHADES = LinearSegmentedColormap.from_list("shades", ["white", MODEL])
_OPEN_END = 1.6  # ratio of the ends of a class of sizes where one end is 0 or infinite


@styled
def figure_proof(board: Mapping[str, Any]) -> Figure:
    """Returns a figure of a scoreboard: confusion matrix, detectability by size, shares with intervals."""
    rows = list(board["confusion"])
    figure = new_figure(PAGE_IN, 2.6 + 0.17 * max(len(rows), 12))
    grid = figure.add_gridspec(2, 2, width_ratios=(1.45, 1))
    _draw_confusion(figure.add_subplot(grid[:, 0]), board["confusion"])
    _draw_detectability(figure.add_subplot(grid[0, 1]), board["detectability"])
    _draw_shares(figure.add_subplot(grid[1, 1]), board)
    state_finding(
        figure,
        _finding(board),
        "a: number of recordings; pairs, and effects outside the catalogue, have one row each. b, c: 90 % "
        "Wilson intervals. Size: the part of the effect that remains after the base model is fitted again, "
        "divided by the noise floor of 0.5 s means. c: effects with a size of at least 3.",
    )
    return figure


@styled
def figure_detectability(mechanisms: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Returns a figure with a panel for each mechanism of a scoreboard.

    A panel shows every answer by the size of the effect, and the share that is named, with its 90 % band.
    """
    columns = min(len(mechanisms), 3)
    rows = -(-len(mechanisms) // columns)
    figure = new_figure(PAGE_IN, 1.3 + 1.7 * rows)
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for ax in grid.flat[len(mechanisms) :]:
        ax.remove()
    ends: list[float] = []
    for ax, (name, answers) in zip(grid.flat, mechanisms.items(), strict=False):
        _draw_curve(ax, answers)
        sizes = [*answers["curve"]["at"], *answers["sizes"]]
        ends += [0.9 * min(sizes), 1.1 * max(sizes)]
        ax.set_title(f"{name}\nhalf: {half_in_words(answers)}", linespacing=1.3)
    grid[0, 0].set_xlim(min(ends), max(ends))
    for ax in grid[-1]:
        ax.set_xlabel("size [noise floors]")
    for ax in grid[:, 0]:
        ax.set_ylabel("share named correctly")
    right = [is_right for answers in mechanisms.values() for is_right in answers["right"]]
    state_finding(
        figure,
        f"Size from which an effect is named: {sum(right)} of {len(right)} are named correctly",
        "Each mark is one recording: dots are named correctly, squares are named as a look-alike, crosses "
        "are neither. Curve: logistic function of the logarithm of the size, mean and 90 % band of its "
        "posterior, dashed where there are no recordings. Half: the size at which half are named, with its "
        "90 % interval, or a 95 % bound within the sizes of the recordings. Size: part of the effect that "
        "remains after the base model is fitted again, divided by the noise floor of 0.5 s means; dotted: 3.",
    )
    return figure


def _draw_curve(ax: Axes, answers: Mapping[str, Any]) -> None:
    """Draws all answers about one mechanism by size, and the curve of the share that is named."""
    at, curve = np.array(answers["curve"]["at"]), answers["curve"]
    ax.fill_between(at, curve["low"], curve["high"], color=MODEL, alpha=0.18)
    sizes, right = np.array(answers["sizes"]), np.array(answers["right"], bool)
    tested = (at >= sizes.min()) & (at <= sizes.max())
    ax.plot(at, curve["mean"], color=MODEL, lw=0.7, ls="--")
    ax.plot(at[tested], np.array(curve["mean"])[tested], color=MODEL)
    look_alike = np.array(answers["up_to"], bool) & ~right
    for chosen, height, marker, color in (
        (right, 1.0, "o", INK),
        (look_alike, 0.0, "s", GREY),
        (~right & ~look_alike, 0.0, "x", ACCENT),
    ):
        ax.plot(sizes[chosen], np.full(chosen.sum(), height), marker, ls="none", color=color)
    ax.axvline(3.0, color=ACCENT, lw=0.6, ls=":")
    ax.set_xscale("log")
    ax.set_ylim(-0.05, 1.05)
    plain_log(ax.xaxis)


def half_in_words(answers: Mapping[str, Any]) -> str:
    """Returns, as text, the size at which half of the recordings are named, with its 90 % interval.

    Where a value lies outside the sizes of the recordings, the text states a bound instead.
    """
    half, least, largest = answers["curve"]["half"], min(answers["sizes"]), max(answers["sizes"])
    if half["median"] > largest:
        return f"above {min(max(half['low'], least), largest):.1f}"
    if half["median"] < least:
        return f"below {max(min(half['high'], largest), least):.1f}"
    low = f"below {least:.1f}" if half["low"] < least else f"{half['low']:.1f}"
    high = f"above {largest:.1f}" if half["high"] > largest else f"{half['high']:.1f}"
    return f"{half['median']:.1f} ({low} to {high})"


def _finding(board: Mapping[str, Any]) -> str:
    named, alarms = board["named_up_to_look_alikes"]["clear"], board["false_alarms"]
    return (
        f"Of {named['of']} clear effects, {named['hits']} are named correctly or as a look-alike; "
        f"{alarms['hits']} false alarms in {alarms['of']} recordings without an effect"
    )


def _draw_confusion(ax: Axes, confusion: Mapping[str, Mapping[str, int]]) -> None:
    """Draws how often each answer (column) was given for each concealed effect (row)."""
    rows = list(confusion)
    given_answers = {answer for row in confusion.values() for answer in row}
    known = ["nothing-missing", *(row for row in rows if row not in ("nothing", "pair", "outside"))]
    further = sorted(given_answers - set(known) - set(_LAST))
    columns = [name for name in (*known, *further, *_LAST) if name in given_answers]
    counts = np.array([[confusion[row].get(column, 0) for column in columns] for row in rows], dtype=float)
    counts = counts.reshape(len(rows), len(columns))
    total = np.maximum(counts.sum(axis=1, keepdims=True), 1.0)
    ax.imshow(counts / total, cmap=_SHADES, vmin=0.0, vmax=1.0, aspect="auto")
    for i, j in zip(*np.nonzero(counts), strict=True):
        dark = counts[i, j] / total[i, 0] > 0.5
        ax.text(j, i, f"{counts[i, j]:.0f}", ha="center", va="center", color="white" if dark else INK)
    ax.set_xticks(range(len(columns)), columns, rotation=90)
    ax.set_yticks(range(len(rows)), rows)
    ax.set_xticks(np.arange(len(columns) + 1) - 0.5, minor=True)
    ax.set_yticks(np.arange(len(rows) + 1) - 0.5, minor=True)
    ax.grid(which="minor", color=GREY, lw=0.2)
    ax.tick_params(which="both", length=0)
    ax.set(xlabel="answer", ylabel="concealed effect")
    panel_title(ax, "a")


def _draw_detectability(ax: Axes, classes: Sequence[Mapping[str, Any]]) -> None:
    """Draws a step for each class of sizes: the share that is named, with its interval."""
    lowest = classes[0]["to"] / _OPEN_END
    for size_class in classes:
        low, high = size_class["from"] or lowest, size_class["to"] or size_class["from"] * _OPEN_END
        middle = np.sqrt(low * high)
        for name, color, label, shift, width in (
            ("named", INK, "correctly", 0.97, 3.0),
            ("up_to_look_alikes", MODEL, "or look-alike", 1.03, 1.0),
        ):
            share = size_class[name]
            if not share["of"]:
                continue
            ax.hlines(share["share"], low, high, color=color, lw=width, label=label)
            ax.vlines(middle * shift, share["low"], share["high"], color=color, lw=0.7)
    handles, labels = ax.get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    if unique:
        ax.legend(unique.values(), unique.keys(), loc="upper right", bbox_to_anchor=(1.0, 1.24), ncols=2)
    ax.axvline(3.0, color=ACCENT, lw=0.6, ls=":")
    ax.set_xscale("log")
    ax.set(ylim=(-0.03, 1.03), xlabel="size [noise floors]", ylabel="share named")
    plain_log(ax.xaxis)
    panel_title(ax, "b")


def _draw_shares(ax: Axes, board: Mapping[str, Any]) -> None:
    """Draws shares of a scoreboard with their intervals, and the range that each share should reach."""
    lines = (
        ("correctly named", board["named"]["clear"], (0.9, 1.0)),
        ("or a look-alike", board["named_up_to_look_alikes"]["clear"], (0.95, 1.0)),
        ("outside: unknown", board["unknown_outside"]["clear"], (0.8, 1.0)),
        ("effect in 90 %", board["effect_in_interval"]["clear"], (0.8, 0.97)),
        ("base in 90 %", board["base_in_interval"]["clear"], (0.8, 0.97)),
        ("false alarms", board["false_alarms"], (0.0, 0.05)),
    )
    for position, (_, share, target) in enumerate(reversed(lines)):
        ax.hlines(position, *target, color=ACCENT, lw=5.0, alpha=0.35)
        if share["of"]:
            ax.hlines(position, share["low"], share["high"], color=MODEL, lw=1.0)
            ax.plot(share["share"], position, "o", color=MODEL)
    ax.set_yticks(range(len(lines)), [f"{text}, {share['of']}" for text, share, _ in reversed(lines)])
    ax.set(xlim=(-0.03, 1.03), ylim=(-0.6, len(lines) - 0.4), xlabel="share, of how many; orange: target")
    panel_title(ax, "c")
