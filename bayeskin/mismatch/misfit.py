"""Measures how far a force lies from the recording."""

from __future__ import annotations

import numpy as np

from bayeskin.inference.noise_model import bins_in_windows
from bayeskin.types import Array, BinnedForce


def misfit_n(binned: BinnedForce, force_n: Array, start_s: float | None = None) -> float:
    """Returns the RMS [N] of the difference between the recording and a force (m,), over its usable bins.

    start_s : time from which bins count; None counts all of them
    """
    windows = None if start_s is None else ((start_s, float(binned.edges_s[-1])),)
    counted = bins_in_windows(binned, windows) >= 0
    return float(np.sqrt(np.mean((binned.force_n - force_n)[counted] ** 2)))


def explained_share(binned: BinnedForce, base_n: Array, best_n: Array) -> float:
    """Returns the share of the squared misfit of a base force (m,) that another force (m,) explains."""
    return 1.0 - misfit_n(binned, best_n) ** 2 / misfit_n(binned, base_n) ** 2
