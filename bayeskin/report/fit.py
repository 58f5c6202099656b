"""Draws the fit: the recorded bins, their prediction by the posterior, and the residual."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from bayeskin.number_format import number
from bayeskin.report.style import (
    GREY,
    INK,
    MODEL,
    PAGE_IN,
    PARTS,
    RECORDED,
    new_figure,
    panel_title,
    plain_log,
    state_finding,
    styled,
)
from bayeskin.report.timeline import (
    PHASE_COLORS,
    ForceBands,
    draw_bands,
    mark_windows,
    phase_legend,
    predictive_bands,
    shade_phases,
)
from bayeskin.types import Array, BinnedForce

Mask = NDArray[np.bool_]


@styled
def figure_fit(
    binned: BinnedForce,
    displacement_m: ArrayLike,
    fitted: ArrayLike,
    *,
    mean_n: ArrayLike,
    surrogate_sd_n: ArrayLike,
    noise_sd_n: ArrayLike,
    force_n: ArrayLike,
) -> Figure:
    """Returns a figure of the recorded bins with their predictive bands, the residual, and its uncertainty.

    displacement_m (m,) : LVDT displacement of each bin
    fitted (m,) : bool, bins in the likelihood
    mean_n, surrogate_sd_n, noise_sd_n, force_n (s, m) : posterior predictive draws [N], which
        `predictive_bands` describes
    """
    displacement_mm = 1e3 * np.asarray(displacement_m, dtype=float)
    chosen = np.asarray(fitted, dtype=bool)
    bands = predictive_bands(mean_n, surrogate_sd_n, noise_sd_n, force_n)
    figure = new_figure(PAGE_IN, 5.0)
    grid = figure.add_gridspec(3, 2, width_ratios=(2.1, 1), height_ratios=(1.7, 1.2, 0.9))
    force = figure.add_subplot(grid[0, 0])
    residual = figure.add_subplot(grid[1, 0], sharex=force)
    parts = figure.add_subplot(grid[2, 0], sharex=force)
    loop = figure.add_subplot(grid[0, 1])
    residual_loop = figure.add_subplot(grid[1:, 1], sharex=loop)
    _draw_force(force, binned, bands, chosen)
    _draw_residual(residual, binned, bands, chosen)
    _draw_parts(parts, binned, bands)
    _draw_loop(loop, binned, bands, displacement_mm)
    _draw_residual_loop(residual_loop, binned, bands.median_n, displacement_mm)
    for ax in (force, residual, loop):
        ax.tick_params(labelbottom=False)
    titles = ("", "residual with the predictive bands", "90 % half-width", "force", "residual by phase")
    for ax, letter, title in zip((force, residual, parts, loop, residual_loop), "abcde", titles, strict=True):
        panel_title(ax, letter, title)
    caption = (
        f"Bands are pointwise and include the uncertainty of the parameters, the errors of model and "
        "surrogate, and noise; "
        f"{np.atleast_2d(np.asarray(force_n)).shape[0]} posterior draws. "
        "Residual: recorded minus posterior median. Open points, if any, were not fitted."
    )
    state_finding(figure, _finding(binned, bands, chosen), caption)
    return figure


def _draw_residual(ax: Axes, binned: BinnedForce, bands: ForceBands, chosen: Mask) -> None:
    """Draws recorded minus predicted median [mN] over time, with the predictive bands."""
    shade_phases(ax, binned.phases)
    draw_bands(ax, binned.time_s, 1e3 * (bands.low_n - bands.median_n), 1e3 * (bands.high_n - bands.median_n))
    ax.axhline(0, color=GREY, lw=0.6)
    _draw_bins(ax, binned.time_s, 1e3 * (binned.force_n - bands.median_n), chosen)
    ax.set_ylabel("residual [mN]")


def _draw_parts(ax: Axes, binned: BinnedForce, bands: ForceBands) -> None:
    """Draws the half-width [mN] of each part's 90 % interval over time, on a logarithmic axis."""
    shade_phases(ax, binned.phases)
    for name, width_n in bands.parts_n.items():
        positive = np.where(width_n > 0, 1e3 * width_n, np.nan)
        ax.plot(binned.time_s, positive, color=PARTS[name], lw=0.8 if name == "all" else 1.2, label=name)
    widths = np.concatenate([w[w > 0] for w in bands.parts_n.values()])
    if len(widths):
        # A part that vanishes somewhere (a force known to be zero) must not flatten the others.
        top = 1e3 * widths.max()
        ax.set_yscale("log")
        ax.set_ylim(max(1e3 * np.quantile(widths, 0.02) / 1.5, 1e-4 * top), 2 * top)
        plain_log(ax.yaxis)
    ax.legend(loc="lower right", bbox_to_anchor=(1, 0.97), ncols=4, columnspacing=0.9, handlelength=1.1)
    ax.set(xlabel="time [s]", ylabel="half-width [mN]")


