"""The formulations of the test state what they offer, and a specification chooses between them."""

from __future__ import annotations

import numpy as np
import pytest
from toys.gmsh_file import coarse_tetrahedra, gmsh_text

from bayeskin.errors import InputError
from bayeskin.finite_element import ModelSpec, simulate
from bayeskin.finite_element.tissue import TissueLaw
from bayeskin.forward.reduced import stands_for
from bayeskin.geometry import Geometry
from bayeskin.recordings import idealised_motion, recorded_motion, segment
from bayeskin.types import PadMotion, Recording
from bayeskin.workflow.recording import pad_motion

THETA = {"E_c": 60e3, "E_s": 40e3, "k_c": 1e-14, "k_s": 5e-13, "p_init": 300.0}
MOTION = PadMotion(np.array([0.0, 4.0, 8.0, 10.0]), 1e-3 * np.array([0.0, 2.0, 2.0, 1.0]))
FORCES_N = (0.0342462531178, 0.0260555159032, 0.00498112680029)  # at the corners, on the coarse mesh
ARTICLE = ModelSpec("article", "some.msh")
OWN = ModelSpec("own", forward="http://localhost:1")


@pytest.fixture(scope="module")
def article_spec(tmp_path_factory: pytest.TempPathFactory) -> ModelSpec:
    path = tmp_path_factory.mktemp("mesh") / "coarse.msh"
    path.write_text(gmsh_text(coarse_tetrahedra(Geometry(arm_radius_m=None))))
    return ModelSpec("article", str(path))


def test_the_articles_formulation_runs_in_its_own_steps_to_the_force_it_always_had(
    article_spec: ModelSpec,
) -> None:
    seen: list[float] = []
    run = simulate(article_spec, MOTION, THETA, on_state=lambda time_s, x, force_n: seen.append(time_s))
    assert run.status == "ok", run.message
    np.testing.assert_allclose(run.time_s, np.arange(0.0, 10.1, 0.5))
    assert seen == run.time_s[1:].tolist()
    assert run.time_s[run.corner].tolist() == MOTION.time_s.tolist()
    assert run.model_hash == article_spec.hash
    np.testing.assert_allclose(run.at(MOTION.time_s[1:]), FORCES_N, rtol=1e-6)


def test_steps_and_observation_are_part_of_the_models_hash(article_spec: ModelSpec) -> None:
    coarser = ModelSpec("article", article_spec.mesh, tolerance=0.1)
    assert coarser.hash == article_spec.hash  # its steps are fixed
    reaction = ModelSpec(mesh=article_spec.mesh)
    assert len({article_spec.hash, reaction.hash, ModelSpec(mesh=reaction.mesh, tolerance=0.1).hash}) == 3


@pytest.mark.parametrize("spec", [ARTICLE, OWN], ids=["article", "own"])
def test_what_a_formulation_does_not_offer_is_refused(spec: ModelSpec) -> None:
    for where, asked in (
        ("gradients", {"gradients": {"E_c": 1e3}}),
        ("tissue mechanisms", {"laws": [lambda values, sites: TissueLaw()]}),
    ):
        with pytest.raises(InputError, match=f"{where}: observation '{spec.observation}'"):
            simulate(spec, MOTION, THETA, **asked)


def test_a_reduced_model_replaces_only_the_reaction_on_bricks() -> None:
    assert stands_for(ModelSpec(refinement=0))
    assert not any(map(stands_for, (ARTICLE, OWN, ModelSpec(mesh="some.msh"))))


def test_samples_drive_the_articles_formulation_and_a_protocol_drives_the_others() -> None:
    time_s = np.arange(0.0, 60.0, 0.01)
    displacement_m = np.interp(time_s, [0.0, 5.0, 9.0, 30.0, 34.0, 60.0], 1e-3 * np.array([0, 0, 3, 3, 6, 6]))
    recording = Recording(time_s, displacement_m, 30.0 * displacement_m, "made up", "0" * 64)
    phases = segment(recording)
    for protocol, protocol_motion in (("recorded", recorded_motion), ("idealised", idealised_motion)):
        for spec in (ModelSpec(), OWN):
            driven = pad_motion(spec, recording, phases, protocol)
            assert driven.time_s.tolist() == protocol_motion(recording, phases).time_s.tolist()
        assert pad_motion(ARTICLE, recording, phases, protocol).time_s == pytest.approx(time_s[::50])
