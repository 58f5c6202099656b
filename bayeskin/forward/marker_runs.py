"""Runs the reduced model of a device for the displacements of markers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from bayeskin.geometry import Geometry
from bayeskin.reduced.files import load_reduced
from bayeskin.reduced.region import REGION
from bayeskin.reduced.surface import simulate_surface
from bayeskin.types import Array, Markers, PadMotion


@dataclass(frozen=True)
class MarkerRuns:
    """Returns the displacements (t - 1, p, 2) [m] of markers at parameters, or the message of a failed run.

    Instances can be pickled, so that worker processes can use them.
    """

    file: Path
    geometry: Geometry
    motion: PadMotion
    markers: Markers

    def __call__(self, theta: Mapping[str, float]) -> Array | str:
        run = simulate_surface(
            load_reduced(self.file), self.motion, theta, (), None, self.markers.reference_m,
            self.markers.time_s, REGION.least_stiffness, self.geometry,
        )  # fmt: skip
        return run.simulation.message if run.displacement_m is None else run.displacement_m
