"""Several recordings of one skin on one axis of time, and the values that each recording has for itself.

A span is the part of the common axis that one recording covers. Between two spans the axis has a pause, which
belongs to no recording: the bins have one bin there without a force. The pause says nothing about the time
between the tests. In every recording the skin starts at rest.

A value that each recording has for itself, such as the initial pressure, has its plain name for the first
recording, and a name such as `p_init@2` for the second. A recording without such a name shares the plain one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from bayeskin.types.arrays import Array

T = TypeVar("T")
_MARK = "@"


class Span(NamedTuple):
    """The part of a common axis of time that one recording covers."""

    name: str
    start_s: float
    end_s: float


def own_name(name: str, recording: int) -> str:
    """Returns the name of a value that recording number 0, 1, ... has for itself."""
    return name if recording == 0 else f"{name}{_MARK}{recording + 1}"


def figure_name(name: str, recording: int) -> str:
    """Returns the name of a figure of recording number 0, 1, ...; that of the first is the plain one."""
    return name if recording == 0 else f"{name}-{recording + 1}"


def plain_name(name: str) -> str:
    """Returns the name of a value without the number of a recording."""
    return name.partition(_MARK)[0]


def recording_of(name: str) -> int:
    """Returns the number of the recording to which a name belongs; 0 for a plain name."""
    number = name.partition(_MARK)[2]
    return int(number) - 1 if number else 0


def values_in(values: Mapping[str, T], recording: int) -> dict[str, T]:
    """Returns the values of one recording by their plain names, with the values that it shares."""
    shared = {name: value for name, value in values.items() if _MARK not in name}
    own = {
        plain_name(name): value
        for name, value in values.items()
        if _MARK in name and recording_of(name) == recording
    }
    return {**shared, **own}


def end_to_end(parts: Sequence[Array], between: float) -> Array:
    """Returns values over the bins of several recordings (..., m) as values over all bins.

    between : the value in the one bin of each pause
    """
    pause = np.full((*parts[0].shape[:-1], 1), between)
    pieces = [part for array in parts for part in (pause, array)][1:]
    return np.concatenate(pieces, axis=-1)


def recording_at(spans: Sequence[Span], time_s: Array) -> NDArray[np.int64]:
    """Returns the number of the recording at each time, (n,); a pause counts to the recording before it."""
    starts = np.array([span.start_s for span in spans] or [-np.inf])
    return np.clip(np.searchsorted(starts, time_s + 1e-9, side="right") - 1, 0, None).astype(np.int64)


def edges_of(spans: Sequence[Span], edges_s: Array) -> list[Array]:
    """Returns the edges of the bins of each recording, on the recording's own axis of time."""
    starts_s = [span.start_s for span in spans] or [0.0]
    return [
        edges_s[bins.start : bins.stop + 1] - start_s
        for bins, start_s in zip(bins_of(spans, edges_s), starts_s, strict=True)
    ]


def bins_of(spans: Sequence[Span], edges_s: Array) -> list[slice]:
    """Returns the bins of each recording, as slices of the bins between edges_s (m + 1,)."""
    if not spans:
        return [slice(0, len(edges_s) - 1)]
    first = [int(np.searchsorted(edges_s, span.start_s - 1e-9)) for span in spans]
    ends = [following - 1 for _, following in pairwise(first)]
    return [slice(start, end) for start, end in zip(first, [*ends, len(edges_s) - 1], strict=True)]
