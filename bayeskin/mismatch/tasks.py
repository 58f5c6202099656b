"""The tasks that a search gives to the processes that run the models; they travel by value."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from bayeskin.forward.interface import ModelRun


@dataclass(frozen=True)
class Probe:
    """Asks for the force of a set at values, by the forward model alone: (m,) or why it failed."""

    names: tuple[str, ...]
    theta: Mapping[str, float]


@dataclass(frozen=True)
class FullProbe:
    """Asks for the force of a set at values by the full model: (m,) or why it failed."""

    names: tuple[str, ...]
    theta: Mapping[str, float]


@dataclass(frozen=True)
class Climb:
    """Asks for the fit of a set from values, in so many runs at most.

    off_n (m,) : added to the runs' force; until_s : end of what is fitted, None for the whole recording
    """

    names: tuple[str, ...]
    start: Mapping[str, float]
    runs: int
    off_n: tuple[float, ...] = ()
    until_s: float | None = None


@dataclass(frozen=True)
class Promise:
    """Asks how many nats a mechanism with a shortcut for the force promises beside a fit, about its run.

    off_n (m,) : part of the run's force that was added to it
    """

    names: tuple[str, ...]
    theta: Mapping[str, float]
    run: ModelRun
    name: str
    off_n: tuple[float, ...] = ()


@dataclass(frozen=True)
class Join:
    """Asks for the fit of a set with one such mechanism more, first searched for on the tangent of a run."""

    promise: Promise
    runs: int


@dataclass(frozen=True)
class Weigh:
    """Asks for the log evidences of a fit, as JSON has it, alone and with something smooth beside it."""

    fit: Mapping[str, Any]


@dataclass(frozen=True)
class OtherTest:
    """Asks for the force that is reported of a set at values in another test: (m,) or why it failed.

    time_s, displacement_m : corners of the pads' motion; edges_s (m + 1,)
    """

    names: tuple[str, ...]
    theta: Mapping[str, float]
    time_s: tuple[float, ...]
    displacement_m: tuple[float, ...]
    edges_s: tuple[float, ...]


Task = Probe | FullProbe | Climb | Promise | Join | Weigh | OtherTest
Ask = Callable[[Sequence[Task]], list[object]]  # answers in the order of the tasks
