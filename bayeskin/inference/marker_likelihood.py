"""Log-likelihood of tracks of markers: white noise, and a rigid motion of the camera in each image.

The displacements of the visible points in an image, since the first image, are

    d = u(theta) + B c + e ,   e ~ N(0, s^2 I) ,   c ~ N(0, S)

where u is the model's displacement and the three columns of B are a unit translation along x, one along y,
and a unit rotation about the origin. The motion c of the camera is not known. It is integrated out, with its
prior covariance S = diag(t^2, t^2, r^2), so that d - u has the covariance s^2 I + B S B'. With the singular
value decomposition of B S^(1/2), its inverse and determinant take a few sums for each image (Woodbury's
identity). A camera that may move far hides the mean displacement and the mean rotation of the points.

The noise is independent from image to image. The first image is the reference of image correlation, so its
places count as exact.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from bayeskin.types import Array, Markers, Parameter, ParameterSpace

MARKER_SD = "marker_sd"
_SOURCE = "weakly informative: spans what image correlation of skin reaches"


@dataclass(frozen=True)
class CameraMotion:
    """Prior sd of the camera's rigid motion in each image: translation along each axis, and rotation."""

    translation_m: float = 1e-3
    rotation_rad: float = 0.02


class PredictsMarkers(Protocol):
    """A model of the displacements of markers."""

    @property
    def space(self) -> ParameterSpace: ...

    @property
    def provenance(self) -> Mapping[str, Any]: ...

    def predict_m(self, theta: ArrayLike) -> Array:
        """Returns displacements since the first image (n, t - 1, p, 2) [m] at theta (n, d)."""
        ...


@dataclass(frozen=True)
class MarkerLikelihood:
    """The tracks of markers with a model of them.

    sd_m : bounds of the log-uniform prior of the noise's sd [m]; a known sd has bounds that are all but equal
    camera : prior sd of the camera's motion in each image
    """

    markers: Markers
    model: PredictsMarkers
    sd_m: tuple[float, float] = (1e-6, 1e-3)
    camera: CameraMotion = CameraMotion()

    @property
    def parameter(self) -> Parameter:
        """Returns the parameter of the noise."""
        return Parameter(MARKER_SD, "m", *self.sd_m, "log-uniform", "noise sd of the markers", _SOURCE)

    @cached_property
    def _seen(self) -> Array:
        """Returns one where a coordinate was seen and zero elsewhere, (t - 1, 2 p)."""
        observed_m = self.markers.displacement_m
        return np.isfinite(observed_m).reshape(len(observed_m), -1).astype(float)

    @cached_property
    def _camera(self) -> tuple[Array, Array]:
        """Returns for each image orthonormal shapes of the camera's motion, and their prior variances.

        The shapes are (t - 1, 2 p, 3), and the variances (t - 1, 3) [m^2].
        """
        place_m = self.markers.reference_m
        shapes: Array = np.zeros((*place_m.shape, 3))
        shapes[:, 0, 0] = shapes[:, 1, 1] = self.camera.translation_m
        shapes[:, 0, 2] = -place_m[:, 1] * self.camera.rotation_rad
        shapes[:, 1, 2] = place_m[:, 0] * self.camera.rotation_rad
        visible = self._seen[:, :, None] * shapes.reshape(-1, 3)
        left, size, _ = np.linalg.svd(visible, full_matrices=False)
        return left, size**2

    def columns(self, theta: Array, names: tuple[str, ...]) -> Array:
        """Returns the columns of the model's parameters (n, d) among parameters (n, D) of these names."""
        return np.asarray(theta[:, [names.index(name) for name in self.model.space.names]])

    def residual_m(self, predicted_m: Array) -> Array:
        """Returns recorded minus predicted displacements (n, t - 1, 2 p) [m]; zero where nothing was seen.

        predicted_m : displacements (n, t - 1, p, 2)
        """
        observed_m = self.markers.displacement_m
        residual = np.nan_to_num(observed_m - predicted_m)
        return residual.reshape(*predicted_m.shape[:-2], -1)

    def log_density(self, predicted_m: Array, sd_m: Array) -> Array:
        """Returns the log density (n,) of the tracks, in nats (displacements in m).

        predicted_m : displacements (n, t - 1, p, 2), or (1, ...) for all sd; sd_m (n,) : sd of the noise
        """
        residual, (shapes, variance) = self.residual_m(predicted_m), self._camera
        along = np.einsum("ntq,tqc->ntc", residual, shapes)
        white = sd_m[:, None] ** 2
        total = white[:, :, None] + variance  # (n, t - 1, 3)
        across = np.sum(residual**2, axis=2) - np.sum(along**2, axis=2)
        square = np.sum(across / white + np.sum(along**2 / total, axis=2), axis=1)
        free = self._seen.sum(axis=1) - 3.0
        log_scale = np.sum(free * np.log(white) + np.sum(np.log(total), axis=2), axis=1)
        return np.asarray(-0.5 * (square + log_scale + self._seen.sum() * np.log(2.0 * np.pi)))

    def whitened(self, columns_m: Array, sd_m: float) -> Array:
        """Returns columns (t - 1, 2 p, c) [m] divided by the root of the covariance, in units of its sd.

        The sum of squares of a whitened residual is the exponent of the density. Coordinates that were not
        seen give zeros.
        """
        shapes, variance = self._camera
        seen = columns_m * self._seen[:, :, None]
        along = np.einsum("tqk,tqc->tkc", shapes, seen)
        less = 1.0 / np.sqrt(sd_m**2 + variance) - 1.0 / sd_m
        return np.asarray(seen / sd_m + np.einsum("tqk,tkc->tqc", shapes, less[:, :, None] * along))

    def without_camera(self, predicted_m: Array, sd_m: float) -> Array:
        """Returns the residuals (t - 1, p, 2) [m] less the most probable motion of the camera in each image.

        They are NaN where a point was not seen. predicted_m : displacements (t - 1, p, 2)
        """
        residual, (shapes, variance) = self.residual_m(predicted_m[None])[0], self._camera
        share = variance / (variance + sd_m**2)
        along = np.einsum("tq,tqc->tc", residual, shapes) * share
        left = residual - np.einsum("tqc,tc->tq", shapes, along)
        left[self._seen == 0.0] = np.nan
        return left.reshape(predicted_m.shape)

    @cached_property
    def identity(self) -> str:
        """Returns a hash of the tracks, their model and the priors."""
        plain = [dict(self.model.provenance), self.sd_m, asdict(self.camera)]
        digest = hashlib.sha256(json.dumps(plain, sort_keys=True, default=str).encode())
        for array in (self.markers.time_s, self.markers.position_m):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()
