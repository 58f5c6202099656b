"""Measures the error of a surrogate against the full model, on rows from which it has not learnt."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from bayeskin.surrogates.hyperparameters import NORMAL_90
from bayeskin.surrogates.surrogate import ShapeSurrogate
from bayeskin.types import Array, FreezesArrays, Prediction


@dataclass(frozen=True)
class Validation(FreezesArrays):
    """Errors of a surrogate over n rows and m bins.

    kind : "gp" or "chaos"
    source : the rows on which the error is measured
    relative_error : ||prediction - truth|| / ||truth - its mean over rows||
    coverage_90 : share of bins and rows that the 90 % interval covers (nominal value 0.90). Bins with
        constant force are left out.
    rms_n, predicted_sd_n : (m,) RMS error and predicted sd over the rows [N]
    point_rms_n : (n,) RMS error of each row [N]
    point_relative : (n,) RMS error of each row divided by the row's RMS force
    worst_theta : (d,) parameters of the row with the largest `point_relative`
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
    """Returns the errors of predictions at theta (n, d) against the full model's force_n (n, m)."""
    return compare(surrogate, surrogate.predict(theta), theta, force_n, "held-out", weights)


def compare(
    surrogate: ShapeSurrogate,
    prediction: Prediction,
    theta: Array,
    force_n: Array,
    source: Literal["held-out", "leave-one-out"],
    weights: Array | None = None,
) -> Validation:
    """Returns the errors of predictions that were made elsewhere, against force_n (n, m).

    `weights` (n,) are the weights of the rows in the relative error.
    """
    error = prediction.mean - force_n
    weights = np.ones(len(theta)) if weights is None else weights
    centred = force_n - np.average(force_n, axis=0, weights=weights)
    varies = np.ptp(force_n, axis=0) > 0.0
    covered = np.abs(error) <= NORMAL_90 * prediction.sd()
    point_rms = np.sqrt(np.mean(error**2, axis=1))
    point_relative = point_rms / np.sqrt(np.maximum(np.mean(force_n**2, axis=1), np.finfo(float).tiny))
    scatter = float(weights @ np.sum(centred**2, axis=1))
    squared_error = float(weights @ np.sum(error**2, axis=1))
    return Validation(
        kind=surrogate.provenance["kind"],
        source=source,
        relative_error=float(np.sqrt(squared_error / scatter)) if scatter > 0.0 else float("nan"),
        coverage_90=float(np.mean(covered[:, varies])) if varies.any() else float("nan"),
        rms_n=np.sqrt(np.mean(error**2, axis=0)),
        predicted_sd_n=np.sqrt(np.mean(prediction.sd() ** 2, axis=0)),
        point_rms_n=point_rms,
        point_relative=point_relative,
        worst_theta=theta[np.argmax(point_relative)],
        training_rows=len(surrogate.latents.inputs),
        components=len(surrogate.transform.components),
    )
