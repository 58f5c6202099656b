"""Estimates how large an effect has to be to be named, from single answers that are yes or no.

The share named at a size s is

    p(s) = 1 / (1 + exp(-(ln s - ln m) / w)) ,

where m is the size at which half of the effects are named, and w says how slowly the share rises. The curve
is averaged over both on a grid, with a uniform prior for ln m and a log-uniform prior for w. Few answers
therefore give a wide interval, and no curve claims more than the answers support.

Source: Kuss, Jakel & Wichmann, J. Vision 5 (2005), 478-492.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

FEWEST = 4  # smallest number of answers for which a curve is drawn
HALF = np.exp(np.linspace(np.log(0.1), np.log(300.0), 401))  # m, in multiples of the noise floor
WIDTH = np.exp(np.linspace(np.log(0.05), np.log(1.5), 41))  # w
AT = np.exp(np.linspace(np.log(0.5), np.log(40.0), 41))  # sizes at which the curve is given
LOW, HIGH = 0.05, 0.95


def curve(sizes: Sequence[float], named: Sequence[bool]) -> dict[str, Any]:
    """Returns the share named as a function of size, from the answers `named` (n,) at `sizes` (n,).

    Sizes are in multiples of the noise floor.
    at, mean, low, high : sizes, and the mean and 90 % interval of the share at these sizes
    half : the size at which half are named, as median, `low` and `high`
    """
    log_p, log_q = _logs(np.asarray(sizes, dtype=float))
    yes = np.asarray(named, dtype=bool)
    density = np.where(yes, log_p, log_q).sum(axis=2)
    weight = np.exp(density - density.max())
    weight /= weight.sum()
    share = np.exp(_logs(AT)[0])
    ends = [_quantiles(column, weight.ravel(), (LOW, HIGH)) for column in share.reshape(-1, len(AT)).T]
    half = _quantiles(HALF, weight.sum(axis=1), (LOW, 0.5, HIGH))
    return {
        "at": AT.tolist(),
        "mean": np.tensordot(weight, share, axes=2).tolist(),
        "low": [low for low, _ in ends],
        "high": [high for _, high in ends],
        "half": dict(zip(("low", "median", "high"), half, strict=True)),
    }


def _logs(sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the logarithms of p and of 1 - p, each (m, w, n)."""
    z = (np.log(sizes) - np.log(HALF)[:, None, None]) / WIDTH[None, :, None]
    return -np.logaddexp(0.0, -z), -np.logaddexp(0.0, z)


def _quantiles(values: np.ndarray, weight: np.ndarray, at: Sequence[float]) -> list[float]:
    quantiles: list[float] = np.quantile(values, at, weights=weight, method="inverted_cdf").tolist()
    return quantiles
