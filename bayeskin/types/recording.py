"""A recording as measured, its force in bins, and the jumps of the force that its samples allow."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bayeskin.types.arrays import Array, FreezesArrays
from bayeskin.types.joint import Span, bins_of
from bayeskin.types.protocol import Phase


@dataclass(frozen=True)
class Recording(FreezesArrays):
    """A recording as measured, in SI units, without smoothing and without a zero correction; arrays (n,)."""

    time_s: Array
    displacement_m: Array
    force_n: Array
    name: str
    sha256: str  # hash of the source file's bytes
    notes: tuple[str, ...] = ()  # how the importer interpreted columns and units

    def part(self, span: Span) -> Recording:
        """Returns the samples of one of several recordings, on this recording's own axis of time."""
        inside = (self.time_s >= span.start_s - 1e-9) & (self.time_s <= span.end_s + 1e-9)
        return replace(
            self, name=span.name, time_s=self.time_s[inside] - span.start_s,
            displacement_m=self.displacement_m[inside], force_n=self.force_n[inside],
        )  # fmt: skip


@dataclass(frozen=True)
class BinnedForce(FreezesArrays):
    """Robust bin means of a recording's force, with the noise of each mean.

    edges_s : the edges of the bins, (m+1,)
    force_n : robust means, (m,)
    variance_n2 : the variance of each mean, (m,), which includes the correlation of samples within the bin
    correlation : the correlation of the noise of neighbouring bins, (m-1,)
    phase : for each bin the index in `phases` of the phase that covers most of it, (m,)
    spans : the parts of the time axis that several recordings of one skin cover; () for a single recording
    """

    edges_s: Array
    force_n: Array
    variance_n2: Array
    correlation: Array
    phase: NDArray[np.int64]
    phases: tuple[Phase, ...]
    spans: tuple[Span, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "spans", tuple(Span(*span) for span in self.spans))  # a file has lists

    @property
    def time_s(self) -> Array:
        """Returns the bin centres, (m,)."""
        return 0.5 * (self.edges_s[1:] + self.edges_s[:-1])

    @property
    def slices(self) -> list[slice]:
        """Returns the bins of each recording."""
        return bins_of(self.spans, self.edges_s)

    @property
    def parts(self) -> tuple[BinnedForce, ...]:
        """Returns the bins of each recording, on the recording's own axis of time."""
        if not self.spans:
            return (self,)
        return tuple(self._part(span, bins) for span, bins in zip(self.spans, self.slices, strict=True))

    def _part(self, span: Span, bins: slice) -> BinnedForce:
        """Returns the bins of one recording."""
        phases = [p for p in self.phases if span.start_s - 1e-9 <= p.start_s < span.end_s]
        return BinnedForce(
            self.edges_s[bins.start : bins.stop + 1] - span.start_s,
            self.force_n[bins], self.variance_n2[bins], self.correlation[bins.start : bins.stop - 1],
            self.phase[bins] - self.phases.index(phases[0]),
            tuple(p.later(-span.start_s) for p in phases),
        )  # fmt: skip


@dataclass(frozen=True)
class Jumps(FreezesArrays):
    """The range of force jumps that a recording's samples allow.

    lowest_n, highest_n : the smallest and the largest jump at time_s, (n,) each; infinite where the samples
        do not limit it
    """

    time_s: Array
    lowest_n: Array
    highest_n: Array

    def refute(self, time_s: Array, size_n: Array) -> NDArray[np.bool_]:
        """Returns whether the samples contradict jumps of size_n (k,) [N] at time_s (k,)."""
        at = np.clip(np.searchsorted(self.time_s, time_s), 0, len(self.time_s) - 1)
        return np.asarray((size_n < self.lowest_n[at]) | (size_n > self.highest_n[at]))

    def part(self, span: Span) -> Jumps:
        """Returns the range of jumps in one of several recordings, on this recording's own axis of time."""
        inside = (self.time_s >= span.start_s - 1e-9) & (self.time_s <= span.end_s + 1e-9)
        return Jumps(self.time_s[inside] - span.start_s, self.lowest_n[inside], self.highest_n[inside])

    def until(self, end_s: float) -> Jumps:
        """Returns the range of jumps that the samples up to a given time allow."""
        known = self.time_s <= end_s
        return replace(
            self,
            lowest_n=np.where(known, self.lowest_n, -np.inf),
            highest_n=np.where(known, self.highest_n, np.inf),
        )
