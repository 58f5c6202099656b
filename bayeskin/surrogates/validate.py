"""How far a surrogate is from the full model on rows it has not learnt from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from bayeskin.surrogates.surrogate import ShapeSurrogate
from bayeskin.types import Array, Prediction, _FreezesArrays

NORMAL_90 = 1.6448536269514722


@dataclass(frozen=True)
class Validation(_FreezesArrays):
    """Errors over n rows and m bins.

    kind: "gp" or "chaos"; source: which rows; rms_n (m,) and predicted_sd_n (m,) over the rows [N];
    relative_error: ||prediction - truth|| / ||truth - its mean over rows||; coverage_90: share of bins
    and rows that the 90 % interval covers (nominal 0.90), bins with constant force left out;
    point_rms_n (n,) [N] and point_relative (n,), the same over the row's RMS force; worst_theta (d,) the
    row with the largest `point_relative`.
    """

    kind: Literal["gp", "chaos"]
    source: Literal["held-out", "leave-one-out"]
    relative_error: float
    coverage_90: float
    rms_n: Array
    predicted_sd_n: Array
    point_rms_n: Array
    point_relative: Array
    worst_theta: Array
    training_rows: int
    components: int

    @property
    def rows(self) -> int:
        return len(self.point_rms_n)


def validate(
    surrogate: ShapeSurrogate, theta: Array, force_n: Array, weights: Array | None = None
) -> Validation:
    """Compares predictions at theta (n, d) with force_n (n, m) that the full model gave there."""
    return compare(surrogate, surrogate.predict(theta), theta, force_n, "held-out", weights)


def compare(
    surrogate: ShapeSurrogate,
    prediction: Prediction,
    theta: Array,
    force_n: Array,
    source: Literal["held-out", "leave-one-out"],
    weights: Array | None = None,
) -> Validation:
    """The same for predictions made elsewhere; `weights` (n,) of the rows in the relative error."""
    error = prediction.mean - force_n
    weights = np.ones(len(theta)) if weights is None else weights
    centred = force_n - np.average(force_n, axis=0, weights=weights)
    varies = np.ptp(force_n, axis=0) > 0.0
    covered = np.abs(error) <= NORMAL_90 * prediction.sd()
    point_rms = np.sqrt(np.mean(error**2, axis=1))
    point_relative = point_rms / np.sqrt(np.maximum(np.mean(force_n**2, axis=1), np.finfo(float).tiny))
    scatter = float(weights @ np.sum(centred**2, axis=1))
    miss = float(weights @ np.sum(error**2, axis=1))
    return Validation(
        kind=surrogate.provenance["kind"],
        source=source,
        relative_error=float(np.sqrt(miss / scatter)) if scatter > 0.0 else float("nan"),
        coverage_90=float(np.mean(covered[:, varies])) if varies.any() else float("nan"),
        rms_n=np.sqrt(np.mean(error**2, axis=0)),
        predicted_sd_n=np.sqrt(np.mean(prediction.sd() ** 2, axis=0)),
        point_rms_n=point_rms,
        point_relative=point_relative,
        worst_theta=theta[np.argmax(point_relative)],
        training_rows=len(surrogate.latents.inputs),
        components=len(surrogate.transform.components),
    )
