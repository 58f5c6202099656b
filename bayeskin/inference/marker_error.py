"""Corrects for the error of the full model's own displacements, which its mesh causes.

From mesh to mesh the error shrinks by a nearly constant factor, and its shape stays the same. What the usual
mesh still lacks is therefore about a quarter of what it has gained over the coarse mesh. This is added to the
model's displacements. Its amplitude is uncertain. A smooth Gaussian field over the skin, times the
displacement of a pad, allows for what this shape does not describe (docs/markers.md). It has the symmetry of
the test.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.linalg import eigh

from bayeskin.errors import InputError
from bayeskin.types import Array, Markers, PadMotion


@dataclass(frozen=True)
class DisplacementErrors:
    """Sizes of the displacements' error.

    lacking, sd : mean and sd of what the usual mesh lacks, as a share of its gain over the coarse mesh
    shrinks : factor on this share from one refinement to the next
    smooth : sd of the smooth field, RMS over the points, as a share of a pad's displacement
    length : distance over which this field is correlated, as a share of the distance between the pads
    shapes : largest number of shapes of each component; kept : share of the largest variance below which a
        shape is left out
    """

    lacking: float = 0.25
    sd: float = 0.06
    shrinks: float = 0.22
    smooth: float = 1.5e-3
    length: float = 0.25
    shapes: int = 8
    kept: float = 1e-3


def mesh_correction(
    markers: Markers, refinement: int, settings: DisplacementErrors = DisplacementErrors()
) -> tuple[Array, Array]:
    """Returns what is added to displacements of a mesh (t - 1, p, 2) [m], and the sd of its amplitude.

    refinement : of the bricks; 1 is the usual mesh
    Raises InputError for markers whose change from mesh to mesh is not known.
    """
    if not markers.mesh_change_m.size:
        raise InputError("markers", "the error of the mesh is not known", "a run must have prepared them")
    scaled_m = settings.shrinks ** (refinement - 1) * markers.mesh_change_m
    return settings.lacking * scaled_m, settings.sd * scaled_m


def smooth_errors(
    markers: Markers, motion: PadMotion, gauge_m: float, settings: DisplacementErrors = DisplacementErrors()
) -> Array:
    """Returns independent smooth errors (r, t - 1, p, 2) [m] of the displacements, of one sd each.

    gauge_m : distance between the pads
    """
    pads_m = 0.5 * (motion.at(markers.time_s[1:]) - motion.at(markers.time_s[0]))
    shapes = []
    for component in range(2):
        covariance = _symmetric(markers.reference_m, settings.length * gauge_m, component)
        covariance *= settings.smooth**2 / np.mean(np.diag(covariance))
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
