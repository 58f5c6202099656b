"""The full model against other programs: an independent solver's reaction, the article's own script.

The references lie in the supplement folder (BAYESKIN_SUPPLEMENT). Whole recordings take minutes and
are marked slow; the first seconds of the first ramp are checked each time.
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import openpyxl
import pytest
from toys.synthetic_recordings import supplement

from bayeskin.finite_element import ModelSpec, article, simulate
from bayeskin.finite_element.article_equations import ArticleModel
from bayeskin.finite_element.gmsh import read_gmsh
from bayeskin.finite_element.problem import build_problem, material
from bayeskin.geometry import Geometry
from bayeskin.types import PadMotion

POINTS = {
    "A": {"E_c": 60e3, "E_s": 20e3, "k_c": 1e-14, "k_s": 5e-13, "p_init": 700.0},
    "B": {"E_c": 200e3, "E_s": 5e3, "k_c": 1e-13, "k_s": 5e-12, "p_init": 700.0},
    "C": {"E_c": 684250.48, "E_s": 47789.13, "k_c": 9.428584e-15, "k_s": 5.0299945e-13, "p_init": 700.0},
}
CALIBRATED = POINTS["C"] | {
    "E_c": 684250.4796883139, "E_s": 47789.133894134284,
    "k_c": 9.428584320870872e-15, "k_s": 5.029994538924334e-13,
}  # fmt: skip


def corners_of(time_s: np.ndarray, pad_m: np.ndarray, jump_m_s: float = 1e-4) -> PadMotion:
    """The LVDT motion through the samples where the pad's speed changes."""
    speed = np.diff(pad_m) / np.diff(time_s)
    inner = 1 + np.flatnonzero(np.abs(np.diff(speed)) > jump_m_s)
    kept = np.concatenate([[0], inner, [len(time_s) - 1]])
    return PadMotion(time_s[kept], 2 * pad_m[kept])


def reaction_difference(case: str, until_s: float) -> float:
    """RMSE against the independent solver up to a time, over the peak of that stretch."""
    time_s, pad_m, force_n = np.loadtxt(
        supplement(f"reference/reaction_independent_{case}.csv"), delimiter=",", skiprows=1
    ).T
    kept = time_s <= until_s
    time_s, pad_m, force_n = time_s[kept], pad_m[kept], force_n[kept]
    spec = ModelSpec(mesh=str(supplement("data/Mesh_SKIN.msh")))
    simulation = simulate(spec, corners_of(time_s, pad_m), POINTS[case])
    assert simulation.status == "ok", simulation.message
    return float(np.sqrt(np.mean((simulation.at(time_s) - force_n) ** 2)) / force_n.max())


def test_reaction_of_the_first_pull_and_hold_is_the_independent_solvers():
    assert reaction_difference("A", until_s=28.0) < 0.005


@pytest.mark.slow
@pytest.mark.parametrize("case", "ABC")
def test_reaction_of_the_whole_recording_is_the_independent_solvers(case):
    assert reaction_difference(case, until_s=1e9) < 0.005


def article_reference() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    table = np.loadtxt(supplement("reference/article_forward.csv"), delimiter=",", skiprows=1)
    start = np.zeros((1, table.shape[1]))
    return np.concatenate([start, table]).T[:3]


def article_run(until_s: float, theta: dict[str, float] = CALIBRATED):
    time_s, pad_m, force_n = article_reference()
    kept = time_s <= until_s
    motion = PadMotion(time_s[kept], 2 * pad_m[kept])
    spec = ModelSpec("article", str(supplement("data/Mesh_SKIN.msh")))
    simulation = simulate(spec, motion, theta)
    assert simulation.status == "ok", simulation.message
    return simulation, time_s[kept], force_n[kept]


def test_articles_force_on_the_first_pull_is_its_scripts():
    simulation, time_s, force_n = article_run(until_s=13.0)
    np.testing.assert_allclose(simulation.time_s, time_s)
    # the difference grows along the ramp, to 4e-5 N in 215 s; 1e-3 N is what is asked for
    np.testing.assert_allclose(simulation.force_n, force_n, rtol=0, atol=5e-5)


