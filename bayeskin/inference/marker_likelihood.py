"""Log-likelihood of tracks of markers: white noise, and a rigid motion of the camera in each image.

The displacements of the visible points in an image, since the first image, are

    d = u(theta) + m + E z + B c + e ,   e ~ N(0, s^2 I) ,   c ~ N(0, S) ,   z ~ N(0, I)

where u is the model's displacement, m corrects it for the mesh, and the columns of E are its errors. The
three columns of B are a unit translation along x, one along y, and a unit rotation about the origin. The
motion c of the camera is not known. It is integrated out, with its prior covariance S = diag(t^2, t^2, r^2).
With the singular value decomposition of B S^(1/2), the inverse and the determinant of C = s^2 I + B S B' take
a few sums for each image. The errors z are common to all images, and are integrated out too: the covariance
of d - u over all images is C + E E' (Woodbury's identity, twice). A camera that may move far hides the mean
displacement and the mean rotation of the points.

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

from bayeskin.types import Array, Markers, ParameterSpace


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

    correction_m (t - 1, p, 2) : correction that is added to the model's displacements
    errors_m (r, t - 1, p, 2) : errors of the model's displacements, of one sd each
    camera : prior sd of the camera's motion in each image
    """

    markers: Markers
    model: PredictsMarkers
    correction_m: Array
    errors_m: Array
    camera: CameraMotion = CameraMotion()

    @cached_property
    def _errors(self) -> Array:
        """Returns the errors of the coordinates that were seen, and zeros elsewhere, (r, t - 1, 2 p)."""
        return np.asarray(self.errors_m.reshape(len(self.errors_m), *self._seen.shape) * self._seen)

    @cached_property
    def _errors_along(self) -> Array:
        """Returns the errors' parts along the shapes of the camera's motion, (r, t - 1, 3)."""
        return np.einsum("rtq,tqc->rtc", self._errors, self._camera[0], optimize=True)

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

    def predict_m(self, theta: Array, names: tuple[str, ...]) -> Array:
        """Returns corrected displacements (n, t - 1, p, 2) [m] at parameters (n, D) of these names."""
        return np.asarray(self.model.predict_m(self.columns(theta, names)) + self.correction_m)

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
        along = np.einsum("ntq,tqc->ntc", residual, shapes, optimize=True)
        white = sd_m[:, None] ** 2
        total = white[:, :, None] + variance  # (n, t - 1, 3)
        across = np.sum(residual**2, axis=2) - np.sum(along**2, axis=2)
        square = np.sum(across / white + np.sum(along**2 / total, axis=2), axis=1)
        free = self._seen.sum(axis=1) - 3.0
        log_scale = np.sum(free * np.log(white) + np.sum(np.log(total), axis=2), axis=1)
        explained, log_more = self._errors_explain(
            residual, along, white, 1.0 / white[:, :, None] - 1.0 / total
        )
        log_scale = log_scale + log_more
        return np.asarray(-0.5 * (square - explained + log_scale + self._seen.sum() * np.log(2.0 * np.pi)))

    def _errors_explain(
        self, residual: Array, along: Array, white: Array, less: Array
    ) -> tuple[Array, Array]:
        """Returns by how much the errors lower the exponent and raise the log determinant, (n,) each.

        residual (n, t - 1, 2 p), along (n, t - 1, 3) : residuals and their parts along the camera's motion
        white (n, 1) : variance of the noise; less (n, t - 1, 3) : precision that the camera's motion takes
        """
        n, rank = len(residual), len(self.errors_m)
        errors, errors_along = self._errors.reshape(rank, -1), self._errors_along.reshape(rank, -1)
        pairs = (errors_along[:, None] * errors_along).reshape(rank * rank, -1)
        gram = (errors @ errors.T) / white[:, :, None]
        gram = gram - (less.reshape(len(less), -1) @ pairs.T).reshape(-1, rank, rank)
        pull = (
            residual.reshape(n, -1) @ errors.T / white
            - (less * along).reshape(-1, pairs.shape[1]) @ errors_along.T
        )
        lower = np.linalg.cholesky(np.eye(rank) + gram)
        known = np.linalg.solve(lower, np.broadcast_to(pull, (len(lower), rank))[:, :, None])
        log_more = 2.0 * np.sum(np.log(np.diagonal(lower, axis1=1, axis2=2)), axis=1)
        return np.sum(known[:, :, 0] ** 2, axis=1), log_more

    def whitened(self, columns_m: Array, sd_m: float) -> Array:
        """Returns columns (t - 1, 2 p, c) [m] divided by the root of the covariance, in units of its sd.

        The sum of squares of a whitened residual is the exponent of the density. Coordinates that were not
        seen give zeros.
        """
        white = self._without_errors(columns_m, sd_m)
        errors = self._without_errors(self._errors.transpose(1, 2, 0), sd_m)
        shapes, size, _ = np.linalg.svd(errors.reshape(-1, len(self.errors_m)), full_matrices=False)
        flat = white.reshape(-1, white.shape[2])
        less = 1.0 / np.sqrt(1.0 + size**2) - 1.0
        return np.asarray((flat + shapes @ (less[:, None] * (shapes.T @ flat))).reshape(white.shape))

    def _without_errors(self, columns_m: Array, sd_m: float) -> Array:
        """Returns `whitened` columns for a model without errors."""
        shapes, variance = self._camera
        seen = columns_m * self._seen[:, :, None]
        along = np.einsum("tqk,tqc->tkc", shapes, seen, optimize=True)
        less = 1.0 / np.sqrt(sd_m**2 + variance) - 1.0 / sd_m
        turned = np.einsum("tqk,tkc->tqc", shapes, less[:, :, None] * along, optimize=True)
        return np.asarray(seen / sd_m + turned)

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
        plain = [dict(self.model.provenance), asdict(self.camera)]
        digest = hashlib.sha256(json.dumps(plain, sort_keys=True, default=str).encode())
        for array in (self.markers.time_s, self.markers.position_m, self.correction_m, self.errors_m):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()
