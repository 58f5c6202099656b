"""The skin's model with mechanisms that are switched on strongly, and states to evaluate it at."""

from __future__ import annotations

import numpy as np

from bayeskin.finite_element.lagrangian import LagrangianModel
from bayeskin.finite_element.problem import Sites, material
from bayeskin.mechanisms import catalogue, laws
from bayeskin.mechanisms.mechanism import Tissue
from bayeskin.types import PadMotion

ALL = catalogue()
TISSUE = {name: m for name, m in ALL.items() if isinstance(m.act, Tissue)}
SOLVED = {name: m for name, m in ALL.items() if m.act.bind is not None}
IN_SERIES = {"backlash", "pad-slip", "slow-recovery"}
THETA = {"E_c": 60e3, "E_s": 20e3, "k_c": 1e-14, "k_s": 5e-13, "p_init": 0.0}
STILL = PadMotion(np.array([0.0, 1.0]), np.zeros(2))
STRONG = {
    "fibre_stress": 2e5, "k2": 5.0, "dispersion": 0.1, "M_k": 30.0, "adherence": 1e7, "leakage": 1e-9,
    "langer_ratio": 3.0, "langer_angle": 0.7, "opening": 0.05, "g_1": 0.6, "tau_1": 1.5, "g_2": 0.3,
    "tau_2": 40.0, "damage": 0.5, "damage_energy": 1.0, "recovery_compliance": 1e-3, "recovery_time": 20.0,
    "gap": 2e-4, "frame_compliance": 1e-3, "slip_rate": 1e-4, "slip_threshold": 0.02, "nu_c": 0.3,
    "nu_s": 0.1, "stiffness_rate": -1e-3, "stiffness_time": 300.0, "set_share": 0.5, "yield_stretch": 1.02,
}  # fmt: skip
ONE = Sites(np.array([True]), np.array([[0.0], [0.0], [0.05]]))  # a point in the cutis


def strong(*names, **values):
    """The base's parameters, and those of mechanisms at the values given, else strong ones."""
    own = {p.name for n in names for p in SOLVED[n].parameters}
    return THETA | {name: value for name, value in (STRONG | values).items() if name in own}


def skin(problem, *names, **values):
    """The model with mechanisms at the values given, else strong ones."""
    theta = strong(*names, **values)
    bound = tuple(bind(theta, problem.sites) for bind in laws([SOLVED[n] for n in names]))
    return LagrangianModel(problem, material(theta, problem.mesh.cutis), STILL, bound)


def unknowns(problem, seed, size=1.0):
    """A rough but upright state."""
    rng, n = np.random.default_rng(seed), 3 * problem.space.n_nodes
    return size * np.concatenate(
        [2e-5 * rng.standard_normal(n), 1e3 * rng.standard_normal(problem.space.n_corners)]
    )
