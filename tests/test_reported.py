"""The full model as the instrument reports its force."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayeskin.finite_element import ModelSpec, simulate
from bayeskin.forward import observed
from bayeskin.forward.observed import FullForce
from bayeskin.geometry import Geometry
from bayeskin.types import PadMotion

MOTION = PadMotion(np.array([0.0, 1.0, 4.0, 8.0]), 1e-3 * np.array([0.0, 0.0, 2.0, 2.0]))
EDGES_S = np.linspace(0.0, 8.0, 17)
SPEC = ModelSpec(refinement=0)
THETA = {"E_c": 60e3, "E_s": 20e3, "k_c": 1e-14, "k_s": 5e-13, "p_init": 0.0}


@pytest.fixture(scope="module")
def full() -> FullForce:
    return FullForce(SPEC, MOTION, EDGES_S)


def test_a_full_force_is_the_runs_bin_means_and_what_the_instrument_adds(full: FullForce) -> None:
    plain = full(((), THETA))
    assert isinstance(plain, np.ndarray)
    np.testing.assert_allclose(plain, simulate(SPEC, MOTION, THETA).bin_means(EDGES_S), atol=2e-5)
    shifted = full((("force-offset",), {**THETA, "F0": -0.03, "tau_noise": 1.0}))
    np.testing.assert_allclose(shifted, plain - 0.03, atol=1e-12)
    behind = full((("backlash", "force-offset"), {**THETA, "F0": 0.0, "gap": 2e-4, "frame_compliance": 0.0}))
    assert isinstance(behind, np.ndarray)
    assert behind[-1] < 0.99 * plain[-1]


def test_a_length_of_the_tissue_is_one_of_the_runs_parameters(full: FullForce) -> None:
    thick = full(((), {**THETA, "cutis_m": 2.4e-3}))
    meshed = replace(full, spec=ModelSpec(refinement=0, geometry=Geometry(cutis_m=2.4e-3)))(((), THETA))
    assert isinstance(thick, np.ndarray)
    np.testing.assert_allclose(thick, meshed, atol=5e-3 * np.abs(thick).max())
    plain = full(((), THETA))
    assert isinstance(plain, np.ndarray)
    assert thick[-1] > 1.05 * plain[-1]


def test_a_run_that_fails_gives_its_message(full: FullForce, monkeypatch: pytest.MonkeyPatch) -> None:
    failed = replace(simulate(SPEC, MOTION, THETA), status="failed", message="did not converge")
    monkeypatch.setattr(observed, "simulate", lambda *args, **more: failed)
    assert full(((), THETA)) == "did not converge"
