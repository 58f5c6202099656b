"""Places the faces of the bricks: grid lines along x, y and z, graded toward the edges of pads and guard.

At these edges a clamped surface meets a free one, and the stress is singular. The bricks are therefore small
there, and a refinement divides them there. The lines of the article's device serve as a pattern. The pattern
has sections, such as the gauge or a layer of skin. Each section is stretched to the length that it has on the
device at hand.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from bayeskin.errors import InputError
from bayeskin.geometry import Geometry
from bayeskin.types import Array

_TOWARD_EDGE = 0.25  # a cell beside an edge is divided at this share of its width from the edge

# A stretch is one section of the pattern: its length on the article's device, and the positions of its inner
# lines, measured from its start [mm]. The sections along x are half the gauge, pad, gap, guard, and the free
# skin beyond. Along y they are half the pad, gap, guard, and free skin. Along z they are subcutis and cutis.
# Free skin has coarse bricks, because with fine ones a soft cutis on a stiff subcutis tends to fold there.
# Bricks are smaller at edges that carry much of the measured force. The guard shields the edges of the
# article's pad. Nothing shields the edges of a pad without a guard, or of a guard that is also measured.
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
    """Returns the coordinates [m] of the bricks' faces along x, y and z, before rolling.

    refinement : 1 is the default and 0 is coarser; each level above 1 adds a line on either side of every
        edge
    geometry : device and tissue
    like : a geometry with the same pads and guard. The result then has the lines of this geometry, moved
        along z to the layers of `geometry`

    Raises InputError if the pads or the guard differ from those of `like`.
    """
    if like is None:
        return tuple(1e-3 * np.array(axis) for axis in _lines_mm(refinement, geometry))
    if (like.along_m, like.across_m) != (geometry.along_m, geometry.across_m):
        raise InputError(
            "geometry",
            "its pads or its guard differ from those of the reference device",
            "they must be the same",
        )
    x, y, z = _lines_mm(refinement, like)
    old, new = ([0.0, _mm(tissue.subcutis_m), _mm(tissue.thickness_m)] for tissue in (like, geometry))
    return 1e-3 * np.array(x), 1e-3 * np.array(y), 1e-3 * np.interp(z, old, new)


def _lines_mm(refinement: int, geometry: Geometry) -> list[tuple[float, ...]]:
    """Returns the lines [mm] along x, y and z for a level of refinement."""
    length, width, thickness = geometry.box_m
    edges = [[_mm(x) for x in ends] for ends in (geometry.along_m, geometry.across_m, (thickness,))]
    stops = [
        [0.0, *edges[0], _mm(length)],
        [0.0, *edges[1], _mm(width)],
        [0.0, _mm(geometry.subcutis_m), *edges[2]],
    ]
    coarsest, coarse = _patterns(geometry)
    pattern = coarse if refinement else coarsest
    lines = [_stretched(*axis) for axis in zip(stops, pattern, strict=True)]
    for _ in range(refinement - 1):
        lines = [_divided_at_edges(*axis) for axis in zip(lines, edges, strict=True)]
    return lines


def _patterns(geometry: Geometry) -> tuple[Pattern, Pattern]:
    """Returns the patterns of refinements 0 and 1 for a geometry."""
    if geometry.guard is None:
        return _COARSEST_UNGUARDED, _COARSE_UNGUARDED
    if geometry.force_on == "pad and guard":
        return _COARSEST_BOTH, _COARSE_BOTH
    return _COARSEST, _COARSE


def _mm(length_m: float) -> float:
    """Returns a length in millimetres, without the rounding error of the product."""
    return round(1e3 * length_m, 12)


def _stretched(stops: Sequence[float], stretches: Sequence[Stretch]) -> tuple[float, ...]:
    """Returns the lines of one axis: each section of the pattern, stretched between two stops."""
    lines = [stops[0]]
    for (start, end), (length, inner) in zip(pairwise(stops), stretches, strict=True):
        lines += [*(start + (end - start) * line / length for line in inner), end]
    return tuple(lines)


def _divided_at_edges(lines: tuple[float, ...], edges: Sequence[float]) -> tuple[float, ...]:
    """Returns the lines of one axis with a further line on either side of each edge."""
    new = [a + _TOWARD_EDGE * (b - a) for a, b in pairwise(lines) if a in edges]
    new += [b - _TOWARD_EDGE * (b - a) for a, b in pairwise(lines) if b in edges]
    return tuple(sorted({*lines, *new}))