@pytest.mark.slow
def test_articles_force_over_the_whole_recording_is_its_scripts():
    simulation, _, force_n = article_run(until_s=1e9)
    assert (
        np.sqrt(np.mean((simulation.force_n - force_n) ** 2)) < 1e-4
    )  # 2.7e-5 N; 1e-3 N is what is asked for


@pytest.mark.slow
def test_articles_force_is_its_sensitivity_studys_in_the_hold():
    """`Sobol_indice.xlsx`, sheet "reference": the calibrated point on the article's own machine.

    Its pads moved a little differently: on the ramp its force differs from the script's on the released
    recording by up to 20 mN (at 19.0 s), and from 21 s on by less than 1 mN.
    """
    book = openpyxl.load_workbook(supplement("data/Sobol_indice.xlsx"), data_only=True, read_only=True)
    rows = np.array(
        [row[:2] for row in book["reference"].iter_rows(min_row=2, values_only=True)], dtype=float
    )
    simulation, *_ = article_run(until_s=79.5)
    held = (rows[:, 0] > 20.9) & (rows[:, 0] < 75.1)
    there = np.interp(rows[held, 0], simulation.time_s, simulation.force_n)
    assert np.sqrt(np.mean((there - rows[held, 1]) ** 2)) < 1e-3


def test_articles_tangent_is_the_derivative_of_its_residual():
    problem = build_problem(read_gmsh(supplement("data/Mesh_SKIN.msh")))
    model = ArticleModel(problem, material(CALIBRATED, problem.mesh.cutis))
    space, rng = problem.space, np.random.default_rng(2)
    n = 3 * space.n_nodes
    x = np.concatenate([1e-5 * rng.standard_normal(n), 1e3 * rng.standard_normal(space.n_corners)])
    step = np.concatenate([1e-8 * rng.standard_normal(n), rng.standard_normal(space.n_corners)])
    equations = model.equations(0 * x, space.grad_u, space.grad_p, space.weight, 0.5)
    free, fixed = problem.pattern.free, problem.pattern.fixed
    free_free, free_fixed = equations.tangent(x)
    exact = free_free @ step[free] + free_fixed @ step[fixed]
    h = 1e-3
    difference = (equations.residual(x + h * step) - equations.residual(x - h * step)) / (2 * h)
    for rows in (free < n, free >= n):
        assert np.abs(difference - exact)[rows].max() < 1e-6 * np.abs(exact[rows]).max()


class ScriptedForces:
    """Stands in for `ArticleModel`: the forces of its steps are given."""

    def __init__(self, forces: list[float]) -> None:
        self.forces = iter(forces)
        space = SimpleNamespace(dofs=4, n_nodes=1)
        mesh = SimpleNamespace(geometry=SimpleNamespace(p=np.zeros((3, 1))))
        self.problem = SimpleNamespace(space=space, mesh=mesh, lengths=Geometry())
        self.material = SimpleNamespace(mu=np.array([1e5]))

    def step(self, x, corners, dt, pad, guess):
        return x, next(self.forces)

    def move(self, corners, old, new):
        return corners


@pytest.mark.parametrize(
    ("forces", "stable"),
    [
        ([0.1, 0.2, 0.19, 0.18, 0.17, 0.16], True),  # a load and its relaxation
        ([0.1, 0.2, 0.1995, 0.1997, 0.1994, 0.1996], True),  # rounding
        ([0.1, 0.2, 0.17, 0.19, 0.15, 0.2], False),
        ([1e-9, -1e-9, 2e-9, -3e-9, 2e-9, -1e-9], True),  # nothing has happened yet
    ],
)
def test_an_article_run_whose_force_swings_has_failed(forces, stable):
    time_s = np.arange(0.0, 3.5, 0.5)
    pads = np.array([0.0, 1e-3, 2e-3, 2e-3, 2e-3, 2e-3, 2e-3])
    message = article.integrate(ScriptedForces(forces), time_s, pads, 0.0, lambda *_: None)
    assert (message == "") is stable, message
