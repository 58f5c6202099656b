"""Gives all figures the same style: colours, font sizes, titles that state the result, symbols of parameters.

Figures are made with matplotlib's object interface. This module does not use pyplot, and its settings
apply only while a figure is drawn or saved.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Sequence
from typing import Any, ParamSpec, TypeVar

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import LogLocator, NullFormatter
from numpy.typing import ArrayLike

from bayeskin.geometry import LENGTHS
from bayeskin.number_format import at_edge, unit_text
from bayeskin.types import Array, Parameter

P = ParamSpec("P")
R = TypeVar("R")

COLUMN_IN, PAGE_IN = 3.5, 7.2  # widths of one and of two journal columns [inch]

# Readers with any common colour blindness can distinguish the colours of Okabe & Ito (2008). Where these do
# not suffice, colours of Tol's muted set follow.
INK, GREY, FAINT = "#222222", "#767676", "#D0D0D0"
RECORDED, MODEL, ACCENT = INK, "#0072B2", "#D55E00"
PARTS = {"model": "#0072B2", "surrogate": "#D55E00", "noise": "#8C8C8C", "all": INK}
_NAMED = {"E_c": "#0072B2", "E_s": "#D55E00", "k_c": "#56B4E9", "k_s": "#E69F00", "p_init": "#009E73"}
_FURTHER = ("#CC79A7", "#332288", "#882255", "#999933", "#44AA99", "#AA4499", "#661100", "#888888")
GREEK = {
    "alpha": "α", "beta": "β", "gamma": "γ", "delta": "δ", "eta": "η", "lambda": "λ", "mu": "μ", "nu": "ν",
    "rho": "ρ", "sigma": "σ", "tau": "τ", "phi": "φ",
}  # fmt: skip

STYLE: dict[str, Any] = {
    "figure.facecolor": "white", "savefig.facecolor": "white", "figure.dpi": 100,
    "font.family": "DejaVu Sans",  # comes with matplotlib, so that all machines draw the same letters
    "font.size": 7.5, "axes.titlesize": 7.5, "axes.labelsize": 7.5, "figure.titlesize": 9,
    "xtick.labelsize": 7, "ytick.labelsize": 7, "legend.fontsize": 7, "figure.titleweight": "bold",
    "text.usetex": False, "text.color": INK, "axes.labelcolor": INK, "axes.edgecolor": GREY,
    "xtick.color": GREY, "ytick.color": GREY, "xtick.labelcolor": INK, "ytick.labelcolor": INK,
    "axes.spines.top": False, "axes.spines.right": False, "axes.linewidth": 0.6,
    "xtick.major.width": 0.6, "ytick.major.width": 0.6, "xtick.minor.width": 0.4, "ytick.minor.width": 0.4,
    "xtick.major.size": 3, "ytick.major.size": 3, "xtick.minor.size": 1.5, "ytick.minor.size": 1.5,
    "axes.titlelocation": "left", "axes.titlepad": 5, "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "lines.linewidth": 1.1, "lines.markersize": 3, "patch.linewidth": 0,
    "legend.frameon": False, "legend.handlelength": 1.4, "legend.borderaxespad": 0.2,
    "legend.labelspacing": 0.3,
    "svg.hashsalt": "bayeskin", "svg.fonttype": "path", "path.simplify": True,
}  # fmt: skip
# All other settings take matplotlib's default, so that a user's matplotlibrc changes nothing. The backend is
# left out, because the caller chooses it.
SETTINGS: dict[Any, Any] = {
    key: value for key, value in (dict(mpl.rcParamsDefault) | STYLE).items() if "backend" not in key
}


def styled(draw: Callable[P, R]) -> Callable[P, R]:
    """Returns a drawing function that always runs with the settings of this module."""

    @functools.wraps(draw)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        with mpl.rc_context(SETTINGS):
            return draw(*args, **kwargs)

    return wrapper


def new_figure(width_in: float, height_in: float) -> Figure:
    """Returns an empty figure of a given size [inch] that lays out its own axes."""
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    engine = figure.get_layout_engine()
    assert engine is not None
    engine.set(w_pad=0.04, h_pad=0.04, wspace=0.03, hspace=0.03)  # type: ignore[call-arg]
    return figure


def state_finding(figure: Figure, finding: str, caption: str = "") -> tuple[Text, Text]:
    """Writes the result above a figure and a caption below it, and returns both texts.

    Both are wrapped to the width of the figure.
    """
    width = figure.get_figwidth()
    bold = re.sub(r"(?<!\\)\$(.+?)(?<!\\)\$", r"$\\boldsymbol{\1}$", finding)
    head = figure.suptitle("\n".join(_wrap(bold, int(13 * width))), x=0.01, ha="left", linespacing=1.25)
    foot = figure.supxlabel(
        "\n".join(_wrap(caption, int(19.5 * width))),
        x=0.01,
        ha="left",
        fontsize=6.5,
        color=GREY,
        linespacing=1.3,
    )
    return head, foot


def literal(text: str) -> str:
    """Returns text, such as a file name, with its dollar signs escaped, so that it contains no markup."""
    return text.replace("$", r"\$")


def _wrap(text: str, columns: int) -> list[str]:
    """Returns lines of at most `columns` printed characters; the markup of symbols does not count."""
    lines: list[list[str]] = [[]]
    room = columns
    for word in text.split():
        printed = len(re.sub(r"\\[a-z]+|[$_{}]", "", word)) + 1
        if printed > room and lines[-1]:
            lines.append([])
            room = columns
        lines[-1].append(word)
        room -= printed
    return [" ".join(line) for line in lines]


def panel_title(ax: Axes, letter: str, text: str = "") -> Text:
    """Writes a bold panel letter and a short title at the upper left of a panel, and returns the text."""
    return ax.set_title(rf"$\mathbf{{{letter}}}$  {text}".rstrip())


def legend_above(ax: Axes) -> None:
    """Puts the legend above the axes at the right, where it hides nothing."""
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=4, borderaxespad=0.2)


def plain_log(axis: Axis) -> None:
    """Labels a logarithmic axis with plain numbers: powers of ten, and on short axes 2 and 5 times these."""
    low, high = axis.get_view_interval()
    narrow = low > 0 and high / low < 60
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if narrow else (1.0,)))
    axis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.set_minor_formatter(NullFormatter())


def symbol(name: str) -> str:
    """Returns the printed form of a parameter's name: ``E_c`` becomes a symbol, ``gap_width`` two words."""
    name = name.removesuffix("_m") if name in LENGTHS else name
    name = re.sub(rf"^([A-Z](?=[a-z\d]$)|[a-z](?=\d$)|(?:{'|'.join(GREEK)})(?=\d$))", r"\1_", name)
    head, _, tail = name.partition("_")
    head = "sigma" if head == "sd" and tail else head
    if re.fullmatch(r"[A-Za-z]", head) or head in GREEK:
        base = rf"\{head}" if head in GREEK else head
        if not re.fullmatch(r"\w*", tail):
            return name.replace("_", " ")
        sub = tail.replace("_", ",") if len(tail) <= 1 else rf"\mathrm{{{tail.replace('_', ',')}}}"
        return rf"${base}_{{{sub}}}$" if tail else rf"${base}$"
    return name.replace("_", " ")


