"""Fluid leaves through the surface beside the pads.

The outflow per area is c p, where p is the interstitial pressure and c the conductance of the surface.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import scipy.sparse as sp

from bayeskin.finite_element.problem import Problem, Sites
from bayeskin.finite_element.tissue import SurfaceTerm, TissueLaw, pressure_rows, surface_mass
from bayeskin.mechanisms.mechanism import Mechanism, Tissue
from bayeskin.number_format import number
from bayeskin.types import Parameter


def open_surface(problem: Problem) -> np.ndarray:
    """Returns the facets of the top that neither a pad nor a guard covers."""
    named = problem.mesh.facets
    return np.setdiff1d(problem.mesh.top(), np.concatenate([named["pad"], named["guard"]]))


def outflow(problem: Problem) -> sp.csr_matrix:
    """Returns the matrix (dofs, dofs) of a conductance of 1 m/(Pa s), with the sign of `assembly`."""
    return -pressure_rows(problem.space, surface_mass(problem, open_surface(problem), False))


def bind(values: Mapping[str, float], sites: Sites) -> TissueLaw:
    """Returns the tissue law for `leakage`."""
    return TissueLaw(surfaces=(SurfaceTerm(values["leakage"], outflow, per_second=True),))


MECHANISM = Mechanism(
    name="fluid-leakage",
    parameters=(
        Parameter(
            "leakage",
            "m/(Pa s)",
            0.0,
            1e-8,
            "log-uniform",
            "conductance of the surface: outflow per area and pressure",
            stress_power=-1,
            offset=1e-12,
        ),
    ),
    neutral={"leakage": 0.0},
    statement=lambda v: (
        f"Fluid leaks through the surface: {number(6e7 * v['leakage'], 3)} micrometres a minute for each kPa "
        "of pressure."
    ),
    act=Tissue(bind),
)
