"""Fluid leaves through the surface beside the pads: outflow c p per area, by its interstitial pressure."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayeskin.mechanisms.mechanism import Mechanism, Tissue
from bayeskin.model.problem import Problem
from bayeskin.model.tissue import SurfaceTerm, TissueLaw, pressure_rows, surface_mass
from bayeskin.types import Parameter
from bayeskin.words import number


def open_surface(problem: Problem) -> np.ndarray:
    """Facets of the top that no pad covers."""
    named = problem.mesh.facets
    return np.setdiff1d(problem.mesh.top(), np.concatenate([named["pad"], named["guard"]]))


class FluidLeakage(TissueLaw):
    """Outflow of a conductance [m/(Pa s)]; the fluid's balance has the sign of `assembly`."""

    def __init__(self, conductance: float, problem: Problem) -> None:
        mass = surface_mass(problem, open_surface(problem), False)
        self.surfaces = (SurfaceTerm(-conductance * pressure_rows(problem.space, mass), per_second=True),)


def bind(values: Mapping[str, float], problem: Problem) -> TissueLaw:
    """The law of `leakage`."""
    return FluidLeakage(values["leakage"], problem)


MECHANISM = Mechanism(
    name="fluid-leakage",
    parameters=(
        Parameter(
            "leakage",
            "m/(Pa s)",
            0.0,
            1e-8,
            "log-uniform",
            "conductance of the surface: outflow by its area and pressure",
            stress_power=-1,
            offset=1e-12,
        ),
    ),
    neutral={"leakage": 0.0},
    statement=lambda v: (
        f"Fluid leaves through the surface, {number(6e7 * v['leakage'], 3)} micrometres a minute at each kPa."
    ),
    group=("fluid-leakage",),
    act=Tissue(bind),
)
