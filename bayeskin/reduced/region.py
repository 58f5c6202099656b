"""Checks that a run stays where a reduced model can be trusted: in its trained region, away from folding.

Relaxed skin that is pushed together folds: the smallest eigenvalue of its stiffness falls to zero. Near
folding a small error of the modes is a large error of the force.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from bayeskin.finite_element.stages import Step
from bayeskin.geometry import Geometry
from bayeskin.reduced.cases import CASES, Protocols, Trained
from bayeskin.types import Array, PadMotion, ParameterSpace


@dataclass(frozen=True)
class RegionSettings:
    """Settings of the region in which a reduced model is trusted.

    least_stiffness : smallest eigenvalue of the stiffness, relative to rest (docs/reduced.md)
    least_stiffness_if_checked : the same where runs of the full model check the results. Nearer to folding
        the reduced model cannot be used
    low : the stiffness is checked at corners below this share of the largest displacement
    faster : largest allowed speed over the fastest in training; the skin is undrained at both
    """

    least_stiffness: float = 0.4
    least_stiffness_if_checked: float = 0.15
    low: float = 0.3
    faster: float = 2.0


REGION = RegionSettings()


def outside(
    trained: Trained,
    theta: Mapping[str, float],
    mechanisms: Sequence[str],
    geometry: Geometry,
    motion: PadMotion,
) -> str:
    """Returns one line that says how a run leaves the trained region; the line is empty inside it."""
    unknown = [name for name in mechanisms if name not in trained.mechanisms]
    if unknown:
        return f"mechanism {unknown[0]} was not trained"
    spaces = [trained.base, *(trained.mechanisms[name] for name in mechanisms)]
    lines = [line for space in spaces if (line := _outside_prior(space, theta))]
    lines += protocol_outside(trained.protocols, motion)
    lines += other_geometry(trained.geometry, geometry)
    return "; ".join(lines)


def protocol_outside(trained: Protocols, motion: PadMotion) -> list[str]:
    """Returns messages that say how a protocol leaves the trained range; an empty list inside it."""
    lines = []
    largest_m, lowest_m = float(motion.displacement_m.max()), float(motion.displacement_m.min())
    if largest_m > trained.largest_m * (1.0 + 1e-9):
        lines.append(
            f"the pads open by {1e3 * largest_m:.2f} mm, more than the trained {1e3 * trained.largest_m:g} mm"
        )
    if lowest_m < -1e-6:
        lines.append(f"the pads are pushed together by {-1e3 * lowest_m:.2f} mm")
    fastest = float(np.abs(np.diff(motion.displacement_m) / np.diff(motion.time_s)).max(initial=0.0))
    if fastest > REGION.faster * trained.speeds_m_s[1]:
        lines.append(f"the pads move at {1e3 * fastest:.3g} mm/s, faster than in the training")
    return lines


def _outside_prior(space: ParameterSpace, theta: Mapping[str, float]) -> str:
    """Returns a message about the first parameter that lies outside its trained range, or an empty string."""
    for parameter in space.parameters:
        value = theta[parameter.name]
        slack = 1e-9 * (parameter.upper - parameter.lower)
        if not parameter.lower - slack <= value <= parameter.upper + slack:
            return (
                f"{parameter.name} is {value:g}, outside the trained range "
                f"{parameter.lower:g} to {parameter.upper:g}"
            )
    return ""


def other_geometry(trained: Geometry, geometry: Geometry) -> list[str]:
    """Returns messages that say where a geometry differs from the trained one by more than training runs."""
    lines = []
    same_tissue = replace(
        geometry,
        cutis_m=trained.cutis_m,
        subcutis_m=trained.subcutis_m,
        arm_radius_m=trained.arm_radius_m,
    )
    if same_tissue != trained:
        lines.append("the pads, the guard or the load cell differ")
    thickness, radius = CASES.thickness_range, CASES.radius_range
    for name, share in (("cutis_m", thickness), ("subcutis_m", thickness), ("arm_radius_m", radius)):
        ref_m, given_m = getattr(trained, name), getattr(geometry, name)
        if (ref_m is None) != (given_m is None):
            lines.append("the arm is flat" if given_m is None else "the arm is round")
        elif ref_m is not None and abs(given_m / ref_m - 1.0) > share * (1.0 + 1e-9):
            lines.append(f"{name.removesuffix('_m')} is {1e3 * given_m:.3g} mm, outside the trained range "
                         f"{1e3 * ref_m:.3g} mm +- {100 * share:.0f} %")  # fmt: skip
    return lines


class Stability:
    """Checks the stiffness of the skin at corners where the pads are nearly closed again, to detect folding.

    least : smallest allowed stiffness, relative to the stiffness at rest
    left : smallest eigenvalue of the stiffness so far, relative to rest; 1 where nothing had to be checked
    """

    def __init__(self, largest_m: float, least: float) -> None:
        self._low_m, self._least = REGION.low * largest_m, least
        self._rest: Array | None = None
        self.left = 1.0

    def look(self, step: Step, stiffness: Callable[[], Array]) -> None:
        """Checks an accepted step.

        stiffness : function that returns the stiffness (u, u). It is called at the first step, where it gives
            the stiffness at rest, and at corners where the pads are nearly closed again
        """
        if self._rest is None:
            self._rest = stiffness()
        elif step.corner and abs(float(step.state.x[0])) <= self._low_m:
            smallest = scipy.linalg.eigh(stiffness(), self._rest, eigvals_only=True, subset_by_index=[0, 0])
            self.left = min(self.left, float(smallest[0]))

    @property
    def message(self) -> str:
        """Returns one line where the skin came near folding, otherwise an empty string."""
        if self.left >= self._least:
            return ""
        return (
            f"the skin is near folding where the pads return: {100 * self.left:.1f} % of its stiffness is "
            "left; run the full model"
        )
