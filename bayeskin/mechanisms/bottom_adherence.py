"""The subcutis sticks to the muscle's fascia: springs on the bottom face resist tangential motion.

The traction on the bottom face is -s (u - (u . n) n), where n is its normal and s the stiffness. The face is
free at 0 and stuck at 1e9 Pa/m.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np
import scipy.sparse as sp

from bayeskin.finite_element.problem import Problem, Sites
from bayeskin.finite_element.tissue import SurfaceTerm, TissueLaw, displacement_rows, surface_mass
from bayeskin.mechanisms.mechanism import Mechanism, Tissue
from bayeskin.number_format import number
from bayeskin.types import Array, Parameter


def tangential(point: Array, i: int, j: int) -> Array:
    """Returns entry (i, j) of I - n (x) n at points (3, ...) of a face around the arm's axis."""
    radius = np.hypot(point[1], point[2])
    normal = [np.zeros_like(radius), point[1] / radius, point[2] / radius]
    return float(i == j) - normal[i] * normal[j]


def springs(problem: Problem) -> sp.csr_matrix:
    """Returns the matrix (dofs, dofs) of springs of 1 Pa/m on the bottom face."""
    bottom, space = problem.mesh.facets["bottom"], problem.space

    def spring(i: int, j: int) -> sp.csr_matrix:
        mass = surface_mass(problem, bottom, True, partial(tangential, i=i, j=j))
        return displacement_rows(space, mass, i, j)

    matrix = spring(0, 0)
    for i, j in ((1, 1), (1, 2), (2, 1), (2, 2)):
        matrix = matrix + spring(i, j)
    return matrix


def bind(values: Mapping[str, float], sites: Sites) -> TissueLaw:
    """Returns the tissue law for `adherence`."""
    return TissueLaw(surfaces=(SurfaceTerm(values["adherence"], springs),))


MECHANISM = Mechanism(
    name="bottom-adherence",
    parameters=(
        Parameter(
            "adherence",
            "Pa/m",
            0.0,
            1e9,
            "log-uniform",
            "tangential stiffness of the bond to the fascia, per area",
            stress_power=1,
            offset=1e5,
        ),
    ),
    neutral={"adherence": 0.0},
    statement=lambda v: (
        "The subcutis sticks to the fascia below it; the bond has a tangential stiffness of "
        f"{number(1e-6 * v['adherence'], 3)} kPa for each mm."
    ),
    act=Tissue(bind),
)
