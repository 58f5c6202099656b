"""The cutis is stiffer along the Langer lines, in tension and in compression.

The law is that of `fibres` with k2 = 0 and k1 = (ratio - 1) E_c / 4. Young's modulus along the lines is then
about `ratio` times E_c at small strain. The lines lie at an angle to x in the plane of the skin. In one
uniaxial test most of the effect looks like a different E_c.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayeskin.finite_element.problem import Sites
from bayeskin.finite_element.tissue import TissueLaw
from bayeskin.mechanisms.fibres import fibres
from bayeskin.mechanisms.mechanism import Mechanism, Tissue
from bayeskin.types import Parameter


def bind(values: Mapping[str, float], sites: Sites) -> TissueLaw:
    """Returns the law of fibres in the cutis, at `langer_angle` to x and parallel to the surface."""
    around = np.arctan2(sites.points_m[1], sites.points_m[2])  # the tangent is (0, cos, -sin)
    angle = values["langer_angle"]
    direction = np.stack(
        [
            np.full_like(around, np.cos(angle)),
            np.sin(angle) * np.cos(around),
            -np.sin(angle) * np.sin(around),
        ],
        axis=-1,
    )
    k1 = np.where(sites.cutis, 0.25 * (values["langer_ratio"] - 1.0) * values["E_c"], 0.0)
    return fibres(sites, direction, k1, 0.0, tension_only=False)


MECHANISM = Mechanism(
    name="fibre-anisotropy",
    parameters=(
        Parameter(
            "langer_ratio",
            "-",
            1.0,
            5.0,
            "uniform",
            "ratio of the stiffness along the Langer lines to that across",
        ),
        Parameter("langer_angle", "rad", 0.0, np.pi / 2, "uniform", "angle of the Langer lines to the pull"),
    ),
    neutral={"langer_ratio": 1.0, "langer_angle": 0.0},
    statement=lambda v: (
        f"The cutis is {v['langer_ratio']:.1f} times as stiff along the Langer lines as across them, and the "
        f"lines are at {np.degrees(v['langer_angle']):.0f} degrees to the pull; a single uniaxial test can "
        "hardly distinguish this from a stiffer cutis, but a further test across the pull can."
    ),
    act=Tissue(bind),
)