def parameter_label(parameter: Parameter) -> str:
    """Returns the axis label of a parameter.

    Where the prior is in logarithms, the axis shows log10 of the value in SI.
    """
    name = symbol(parameter.name)
    space = " " if name.startswith("$") else "\n"  # a name in words takes several lines
    if len(name) > 12:
        name = name.replace(" ", space, 1)
    if parameter.in_log:
        unit = unit_text(parameter.unit)
        return f"log$_{{10}}$ {name}" + (f"{space}/ {unit}" if unit else "")
    unit = _axis(parameter)[1]
    return name + (f"{space}[{unit}]" if unit else "")


def parameter_colors(names: Sequence[str]) -> list[str]:
    """Returns a colour for each parameter; the article's parameters have the same colour in every figure."""
    spare = [name for name in names if name not in _NAMED]
    further = {name: _FURTHER[i % len(_FURTHER)] for i, name in enumerate(spare)}
    return [_NAMED.get(name) or further[name] for name in names]


def axis_values(parameter: Parameter, values: ArrayLike) -> Array:
    """Returns values, given in SI, of a parameter on the axis that `parameter_label` labels; same shape."""
    values = np.asarray(values, dtype=float)
    return np.log10(values) if parameter.in_log else values * _axis(parameter)[0]


def _axis(parameter: Parameter) -> tuple[float, str]:
    """Returns the factor and the unit of an axis that is not logarithmic.

    Where numbers would be long, the factor contains a power of ten, which the unit then states.
    """
    factor, unit = at_edge(parameter.unit)
    reach = factor * max(abs(parameter.lower), abs(parameter.upper))
    power = 3 * int(np.floor(np.log10(reach) / 3)) if reach > 0 and not 0.01 <= reach < 1e4 else 0
    parts = unit_text(f"10^{power}") if power else "", unit_text(unit)
    return factor / 10.0**power, " ".join(part for part in parts if part)


def list_symbols(names: Sequence[str]) -> str:
    """Returns the symbols of parameters as a list in words: ``E_c, E_s and k_c``."""
    printed = [symbol(name) for name in names]
    return printed[0] if len(printed) == 1 else ", ".join(printed[:-1]) + " and " + printed[-1]
