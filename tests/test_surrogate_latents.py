"""Gaussian processes and sparse chaos of single latents against closed formulas."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.polynomial.legendre import leggauss
from scipy.optimize import check_grad
from scipy.stats import qmc

from bayeskin import storage
from bayeskin.polynomials import legendre_basis, multi_indices
from bayeskin.shipped import shipped
from bayeskin.surrogates import subspace
from bayeskin.surrogates.chaos import LatentChaos, fit_sparse
from bayeskin.surrogates.gp import LatentGPs
from bayeskin.surrogates.hyperparameters import LatentFit, TrainingData, fit_latent, restricted_likelihood
from bayeskin.surrogates.kernels import KERNELS, kernel, squared_distances, trend_basis, trend_degree
from bayeskin.surrogates.shapes import split
from bayeskin.surrogates.similarity import Similarity
from bayeskin.surrogates.subspace import SubspaceSettings
from bayeskin.types import Design


def test_fits_of_few_rows_are_off_by_what_they_state():
    rng = np.random.default_rng(11)
    squares = []
    for _ in range(40):
        bend, unit, fresh = rng.standard_normal((4, 4)), rng.uniform(size=(8, 4)), rng.uniform(size=(20, 4))
        target, truth = (
            np.sum(((x - 0.5) @ bend) * (x - 0.5), axis=1) + 0.3 * x @ bend[0] for x in (unit, fresh)
        )
        fit = fit_latent(unit, target, np.ones(8))
        mean, variance = LatentGPs.assemble(unit, target[:, None], [fit]).predict(fresh)
        squares.append((np.mean((mean[:, 0] - truth) ** 2), np.mean(variance)))
    missed, stated = np.sqrt(np.mean(squares, axis=0))
    assert 0.7 * stated < missed < 1.5 * stated  # lengths and directions of their own: 0.13


@pytest.mark.parametrize("name", KERNELS)
def test_likelihood_gradient_is_its_finite_difference(name):
    rng = np.random.default_rng(4)
    unit = rng.random((30, 3))
    data = TrainingData(unit - 0.5, trend_basis(unit, 1), np.sin(5 * unit[:, 0] + unit[:, 1]))
    x = np.append((np.eye(3) * 1.5 + 0.3 * rng.normal(size=(3, 3))).ravel(), np.log(1e-3))

    def value(x):
        return restricted_likelihood(name, x[:9].reshape(3, 3), np.exp(x[9]), data).value

    def gradient(x):
        at = restricted_likelihood(name, x[:9].reshape(3, 3), np.exp(x[9]), data)
        return np.append(at.by_map.ravel(), at.by_log_nugget)

    assert check_grad(value, gradient, x, epsilon=1e-6) < 1e-4 * np.linalg.norm(gradient(x))


def small_gp(name, rows=24):
    rng = np.random.default_rng(5)
    unit = rng.random((rows, 2))
    target = np.exp(unit[:, 0]) + np.sin(4 * unit[:, 1])
    fit = LatentFit(name, np.array([[1.5, 0.0], [0.7, 2.0]]), 1e-4, 0.0, 1.0)
    return LatentGPs.assemble(unit, target[:, None], [fit])


@pytest.mark.parametrize("name", KERNELS)
def test_gp_predicts_as_the_textbook_formulas(name):
    """Universal kriging solved as one bordered system, an independent route to mean and variance."""
    gp, points = small_gp(name), np.random.default_rng(6).random((7, 2))
    target = gp.targets[:, 0]
    scaled = (target - target.mean()) / target.std()
    map_ = gp.linear_maps[0]
    near = kernel(name, squared_distances(gp.inputs @ map_.T, gp.inputs @ map_.T))[0] + 1e-4 * np.eye(24)
    cross = kernel(name, squared_distances(points @ map_.T, gp.inputs @ map_.T))[0]
    degree = trend_degree(24, 2)
    basis, at = trend_basis(gp.inputs, degree), trend_basis(points, degree)
    p = basis.shape[1]
    bordered = np.linalg.inv(np.block([[near, basis], [basis.T, np.zeros((p, p))]]))
    both = np.hstack([cross, at])
    mean = both @ bordered[:, :24] @ scaled
    process = scaled @ bordered[:24, :24] @ scaled / (24 - p)
    variance = process * (1 + 1e-4 - np.einsum("ij,jk,ik->i", both, bordered, both))
    prediction = gp.predict(points)
    np.testing.assert_allclose(prediction[0][:, 0], target.mean() + target.std() * mean, rtol=1e-7)
    np.testing.assert_allclose(prediction[1][:, 0], target.var() * variance, rtol=1e-4)


@pytest.mark.parametrize("nugget", [1e-2, 1.0])
def test_a_variance_from_few_directions_is_hardly_larger_and_never_smaller(nugget, monkeypatch):
    rng = np.random.default_rng(8)
    unit, points = rng.random((300, 3)), rng.random((500, 3))
    targets = np.sin(unit @ rng.normal(size=(3, 4)))
    maps = np.tril(rng.normal(size=(4, 3, 3))) + 2 * np.eye(3)
    names = ("gaussian", "matern52", "gaussian", "gaussian")
    fits = [
        LatentFit(name, map_, own, 0.0, 1.3)
        for name, map_, own in zip(names, maps, (nugget, nugget, 1e-9, 10 * nugget), strict=True)
    ]
    gps = LatentGPs.assemble(unit, targets, fits)
    assert [conditioned.few is None for conditioned in gps.conditioned] == [False, nugget < 1.0, True, False]
    prediction = gps.predict(points)
    monkeypatch.setattr(subspace, "SUBSPACE", SubspaceSettings(least_rows=1000))
    exact = LatentGPs.assemble(unit, targets, fits).predict(points)
    np.testing.assert_allclose(prediction[0], exact[0], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(gps.predict_mean(points), exact[0], rtol=1e-9, atol=1e-9)
    ratio = prediction[1] / exact[1]
    assert ratio.min() > 1.0 - 1e-9
    assert ratio.max() < 1.3
    assert ratio.mean() < 1.03


def test_latents_of_two_kernels_are_predicted_together_as_each_by_itself():
    rng = np.random.default_rng(7)
    unit, points = rng.random((41, 3)), rng.random((300, 3))
    targets = np.sin(unit @ rng.normal(size=(3, 3)))
    maps = np.tril(rng.normal(size=(3, 3, 3))) + 2 * np.eye(3)
    names = ("matern52", "gaussian", "matern52")
    fits = [LatentFit(name, map_, 1e-4, 0.0, 1.3) for name, map_ in zip(names, maps, strict=True)]
    together = LatentGPs.assemble(unit, targets, fits).predict(points)
    for j, fit in enumerate(fits):
        alone = LatentGPs.assemble(unit, targets[:, j : j + 1], [fit]).predict(points)
        for joint, expected in zip(together, alone, strict=True):
            np.testing.assert_allclose(joint[:, j], expected[:, 0], rtol=1e-9)


def test_gp_leave_one_out_is_the_gp_without_the_row():
    gp = small_gp("matern52")
    mean, variance = gp.leave_one_out()
    degree = gp.degree
    without = replace(gp, inputs=gp.inputs[1:], targets=gp.targets[1:])
    assert without.degree == degree
    left_mean, left_variance = without.predict(gp.inputs[:1])
    assert mean[0, 0] == pytest.approx(left_mean[0, 0], rel=1e-6)
    # the process's variance is re-estimated without the row; the shape of the variance is the same
    ratio = (without.conditioned[0].variance * without.conditioned[0].deviation ** 2) / (
        gp.conditioned[0].variance * gp.conditioned[0].deviation ** 2
    )
    assert variance[0, 0] * ratio == pytest.approx(left_variance[0, 0], rel=1e-4)


def test_gp_finds_an_oblique_direction():
    unit = qmc.Sobol(4, seed=2).random_base2(6)
    target = np.tanh(6.0 * (unit[:, 0] - unit[:, 1]))
    fit = fit_latent(unit, target, np.ones(len(unit)))
    value = np.linalg.norm(fit.linear_map @ np.array([1, 1, 0, 0])) / np.linalg.norm(
        fit.linear_map @ np.array([1, -1, 0, 0])
    )
    assert value < 0.25  # axis-aligned lengths would give 1
    assert np.sqrt(fit.error) < 0.03


def test_all_rows_teach_the_hyperparameters():
    """The amplitude of 64 held-out runs of the article's protocol: by the hyperparameters that every other of
    its rows makes, it errs by 0.76e-3."""
    design = storage.load(shipped("surrogates/healthy-skin-reaction-design.h5"), Design)
    similarity = Similarity(design.space)
    inputs, target = similarity.inputs(design.theta), split(design.force_n)[0]
    target = target - similarity.log_scale(design.theta)
    learnt, seen = target[design.training], inputs[design.training]
    fit = fit_latent(seen, learnt, np.ones(len(learnt)))
    predicted = LatentGPs.assemble(seen, learnt[:, None], [fit]).predict_mean(inputs[design.testing])[:, 0]
    assert np.sqrt(np.mean((predicted - target[design.testing]) ** 2)) < 0.35e-3


def test_hyperbolic_sets_hold_what_they_should():
    assert len(multi_indices(3, 4, norm=1.0)) == 35  # binomial(7, 3)
    assert [tuple(row) for row in multi_indices(2, 2, norm=0.75)] == [(0, 0), (0, 1), (1, 0), (0, 2), (2, 0)]


def test_legendre_terms_are_orthonormal_under_the_prior():
    nodes, weights = leggauss(8)
    x, y = np.meshgrid(nodes, nodes)
    unit = 0.5 + 0.5 * np.column_stack([x.ravel(), y.ravel()])
    weight = np.outer(weights, weights).ravel() / 4
    basis = legendre_basis(unit, multi_indices(2, 6))
    np.testing.assert_allclose(basis.T @ (weight[:, None] * basis), np.eye(basis.shape[1]), atol=1e-12)


def test_sparse_chaos_finds_a_sparse_polynomial_exactly():
    unit = qmc.Sobol(4, seed=2).random_base2(6)
    terms = np.array([[0, 0, 0, 0], [2, 0, 0, 0], [0, 1, 1, 0]])
    target = legendre_basis(unit, terms) @ np.array([1.0, 0.5, -2.0])
    fit = fit_sparse(unit, target, np.ones(len(unit)))
    assert fit.error < 1e-20
    assert {tuple(row) for row in terms} <= {tuple(row) for row in fit.indices}
    latents = LatentChaos.assemble(unit, target[:, None], [fit])
    fresh = np.random.default_rng(0).random((20, 4))
    np.testing.assert_allclose(
        latents.predict(fresh)[0][:, 0], legendre_basis(fresh, terms) @ [1.0, 0.5, -2.0], atol=1e-10
    )


def test_chaos_leave_one_out_is_the_regression_without_the_row():
    rng = np.random.default_rng(3)
    unit = rng.random((40, 2))
    target = np.exp(unit @ [1.0, 2.0])
    latents = LatentChaos.assemble(unit, target[:, None], [fit_sparse(unit, target, np.ones(40))])
    basis = legendre_basis(unit, latents.indices)
    coefficients = np.linalg.lstsq(basis[1:], target[1:], rcond=None)[0]
    assert latents.leave_one_out()[0][0, 0] == pytest.approx(float(basis[0] @ coefficients), rel=1e-9)


@pytest.mark.parametrize("kind", ["gp", "chaos"])
def test_cross_validated_error_of_a_latent_is_that_of_fresh_points(kind):
    rng = np.random.default_rng(8)

    def function(unit):
        return np.log(np.exp(5 * unit[:, 0]) + np.exp(4 * unit[:, 1])) + 0.3 * np.sin(3 * unit[:, 2])

    unit, fresh = qmc.Sobol(5, seed=4).random_base2(6), rng.random((400, 5))
    target = function(unit)
    if kind == "gp":
        fit = fit_latent(unit, target, np.ones(len(unit)))
        prediction = LatentGPs.assemble(unit, target[:, None], [fit]).predict(fresh)[0][:, 0]
    else:
        fit = fit_sparse(unit, target, np.ones(len(unit)))
        prediction = LatentChaos.assemble(unit, target[:, None], [fit]).predict(fresh)[0][:, 0]
    ratio = np.sqrt(np.mean((prediction - function(fresh)) ** 2) / fit.error)
    assert 1 / 2.5 < ratio < 2.5
