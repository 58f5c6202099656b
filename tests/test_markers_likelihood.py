"""The likelihood of tracks: white noise, the camera's motion, and the joint posterior with the force."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.stats import multivariate_normal
from toys.inference_problems import NOISE, TRUTH, toy_problem

from bayeskin.inference import LogPosterior
from bayeskin.inference.gauss_newton import gauss_newton
from bayeskin.inference.marker_gain import widened_without_markers
from bayeskin.inference.marker_likelihood import CameraMotion, MarkerLikelihood
from bayeskin.types import Array, Markers, ParameterSpace

PLACES_M = 1e-3 * np.array([[-12.0, 3.0], [12.0, 3.0], [0.0, -6.5], [9.5, 0.25], [14.0, 7.0]])
CAMERA = CameraMotion(3e-4, 0.01)
SD_M = 2e-5


@dataclass(frozen=True)
class Linear:
    """Displacements that are linear in the logarithms of two parameters."""

    space: ParameterSpace
    shapes_m: Array  # (2, t - 1, p, 2)

    @property
    def provenance(self) -> Mapping[str, Any]:
        return {"toy": "linear"}

    def predict_m(self, theta: ArrayLike) -> Array:
        line = np.log(np.atleast_2d(np.asarray(theta, dtype=float)))[:, :2]
        return np.einsum("nd,dtpi->ntpi", line, self.shapes_m)


def likelihood(space: ParameterSpace, theta: Array, lost: bool = True) -> MarkerLikelihood:
    """Four images of five points, which the camera's motion moves too; one point is lost in two of them."""
    rng = np.random.default_rng(4)
    model = Linear(space, 3e-3 * rng.standard_normal((2, 3, 5, 2)))
    move_m = CAMERA.translation_m * rng.standard_normal((3, 1, 2))
    turn = CAMERA.rotation_rad * rng.standard_normal((3, 1, 1)) * (PLACES_M[:, ::-1] * [-1.0, 1.0])
    moved_m = model.predict_m(theta)[0] + move_m + turn + SD_M * rng.standard_normal((3, 5, 2))
    if lost:
        moved_m[1:, 2] = np.nan
    position_m = PLACES_M + np.concatenate([np.zeros((1, 5, 2)), moved_m])
    markers = Markers(np.arange(4.0), position_m, tuple("abcde"), "toy", "0")
    errors_m = 2e-5 * rng.standard_normal((2, 3, 5, 2))
    return MarkerLikelihood(markers, model, np.zeros((3, 5, 2)), errors_m, CAMERA)


@pytest.fixture(scope="module")
def joint() -> tuple[LogPosterior, Array]:
    """A posterior of force and markers, and the true parameters."""
    log_posterior, theta = toy_problem(), np.array([*TRUTH.values(), *NOISE.values()])
    markers = likelihood(log_posterior.surrogate.space, theta[:5])
    return replace(log_posterior, markers=markers), theta


def covariance(places_m: Array, sd_m: float) -> Array:
    shapes = np.zeros((len(places_m), 2, 3))
    shapes[:, 0, 0] = shapes[:, 1, 1] = CAMERA.translation_m
    shapes[:, 0, 2], shapes[:, 1, 2] = (
        -CAMERA.rotation_rad * places_m[:, 1],
        CAMERA.rotation_rad * places_m[:, 0],
    )
    flat = shapes.reshape(-1, 3)
    return flat @ flat.T + sd_m**2 * np.eye(len(flat))


def whole(markers: MarkerLikelihood) -> Array:
    """The covariance of all coordinates of all images, (30, 30)."""
    errors = markers.errors_m.reshape(2, -1)
    return np.kron(np.eye(3), covariance(PLACES_M, SD_M)) + errors.T @ errors


def test_the_density_is_that_of_the_whole_covariance(joint: tuple[LogPosterior, Array]) -> None:
    markers, theta = joint[0].markers, joint[1]
    assert markers is not None
    predicted_m = markers.model.predict_m(theta[:5])
    observed_m = markers.markers.displacement_m
    seen = np.isfinite(observed_m).ravel()
    difference = (observed_m - predicted_m[0]).ravel()[seen]
    expected = multivariate_normal(cov=whole(markers)[np.ix_(seen, seen)]).logpdf(difference)
    density = markers.log_density(predicted_m, np.array([SD_M]))
    assert float(density[0]) == pytest.approx(expected, abs=1e-8)


