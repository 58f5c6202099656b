"""Allows for the error of the full model's own displacements, which its mesh causes.

Near the clamped edges of the pads a mesh is too stiff. The skin between the pads then moves too far, by a
smooth field that grows with the opening of the pads and has the symmetry of the test. The error is therefore
a Gaussian field over the skin, times the displacement of a pad. Between the pads of the article's device,
448 bricks are off by 0.45 % of a pad's displacement (RMS, docs/markers.md). This error resembles a change of
the stiffness ratio of the layers, so about twice its size is allowed for.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.linalg import eigh

from bayeskin.types import Array, Markers, PadMotion


@dataclass(frozen=True)
class DisplacementErrors:
    """Size of the displacements' error.

    share : sd of the error, RMS over the points, as a share of a pad's displacement
    length : distance over which the error is correlated, as a share of the distance between the pads
    shapes : largest number of shapes of each component; kept : share of the largest variance below which a
        shape is left out
    """

    share: float = 1e-2
    length: float = 0.25
    shapes: int = 8
    kept: float = 1e-3


def displacement_errors(
    markers: Markers, motion: PadMotion, gauge_m: float, settings: DisplacementErrors = DisplacementErrors()
) -> Array:
    """Returns independent errors (r, t - 1, p, 2) [m] of the displacements, of one sd each.

    gauge_m : distance between the pads
    """
    pads_m = 0.5 * (motion.at(markers.time_s[1:]) - motion.at(markers.time_s[0]))
    shapes = []
    for component in range(2):
        covariance = _symmetric(markers.reference_m, settings.length * gauge_m, component)
        covariance *= settings.share**2 / np.mean(np.diag(covariance))
        last = len(covariance) - 1
        first = max(last + 1 - settings.shapes, 0)
        variance, vectors = eigh(covariance, subset_by_index=[first, last])
        for size, vector in zip(variance, vectors.T, strict=True):
            if size > settings.kept * variance[-1]:
                shape = np.zeros((len(vector), 2))
                shape[:, component] = np.sqrt(size) * vector
                shapes.append(shape)
    return np.asarray(pads_m[None, :, None, None] * np.array(shapes)[:, None])


def _symmetric(place_m: Array, length_m: float, component: int) -> Array:
    """Returns the covariance (p, p) of a component of the error, which has the symmetry of the test.

    The component changes its sign at the plane to which it is normal, and stays the same at the other plane.
    """
    out: Array = np.zeros((len(place_m), len(place_m)))
    for signs in product((1.0, -1.0), repeat=2):
        apart = place_m[:, None] - place_m * np.array(signs)
        out += signs[component] * np.exp(-0.5 * np.sum(apart**2, axis=2) / length_m**2)
    return out
