"""States what a fit says about the markers, in the types of JSON, for a calibration and a diagnosis."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bayeskin.inference import LogPosterior
from bayeskin.inference.marker_gain import widened_without_markers
from bayeskin.inference.noise_model import MARKER_SD
from bayeskin.mismatch.on_skin import OnSkin

MOST_LISTED = 10


def on_skin_entry(log_posterior: LogPosterior, theta: Mapping[str, float], located: OnSkin) -> dict[str, Any]:
    """Returns noise and residuals of the markers at values of all parameters, and what the markers add.

    The longest significant residuals are listed, the longest first. `widens` has the factors by which the sds
    of the parameters would be larger without the markers.
    """
    likelihood = log_posterior.markers
    assert likelihood is not None
    length_m = np.linalg.norm(located.vector_m, axis=1)
    order = [int(i) for i in np.argsort(-length_m) if located.significant[i]]
    return {
        "points": len(length_m), "images": len(likelihood.markers.time_s), "sd_m": theta[MARKER_SD],
        "significant": len(order), "rms_m": located.rms_m,
        "widens": widened_without_markers(log_posterior, theta),
        "largest": [
            {"point": likelihood.markers.points[i], "place_m": located.place_m[i].tolist(),
             "residual_m": located.vector_m[i].tolist()}
            for i in order[:MOST_LISTED]
        ],
    }  # fmt: skip
