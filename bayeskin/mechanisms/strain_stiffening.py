"""Collagen recruits: fibres along x in the cutis that only pull, stiffer the further they are stretched.

The law is that of `fibres`; a dispersion of 1/3 makes it an isotropic Fung form. Its k1 follows from their
second Piola-Kirchhoff stress S along x in a skin that is a quarter longer and, at the same volume, narrows
and thins alike: with the stretch l = 1.25 and the dispersion kappa

    E = kappa (l^2 + 2 / l - 3) + (1 - 3 kappa) (l^2 - 1) ,   S = 2 (1 - 2 kappa) k1 E exp(k2 E^2) ,

about what a test of a skin sees, so that k2 and kappa bend the curve and do not lift it.

Range of S: k1 up to 1e6 Pa; slopes of 1 to 83 MPa in excised skin, taut: Annaidh et al., J. Mech. Behav.
Biomed. Mater. 5 (2012), 139-148. A k2 above 50 locks at the strains beside the pads.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayeskin.finite_element.problem import Sites
from bayeskin.finite_element.tissue import TissueLaw
from bayeskin.mechanisms.fibres import fibres
from bayeskin.mechanisms.mechanism import Mechanism, Tissue
from bayeskin.number_format import number
from bayeskin.types import Parameter

STRETCH = 1.25


def first_modulus(values: Mapping[str, float]) -> float:
    """Returns k1 [Pa] that the fibre stress S, k2 and the dispersion make."""
    kappa = values["dispersion"]
    strain = kappa * (STRETCH**2 + 2.0 / STRETCH - 3.0) + (1.0 - 3.0 * kappa) * (STRETCH**2 - 1.0)
    slope = 2.0 * (1.0 - 2.0 * kappa) * strain * float(np.exp(values["k2"] * strain**2))
    return values["fibre_stress"] / slope


def bind(values: Mapping[str, float], sites: Sites) -> TissueLaw:
    """Returns fibres along x in the cutis."""
    k1 = np.where(sites.cutis, first_modulus(values), 0.0)
    return fibres(sites, np.array([1.0, 0.0, 0.0]), k1, values["k2"], values["dispersion"])


MECHANISM = Mechanism(
    name="strain-stiffening",
    parameters=(
        Parameter(
            "fibre_stress",
            "Pa",
            0.0,
            1e6,
            "log-uniform",
            "2nd Piola-Kirchhoff stress of the fibres in skin a quarter longer",
            stress_power=1,
            offset=1e3,
        ),
        Parameter("k2", "-", 1.0, 50.0, "log-uniform", "how fast the fibres stiffen with stretch"),
        Parameter("dispersion", "-", 0.0, 1 / 3, "uniform", "of the fibres: 0 all along the pull, 1/3 none"),
    ),
    neutral={"fibre_stress": 0.0, "k2": 5.0, "dispersion": 0.0},
    statement=lambda v: (
        f"Fibres of the cutis stiffen with stretch: k1 = {number(1e-3 * first_modulus(v), 3)} kPa, "
        f"k2 = {number(v['k2'], 2)}, so that they pull with {number(1e-3 * v['fibre_stress'], 3)} kPa "
        "in skin that is a quarter longer."
    ),
    group=("strain-stiffening", "pre-stretch"),
    act=Tissue(bind),
)
