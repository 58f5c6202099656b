"""Draws the posterior: how precisely each parameter is known, and which parameters trade off."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import ArrayLike

from bayeskin.errors import InputError
from bayeskin.inference.identify import Informed, identifiability
from bayeskin.report.style import (
    ACCENT,
    GREY,
    MODEL,
    axis_values,
    list_symbols,
    styled,
)
from bayeskin.report.timeline import LEVELS
from bayeskin.report.triangle import label_edges, triangle
from bayeskin.types import Array, Parameter, ParameterSpace

_BINS = 80
_TINTS = ["#C6DDEC", "#7FB3D5"]  # colours of the 90 % and the 50 % region


@styled
def figure_posterior(
    space: ParameterSpace,
    draws: ArrayLike,
    map_theta: Mapping[str, float],
    names: Sequence[str] | None = None,
) -> Figure:
    """Returns a corner plot: marginals with the priors, 50 % and 90 % regions of each pair, and the MAP.

    draws (s, d) : of the posterior, in SI and in the order of `space`
    map_theta : values of the MAP by name, in SI; it may be empty
    names : parameters to draw, or None for all

    Raises InputError for a name that the space does not have.
    """
    draws = np.asarray(draws, dtype=float)
    chosen = list(space.names if names is None else names)
    for name in chosen:
        if name not in space.names:
            raise InputError(
                "names of the corner plot", f"{name!r} is not known", f"use some of {', '.join(space.names)}"
            )
    parameters = [space.parameters[space.names.index(name)] for name in chosen]
    columns = [axis_values(p, draws[:, space.names.index(p.name)]) for p in parameters]
    best = [axis_values(p, map_theta[p.name]) if p.name in map_theta else np.nan for p in parameters]
    ranges = [_axis_range(p, column) for p, column in zip(parameters, columns, strict=True)]
    caption = (
        f"{len(draws)} posterior draws. Regions hold 50 % and 90 % of them (smoothed histogram); "
        "a pair without structure beyond the scatter of the draws has an even tint. "
        "Above each marginal: median and 90 % interval. Dashed: prior."
    )
    d = len(parameters)
    places = [space.names.index(name) for name in chosen]
    figure, axes = triangle(parameters, 0.34, _finding(parameters, draws[:, places]), caption)
    for i in range(d):
        _draw_marginal(axes[i][i], parameters[i], columns[i], float(best[i]), ranges[i])
        for j in range(i):
            _draw_pair(axes[i][j], (columns[j], columns[i]), (float(best[j]), float(best[i])),
                       (ranges[j], ranges[i]))  # fmt: skip
    label_edges(figure, axes, parameters, parameters)
    _draw_key(axes, bool(map_theta))
    return figure


def mass_levels(density: Array, fractions: Sequence[float]) -> list[float]:
    """Returns levels of a gridded density; cells above a level hold the given fraction of its mass."""
    heights = np.sort(density, axis=None)[::-1]
    mass = np.cumsum(heights) / heights.sum()
    return [float(heights[np.searchsorted(mass, fraction)]) for fraction in fractions]


def smoothed_histogram(
    x: Array, y: Array, x_range: Array, y_range: Array
) -> tuple[Array, Array, Array, bool]:
    """Returns the smoothed density of a pair of parameters from their draws (s,).

    The four results are the cell centres of both axes, (80,) each, the density (80, 80), and whether the
    density is flat apart from the scatter of sampling. The histogram is smoothed by a normal kernel at 0.7
    of Scott's bandwidth. The kernel has the draws' own covariance, so that a narrow ridge stays narrow. The
    histogram is mirrored at the edges, where a prior may cut the density off.
    """
    counts, x_edges, y_edges = np.histogram2d(x, y, bins=_BINS, range=[x_range, y_range])
    scale = _BINS / np.array([np.ptp(x_range), np.ptp(y_range)])
    kernel = 0.5 * len(x) ** (-1 / 3) * np.cov(x, y) * np.outer(scale, scale) + 0.7 * np.eye(2)
    padded = np.pad(counts, _BINS // 2, mode="symmetric")
    fx, fy = np.fft.fftfreq(2 * _BINS)[:, None], np.fft.rfftfreq(2 * _BINS)
    damping = np.exp(
        -2 * np.pi**2 * (kernel[0, 0] * fx**2 + 2 * kernel[0, 1] * fx * fy + kernel[1, 1] * fy**2)
    )
    smooth = np.fft.irfft2(np.fft.rfft2(padded) * damping, padded.shape)
    inside = slice(_BINS // 2, -(_BINS // 2))
    density = np.maximum(smooth[inside, inside], 0.0)
    # This is the relative sd that sampling would cause in a uniform density.
    scatter = np.sqrt(_BINS**2 / (4 * np.pi * np.sqrt(np.linalg.det(kernel)) * len(x)))
    flat = bool(density.std() < 2.5 * scatter * density.mean())
    return 0.5 * (x_edges[1:] + x_edges[:-1]), 0.5 * (y_edges[1:] + y_edges[:-1]), density, flat


def _axis_range(parameter: Parameter, values: Array) -> Array:
    """Returns the ends (2,) of an axis: the prior's range, or the draws' range where it is much narrower."""
    low, high = axis_values(parameter, [parameter.lower, parameter.upper])
    tails = np.quantile(values, [0.001, 0.999])
    if np.ptp(tails) > 0.35 * (high - low):
        return np.array([low, high])
    margin = 0.15 * np.ptp(tails) or 0.02 * (high - low)
    return np.array([max(tails[0] - margin, low), min(tails[1] + margin, high)])


def _draw_marginal(ax: Axes, p: Parameter, values: Array, best: float, span: Array) -> None:
    ax.hist(values, bins=_BINS // 3, range=(span[0], span[1]), density=True, color=MODEL, alpha=0.45)
    ax.plot(*_prior_outline(p), color=GREY, lw=0.9, ls=(0, (4, 2)))
    if np.isfinite(best):
        ax.axvline(best, color=ACCENT, lw=0.9)
    a, middle, b = np.quantile(values, [0.05, 0.5, 0.95])
    digits = max(0, min(6, 1 - int(np.floor(np.log10(max(b - a, 1e-6))))))
    text = rf"${middle:.{digits}f}_{{{a - middle:+.{digits}f}}}^{{{b - middle:+.{digits}f}}}$"
    ax.set_title(text, loc="center", pad=3)
    ax.set_xlim(span[0], span[1])
    ax.margins(y=0.1)
    ax.set_ylim(bottom=0)
    ax.set_yticks([])
    ax.spines["left"].set_visible(False)


def _prior_outline(p: Parameter) -> tuple[Array, Array]:
    """Returns points on the parameter's axis and the prior's density there."""
    low, high = axis_values(p, [p.lower, p.upper])
    if not p.peaked:
        return np.array([low, low, high, high]), np.array([0, 1, 1, 0]) / (high - low)
    space = ParameterSpace((p,))
    theta = space.box.from_unit(np.linspace(0.0, 1.0, 201)[:, None])
    position = axis_values(p, theta[:, 0])
    return position, np.gradient(space.to_unit(theta)[:, 0], position)


def _draw_pair(ax: Axes, values: tuple[Array, Array], best: tuple[float, float],
               spans: tuple[Array, Array]) -> None:  # fmt: skip
    if all(np.ptp(v) > 0 for v in values):
        x, y, density, flat = smoothed_histogram(values[0], values[1], spans[0], spans[1])
        inner, outer = mass_levels(density, LEVELS)
        if flat:
            ax.set_facecolor(_TINTS[0])
        elif 0 < outer < inner < density.max():
            levels = [outer, inner, 1.01 * density.max()]
            ax.contourf(x, y, density.T, levels=levels, colors=_TINTS)
            ax.contour(x, y, density.T, levels=levels[:2], colors=MODEL, linewidths=0.6)
    else:
        ax.plot(values[0], values[1], ".", ms=2, color=MODEL)
    if np.all(np.isfinite(best)):
        ax.plot(*best, "P", ms=4.5, mfc=ACCENT, mec="white", mew=0.5)
    ax.set(xlim=spans[0], ylim=spans[1])


def _draw_key(axes: list[list[Axes]], has_map: bool) -> None:
    handles: list[Line2D | Patch] = [
        Patch(facecolor=_TINTS[1], edgecolor=MODEL, lw=0.6, label="50 % region"),
        Patch(facecolor=_TINTS[0], edgecolor=MODEL, lw=0.6, label="90 % region"),
        Line2D([], [], color=GREY, lw=0.9, ls=(0, (4, 2)), label="prior"),
    ]
    if len(axes) == 1:
        handles = handles[2:]
    if has_map:
        handles.append(Line2D([], [], color=ACCENT, marker="P", ms=4.5, lw=0, label="MAP"))
    # The space above the diagonal is free, so the legend stands to the right of the first marginal.
    axes[0][0].legend(handles=handles, loc="upper left", bbox_to_anchor=(1.05, 1.0))


def _finding(parameters: Sequence[Parameter], draws: Array) -> str:
    """Returns which parameters the recording informs, as a sentence, from draws (s, d) in their order."""
    kinds: dict[Informed, list[str]] = {kind: [] for kind in Informed}
    for result in identifiability(ParameterSpace(tuple(parameters)), draws).parameters:
        kinds[result.informed].append(result.name)
    well, weakly, uninformed = (kinds[kind] for kind in (Informed.WELL, Informed.WEAKLY, Informed.NOT))
    parts = [f"informs {list_symbols(well)}"] if well else []
    parts += [f"informs {list_symbols(weakly)} weakly"] if weakly else []
    pronoun = "it" if len(uninformed) == 1 else "them"
    parts += [f"leaves {list_symbols(uninformed)} as the prior states {pronoun}"] if uninformed else []
    return f"The recording {'; it '.join(parts)}"
