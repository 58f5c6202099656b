"""Simplifies a curve of many samples to few straight pieces (Ramer 1972; Douglas & Peucker 1973)."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from bayeskin.types import Array


def simplify(x: Array, y: Array, tolerance: float, fixed: NDArray[np.int64]) -> NDArray[np.int64]:
    """Returns the indices of samples whose polyline stays vertically within `tolerance` of every sample.

    x, y : (n,), with x increasing
    fixed : (j,) indices that are kept in any case. The first and the last sample are always kept, whether
        `fixed` contains them or not.
    """
    keep = {0, len(x) - 1, *map(int, fixed)}
    ends = sorted(keep)
    pieces = list(pairwise(ends))
    while pieces:
        a, b = pieces.pop()
        if b - a < 2:
            continue
        chord = y[a] + (y[b] - y[a]) / (x[b] - x[a]) * (x[a : b + 1] - x[a])
        distance = np.abs(y[a : b + 1] - chord)
        farthest = int(np.argmax(distance))
        if distance[farthest] > tolerance:
            keep.add(a + farthest)
            pieces += [(a, a + farthest), (a + farthest, b)]
    return np.array(sorted(keep))
