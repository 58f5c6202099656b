"""The model on other devices and other skin: meshes of the right size, the forces of equilibrium."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import skfem

from bayeskin.errors import InputError
from bayeskin.finite_element import ModelSpec, simulate
from bayeskin.finite_element.bricks import brick_lines
from bayeskin.finite_element.gradients import logarithms
from bayeskin.finite_element.lagrangian import LagrangianModel
from bayeskin.finite_element.mesh import brick_mesh
from bayeskin.finite_element.problem import build_problem, material
from bayeskin.finite_element.stepping import integrate
from bayeskin.geometry import Geometry, Guard
from bayeskin.types import PadMotion

THETA = {"E_c": 6e4, "E_s": 2e4, "k_c": 1e-14, "k_s": 5e-13, "p_init": 700.0}
SHORT = PadMotion(np.array([0.0, 4.0, 10.0]), 1e-3 * np.array([0.0, 4.0, 4.0]))
PADS = Geometry(gauge_m=20e-3, pad_length_m=10e-3, pad_width_m=20e-3, guard=None)
OTHERS = [
    Geometry(),
    PADS,
    Geometry(cutis_m=3.5e-3, subcutis_m=20e-3, arm_radius_m=35e-3),
    Geometry(12e-3, 4e-3, 6e-3, None, "pad", 1.2e-3, 3e-3, None),
    Geometry(20e-3, 6e-3, 20e-3, Guard(0.3e-3, 4e-3), "pad and guard"),
    Geometry(5e-3, 20e-3, 20e-3, None),
]
# Forces [N] at 0, 1, 4 and 10 s of SHORT, as they were when the article's lengths stood in the source.
BEFORE = {
    0: [0.0, 0.053142323495179965, 0.20172119967096125, 0.20022697415076093],
    1: [0.0, 0.05168172633051079, 0.1969095354534407, 0.19518412849233174],
}
HASHES = {
    0: "12d0699eb627c10c98eee359b388a9a9611ceeb86f639363355f354e2ca94413",
    1: "18f49bd2895d69b788c78c93153fd4a5b86cd6dcd74cddbbb2fc0944cbe22992",
    2: "ba42214703497cb8e26508796f4b016f6dc76b20ac073f870f8c3bc826e7dc0f",
}


@pytest.mark.parametrize("refinement", [0, 1])
def test_the_article_s_device_has_the_forces_that_it_had(refinement):
    simulation = simulate(ModelSpec(refinement=refinement), SHORT, THETA)
    np.testing.assert_allclose(simulation.at([0.0, 1.0, 4.0, 10.0]), BEFORE[refinement], rtol=1e-9)


def test_hashes_of_the_article_s_device_are_those_of_stored_designs():
    assert {r: ModelSpec(refinement=r).hash for r in HASHES} == HASHES
    others = [ModelSpec(geometry=g).hash for g in OTHERS]
    others.append(ModelSpec(geometry=Geometry(force_on="pad and guard")).hash)
    assert len(set(others)) == len(others)


@pytest.mark.parametrize(
    ("geometry", "refinement"), [*((one, refinement) for one in OTHERS for refinement in (0, 1)), (PADS, 2)]
)
def test_pads_guard_and_layers_have_their_areas_and_volumes(geometry, refinement):
    """Rolling keeps arcs at every depth, so that all are those of the flat box."""
    mesh = brick_mesh(refinement, geometry)
    length, width, _ = geometry.box_m
    volumes = build_problem(mesh).space.weight.sum(axis=1)
    assert volumes[mesh.cutis].sum() == pytest.approx(length * width * geometry.cutis_m, rel=5e-3)
    assert volumes[~mesh.cutis].sum() == pytest.approx(length * width * geometry.subcutis_m, rel=5e-3)
    assert area(mesh, mesh.facets["pad"]) == pytest.approx(geometry.quarter_pad_m2, rel=1e-4)
    assert area(mesh, mesh.top()) == pytest.approx(length * width, rel=2e-3)
    guard = 0.0
    if geometry.guard is not None:
        start, _, behind, end = geometry.along_m
        _, beside, side = geometry.across_m
        guard = (end - start) * side - (behind - start) * beside
    assert area(mesh, mesh.facets["guard"]) == pytest.approx(guard, rel=1e-4, abs=1e-12)


def area(mesh, facets):
    """Area of facets [m^2]."""
    if not len(facets):
        return 0.0
    basis = skfem.FacetBasis(
        mesh.geometry, mesh.geometry.elem(), mesh.facet_mapping(), facets=facets, intorder=4
    )
    return float(basis.dx.sum())


def test_lines_grow_with_the_device():
    twice = Geometry(72e-3, 16e-3, 16e-3, Guard(2e-3, 16e-3), "pad", 4e-3, 16e-3, 96e-3)
    for line, other in zip(brick_lines(2), brick_lines(2, twice), strict=True):
        np.testing.assert_allclose(other, 2 * line)


def test_a_mesh_like_another_has_its_cells_with_nodes_moved_by_layer():
    reference, thicker = Geometry(), Geometry(cutis_m=2.4e-3, subcutis_m=36e-3, arm_radius_m=60e-3)
    mesh, like = brick_mesh(1, reference), brick_mesh(1, thicker, like=reference)
    np.testing.assert_array_equal(mesh.geometry.t, like.geometry.t)
    np.testing.assert_array_equal(mesh.cutis, like.cutis)
    for name, facets in mesh.facets.items():
        np.testing.assert_array_equal(facets, like.facets[name])
    volumes = build_problem(like).space.weight.sum(axis=1)
    assert volumes[like.cutis].sum() == pytest.approx(0.105 * 0.084 * 2.4e-3, rel=5e-3)
    assert volumes[~like.cutis].sum() == pytest.approx(0.105 * 0.084 * 36e-3, rel=5e-3)
    assert brick_mesh(1, thicker).geometry.p.max() > like.geometry.p.max()  # whose box is its own
    np.testing.assert_array_equal(brick_mesh(1, reference, like=reference).geometry.p, mesh.geometry.p)
    with pytest.raises(InputError, match="its pads or its guard differ"):
        brick_mesh(1, PADS, like=reference)


def test_moved_nodes_follow_a_millionth_of_a_thickness():
    """Differences of coordinates are derivatives to rounding, so that those of a force can be."""
    z = {h: brick_lines(1, Geometry(cutis_m=2e-3 * (1 + h)), Geometry())[2] for h in (-1e-6, 0.0, 1e-6)}
    slope = (z[1e-6] - z[-1e-6]) / 2e-6
    np.testing.assert_allclose(slope, np.maximum(z[0.0] - 8e-3, 0.0), atol=1e-9)


@pytest.fixture(scope="module", params=[Geometry(), Geometry(cutis_m=3e-3, arm_radius_m=None)])
def pulled(request):
    """A problem with its unknowns and residual at the end of a pull, force on pad and guard."""
    problem = build_problem(brick_mesh(1, replace(request.param, force_on="pad and guard")))
    pull = PadMotion(SHORT.time_s[:2], SHORT.displacement_m[:2])
    model = LagrangianModel(problem, material(THETA, problem.mesh.cutis), pull)
    steps = []
    assert integrate(model, THETA["p_init"], 1e-2, steps.append) == ""
    return problem, steps[-1], model.full_residual


def test_pad_and_guard_pull_as_much_as_the_plane_of_symmetry_holds(pulled):
    problem, step, residual = pulled
    held_n = residual[3 * problem.space.facet_nodes("symmetry_x")].sum()
    assert step.force_n == pytest.approx(-2.0 * held_n, rel=1e-6)
    pad_n = 2.0 * residual[3 * problem.pad].sum()
    guard_n = 2.0 * residual[3 * np.setdiff1d(problem.pads, problem.pad)].sum()
    assert 0.1 * step.force_n < pad_n < 0.9 * step.force_n
    assert pad_n + guard_n == pytest.approx(step.force_n, rel=1e-12)


def test_that_is_the_integral_of_the_stress_over_the_plane(pulled):
    """Nominal traction P_xx at x = 0, by quadrature of the fields alone, where bricks are coarse."""
    problem, step, _ = pulled
    mesh, n = problem.mesh, 3 * problem.space.n_nodes
    basis = skfem.FacetBasis(
        mesh.geometry, skfem.ElementHex2(), mesh.facet_mapping(), facets=mesh.facets["symmetry_x"], intorder=6
    )
    u = [basis.interpolate(step.state.x[i:n:3]).grad for i in range(3)]
    f = np.eye(3) + np.stack(u).transpose(2, 3, 0, 1)
    j, inverse = np.linalg.det(f), np.linalg.inv(f)
    p = np.asarray(basis.with_element(skfem.ElementHex1()).interpolate(step.state.x[n:]))
    cells = material(THETA, mesh.cutis)
    mu, lam = (part[basis.tind][:, None] for part in (cells.mu, cells.lam))
    nominal = mu * (f[..., 0, 0] - inverse[..., 0, 0]) + (lam * np.log(j) - p * j) * inverse[..., 0, 0]
    assert 2.0 * float((nominal * basis.dx).sum()) == pytest.approx(step.force_n, rel=2e-2)


def test_derivatives_are_those_of_the_force_on_pad_and_guard():
    spec = ModelSpec(refinement=0, geometry=Geometry(force_on="pad and guard"), tolerance=1e-2)
    simulation = simulate(spec, SHORT, THETA, gradients=logarithms(THETA))
    assert simulation.force_n[-1] > 1.5 * simulate(ModelSpec(refinement=0), SHORT, THETA).force_n[-1]
    ends = [simulate(spec, SHORT, THETA | {"E_s": THETA["E_s"] * (1 + h)}) for h in (1e-3, -1e-3)]
    difference = (ends[0].force_n[-1] - ends[1].force_n[-1]) / 2e-3
    assert simulation.gradient_n[-1, simulation.gradient_names.index("E_s")] == pytest.approx(
        difference, rel=1e-3
    )


def test_pre_stretch_opens_the_pads_by_a_share_of_this_gauge():
    from bayeskin.mechanisms import catalogue

    problem = build_problem(brick_mesh(0, PADS))
    law = catalogue()["pre-stretch"].act.bind({"opening": 0.1}, problem)
    assert law.opening_m == pytest.approx(2e-3)


@pytest.mark.parametrize("observation", ["article", "own"])
def test_observations_that_know_one_device_refuse_another(observation):
    options = {"mesh": "some.msh"} if observation == "article" else {"forward": "http://localhost:1"}
    with pytest.raises(InputError, match="geometry: it is not the article's"):
        ModelSpec(observation=observation, geometry=PADS, **options)
