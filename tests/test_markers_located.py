"""Markers that move otherwise than a fit says are located on the skin; a surrogate of their displacements."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from toys.inference_problems import NOISE, TRUTH, toy_problem

from bayeskin.design import default_space
from bayeskin.errors import InputError
from bayeskin.geometry import Geometry
from bayeskin.inference.marker_error import mesh_correction, smooth_errors
from bayeskin.inference.marker_likelihood import CameraMotion, MarkerLikelihood
from bayeskin.mismatch.on_skin import OnSkin, on_skin, strains
from bayeskin.report import figure_on_skin
from bayeskin.surrogates.marker_surrogate import train_marker_surrogate
from bayeskin.types import Array, Markers, PadMotion, ParameterSpace

MOTION = PadMotion(np.array([0.0, 2.0, 12.0, 20.0]), 1e-3 * np.array([0.0, 0.0, 5.0, 5.0]))
TICKS = 1e-3 * np.linspace(-12.0, 12.0, 7)
PLACES_M = np.stack(np.meshgrid(TICKS, TICKS, indexing="ij"), axis=-1).reshape(-1, 2)
AT_S = np.arange(0.0, 20.1, 1.0)
SD_M = 1e-5


@dataclass(frozen=True)
class Still:
    """A model whose points stretch with the pads, whatever the parameters are."""

    space: ParameterSpace

    @property
    def provenance(self) -> dict[str, Any]:
        return {}

    def predict_m(self, theta: Array) -> Array:
        moved = np.multiply.outer(MOTION.at(AT_S[1:]) / 36e-3, PLACES_M * [1.0, -0.3])
        return np.repeat(moved[None], len(np.atleast_2d(theta)), axis=0)


def fit_with(missing_m: Array) -> Any:
    """A fit whose markers lack a field (p, 2) [m] at the largest opening, and shake with their camera."""
    posterior, rng = toy_problem(), np.random.default_rng(8)
    model = Still(posterior.surrogate.space)
    share = MOTION.at(AT_S[1:]) / 5e-3
    moved = model.predict_m(np.zeros((1, 5)))[0] + share[:, None, None] * missing_m
    moved = moved + 2e-4 * rng.standard_normal((len(share), 1, 2)) + SD_M * rng.standard_normal(moved.shape)
    position_m = PLACES_M + np.concatenate([np.zeros((1, *PLACES_M.shape)), moved])
    markers = Markers(AT_S, position_m, tuple(str(i) for i in range(len(PLACES_M))), "toy", "0")
    errors_m = smooth_errors(markers, MOTION, 36e-3)
    likelihood = MarkerLikelihood(markers, model, np.zeros_like(moved), errors_m, CameraMotion(1e-3, 0.02))
    theta = {**TRUTH, **NOISE, "marker_sd": SD_M}
    return SimpleNamespace(log_posterior=replace(posterior, markers=likelihood), theta=theta)


def located_with(missing_m: Array) -> OnSkin | None:
    fit = fit_with(missing_m)
    return on_skin(fit.log_posterior, fit.theta, MOTION)


def test_where_nothing_is_missing_no_point_is_significant() -> None:
    located = located_with(np.zeros_like(PLACES_M))
    assert located is not None
    assert not located.significant.any()
    assert on_skin(toy_problem(), {}, MOTION) is None


def test_skin_that_does_not_stretch_is_found_where_it_is() -> None:
    """A patch that hardly stretches: the points in it stay with its middle."""
    middle, radius = np.array([4e-3, 4e-3]), 8.5e-3
    inside = np.linalg.norm(PLACES_M - middle, axis=1) < radius
    stretch = 5.0 / 36.0
    missing_m = np.where(inside[:, None], -stretch * (PLACES_M - middle), 0.0)
    located = located_with(missing_m)
    assert located is not None
    assert located.significant.sum() >= 3
    assert inside[located.significant].mean() > 0.7
    assert np.mean(located.strain[inside, 0]) < np.mean(located.strain[~inside, 0]) - 0.02
    figure = figure_on_skin(located, Geometry(), [1e-3 * np.array([[0.0, 0.0], [1.0, 1.0]])])
    assert f"At {located.significant.sum()} of 49 points" in figure.get_suptitle()


def test_strains_are_the_slopes_of_a_field_even_with_a_wrong_track() -> None:
    rng, places_m = np.random.default_rng(2), np.random.default_rng(1).uniform(-1e-2, 1e-2, (200, 2))
    vectors_m = places_m @ np.array([[0.05, 0.01], [0.03, -0.02]]) + 1e-7 * rng.standard_normal((200, 2))
    vectors_m[17] += 1e-3
    expected = np.broadcast_to([0.05, -0.02, 0.02], (200, 3))
    np.testing.assert_allclose(strains(places_m, vectors_m), expected, atol=2e-3)
    assert np.isnan(strains(places_m[:5], vectors_m[:5])).all()


def test_the_errors_of_displacements_have_the_symmetry_of_the_test() -> None:
    markers = fit_with(np.zeros_like(PLACES_M)).log_posterior.markers.markers
    errors_m = smooth_errors(markers, MOTION, 36e-3)
    mirrored = np.array(
        [int(np.argmin(np.sum((PLACES_M - place * [-1, 1]) ** 2, axis=1))) for place in PLACES_M]
    )
    np.testing.assert_allclose(errors_m[:, :, mirrored], errors_m * [-1.0, 1.0], atol=1e-12)
    rms = np.sqrt(np.mean(np.sum(errors_m[:, -1] ** 2, axis=0)))
    assert 0.0012 < rms / 2.5e-3 < 0.00151  # of a pad's displacement
    assert np.all(errors_m[:, 0] == 0.0)  # before the pads open


def test_a_finer_mesh_lacks_less() -> None:
    markers = fit_with(np.zeros_like(PLACES_M)).log_posterior.markers.markers
    with pytest.raises(InputError, match="error of the mesh is not known"):
        mesh_correction(markers, 1)
    known = replace(markers, mesh_change_m=np.full((20, 49, 2), -1e-5))
    (usual, sd), (finer, _) = mesh_correction(known, 1), mesh_correction(known, 2)
    np.testing.assert_allclose(usual, -2.5e-6)
    np.testing.assert_allclose(sd, -6e-7)
    np.testing.assert_allclose(finer, 0.22 * usual)


def test_a_surrogate_of_displacements_knows_that_they_do_not_scale() -> None:
    """Displacements that depend on the ratio of the moduli, and weakly on a permeability times a modulus."""
    space, rng = default_space(), np.random.default_rng(3)
    shapes_m = 1e-4 * rng.standard_normal((2, 4, 6, 2))

    def moved_m(theta: Array) -> Array:
        ratio, flow = np.log(theta[:, 1] / theta[:, 0]), np.log10(theta[:, 3] * theta[:, 0] / 1e-8)
        scores = np.stack([np.tanh(0.3 * ratio), 0.2 * np.sin(0.5 * flow)], axis=1)
        return np.tensordot(scores, shapes_m, 1)

    theta = space.draw(rng, 120)
    surrogate = train_marker_surrogate(space, theta, moved_m(theta), np.ones(120), {})
    new = space.draw(rng, 40)
    off_m = surrogate.predict_m(new) - moved_m(new)
    assert np.sqrt(np.mean(off_m**2)) < 2e-6
    assert np.sqrt(np.mean(off_m**2)) == pytest.approx(surrogate.rms_error_m, rel=1.5)
    stiffer = np.clip(new * [2.0, 2.0, 0.5, 0.5, 1.0], space.lower, space.upper)
    inside = np.all(stiffer == new * [2.0, 2.0, 0.5, 0.5, 1.0], axis=1)
    scaled, plain = surrogate.predict_m(stiffer[inside]), surrogate.predict_m(new[inside])
    np.testing.assert_allclose(scaled, plain, atol=1e-9)
