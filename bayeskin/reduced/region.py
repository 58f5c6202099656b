"""The region in which a reduced model can be trusted: where it was trained, away from folds of the skin.

Relaxed skin that is pushed together folds: the smallest eigenvalue of its stiffness falls to zero. Near there
a small error of the modes is a large one of the force.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import scipy.linalg

from bayeskin.finite_element.lagrangian import Step
from bayeskin.geometry import Geometry
from bayeskin.reduced.cases import RADIUS_RANGE, THICKNESS_RANGE, Protocols, Trained
from bayeskin.types import Array, PadMotion, ParameterSpace

LEAST_STIFFNESS = 0.4  # smallest eigenvalue of the stiffness over that at rest (docs/reduced.md)
LOW = 0.3  # of the largest displacement: at corners below it the stiffness is looked at
FASTER = 2.0  # than the fastest training protocol: faster ones leave the skin as undrained as it is


def outside(
    trained: Trained,
    theta: Mapping[str, float],
    mechanisms: Sequence[str],
    geometry: Geometry,
    motion: PadMotion,
) -> str:
    """Returns one line that says where a run leaves the trained region; empty inside it."""
    unknown = [name for name in mechanisms if name not in trained.mechanisms]
    if unknown:
        return f"mechanism {unknown[0]} was not trained"
    spaces = [trained.base, *(trained.mechanisms[name] for name in mechanisms)]
    lines = [line for space in spaces if (line := _beyond(space, theta))]
    lines += protocol_outside(trained.protocols, motion)
    lines += other_geometry(trained.geometry, geometry)
    return "; ".join(lines)


def protocol_outside(trained: Protocols, motion: PadMotion) -> list[str]:
    """Returns how a protocol leaves those that a reduced model was trained on; empty where it does not."""
    lines = []
    largest_m, lowest_m = float(motion.displacement_m.max()), float(motion.displacement_m.min())
    if largest_m > trained.largest_m * (1.0 + 1e-9):
        lines.append(
            f"the pads open by {1e3 * largest_m:.2f} mm, trained up to {1e3 * trained.largest_m:g} mm"
        )
    if lowest_m < -1e-6:
        lines.append(f"the pads are pushed together by {-1e3 * lowest_m:.2f} mm")
    fastest = float(np.abs(np.diff(motion.displacement_m) / np.diff(motion.time_s)).max(initial=0.0))
    if fastest > FASTER * trained.speeds_m_s[1]:
        lines.append(f"the pads move at {1e3 * fastest:.3g} mm/s")
    return lines


def _beyond(space: ParameterSpace, theta: Mapping[str, float]) -> str:
    for parameter in space.parameters:
        value = theta[parameter.name]
        slack = 1e-9 * (parameter.upper - parameter.lower)
        if not parameter.lower - slack <= value <= parameter.upper + slack:
            return f"{parameter.name} is {value:g}, trained {parameter.lower:g} to {parameter.upper:g}"
    return ""


def other_geometry(trained: Geometry, geometry: Geometry) -> list[str]:
    """Returns how a geometry differs from the trained one by more than training runs did."""
    lines = []
    same_tissue = replace(
        geometry,
        cutis_m=trained.cutis_m,
        subcutis_m=trained.subcutis_m,
        arm_radius_m=trained.arm_radius_m,
    )
    if same_tissue != trained:
        lines.append("pads, guard or load cell are others")
    for name, share in (
        ("cutis_m", THICKNESS_RANGE), ("subcutis_m", THICKNESS_RANGE), ("arm_radius_m", RADIUS_RANGE)
    ):  # fmt: skip
        one, other = getattr(trained, name), getattr(geometry, name)
        if (one is None) != (other is None):
            lines.append("the arm is flat" if other is None else "the arm is round")
        elif one is not None and abs(other / one - 1.0) > share * (1.0 + 1e-9):
            lines.append(f"{name.removesuffix('_m')} is {1e3 * other:.3g} mm, trained {1e3 * one:.3g} mm "
                         f"+- {100 * share:.0f} %")  # fmt: skip
    return lines


class Stability:
    """Looks at the stiffness of the skin where the pads have come back, for how near it is to folding.

    least : share of the stiffness at rest that has to be left
    left : the smallest eigenvalue so far, over those at rest; 1 where there was nothing to look at
    """

    def __init__(self, largest_m: float, least: float) -> None:
        self._low_m, self._least = LOW * largest_m, least
        self._rest: Array | None = None
        self.left = 1.0

    def look(self, step: Step, stiffness: Callable[[], Array]) -> None:
        """Takes an accepted step; `stiffness` (u, u) is asked for at the first and where it may be small."""
        if self._rest is None:
            self._rest = stiffness()
        elif step.corner and abs(float(step.state.x[0])) <= self._low_m:
            smallest = scipy.linalg.eigh(stiffness(), self._rest, eigvals_only=True, subset_by_index=[0, 0])
            self.left = min(self.left, float(smallest[0]))

    @property
    def message(self) -> str:
        """One line where the skin came near folding, else empty."""
        if self.left >= self._least:
            return ""
        return (
            f"the skin is near folding where the pads come back: {100 * self.left:.1f} % of its stiffness is "
            "left; run the full model"
        )
