"""The cutis is stiffer along the Langer lines, in pull and in push.

The law of `fibres` with k2 = 0 and k1 = (ratio - 1) E_c / 4, so that Young's modulus along the lines is about
`ratio` times E_c at small strain; the lines lie at an angle to x in the skin's plane. In one uniaxial test
most of it looks like another E_c.

Skin that is incompressible, pulled alike by a small strain, without shear, and narrows by the share y of it
has, with r = ratio - 1 and the lines' angle a, the energy

    W / E = (1 + y^2 + (1 - y)^2) / 3 + r (cos^2 a - y sin^2 a)^2 / 2 ;

where that is least, the force is 2 W / E times the one without lines. Those that keep their length, at some
55 degrees, add nothing to it. Skin that pads hold is not strained alike, so that they add a share of r at any
angle (`estimate`).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayeskin.mechanisms.fibres import fibres
from bayeskin.mechanisms.mechanism import ForceOfTime, Mechanism, Tissue, Values
from bayeskin.model.problem import Sites
from bayeskin.model.tissue import TissueLaw
from bayeskin.types import PadMotion, Parameter

AT_ANY_ANGLE = 0.2  # of the ratio's excess over 1


def bind(values: Mapping[str, float], sites: Sites) -> TissueLaw:
    """Returns fibres in the cutis at `langer_angle` to x in the planes that are parallel to the surface."""
    around = np.arctan2(sites.points_m[1], sites.points_m[2])  # the tangent there is (0, cos, -sin)
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


def estimate(values: Values, motion: PadMotion, force: ForceOfTime) -> ForceOfTime:
    """The force times what a sheet gains, and a share of the ratio."""
    more = values["langer_ratio"] - 1.0
    along, across = np.cos(values["langer_angle"]) ** 2, np.sin(values["langer_angle"]) ** 2
    narrows = (2.0 / 3.0 + more * along * across) / (4.0 / 3.0 + more * across**2)
    energy = (1.0 + narrows**2 + (1.0 - narrows) ** 2) / 3.0 + 0.5 * more * (along - narrows * across) ** 2
    factor = 2.0 * energy + AT_ANY_ANGLE * more
    return lambda time_s: factor[:, None] * force(time_s)


MECHANISM = Mechanism(
    name="fibre-anisotropy",
    parameters=(
        Parameter("langer_ratio", "-", 1.0, 5.0, "uniform", "stiffness along the Langer lines over across"),
        Parameter("langer_angle", "rad", 0.0, np.pi / 2, "uniform", "of the Langer lines to the pull"),
    ),
    neutral={"langer_ratio": 1.0, "langer_angle": 0.0},
    statement=lambda v: (
        f"The cutis is {v['langer_ratio']:.1f} times as stiff along lines at "
        f"{np.degrees(v['langer_angle']):.0f} degrees to the pull; "
        "in one uniaxial test most of this looks like a stiffer cutis, and a pull across would tell."
    ),
    group=("fibre-anisotropy",),
    act=Tissue(bind, estimate),
)
