"""Locates a mismatch on the skin: where the markers move otherwise than the fitted model says.

The residual of each point, over all images and without the camera's motion, is fitted in proportion to the
opening of the pads. The result is one vector for each point: its residual at the largest opening. Noise is
taken from the scatter from image to image, which no fit changes. The error that is allowed for the model's
displacements is added to it. Gradients of the vectors over neighbouring points give the strain that the model
lacks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bayeskin.inference import LogPosterior
from bayeskin.inference.noise_model import MARKER_SD
from bayeskin.types import Array, PadMotion

LEVEL = 0.05  # probability that noise alone makes any point significant
NEIGHBOURS, NEAR = 9, 0.05  # least number, and share, of the points that give a strain at one of them
REWEIGHTED, TINY_M = 10, 1e-9
WRONG = 3.0  # a residual so many times the median has half the weight
MAD_TO_SD = 1.4826  # of normal variables


@dataclass(frozen=True)
class OnSkin:
    """Residuals of p points at the largest opening of the pads.

    place_m (p, 2) : places before the test; vector_m (p, 2) : recorded minus fitted displacements
    allowed_m (p,) : sd of a coordinate of a vector that noise and the allowed error of the model make
    significant (p,) : points whose residual is larger. If nothing is missing, any point is so with the
        probability `LEVEL`
    strain (p, 3) : strains along the pull, across it, and shear, that the model lacks; NaN for few points
    """

    place_m: Array
    vector_m: Array
    allowed_m: Array
    significant: NDArray[np.bool_]
    strain: Array

    @property
    def rms_m(self) -> float:
        """Returns the RMS length of the vectors."""
        return float(np.sqrt(np.mean(np.sum(self.vector_m**2, axis=1))))


def on_skin(log_posterior: LogPosterior, theta: Mapping[str, float], motion: PadMotion) -> OnSkin | None:
    """Returns the residuals on the skin at values of all parameters, or None without markers."""
    likelihood = log_posterior.markers
    if likelihood is None:
        return None
    values = np.array([[theta[name] for name in log_posterior.names]])
    predicted_m = log_posterior.predict_markers(values)[0]
    residual_m = likelihood.without_camera(predicted_m, theta[MARKER_SD])
    markers = likelihood.markers
    opening_m = motion.at(markers.time_s) - motion.at(markers.time_s[0])
    share = opening_m[1:] / opening_m[int(np.argmax(np.abs(opening_m)))]
    weight = share[:, None, None] * np.isfinite(residual_m)
    square = np.maximum(np.sum(weight**2, axis=0), 1e-12)
    vector_m = np.sum(weight * np.nan_to_num(residual_m), axis=0) / square
    widest = int(np.argmax(np.abs(share)))
    error_m2 = np.mean(np.sum(likelihood.errors_m[:, widest] ** 2, axis=0), axis=1)
    allowed_m = np.sqrt(_scatter(residual_m) ** 2 / square.mean(axis=1) + error_m2)
    farthest = np.sqrt(-2.0 * np.log(LEVEL / len(vector_m)))  # Rayleigh's distribution, for all points
    return OnSkin(
        markers.reference_m, vector_m, allowed_m,
        np.linalg.norm(vector_m, axis=1) > farthest * allowed_m, strains(markers.reference_m, vector_m),
    )  # fmt: skip


def _scatter(residual_m: Array) -> float:
    """Returns the sd [m] of the noise of a coordinate, from second differences over the images."""
    bends = np.diff(residual_m, 2, axis=0)
    bends = bends[np.isfinite(bends)]
    return float(MAD_TO_SD * np.median(np.abs(bends)) / np.sqrt(6.0)) if len(bends) else 0.0


def strains(place_m: Array, vector_m: Array) -> Array:
    """Returns the strains (p, 3) of vectors at places: along x, along y, and shear.

    Each is the slope of a plane through the nearest points, in which single wrong tracks weigh little
    (reweighted least squares with Cauchy's weights). NaN where the points are too few.
    """
    if len(place_m) < NEIGHBOURS:
        return np.full((len(place_m), 3), np.nan)
    near = cKDTree(place_m).query(place_m, max(NEIGHBOURS, round(NEAR * len(place_m))))[1]
    apart = place_m[near] - place_m[:, None]
    reach = np.abs(apart).max()
    design = np.concatenate([np.ones((*near.shape, 1)), apart / reach], axis=2)  # (p, k, 3)
    weight, values = np.ones(near.shape), vector_m[near]
    for _ in range(REWEIGHTED):
        weighted = design * weight[:, :, None]
        slopes = np.linalg.solve(weighted.transpose(0, 2, 1) @ design, weighted.transpose(0, 2, 1) @ values)
        off = np.linalg.norm(values - design @ slopes, axis=2)
        usual = np.median(off, axis=1, keepdims=True) + TINY_M
        weight = 1.0 / (1.0 + (off / (WRONG * usual)) ** 2)
    slopes = slopes / reach
    return np.stack([slopes[:, 1, 0], slopes[:, 2, 1], 0.5 * (slopes[:, 1, 1] + slopes[:, 2, 0])], axis=1)
