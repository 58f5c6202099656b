"""Components of a surrogate's shapes: the variance they leave, and errors that all bins share."""

from dataclasses import replace

import numpy as np
import pytest
from toys.trained_surrogates import DESIGN

from bayeskin import storage
from bayeskin.shipped import shipped
from bayeskin.surrogates import train
from bayeskin.surrogates.shapes import all_components, split
from bayeskin.types import Design


def test_components_and_their_truncation_account_for_all_variance():
    amplitude, shapes = split(DESIGN.force_n)
    np.testing.assert_allclose(np.exp(amplitude)[:, None] * shapes, DESIGN.force_n, rtol=1e-12)
    full, variances = all_components(shapes, np.ones(len(shapes)))
    kept = full.keep(2, shapes, np.ones(len(shapes)), fitted=3)
    expected = variances[2:].sum() * len(shapes) / (len(shapes) - 3)
    assert kept.truncation.sum() == pytest.approx(expected, rel=1e-10)
    latent = kept.encode(DESIGN.force_n)
    rest = DESIGN.force_n - kept.decode(latent, np.zeros_like(latent)).mean
    assert np.linalg.norm(rest) < 3e-3 * np.linalg.norm(DESIGN.force_n)


def test_what_components_leave_is_that_of_the_rows_that_count():
    rng = np.random.default_rng(4)
    shapes = np.concatenate([0.1 * rng.standard_normal((30, 50)), 3.0 * rng.standard_normal((30, 50))])
    none = all_components(shapes, np.ones(60))[0].keep(0, shapes, np.repeat([1.0, 1e-9], 30), fitted=0)
    assert none.truncation.mean() == pytest.approx(np.mean((shapes[:30] - none.mean) ** 2), rel=1e-6)


def test_a_shape_that_nothing_predicts_is_an_error_of_all_bins_together():
    rng = np.random.default_rng(8)
    shape = np.sin(np.linspace(0.0, 6.0, DESIGN.force_n.shape[1]))
    rms = np.sqrt(np.mean(DESIGN.force_n**2, axis=1))
    moved = DESIGN.force_n + 0.03 * (rms * rng.standard_normal(len(rms)))[:, None] * shape
    design = replace(DESIGN, force_n=moved)
    prediction = train(design, "gp")[0].predict(design.theta[design.held_out])
    assert np.mean(prediction.diagonal) < 0.05 * np.mean(prediction.sd() ** 2)


def test_what_is_left_to_the_noise_of_single_bins_is_next_to_nothing_of_the_error():
    design = storage.load(shipped("surrogates/demo-design.h5"), Design)
    prediction = train(design, "gp")[0].predict(design.theta[design.testing])
    assert np.mean(prediction.diagonal) < 0.01 * np.mean(prediction.sd() ** 2)
