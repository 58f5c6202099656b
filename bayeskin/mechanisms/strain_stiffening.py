"""Collagen recruits: fibres along x in the cutis that only pull, stiffer the further they are stretched.

The law is that of `fibres`; a dispersion of 1/3 makes it an isotropic Fung form.

Range of k1 and k2: wide beside the slopes of 1 to 83 MPa of excised skin (Annaidh et al., J. Mech. Behav.
Biomed. Mater. 5, 2012, 139-148).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayeskin.mechanisms.fibres import Fibres
from bayeskin.mechanisms.mechanism import Mechanism, Tissue
from bayeskin.model.problem import Problem
from bayeskin.model.tissue import TissueLaw
from bayeskin.types import Parameter


def bind(values: Mapping[str, float], problem: Problem) -> TissueLaw:
    """Fibres along x in the cutis."""
    direction = np.zeros((*problem.space.weight.shape, 3))
    direction[..., 0] = 1.0
    k1 = np.where(problem.mesh.cutis, values["k1"], 0.0)
    return Fibres(direction, k1, values["k2"], values["dispersion"])


MECHANISM = Mechanism(
    name="strain-stiffening",
    parameters=(
        Parameter("k1", "Pa", 0.0, 1e6, "uniform", "stiffness of the fibres", stress_power=1),
        Parameter("k2", "-", 1.0, 100.0, "log-uniform", "how fast the fibres stiffen"),
        Parameter("dispersion", "-", 0.0, 1 / 3, "uniform", "of the fibres: 0 all along x, 1/3 none"),
    ),
    neutral={"k1": 0.0, "k2": 10.0, "dispersion": 0.0},
    statement=lambda v: (
        f"Fibres of the cutis stiffen with stretch: {1e-3 * v['k1']:.3g} kPa at first, "
        f"{1e-3 * v['k1'] * np.exp(0.04 * v['k2']):.3g} kPa where they are 10 % longer."
    ),
    group=("strain-stiffening", "pre-stretch"),
    act=Tissue(bind),
)
