"""The protocol of a test: the displacement over time, and its phases."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from bayeskin.types.arrays import Array, FreezesArrays
from bayeskin.types.joint import Span

PhaseKind = Literal["rest", "load", "hold", "unload"]
PHASE_IN_WORDS: dict[PhaseKind, str] = {
    "rest": "at rest", "load": "while loading", "hold": "in holds", "unload": "while unloading",
}  # fmt: skip
PHASE_KINDS = tuple(PHASE_IN_WORDS)


@dataclass(frozen=True)
class Phase(FreezesArrays):
    """A phase of the protocol, in which the pads rest, load, hold or unload."""

    kind: PhaseKind
    cycle: int  # 1 for the first loading; the rest phase before it belongs to cycle 0
    start_s: float
    end_s: float

    def later(self, by_s: float) -> Phase:
        """Returns the phase on an axis of time on which it begins `by_s` later."""
        return replace(self, start_s=self.start_s + by_s, end_s=self.end_s + by_s)


@dataclass(frozen=True)
class PadMotion(FreezesArrays):
    """The protocol: the LVDT displacement over time, as straight lines between corners.

    `displacement_m` is the *full* LVDT reading; each pad of the symmetric model moves by half of it. Both
    arrays have shape (k,). `time_s` increases strictly and starts at 0.

    spans : the parts of the time axis that several recordings of one skin cover; () for a single recording
    """

    time_s: Array
    displacement_m: Array
    spans: tuple[Span, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "spans", tuple(Span(*span) for span in self.spans))  # a file has lists

    @property
    def parts(self) -> tuple[PadMotion, ...]:
        """Returns the protocol of each recording, on the recording's own axis of time."""
        if not self.spans:
            return (self,)
        inside = [
            (self.time_s >= span.start_s - 1e-9) & (self.time_s <= span.end_s + 1e-9) for span in self.spans
        ]
        return tuple(
            PadMotion(np.round(self.time_s[rows] - span.start_s, 9), self.displacement_m[rows])
            for span, rows in zip(self.spans, inside, strict=True)
        )

    def at(self, time_s: ArrayLike) -> Array:
        """Returns the LVDT displacement [m] at given times, same shape."""
        return np.interp(np.asarray(time_s, dtype=float), self.time_s, self.displacement_m)

    def times(self, step_s: float, beside_s: ArrayLike | None = None) -> Array:
        """Returns times (n,) [s] every `step_s`, and at the corners or at `beside_s`.

        Regular times closer than a microsecond to one of these are left out.
        """
        fixed = self.time_s if beside_s is None else np.asarray(beside_s, dtype=float)
        every = np.arange(0.0, self.time_s[-1], step_s)
        after = np.searchsorted(fixed, every)
        nearest = np.minimum(
            np.abs(every - fixed[np.maximum(after - 1, 0)]),
            np.abs(every - fixed[np.minimum(after, len(fixed) - 1)]),
        )
        return np.union1d(fixed, every[nearest > 1e-6])  # rounding could make two times out of one
