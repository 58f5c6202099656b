"""The skin is under tension when the test starts.

Before the test the pads were moved apart, and the tissue came to its drained equilibrium. The load cell was
zeroed in this state.

Range: tensions of 28 to 92 kPa were measured in the upper arm (Flynn, Taberner & Nielsen, Biomech. Model.
Mechanobiol. 10 (2011), 27-38).
"""

from __future__ import annotations

from collections.abc import Mapping

from bayeskin.finite_element.problem import Sites
from bayeskin.finite_element.tissue import TissueLaw
from bayeskin.mechanisms.mechanism import Mechanism, Tissue
from bayeskin.types import Parameter


def bind(values: Mapping[str, float], sites: Sites) -> TissueLaw:
    """Returns the law of pads that were each moved outward by a share `opening` of the half gauge length."""
    return TissueLaw(opening_m=2.0 * values["opening"] * sites.lengths.half_gauge_m)


MECHANISM = Mechanism(
    name="pre-stretch",
    parameters=(
        Parameter(
            "opening",
            "-",
            0.0,
            0.15,
            "uniform",
            "displacement of each pad before the test, as a share of half the gauge length",
        ),
    ),
    neutral={"opening": 0.0},
    statement=lambda v: f"The skin was already stretched by {100 * v['opening']:.1f} % when the test began.",
    look_alikes=("strain-stiffening",),
    also_possible=("force-offset",),
    act=Tissue(bind),
)
