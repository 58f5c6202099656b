"""Collagen fibres are recruited: fibres along x in the cutis act in tension only and stiffen with stretch.

The law is that of `fibres`; a dispersion of 1/3 makes it an isotropic Fung form. Its k1 follows from the
second Piola-Kirchhoff stress S of the fibres along x in a skin that is a quarter longer. At constant volume
this skin narrows and thins equally. With the stretch l = 1.25 and the dispersion kappa,

    E = kappa (l^2 + 2 / l - 3) + (1 - 3 kappa) (l^2 - 1) ,   S = 2 (1 - 2 kappa) k1 E exp(k2 E^2) ,

This is about the stretch of a skin in a test, so that k2 and kappa bend the curve without raising it.

Range of S: up to 1e6 Pa. Taut excised skin has slopes of 1 to 83 MPa (Annaidh et al., J. Mech. Behav.
Biomed. Mater. 5 (2012), 139-148). Fibres with a k2 above 50 lock at the strains beside the pads.
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
    """Returns the k1 [Pa] that follows from the fibre stress S, k2 and the dispersion."""
    kappa = values["dispersion"]
    strain = kappa * (STRETCH**2 + 2.0 / STRETCH - 3.0) + (1.0 - 3.0 * kappa) * (STRETCH**2 - 1.0)
    slope = 2.0 * (1.0 - 2.0 * kappa) * strain * float(np.exp(values["k2"] * strain**2))
    return values["fibre_stress"] / slope


def bind(values: Mapping[str, float], sites: Sites) -> TissueLaw:
    """Returns the law of fibres along x in the cutis."""
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
            "2nd Piola-Kirchhoff stress of the fibres at a stretch of 1.25",
            stress_power=1,
            offset=1e3,
        ),
        Parameter("k2", "-", 1.0, 50.0, "log-uniform", "exponent with which the fibres stiffen"),
        Parameter(
            "dispersion",
            "-",
            0.0,
            1 / 3,
            "uniform",
            "dispersion of the fibres: 0 if all lie along the pull, 1/3 if they have no direction",
        ),
    ),
    neutral={"fibre_stress": 0.0, "k2": 5.0, "dispersion": 0.0},
    statement=lambda v: (
        f"Fibres of the cutis stiffen with stretch: k1 = {number(1e-3 * first_modulus(v), 3)} kPa, "
        f"k2 = {number(v['k2'], 2)}, so that their 2nd Piola-Kirchhoff stress is "
        f"{number(1e-3 * v['fibre_stress'], 3)} kPa at a stretch of 1.25."
    ),
    act=Tissue(bind),
)