def test_whitened_columns_have_the_inverse_covariance(joint: tuple[LogPosterior, Array]) -> None:
    markers = joint[0].markers
    assert markers is not None
    columns = np.random.default_rng(2).standard_normal((3, 10, 4))
    white = markers.whitened(columns, SD_M).reshape(30, 4)
    seen = np.isfinite(markers.markers.displacement_m).ravel()
    inverse = np.linalg.inv(whole(markers)[np.ix_(seen, seen)])
    flat = columns.reshape(30, 4)[seen]
    np.testing.assert_allclose(white.T @ white, flat.T @ inverse @ flat, rtol=1e-6)


def test_a_free_camera_hides_the_mean_displacement(joint: tuple[LogPosterior, Array]) -> None:
    theta = joint[1][:5]
    markers = likelihood(joint[0].surrogate.space, theta, lost=False)
    free = replace(markers, camera=CameraMotion(1.0, 1.0))
    predicted_m = markers.model.predict_m(theta)
    shifted_m = predicted_m + 5e-4
    sd_m = np.array([SD_M])
    lost = free.log_density(predicted_m, sd_m) - free.log_density(shifted_m, sd_m)
    assert abs(float(lost[0])) < 1e-3
    held = replace(markers, camera=CameraMotion(1e-9, 1e-9))
    assert float((held.log_density(predicted_m, sd_m) - held.log_density(shifted_m, sd_m))[0]) > 1000.0
    left = free.without_camera(shifted_m[0], SD_M)
    np.testing.assert_allclose(left.mean(axis=1), 0.0, atol=1e-10)
    assert np.sqrt(np.mean(left**2)) < 2.0 * SD_M


def test_one_density_has_force_and_markers(joint: tuple[LogPosterior, Array]) -> None:
    log_posterior, theta = joint
    both = np.concatenate([theta, [SD_M]])
    assert log_posterior.names[-1] == "marker_sd"
    assert log_posterior.split(both)[1].shape == log_posterior.split(theta)[1].shape
    alone = replace(log_posterior, markers=None)
    markers = log_posterior.markers
    assert markers is not None
    of_markers = markers.log_density(markers.model.predict_m(theta[:5]), np.array([SD_M]))
    np.testing.assert_allclose(
        log_posterior.log_likelihood(both), alone.log_likelihood(theta) + of_markers, atol=1e-9
    )
    assert log_posterior.identity != alone.identity


def test_a_climb_uses_the_markers_slopes(joint: tuple[LogPosterior, Array]) -> None:
    log_posterior, theta = joint
    start = log_posterior.to_sampling(np.concatenate([theta, [5 * SD_M]]))
    top = gauss_newton(log_posterior, start, None)
    low, high = log_posterior.bounds
    width, unit = high - low, (top.vector - low) / (high - low)
    for column in (*range(2), len(low) - 1):  # stationary, as differences of the density show
        step = 1e-4 * np.eye(len(low))[column]
        points = low + np.array([unit + step, unit - step]) * width
        up, down = log_posterior.log_prob(points)
        assert abs(up - down) / 2e-4 < 5.0
    alone = gauss_newton(replace(log_posterior, markers=None), start[:-1], None)
    assert top.information[0, 0] > 1.5 * alone.information[0, 0]
    sd_m = log_posterior.from_sampling(top.vector)[-1]
    assert SD_M / 1.6 < sd_m < 1.6 * SD_M


def test_without_the_markers_a_parameter_is_as_much_wider_as_their_information_says(
    joint: tuple[LogPosterior, Array],
) -> None:
    log_posterior, theta = joint
    values = dict(zip(log_posterior.names, map(float, np.concatenate([theta, [SD_M]])), strict=True))
    widens = widened_without_markers(log_posterior, values)
    assert list(widens) == list(log_posterior.surrogate.space.names)
    vector = log_posterior.vector(values)
    both = gauss_newton(log_posterior, vector, None, 0).information[:5, :5]
    force = gauss_newton(replace(log_posterior, markers=None), vector[:-1], None, 0).information[:5, :5]
    sds = [np.sqrt(np.diag(np.linalg.inv(known + 12.0 * np.eye(5)))) for known in (force, both)]
    np.testing.assert_allclose(list(widens.values()), sds[0] / sds[1], rtol=1e-6)
    assert widens["E_c"] > 1.2  # the points move with the first two parameters
    assert log_posterior.markers is not None
    still = Linear(log_posterior.surrogate.space, np.zeros((2, 3, 5, 2)))
    blind = replace(log_posterior, markers=replace(log_posterior.markers, model=still))
    unmoved = widened_without_markers(blind, values)
    np.testing.assert_allclose(list(unmoved.values()), 1.0, rtol=1e-6)
