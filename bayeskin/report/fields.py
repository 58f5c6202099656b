"""Draws fields on the deformed surface of the quarter model, with a row per time and a column per field."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import LinearSegmentedColormap, LogNorm, Normalize
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from bayeskin.errors import InputError
from bayeskin.number_format import number
from bayeskin.report.style import GREY, INK, PAGE_IN, new_figure, plain_log, state_finding, styled
from bayeskin.types import Array

# Grey stands for zero, because a white surface would be invisible on the page.
_SEQUENTIAL = LinearSegmentedColormap.from_list("grey-blue", ["#E6E6E6", "#86B8D9", "#0072B2", "#08284F"])
_DIVERGING = LinearSegmentedColormap.from_list(
    "blue-grey-red", ["#08284F", "#0072B2", "#86B8D9", "#E6E6E6", "#EDA377", "#D55E00", "#5C2000"]
)


@dataclass(frozen=True)
class _DrawingSettings:
    """Settings of the drawing.

    elevation, azimuth : direction of view [rad], in which the top and both planes of symmetry are visible
    decades : decades of a vector's colour scale; smaller vectors have its lowest colour and no arrow
    label_in : width of the labels of the rows [inches]
    arrow_mm, spacing_mm : length of an arrow, and smallest distance of two arrows [mm of the skin]
    """

    elevation: float = float(np.radians(38.0))
    azimuth: float = float(np.radians(-112.0))
    decades: float = 2.0
    label_in: float = 0.95
    arrow_mm: float = 4.5
    spacing_mm: float = 5.5


_DRAWING = _DrawingSettings()


@dataclass(frozen=True)
class SurfaceField:
    """Holds one column of the figure: values (t, f) in `unit` of the surface's small faces at t times.

    A `signed` field has a colour scale that is centred on zero. With directions (t, f, 3), the values are
    lengths of vectors. Their colour scale is logarithmic, and arrows show their directions.
    """

    label: str
    unit: str
    values: Array
    signed: bool = False
    directions: Array | None = None


@styled
def figure_fields(
    row_labels: Sequence[str],
    points_m: ArrayLike,
    faces: ArrayLike,
    part: ArrayLike,
    strong: Sequence[int],
    columns: Sequence[SurfaceField],
    finding: str,
    caption: str = "",
) -> Figure:
    """Returns a figure with a row of panels for each time and a column with a colour bar for each field.

    All panels show the same region.

    row_labels (t,) : one for each time
    points_m (t, v, 3) : deformed positions of the surface's points
    faces (f, 3) or (f, 4) : numbers of the points of each face
    part (f,) : number of the part to which each face belongs; the parts are outlined
    strong : numbers of the parts that have a thick outline
    finding, caption : texts above and below the panels

    Raises InputError if the shapes do not match.
    """
    points, nodes, parts = np.asarray(points_m, dtype=float), np.asarray(faces, dtype=int), np.asarray(part)
    _check(row_labels, points, nodes, parts, columns)
    flat = 1e3 * points @ _view()  # (t, v, 3): right, up, toward the viewer
    visible = flat[:, np.unique(nodes)]
    low, high = visible.min(axis=(0, 1)), visible.max(axis=(0, 1))
    panel_in = (PAGE_IN - _DRAWING.label_in) / max(len(columns), 3)
    height_in = len(row_labels) * (panel_in * (high - low)[1] / (high - low)[0] + 0.06)
    figure = new_figure(_DRAWING.label_in + panel_in * len(columns), height_in + 1.15)
    widths = [_DRAWING.label_in, *[panel_in] * len(columns)]
    axes = figure.subplots(len(row_labels), 1 + len(columns), squeeze=False, width_ratios=widths)
    for j, field in enumerate(columns, start=1):
        scale = _scale(field)
        for i, ax in enumerate(axes[:, j]):
            _paint(ax, flat[i], nodes, field.values[i], scale)
            _outline(ax, flat[i], nodes, parts, strong)
            if field.directions is not None:
                _arrows(ax, flat[i][nodes].mean(axis=1), field, i, scale)
            _frame(ax, low, high, field.values[i], field.unit)
        axes[0, j].set_title(field.label, loc="center")
        extend = "min" if field.directions is not None else "neither"
        bar = figure.colorbar(
            scale, ax=axes[:, j], location="bottom", shrink=0.8, aspect=28, pad=0.02, extend=extend
        )
        bar.set_label(f"{field.label} [{field.unit}]")
        bar.outline.set_visible(False)  # type: ignore[operator]
        if field.directions is not None:
            plain_log(bar.ax.xaxis)
    for label, ax in zip(row_labels, axes[:, 0], strict=True):
        ax.set_axis_off()
        ax.text(0.0, 0.5, label, va="center")
    _triad(axes[0, 1], low, high)
    state_finding(figure, finding, caption)
    return figure


def _check(
    row_labels: Sequence[str], points: Array, faces: Array, part: Array, columns: Sequence[SurfaceField]
) -> None:
    """Raises InputError if the shapes do not match."""
    if points.ndim != 3 or points.shape[0] != len(row_labels) or points.shape[2] != 3:
        raise InputError(
            "points of the surface", f"the shape is {points.shape}", f"it must be ({len(row_labels)}, v, 3)"
        )
    if faces.ndim != 2 or faces.shape[1] not in (3, 4) or faces.max(initial=0) >= points.shape[1]:
        raise InputError(
            "faces of the surface",
            f"the shape is {faces.shape}",
            "it must be (f, 3) or (f, 4), with numbers of points",
        )
    if part.shape != faces.shape[:1]:
        raise InputError(
            "parts of the surface", f"the shape is {part.shape}", f"it must be {faces.shape[:1]}"
        )
    shape = (len(row_labels), len(faces))
    for field in columns:
        if np.shape(field.values) != shape:
            raise InputError(field.label, f"the shape is {np.shape(field.values)}", f"it must be {shape}")
        if field.directions is not None and np.shape(field.directions) != (*shape, 3):
            raise InputError(
                field.label,
                f"the shape of its directions is {np.shape(field.directions)}",
                f"it must be {(*shape, 3)}",
            )


def _view() -> Array:
    """Returns the matrix (3, 3) of a parallel projection.

    Its columns are the directions to the right of the page, up the page, and toward the viewer.
    """
    e, a = _DRAWING.elevation, _DRAWING.azimuth
    right = (-np.sin(a), np.cos(a), 0.0)
    up = (-np.sin(e) * np.cos(a), -np.sin(e) * np.sin(a), np.cos(e))
    toward = (np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e))
    return np.array([right, up, toward]).T


def _scale(field: SurfaceField) -> ScalarMappable:
    """Returns the colour scale of a field."""
    values = field.values[np.isfinite(field.values)]
    reach = float(np.max(np.abs(values), initial=0.0)) or 1.0
    if field.signed:
        return ScalarMappable(Normalize(-reach, reach), _DIVERGING)
    if field.directions is not None:
        return ScalarMappable(LogNorm(reach / 10**_DRAWING.decades, reach, clip=True), _SEQUENTIAL)
    return ScalarMappable(Normalize(min(0.0, float(np.min(values, initial=0.0))), reach), _SEQUENTIAL)


def _paint(ax: Axes, flat_mm: Array, faces: Array, values: Array, scale: ScalarMappable) -> None:
    order = np.argsort(flat_mm[faces, 2].mean(axis=1))  # the nearest faces are painted last
    colors = scale.to_rgba(values[order])
    patch = PolyCollection(
        list(flat_mm[faces[order], :2]), facecolors=colors, edgecolors=colors, linewidths=0.3
    )
    patch.set_rasterized(True)  # thousands of faces would make an SVG of megabytes
    ax.add_collection(patch)


def _outline(ax: Axes, flat_mm: Array, faces: Array, part: Array, strong: Sequence[int]) -> None:
    """Draws the outlines of the parts, with a thick line for those in `strong`."""
    edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    unique, first, inverse = np.unique(edges, axis=0, return_index=True, return_inverse=True)
    owner = np.repeat(part, faces.shape[1])
    inverse = inverse.ravel()
    bounds = np.bincount(inverse) == 1
    bounds[inverse[owner != owner[first][inverse]]] = True
    thick = np.zeros(len(unique), dtype=bool)
    thick[inverse[np.isin(owner, strong)]] = True
    for chosen, color, width in ((bounds & ~thick, GREY, 0.5), (bounds & thick, "white", 1.8)):
        ax.plot(*_broken_line(flat_mm[unique[chosen], :2]), color=color, lw=width, solid_capstyle="round")
    ax.plot(*_broken_line(flat_mm[unique[bounds & thick], :2]), color=INK, lw=0.8, solid_capstyle="round")


def _broken_line(segments: Array) -> tuple[Array, Array]:
    """Returns segments (s, 2, 2) as one line with gaps, which is a single path in an SVG."""
    gaps = np.full((len(segments), 1, 2), np.nan)
    x, y = np.concatenate([segments, gaps], axis=1).reshape(-1, 2).T
    return x, y


def _arrows(ax: Axes, centres_mm: Array, field: SurfaceField, row: int, scale: ScalarMappable) -> None:
    """Draws arrows of equal length in space, spread over the page, for vectors within the colour scale."""
    assert field.directions is not None
    chosen: list[int] = []
    for k in np.flatnonzero(field.values[row] > (scale.norm.vmin or 0.0)):
        gaps = np.linalg.norm(centres_mm[chosen, :2] - centres_mm[k, :2], axis=1)
        if np.all(gaps > _DRAWING.spacing_mm):
            chosen.append(int(k))
    if not chosen:
        return
    vectors = field.directions[row, chosen]
    along = _DRAWING.arrow_mm * (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)) @ _view()[:, :2]
    # An arrow toward the viewer shows no direction.
    seen = np.linalg.norm(along, axis=1) > 0.3 * _DRAWING.arrow_mm
    ax.quiver(
        *centres_mm[chosen, :2][seen].T, *along[seen].T, angles="xy", scale_units="xy", scale=1.0,
        pivot="mid", units="xy", width=0.5, headwidth=4.0, headlength=4.5, headaxislength=4.0,
        color=INK, edgecolor="white", linewidth=0.4,
    )  # fmt: skip


def _frame(ax: Axes, low: Array, high: Array, values: Array, unit: str) -> None:
    margin = 0.01 * float(high[0] - low[0])
    ax.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin), aspect="equal")
    ax.set(xticks=[], yticks=[])
    ax.spines[:].set_visible(False)
    value_range = f"{number(values.min(), 3)} to {number(values.max(), 3)} {unit}"
    ax.text(1.0, 0.0, value_range, transform=ax.transAxes, ha="right", va="bottom", fontsize=6.5, color=GREY)


def _triad(ax: Axes, low: Array, high: Array) -> None:
    """Draws x, y and z, 5 mm long, at the panel's upper left."""
    origin = np.array([low[0] + 0.05 * (high - low)[0], low[1] + 0.78 * (high - low)[1]])
    for direction, name in zip(_view()[:, :2], "xyz", strict=True):
        ax.plot(*np.column_stack([origin, origin + 5.0 * direction]), color=GREY, lw=0.8)
        x, y = origin + 7.5 * direction
        ax.text(x, y, name, color=GREY, fontsize=6.5, ha="center", va="center")
