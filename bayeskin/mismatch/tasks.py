"""The tasks that a search gives to the processes that run the models; they travel by value."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from bayeskin.forward.interface import ModelRun


@dataclass(frozen=True)
class RunTask:
    """Asks for the force (m,) of a set by the forward model, or the message of a run that failed."""

    names: tuple[str, ...]
    theta: Mapping[str, float]


@dataclass(frozen=True)
class FullRunTask:
    """Asks for the force (m,) of a set by the full model, or the message of a run that failed."""

    names: tuple[str, ...]
    theta: Mapping[str, float]


@dataclass(frozen=True)
class FitTask:
    """Asks for the fit of a set.

    start : values from which the fit starts; runs : largest number of model runs
    correction_n (m,) : force that is added to every run; empty for none
    until_s : end of the part of the recording that is fitted, None for the whole
    """

    names: tuple[str, ...]
    start: Mapping[str, float]
    runs: int
    correction_n: tuple[float, ...] = ()
    until_s: float | None = None


@dataclass(frozen=True)
class ScoreTestTask:
    """Asks for the gain [nats] that a mechanism promises beside a set, about the run of the set's fit.

    The mechanism has a shortcut for the force, so the model need not run.

    correction_n (m,) : part of the run's force that was added to it
    """

    names: tuple[str, ...]
    theta: Mapping[str, float]
    run: ModelRun
    name: str
    correction_n: tuple[float, ...] = ()


@dataclass(frozen=True)
class FitWithAddedTask:
    """Asks for the fit of a set with one mechanism more, whose values are first searched for on a tangent."""

    score_test: ScoreTestTask
    runs: int


@dataclass(frozen=True)
class EvidenceTask:
    """Asks for the log-evidences of a set, alone and with an unnamed smooth discrepancy.

    fit : of the set, as JSON has it
    """

    fit: Mapping[str, Any]


@dataclass(frozen=True)
class OtherProtocolTask:
    """Asks for the force (m,) that the instrument reports on another protocol, or a failed run's message.

    time_s, displacement_m : corners of the pads' motion; edges_s (m + 1,) : of the bins
    """

    names: tuple[str, ...]
    theta: Mapping[str, float]
    time_s: tuple[float, ...]
    displacement_m: tuple[float, ...]
    edges_s: tuple[float, ...]


Task = RunTask | FullRunTask | FitTask | ScoreTestTask | FitWithAddedTask | EvidenceTask | OtherProtocolTask
AnswerTasks = Callable[[Sequence[Task]], list[object]]  # returns the answers in the order of the tasks
