"""Tests of the error of the full model: its shapes, its place in the posterior, the models with it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import multivariate_normal
from toys import closed_form_model
from toys.inference_problems import NOISE, TRUTH, ToySurrogate, toy_problem

from bayeskin.finite_element.accuracy import mesh_error
from bayeskin.finite_element.simulate import ModelSpec
from bayeskin.forward.posterior import UNKNOWN_MESH, model_error
from bayeskin.inference.model_error import ErrorSizes, ModelError, relaxing
from bayeskin.inference.noise_model import noise_covariance

SIZES = ErrorSizes()


def test_the_mesh_s_error_is_a_factor_and_a_bend_of_the_force_and_what_relaxes() -> None:
    skin = ToySurrogate()
    theta = np.array([list(TRUTH.values())] * 2)
    plain = skin.predict(theta)
    allowed = ModelError(closed_form_model.MOTION, skin.edges_s, 0.004).beside(plain)
    np.testing.assert_array_equal(allowed.mean, plain.mean)
    new = allowed.factor[0, :, plain.factor.shape[2] :]
    np.testing.assert_allclose(new[:, 0], 0.004 * plain.mean[0])
    middle = 0.5 * (skin.edges_s[1:] + skin.edges_s[:-1])
    top, bottom = (
        np.argmax(closed_form_model.MOTION.at(middle)),
        np.argmin(closed_form_model.MOTION.at(middle)),
    )
    np.testing.assert_allclose(new[[top, bottom], 1], SIZES.bend * plain.mean[0, [top, bottom]] * [1, -1])
    relaxed = relaxing(closed_form_model.MOTION, middle, SIZES.relaxation_s)
    np.testing.assert_allclose(new[:, 2:].T, SIZES.relaxing * plain.mean[0].max() * relaxed)


def test_what_relaxes_is_the_answer_of_a_spring_and_a_dashpot() -> None:
    """dr/dt = d(d / max d)/dt - r / tau, integrated in short steps."""
    step_s = 1e-3
    time_s = np.arange(0.0, closed_form_model.MOTION.time_s[-1], step_s)
    share = closed_form_model.MOTION.at(time_s) / closed_form_model.MOTION.displacement_m.max()
    relaxed = relaxing(closed_form_model.MOTION, time_s, SIZES.relaxation_s)
    for computed, tau in zip(relaxed, SIZES.relaxation_s, strict=True):
        decay, slow = np.exp(-step_s / tau), np.exp(-0.5 * step_s / tau)
        by_steps = lfilter([slow], [1.0, -decay], np.diff(share, prepend=share[0]))
        np.testing.assert_allclose(computed, by_steps, atol=2e-4)


def test_it_is_a_normal_error_of_the_force_in_the_likelihood() -> None:
    """For noise of Gaussian tails, its covariance adds to those of the noise and the surrogate."""
    problem = toy_problem()
    error = ModelError(closed_form_model.MOTION, problem.binned.edges_s, 0.01)
    theta = np.array([[*TRUTH.values(), *NOISE.values()]])
    theta[0, -1] = np.inf
    own = problem.surrogate.predict(theta[:, :5])
    factor = error.beside(own).factor[0]
    noise = noise_covariance(problem.chain, theta[0, 5:], own.diagonal[0])
    exact = multivariate_normal(own.mean[0], noise + factor @ factor.T).logpdf(problem.binned.force_n)
    allowing = dataclasses.replace(problem, model_error=error)
    assert allowing.log_likelihood(theta)[0] == pytest.approx(exact, rel=1e-8)
    assert allowing.log_likelihood(theta)[0] != pytest.approx(problem.log_likelihood(theta)[0], abs=0.1)
    known = allowing.of_full_model(own.mean)
    np.testing.assert_allclose(known.factor[0, :, 1:], factor[:, own.factor.shape[2] :])


def test_chains_of_a_posterior_without_it_are_those_of_another() -> None:
    problem = toy_problem()
    errors = [ModelError(closed_form_model.MOTION, problem.binned.edges_s, sd) for sd in (0.01, 0.02)]
    problems = [problem, *(dataclasses.replace(problem, model_error=error) for error in errors)]
    assert len({posterior.identity["model error"] for posterior in problems}) == 3


def test_a_model_s_error_is_no_doubt_about_its_surrogate() -> None:
    """The limit to a surrogate's own sd holds for that alone."""
    problem = toy_problem()
    error = ModelError(closed_form_model.MOTION, problem.binned.edges_s, 0.5)
    theta = np.array([[*TRUTH.values(), *NOISE.values()]])
    sure = dataclasses.replace(problem, model_error=error, sure_within_n=2e-3)
    assert not sure.impossible(theta, sure.predict(theta)).any()
    unsure = dataclasses.replace(sure, sure_within_n=1e-4)
    assert unsure.impossible(theta, unsure.predict(theta)).all()


def test_the_mesh_and_the_load_cell_are_allowed_for_where_the_force_is_the_pad_s() -> None:
    edges_s = np.linspace(0.0, 10.0, 21)
    spec = ModelSpec()
    known = mesh_error(spec.mesh_hash)
    error = model_error(spec, closed_form_model.MOTION, edges_s)
    assert known is not None
    assert error is not None
    assert error.amplitude == pytest.approx(np.hypot(known.rms, SIZES.calibration))
    longer = dataclasses.replace(spec.geometry, gauge_m=0.04)
    other = model_error(ModelSpec(geometry=longer), closed_form_model.MOTION, edges_s)
    assert other is not None
    assert other.amplitude == pytest.approx(np.hypot(UNKNOWN_MESH, SIZES.calibration))
    assert model_error(ModelSpec("article", "some.msh"), closed_form_model.MOTION, edges_s) is None
