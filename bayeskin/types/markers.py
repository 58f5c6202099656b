"""Tracks of points on the skin, as image correlation gives them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from bayeskin.types.arrays import Array, FreezesArrays


@dataclass(frozen=True)
class Markers(FreezesArrays):
    """Tracks of p points on the skin over t images, on the axis of time of their recording.

    Positions are in the plane of a distant camera that looks down on the skin. x runs along the pull and y
    across it. The origin is midway between the pads before the test. Every point is seen in the first image.

    time_s : times of the images, (t,)
    position_m : positions, (t, p, 2); NaN where a point was not seen
    points : the name of each point, (p,)
    sha256 : hash of the source file's bytes
    mesh_change_m : change of the full model's displacements from its coarse mesh to its usual one,
        (t - 1, p, 2); empty until a run of the full model has shown it
    """

    time_s: Array
    position_m: Array
    points: tuple[str, ...]
    name: str
    sha256: str
    mesh_change_m: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "points", tuple(self.points))  # a file has a list

    def until(self, end_s: float) -> Markers:
        """Returns the same images, in which no point was seen after a given time."""
        unseen = (self.time_s > end_s)[:, None, None]
        return replace(self, position_m=np.where(unseen, np.nan, self.position_m))

    @property
    def reference_m(self) -> Array:
        """Returns the positions in the first image, (p, 2)."""
        return np.asarray(self.position_m[0])

    @property
    def displacement_m(self) -> Array:
        """Returns the displacements since the first image, in the images after it, (t - 1, p, 2)."""
        return np.asarray(self.position_m[1:] - self.position_m[0])
