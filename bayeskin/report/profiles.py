"""Draws profile likelihoods beside the posterior.

The profiles show which values the fit alone excludes. The difference from the posterior shows what the prior
adds.
"""

from __future__ import annotations

from collections.abc import Sequence
from string import ascii_lowercase

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from bayeskin.inference.profile import DROP, Profile
from bayeskin.report.style import (
    GREY,
    MODEL,
    PAGE_IN,
    RECORDED,
    axis_values,
    list_symbols,
    new_figure,
    panel_title,
    parameter_label,
    state_finding,
    styled,
)
from bayeskin.types import Array, Parameter, ParameterSpace

_DEEPEST = 8.0  # nats below the best fit that the axes show
ACROSS = 6  # largest number of panels side by side


@styled
def figure_profiles(space: ParameterSpace, draws: ArrayLike, profiles: Sequence[Profile]) -> Figure:
    """Returns a figure of each parameter's profile likelihood over the range of its prior.

    Behind each profile lies the 90 % interval of the posterior. draws (n, D) : of the posterior, in SI
    """
    draws = np.atleast_2d(np.asarray(draws, dtype=float))
    rows = -(-len(profiles) // ACROSS)
    figure = new_figure(PAGE_IN, 2.5 * rows)
    across = -(-len(profiles) // rows)
    axes = np.ravel(figure.subplots(rows, across, sharey=True, squeeze=False))
    for ax in axes[len(profiles) :]:
        ax.remove()
    for letter, ax, profile in zip(ascii_lowercase, axes, profiles, strict=False):
        column = space.names.index(profile.name)
        _draw(ax, space.parameters[column], profile, draws[:, column])
        panel_title(ax, letter)
    for ax in axes[: len(profiles) : across]:
        ax.set(ylim=(-_DEEPEST, 0.6), ylabel="relative to the best fit [nats]")
    flat = [profile.name for profile in profiles if profile.flat]
    finding = (
        f"The fit excludes no value of {list_symbols(flat)}" if flat else "The fit bounds every parameter"
    )
    caption = (
        "Black: best fit with the parameter held fixed and all others and the noise free. Dashed: 1.35 nats "
        "below the maximum, where the 90 % interval ends. Blue: 5 to 95 % of the posterior. Axes: range of "
        "the prior."
    )
    state_finding(figure, finding, caption)
    return figure


def _draw(ax: Axes, parameter: Parameter, profile: Profile, draws: Array) -> None:
    low, high = axis_values(parameter, np.quantile(draws, [0.05, 0.95]))
    ax.axvspan(low, high, color=MODEL, alpha=0.15, lw=0)
    ax.plot(axis_values(parameter, profile.values), profile.drop_nats, ".-", color=RECORDED, ms=3, lw=0.9)
    ax.axhline(-DROP, color=GREY, lw=0.8, ls=(0, (4, 2)))
    ax.set_xlim(*axis_values(parameter, [parameter.lower, parameter.upper]))
    ax.set_xlabel(parameter_label(parameter))