def _draw_residual_loop(ax: Axes, binned: BinnedForce, predicted_n: Array, displacement_mm: Array) -> None:
    """Draws the residual [mN] over displacement, with each bin in the colour of its phase."""
    kinds = np.array([p.kind for p in binned.phases])[binned.phase]
    residual_mn = 1e3 * (binned.force_n - predicted_n)
    ax.axhline(0, color=GREY, lw=0.6)
    for kind, color in PHASE_COLORS.items():
        inside = kinds == kind
        if np.any(inside):
            ax.plot(displacement_mm[inside], residual_mn[inside], ".", ms=3, color=color, label=kind)
    ax.legend(loc="best", handletextpad=0.1, markerscale=2)
    ax.set(xlabel="displacement [mm]", ylabel="residual [mN]")


def _draw_force(ax: Axes, binned: BinnedForce, bands: ForceBands, chosen: Mask) -> None:
    shade_phases(ax, binned.phases, cycles=True)
    phase_legend(ax, binned.phases)
    draw_bands(ax, binned.time_s, bands.low_n, bands.high_n)
    ax.plot(binned.time_s, bands.median_n, color=MODEL, lw=1.0, label="posterior median")
    _draw_bins(ax, binned.time_s, binned.force_n, chosen)
    top, low = np.nanmax([bands.high_n[1], binned.force_n]), np.nanmin([bands.low_n[1], binned.force_n])
    reach = (top - low) or 1.0
    ax.set_ylim(low - 0.1 * reach, top + 0.16 * reach)
    mark_windows(ax, binned.edges_s, chosen, "fitted")
    ax.set_ylabel("force [N]")


def _draw_loop(ax: Axes, binned: BinnedForce, bands: ForceBands, displacement_mm: Array) -> None:
    ax.plot(displacement_mm, binned.force_n, ".", ms=2.4, color=RECORDED, label="recorded")
    ax.plot(displacement_mm, bands.median_n, color=MODEL, lw=0.9, label="posterior median")
    ax.legend(loc="upper left")
    ax.set_ylabel("force [N]")


def _draw_bins(ax: Axes, time_s: Array, values: Array, chosen: Mask) -> None:
    ax.plot(time_s[chosen], values[chosen], ".", ms=2.2, color=RECORDED, label="recorded", zorder=4)
    if not chosen.all():
        ax.plot(
            time_s[~chosen], values[~chosen], "o", ms=2.0, mfc="white", mec=INK, mew=0.4, zorder=4,
            label="recorded, not fitted",
        )  # fmt: skip


def _finding(binned: BinnedForce, bands: ForceBands, chosen: Mask) -> str:
    residual = binned.force_n - bands.median_n
    inside = (binned.force_n >= bands.low_n[1]) & (binned.force_n <= bands.high_n[1])

    def part(mask: Mask) -> str:
        return f"{number(1e3 * np.sqrt(np.nanmean(residual[mask] ** 2)), 3)} mN RMS"

    if not chosen.any():
        held = f"{100 * inside.mean():.0f} % of bins in the 90 % band"
        return f"Predicted without fitting: residual {part(~chosen)}, {held}"
    elsewhere = "" if chosen.all() else f", {part(~chosen)} elsewhere"
    return (
        f"The residual is {part(chosen)} in the fitted bins{elsewhere}; "
        f"the 90 % band holds {100 * inside[chosen].mean():.0f} % of the fitted bins"
    )
