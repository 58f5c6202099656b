"""Positions of the bricks' faces: lines along x, y and z, graded toward the edges of pads and guard.

At these edges a clamped surface meets a free one and the stress is singular, so that is where bricks are
small, and where a refinement divides them. The lines of the article's device are a pattern: each of its
stretches, such as the gauge or a layer of skin, is drawn over the same stretch of another device.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from bayeskin.errors import InputError
from bayeskin.geometry import Geometry
from bayeskin.types import Array

_TOWARD_EDGE = 0.25  # where a cell beside an edge is divided: a quarter of its width from it

# The pattern of each stretch: its length in the article's device, and its inner lines, from its start [mm].
# Along x: half the gauge, pad, gap, guard, free skin beyond. Along y: half the pad, gap, guard, free skin.
# Along z: subcutis, cutis. Free skin has coarse bricks: a soft cutis on a stiff subcutis would fold there,
# and fine bricks try to. Bricks are smaller at the edges that carry what the load cell measures: those of the
# article's pad are shielded by its guard, those of a bare pad, and of a guard that is measured, too, are not.
Stretch = tuple[float, tuple[float, ...]]
Pattern = tuple[tuple[Stretch, ...], ...]
_COARSEST: Pattern = (
    ((18.0, (12.0,)), (8.0, (4.0,)), (1.0, ()), (8.0, ()), (70.0, (15.0,))),
    ((4.0, ()), (1.0, ()), (7.0, ()), (72.0, (18.0,))),
    ((8.0, ()), (2.0, ())),
)
_COARSE: Pattern = (
    ((18.0, (9.0, 16.5)), (8.0, (1.5, 6.5)), (1.0, ()), (8.0, (1.5, 6.0)), (70.0, (5.0, 13.0, 30.0))),
    ((4.0, (3.0,)), (1.0, ()), (7.0, (3.5,)), (72.0, (6.0, 26.0))),
    ((8.0, (5.0,)), (2.0, (1.5,))),
)
_COARSEST_BOTH: Pattern = (
    ((18.0, (12.0, 16.5)), (8.0, (2.0,)), (1.0, ()), (8.0, ()), (70.0, (4.0, 20.0))),
    ((4.0, ()), (1.0, ()), (7.0, (5.6,)), (72.0, (4.0, 24.0))),
    ((8.0, ()), (2.0, ())),
)
_COARSE_BOTH: Pattern = (
    ((18.0, (9.0, 15.0, 17.5)), (8.0, (0.5, 3.0)), (1.0, ()), (8.0, (6.8,)), (70.0, (1.2, 5.0, 12.0, 30.0))),
    ((4.0, ()), (1.0, ()), (7.0, (4.0, 6.5)), (72.0, (0.8, 4.0, 12.0, 32.0))),
    ((8.0, (5.0,)), (2.0, (1.7,))),
)
_COARSEST_UNGUARDED: Pattern = (
    ((18.0, (12.0, 16.5)), (8.0, (1.5,)), (70.0, (4.0, 20.0))),
    ((4.0, (3.0,)), (72.0, (4.0, 24.0))),
    ((8.0, ()), (2.0, ())),
)
_COARSE_UNGUARDED: Pattern = (
    ((18.0, (9.0, 15.0, 17.5)), (8.0, (0.5, 2.5, 6.8)), (70.0, (1.2, 5.0, 12.0, 30.0))),
    ((4.0, (2.2, 3.75)), (72.0, (0.8, 4.0, 12.0, 32.0))),
    ((8.0, (5.0,)), (2.0, (1.2, 1.8))),
)


def brick_lines(
    refinement: int, geometry: Geometry = Geometry(), like: Geometry | None = None
) -> tuple[Array, ...]:
    """Coordinates of the bricks' faces along x, y and z before rolling [m].

    refinement : 1 is the default, 0 coarser, each higher one has a further line on either side of every edge
    like : as many lines as this geometry has, moved with the layers; its pads and guard must be the same

    Raises InputError for another device than that of `like`.
    """
    if like is None:
        return tuple(1e-3 * np.array(axis) for axis in _lines_mm(refinement, geometry))
    if (like.along_m, like.across_m) != (geometry.along_m, geometry.across_m):
        raise InputError("geometry", "other pads or another guard", "the lengths of the device it is like")
    x, y, z = _lines_mm(refinement, like)
    old, new = ([0.0, _mm(one.subcutis_m), _mm(one.thickness_m)] for one in (like, geometry))
    return 1e-3 * np.array(x), 1e-3 * np.array(y), 1e-3 * np.interp(z, old, new)


def _lines_mm(refinement: int, geometry: Geometry) -> list[tuple[float, ...]]:
    length, width, thickness = geometry.box_m
    edges = [[_mm(x) for x in ends] for ends in (geometry.along_m, geometry.across_m, (thickness,))]
    stops = [
        [0.0, *edges[0], _mm(length)],
        [0.0, *edges[1], _mm(width)],
        [0.0, _mm(geometry.subcutis_m), *edges[2]],
    ]
    coarsest, coarse = _patterns(geometry)
    pattern = coarse if refinement else coarsest
    lines = [_drawn(*axis) for axis in zip(stops, pattern, strict=True)]
    for _ in range(refinement - 1):
        lines = [_divided(*axis) for axis in zip(lines, edges, strict=True)]
    return lines


def _patterns(geometry: Geometry) -> tuple[Pattern, Pattern]:
    """Those of refinement 0 and 1."""
    if geometry.guard is None:
        return _COARSEST_UNGUARDED, _COARSE_UNGUARDED
    if geometry.force_on == "pad and guard":
        return _COARSEST_BOTH, _COARSE_BOTH
    return _COARSEST, _COARSE


def _mm(length_m: float) -> float:
    """Millimetres, without the rounding error of the product."""
    return round(1e3 * length_m, 12)


def _drawn(stops: Sequence[float], stretches: Sequence[Stretch]) -> tuple[float, ...]:
    """Lines of one axis: the pattern's stretches, each drawn between two stops."""
    lines = [stops[0]]
    for (start, end), (length, inner) in zip(pairwise(stops), stretches, strict=True):
        lines += [*(start + (end - start) * line / length for line in inner), end]
    return tuple(lines)


def _divided(lines: tuple[float, ...], edges: Sequence[float]) -> tuple[float, ...]:
    new = [a + _TOWARD_EDGE * (b - a) for a, b in pairwise(lines) if a in edges]
    new += [b - _TOWARD_EDGE * (b - a) for a, b in pairwise(lines) if b in edges]
    return tuple(sorted({*lines, *new}))
