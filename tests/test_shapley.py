"""Shapley effects against closed forms: a correlated Gaussian, Ishigami, and parameters without effect."""

import numpy as np
import pytest
from toys.ishigami import ONE_BIN, box, ishigami, ishigami_indices

from bayeskin.sensitivity.shapley import shapley


@pytest.mark.parametrize("rho", [-0.9, 0.0, 0.6])
def test_a_linear_force_of_correlated_inputs(rho):
    """Owen & Prieur (2017), SIAM/ASA J. Uncertainty Quantification 5:986, section 3."""
    rng, slope, sd = np.random.default_rng(1), np.array([2.0, 1.0]), np.array([0.05, 0.08])
    covariance = np.outer(sd, sd) * np.array([[1.0, rho], [rho, 1.0]])
    theta = rng.multivariate_normal([0.5, 0.5], covariance, 4000)
    effects = shapley(box(2, 0.0, 1.0), theta, theta @ slope[:, None], ONE_BIN, rng, "Gaussian")
    part, cross = slope**2 * sd**2, rho * np.prod(slope * sd)
    exact = part * (1 - rho**2 / 2) + cross + part[::-1] * rho**2 / 2
    np.testing.assert_allclose(effects.effects, exact / (part.sum() + 2 * cross), atol=0.03)
    assert effects.effects.sum() == pytest.approx(1.0)
    assert np.all((effects.interval[0] <= effects.effects) & (effects.effects <= effects.interval[1]))


@pytest.mark.parametrize("rho", [-0.95, -0.9996])
def test_parameters_without_effect_have_no_share_beside_a_ridge(rho):
    """Two whose sum is what the force hangs on share it evenly, however narrow their ridge is."""
    rng, narrow = np.random.default_rng(6), np.sqrt(0.5 * (1.0 + rho))
    along, across = rng.normal(size=(2, 2000, 1)) * [[[np.sqrt(0.5 * (1.0 - rho))]], [[narrow]]]
    theta = 0.5 + 0.05 * np.hstack([across + along, across - along, rng.normal(size=(2000, 3))])
    force = np.tanh(10.0 * theta[:, :2].sum(axis=1, keepdims=True) - 9.0)
    effects = shapley(box(5, 0.0, 1.0), theta, force, ONE_BIN, rng, "a ridge")
    np.testing.assert_allclose(effects.effects, [0.5, 0.5, 0.0, 0.0, 0.0], atol=0.02)


def test_independent_inputs_share_their_interactions_evenly():
    rng = np.random.default_rng(2)
    theta = rng.uniform(-np.pi, np.pi, (6000, 3))
    effects = shapley(box(3, -np.pi, np.pi), theta, ishigami(theta), ONE_BIN, rng, "uniform")
    first, total = ishigami_indices()
    np.testing.assert_allclose(effects.effects, 0.5 * (first + total), atol=0.04)


def test_bins_weigh_by_their_variance_and_width():
    rng = np.random.default_rng(3)
    theta = rng.uniform(0.0, 1.0, (3000, 2))
    force = np.column_stack([theta[:, 0], 2.0 * theta[:, 1]])
    effects = shapley(box(2, 0.0, 1.0), theta, force, np.array([0.0, 8.0, 10.0]), rng, "uniform")
    np.testing.assert_allclose(effects.effects, [0.5, 0.5], atol=0.03)  # 8 x 1 against 2 x 4


def test_without_variance_there_is_no_share_and_no_warning():
    theta = np.random.default_rng(4).uniform(0.0, 1.0, (50, 2))
    effects = shapley(box(2, 0.0, 1.0), theta, np.ones((50, 3)), np.arange(4.0), np.random.default_rng(5), "")
    assert np.isnan(effects.effects).all()
