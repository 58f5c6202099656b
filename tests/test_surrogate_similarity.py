"""Similarity of skins: forces scale with moduli, and surrogates obey the law exactly."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from toys.closed_form_model import SPACE, toy_bin_means
from toys.trained_surrogates import DESIGN

from bayeskin.design import default_space
from bayeskin.surrogates import train
from bayeskin.surrogates.similarity import Similarity
from bayeskin.types import ParameterSpace


def scaled(theta, factor):
    """The same skin in another unit of stress: moduli times `factor`, permeabilities over it."""
    return theta * factor ** np.array([1.0, 1.0, -1.0, -1.0, 0.0])


@given(factor=st.floats(0.05, 20.0), unit=st.lists(st.floats(0.0, 1.0), min_size=5, max_size=5))
def test_similar_skins_share_their_inputs_and_differ_by_the_scale(factor, unit):
    similarity, theta = Similarity(default_space()), default_space().from_unit([unit])
    here, there = similarity.inputs(theta), similarity.inputs(scaled(theta, factor))
    assert similarity.dim == here.shape[1] == 4
    assert np.all((here >= -1e-12) & (here <= 1 + 1e-12))
    np.testing.assert_allclose(there, here, atol=1e-12)
    scale = similarity.log_scale(scaled(theta, factor)) - similarity.log_scale(theta)
    assert scale[0] == pytest.approx(np.log(factor), abs=1e-12)


def test_without_a_modulus_the_inputs_are_the_unit_cube():
    similarity = Similarity(SPACE)  # the toy says nothing of stress powers
    np.testing.assert_array_equal(similarity.inputs(DESIGN.theta), SPACE.to_unit(DESIGN.theta))
    assert not similarity.log_scale(DESIGN.theta).any()


def test_a_surrogate_obeys_the_law_exactly():
    space = ParameterSpace(
        tuple(
            replace(p, stress_power=power)
            for p, power in zip(SPACE.parameters, (1, 1, -1, -1, 0), strict=True)
        )
    )
    lawful = toy_bin_means(scaled(DESIGN.theta, 1e5 / DESIGN.theta[:, :1])) * DESIGN.theta[:, :1] / 1e5
    surrogate, validation = train(replace(DESIGN, space=space, force_n=lawful), "gp", seed=0)
    assert surrogate.latents.inputs.shape[1] == 4
    assert validation.relative_error < 0.01
    theta = space.from_unit(np.full((1, 5), 0.5))
    once, twice = surrogate.predict(theta), surrogate.predict(scaled(theta, 2.0))
    np.testing.assert_allclose(twice.mean, 2.0 * once.mean, rtol=1e-10)
    np.testing.assert_allclose(twice.sd(), 2.0 * once.sd(), rtol=1e-10)
