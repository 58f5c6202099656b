"""Collagen recruits: fibres along x in the cutis that only pull, stiffer the further they are stretched.

The law is that of `fibres`; a dispersion of 1/3 makes it an isotropic Fung form. Its k1 follows from the
fibres' second Piola-Kirchhoff stress S where they are 25 % longer, E = 1.25^2 - 1: S = 2 k1 E exp(k2 E^2),
about what a test of a skin's strain sees, so that k2 bends the curve and does not lift it.

Range of S: k1 up to 1e6 Pa; slopes of 1 to 83 MPa in excised skin, taut: Annaidh et al., J. Mech. Behav.
Biomed. Mater. 5 (2012), 139-148. A k2 above 50 locks at the strains beside the pads.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayeskin.mechanisms.fibres import Fibres
from bayeskin.mechanisms.mechanism import Mechanism, Tissue
from bayeskin.model.problem import Problem
from bayeskin.model.tissue import TissueLaw
from bayeskin.types import Parameter
from bayeskin.words import number

STRAIN = 1.25**2 - 1.0


def first_modulus(values: Mapping[str, float]) -> float:
    """k1 [Pa] of the fibre stress S and of k2."""
    return values["fibre_stress"] / (2.0 * STRAIN * float(np.exp(values["k2"] * STRAIN**2)))


def bind(values: Mapping[str, float], problem: Problem) -> TissueLaw:
    """Fibres along x in the cutis."""
    direction = np.zeros((*problem.space.weight.shape, 3))
    direction[..., 0] = 1.0
    k1 = np.where(problem.mesh.cutis, first_modulus(values), 0.0)
    return Fibres(direction, k1, values["k2"], values["dispersion"])


MECHANISM = Mechanism(
    name="strain-stiffening",
    parameters=(
        Parameter(
            "fibre_stress",
            "Pa",
            0.0,
            1e6,
            "log-uniform",
            "of fibres stretched by a quarter",
            stress_power=1,
            offset=1e3,
        ),
        Parameter("k2", "-", 1.0, 50.0, "log-uniform", "how fast the fibres stiffen"),
        Parameter("dispersion", "-", 0.0, 1 / 3, "uniform", "of the fibres: 0 all along x, 1/3 none"),
    ),
    neutral={"fibre_stress": 0.0, "k2": 5.0, "dispersion": 0.0},
    statement=lambda v: (
        f"Fibres of the cutis stiffen with stretch: k1 = {number(1e-3 * first_modulus(v), 3)} kPa, "
        f"k2 = {number(v['k2'], 2)}, so that they pull with {number(1e-3 * v['fibre_stress'], 3)} kPa "
        "a quarter longer."
    ),
    group=("strain-stiffening", "pre-stretch"),
    act=Tissue(bind),
)
