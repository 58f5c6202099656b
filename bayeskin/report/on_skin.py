"""Draws where on the skin the markers move otherwise than a fitted model says."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from bayeskin.geometry import Geometry
from bayeskin.number_format import number
from bayeskin.report.style import (
    ACCENT,
    FAINT,
    GREY,
    INK,
    PAGE_IN,
    new_figure,
    panel_title,
    state_finding,
    styled,
)
from bayeskin.types import Array

ARROW_SHARE = 0.08  # length of the longest arrow, as a share of the width of the points


class _OnSkin(Protocol):
    """Lists what the figure needs of a `bayeskin.mismatch.on_skin.OnSkin`."""

    @property
    def place_m(self) -> Array: ...
    @property
    def vector_m(self) -> Array: ...
    @property
    def allowed_m(self) -> Array: ...
    @property
    def significant(self) -> NDArray[np.bool_]: ...
    @property
    def strain(self) -> Array: ...
    @property
    def rms_m(self) -> float: ...


@styled
def figure_on_skin(located: _OnSkin, lengths: Geometry, outlines_m: Sequence[Array] = ()) -> Figure:
    """Returns the figure: residual vectors on the skin, and the strains that the model lacks.

    lengths : the device, whose pads and guards are drawn; outlines_m : further outlines (k, 2) [m]
    """
    figure = new_figure(PAGE_IN, 2.9)
    panels = figure.subplots(1, 3, sharex=True, sharey=True)
    _draw_vectors(panels[0], located)
    _draw_strain(figure, panels[1], located, 0)
    _draw_strain(figure, panels[2], located, 1)
    titles = ("recorded minus fitted", "strain along the pull", "strain across it")
    for ax, letter, title in zip(panels, "abc", titles, strict=True):
        _draw_device(ax, lengths, located.place_m)
        for outline_m in outlines_m:
            ax.plot(*(1e3 * outline_m.T), color=INK, lw=1.2)
        panel_title(ax, letter, title)
        ax.set(aspect="equal", xlabel="along the pull [mm]")
    panels[0].set_ylabel("across the pull [mm]")
    count = int(located.significant.sum())
    state_finding(
        figure,
        f"At {count} of {len(located.place_m)} points the skin moves otherwise than the model allows "
        f"({number(1e3 * located.rms_m)} mm RMS at the largest opening)",
        "a: residuals in proportion to the opening, without the camera's motion; orange: larger than noise "
        "and the allowed error of the model explain (5 % for any point). b, c: the strain of these "
        "residuals. Grey outlines: pads and guards.",
    )
    return figure


def _draw_vectors(ax: Axes, located: _OnSkin) -> None:
    """Draws the residual vectors, enlarged, with a scale."""
    place_mm, vector_mm = 1e3 * located.place_m, 1e3 * located.vector_m
    longest_mm = float(np.quantile(np.linalg.norm(vector_mm, axis=1), 0.98)) or 1.0
    enlarged = ARROW_SHARE * float(np.ptp(place_mm[:, 0])) / longest_mm
    colours = np.where(located.significant, ACCENT, GREY)
    arrows = ax.quiver(
        *place_mm.T, *(enlarged * vector_mm).T, color=colours, angles="xy", scale_units="xy", scale=1.0,
        width=0.004,
    )  # fmt: skip
    scale_mm = float(f"{longest_mm:.1g}")
    ax.quiverkey(arrows, 0.92, 1.04, enlarged * scale_mm, f"{scale_mm:g} mm", labelpos="W", color=INK)


def _draw_strain(figure: Figure, ax: Axes, located: _OnSkin, component: int) -> None:
    """Draws a strain at each point: along the pull (0) or across it (1)."""
    strain = 100.0 * located.strain[:, component]
    if not np.isfinite(strain).any():
        ax.text(0.5, 0.5, "too few points", transform=ax.transAxes, ha="center", color=GREY)
        return
    limit = max(float(np.quantile(np.abs(strain), 0.98)), 1e-3)
    size = 4500.0 / max(len(strain), 25)
    x_mm, y_mm = 1e3 * located.place_m.T
    dots = ax.scatter(
        x_mm, y_mm, size, strain, marker="s", lw=0, cmap="RdBu_r", vmin=-limit, vmax=limit
    )  # fmt: skip
    figure.colorbar(dots, ax=ax, label="strain [%]", location="bottom", shrink=0.8, pad=0.02)


def _draw_device(ax: Axes, lengths: Geometry, place_m: Array) -> None:
    """Draws the outlines of both pads and guards, and limits the axes to the points and the pads."""
    half_mm, wide_mm = 1e3 * lengths.half_gauge_m, 1e3 * lengths.across_m[0]
    boxes = [(half_mm, 1e3 * lengths.pad_length_m, wide_mm)]
    if lengths.guard is not None:
        boxes.append((half_mm, 1e3 * (lengths.along_m[3] - lengths.half_gauge_m), 1e3 * lengths.across_m[2]))
    for inner_mm, length_mm, half_width_mm in boxes:
        for start_mm in (inner_mm, -inner_mm - length_mm):
            corner = (start_mm, -half_width_mm)
            ax.add_patch(Rectangle(corner, length_mm, 2 * half_width_mm, fill=False, ec=FAINT, lw=0.8))
    reach_mm = 1e3 * np.abs(place_m).max(axis=0)
    along_mm, across_mm = np.maximum(reach_mm, [half_mm + 4.0, wide_mm]) + 2.0
    ax.set(xlim=(-along_mm, along_mm), ylim=(-across_mm, across_mm))
