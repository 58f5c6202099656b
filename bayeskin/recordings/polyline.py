"""A curve of many samples as few straight pieces (Ramer 1972; Douglas & Peucker 1973)."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from bayeskin.types import Array


def simplify(x: Array, y: Array, tolerance: float, fixed: NDArray[np.int64]) -> NDArray[np.int64]:
    """Indices of samples whose polyline stays within `tolerance` of every sample, vertically.

    x, y (n,), x increasing; fixed (j,) indices that are kept, the first and last sample among them or not.
    """
    keep = {0, len(x) - 1, *map(int, fixed)}
    ends = sorted(keep)
    pieces = list(pairwise(ends))
    while pieces:
        a, b = pieces.pop()
        if b - a < 2:
            continue
        chord = y[a] + (y[b] - y[a]) / (x[b] - x[a]) * (x[a : b + 1] - x[a])
        away = np.abs(y[a : b + 1] - chord)
        far = int(np.argmax(away))
        if away[far] > tolerance:
            keep.add(a + far)
            pieces += [(a, a + far), (a + far, b)]
    return np.array(sorted(keep))
