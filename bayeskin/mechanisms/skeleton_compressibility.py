"""The drained solid is more, or less, compressible than the fixed Poisson ratios 0.48 and 0.3 imply.

Stretch then changes its volume, and fluid has to flow. The force relaxes in holds and is negative after
unloading. All laws of the solid use the same ratios (`problem.material`),

    lambda = E nu / ((1 + nu) (1 - 2 nu)) ,   mu = E / (2 (1 + nu)) .

Source: skin loses volume under tension (Wahlsten et al., Biomech. Model. Mechanobiol. 18 (2019), 1079-1093).
"""

from __future__ import annotations

from collections.abc import Mapping

from bayeskin.finite_element.problem import Constants, Sites
from bayeskin.finite_element.tissue import TissueLaw
from bayeskin.mechanisms.mechanism import Mechanism, Tissue
from bayeskin.types import Parameter


def bind(values: Mapping[str, float], sites: Sites) -> TissueLaw:
    """Returns a law that changes nothing, because the material already has these ratios."""
    return TissueLaw()


MECHANISM = Mechanism(
    name="skeleton-compressibility",
    parameters=(
        Parameter("nu_c", "-", 0.0, 0.49, "uniform", "drained Poisson's ratio of the cutis"),
        Parameter("nu_s", "-", 0.0, 0.45, "uniform", "drained Poisson's ratio of the subcutis"),
    ),
    neutral={"nu_c": Constants.nu_c, "nu_s": Constants.nu_s},
    statement=lambda v: (
        f"The drained solid has a Poisson's ratio of {v['nu_c']:.2f} in the cutis and of {v['nu_s']:.2f} in "
        "the subcutis, so that a stretch changes its volume and makes fluid flow."
    ),
    look_alikes=("slow-recovery", "solid-viscoelasticity", "strain-dependent-permeability"),
    act=Tissue(bind),
    parts=(("nu_c",), ("nu_s",)),
)
