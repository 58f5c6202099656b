"""Fields on the deformed surface of the quarter model, at chosen times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from numpy.typing import ArrayLike

from bayeskin.errors import InputError
from bayeskin.report.style import GREY, PAGE_IN, new_figure, state_finding, styled
from bayeskin.types import Array

# Grey stands for nothing: a white surface would vanish on the page.
_SEQUENTIAL = LinearSegmentedColormap.from_list("grey-blue", ["#E6E6E6", "#86B8D9", "#0072B2", "#08284F"])
_DIVERGING = LinearSegmentedColormap.from_list(
    "blue-grey-red", ["#08284F", "#0072B2", "#86B8D9", "#E6E6E6", "#EDA377", "#D55E00", "#5C2000"]
)


@dataclass(frozen=True)
class SurfaceField:
    """One row of the figure: values_by_node (t, p) in `unit`; `signed` fields get a diverging scale."""

    label: str
    unit: str
    values_by_node: Array
    signed: bool = False


@styled
def figure_fields(
    times_s: Sequence[float],
    points_m: ArrayLike,
    faces: ArrayLike,
    rows: Sequence[SurfaceField],
    finding: str,
) -> Figure:
    """Small multiples: one row a field, one column a time, one colour bar a row.

    points_m (t, p, 3) deformed positions of the surface's nodes; faces (f, 3) or (f, 4) node numbers;
    only nodes of `faces` are framed, so that the faces near the pad alone give a closer view;
    `finding` heads the figure. Each face is painted in the mean of its nodes' values.
    Raises InputError if the shapes do not fit each other.
    """
    points, nodes = np.asarray(points_m, dtype=float), np.asarray(faces, dtype=int)
    _check(times_s, points, nodes, rows)
    columns = len(times_s)
    shown = 1e3 * points[:, np.unique(nodes)]
    width = min(PAGE_IN, 1.2 + 2.0 * columns)
    figure = new_figure(width, 0.55 + 1.65 * len(rows))
    grid = figure.add_gridspec(len(rows), columns)
    for i, field in enumerate(rows):
        scale = _scale(field)
        axes = [figure.add_subplot(grid[i, k], projection="3d") for k in range(columns)]
        for k, ax in enumerate(axes):
            _draw_surface(ax, 1e3 * points[k], nodes, field.values_by_node[k], scale)
            _frame(ax, shown)
            if i == 0:
                ax.set_title(f"{times_s[k]:g} s", loc="center", pad=0)
        bar = figure.colorbar(scale, ax=axes, shrink=0.75, aspect=14, pad=0.01)
        bar.set_label(f"{field.label} [{field.unit}]")
        bar.outline.set_visible(False)  # type: ignore[operator]
    length_mm = _axes_triad(figure.axes[0], shown)
    state_finding(figure, finding, f"Quarter model, deformed, to scale; axes drawn {length_mm:g} mm long.")
    return figure


def _check(times_s: Sequence[float], points: Array, faces: Array, rows: Sequence[SurfaceField]) -> None:
    if points.ndim != 3 or points.shape[0] != len(times_s) or points.shape[2] != 3:
        raise InputError("points of the surface", f"shape {points.shape}", f"({len(times_s)}, p, 3)")
    if faces.ndim != 2 or faces.shape[1] not in (3, 4) or faces.max(initial=0) >= points.shape[1]:
        raise InputError("faces of the surface", f"shape {faces.shape}", "(f, 3) or (f, 4) numbers of nodes")
    for field in rows:
        if np.shape(field.values_by_node) != points.shape[:2]:
            raise InputError(field.label, f"shape {np.shape(field.values_by_node)}", str(points.shape[:2]))


def _scale(field: SurfaceField) -> ScalarMappable:
    values = field.values_by_node[np.isfinite(field.values_by_node)]
    reach = float(np.max(np.abs(values), initial=0.0)) or 1.0
    if field.signed:
        return ScalarMappable(Normalize(-reach, reach), _DIVERGING)
    return ScalarMappable(Normalize(min(0.0, float(np.min(values, initial=0.0))), reach), _SEQUENTIAL)


def _draw_surface(ax: Any, points_mm: Array, faces: Array, values: Array, scale: ScalarMappable) -> None:
    colors = scale.to_rgba(values[faces].mean(axis=1))
    patch = Poly3DCollection(points_mm[faces], facecolors=colors, edgecolors=colors, linewidths=0.2)
    patch.set_rasterized(True)  # thousands of faces would make an SVG of megabytes
    patch.set(clip_on=False, in_layout=False)
    ax.add_collection3d(patch)
    outline = Line3DCollection(points_mm[_boundary(faces)], colors=GREY, linewidths=0.5)
    outline.set(clip_on=False, in_layout=False)
    ax.add_collection3d(outline)


def _boundary(faces: Array) -> Array:
    """Edges (b, 2) that belong to one face only."""
    edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    unique, counts = np.unique(edges, axis=0, return_counts=True)
    return unique[counts == 1]


def _frame(ax: Any, points_mm: Array) -> None:
    low, high = points_mm.min(axis=(0, 1)), points_mm.max(axis=(0, 1))
    reach = np.where(high > low, high - low, 1.0)
    ax.set(
        xlim=(low[0], low[0] + reach[0]), ylim=(low[1], low[1] + reach[1]), zlim=(low[2], low[2] + reach[2])
    )
    ax.set_box_aspect(reach, zoom=0.98)
    ax.view_init(elev=42, azim=140)
    ax.set_axis_off()


def _axes_triad(ax: Any, points_mm: Array) -> float:
    """Draws x, y and z below the surface's corner; returns their length [mm]."""
    low, high = points_mm.min(axis=(0, 1)), points_mm.max(axis=(0, 1))
    extent = float(np.max(high - low)) or 1.0
    length = max(step for step in (0.1, 1.0, 2.0, 5.0, 10.0, 20.0) if step <= max(0.2 * extent, 0.1))
    origin = np.array([low[0], low[1], min(low[2], high[2] - 0.45 * extent)])
    for direction, name in zip(np.eye(3), "xyz", strict=True):
        tip = origin + length * direction
        ax.plot(*np.column_stack([origin, tip]), color=GREY, lw=1.0, clip_on=False, in_layout=False)
        label = origin + 1.35 * length * direction
        ax.text(*label, name, in_layout=False, color=GREY, fontsize=7, ha="center", va="center")
    return length
