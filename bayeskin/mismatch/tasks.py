"""Defines the tasks that a search gives to the processes that run the models; they can be pickled."""

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
    """Asks for the fit of a set, or the message that says why there is none.

    start : values from which the fit starts; runs : largest number of model runs
    correction_n (m,) : force [N] that is added to every run; empty for none
    until_s : end of the part of the recording that is fitted [s]; None for the whole recording
    recording : number of the recording that is fitted alone, with its values by their plain names; None for
        all recordings together
    first : run of the set at `start` that exists already, without a correction; None where there is none
    """

    names: tuple[str, ...]
    start: Mapping[str, float]
    runs: int
    correction_n: tuple[float, ...] = ()
    until_s: float | None = None
    recording: int | None = None
    first: ModelRun | None = None


@dataclass(frozen=True)
class ScoreTestTask:
    """Asks for the gain [nats] that a score test promises for a mechanism that is added to a fitted set.

    The mechanism acts on the force of the fit's run, so the forward model need not run.

    names, theta, run : the set, the values of its fit, and the run of its fit; name : the added mechanism
    correction_n (m,) : part of the run's force [N] that was added as a correction; empty for none
    """

    names: tuple[str, ...]
    theta: Mapping[str, float]
    run: ModelRun
    name: str
    correction_n: tuple[float, ...] = ()


@dataclass(frozen=True)
class FitWithAddedTask:
    """Asks for the fit of a set with one mechanism more, whose values are first searched for on a tangent.

    score_test : the set and the added mechanism; runs : largest number of model runs
    """

    score_test: ScoreTestTask
    runs: int


@dataclass(frozen=True)
class EvidenceTask:
    """Asks for the log-evidences of a set, alone and with an unnamed smooth discrepancy.

    fit : the fit of the set, in JSON's types
    """

    fit: Mapping[str, Any]


@dataclass(frozen=True)
class OtherProtocolTask:
    """Asks for the force (m,) that the instrument reports on another protocol, or a failed run's message.

    time_s, displacement_m : corners of the pads' motion; edges_s (m + 1,) : edges of the bins
    """

    names: tuple[str, ...]
    theta: Mapping[str, float]
    time_s: tuple[float, ...]
    displacement_m: tuple[float, ...]
    edges_s: tuple[float, ...]


Task = RunTask | FullRunTask | FitTask | ScoreTestTask | FitWithAddedTask | EvidenceTask | OtherProtocolTask
AnswerTasks = Callable[[Sequence[Task]], list[object]]  # returns the answers in the order of the tasks
