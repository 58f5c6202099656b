"""Estimates how long a job still takes, from how long its stages usually take."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from statistics import median

from bayeskin.app.recordings import RecordingFolder
from bayeskin.config import Config
from bayeskin.workflow.folder import read_record

# Seconds of the stages on two free cores: docs/cost.md for a run with a design by the reduced model, and
# README.md for a diagnosis.
USUAL_S = {
    "recording": 1.0,
    "design": 128.0,
    "train": 15.0,
    "map": 56.0,
    "sample": 168.0,
    "sobol": 31.0,
    "report": 1.0,
    "diagnose": 147.0,
}
SHIPPED_DESIGN_S = 1.0  # of a run with a shipped surrogate
FULL_DESIGN_S = 1600.0  # of a design by the full model, 11 to 42 minutes
# The time that a stage still takes may be shorter or longer by this factor. The search of a diagnosis has no
# known length.
UNSURE = {"diagnose": 2.0}
OVERRUN = 0.5  # a stage that has taken longer than usual is expected to take this share of it once more


def usual_seconds(stage: str, config: Config, others: Iterable[RecordingFolder]) -> float:
    """Returns how long a stage usually takes: the median of finished runs of other recordings, if any.

    A design takes as long as its models do, so it is estimated from the configuration alone.
    """
    if stage == "design":
        reduced = config.design.coarse == "reduced"
        return SHIPPED_DESIGN_S if config.surrogate.file else USUAL_S[stage] if reduced else FULL_DESIGN_S
    records = (read_record(folder.run / stage) for folder in others)
    finished = [record.seconds for record in records if record is not None and record.done]
    return median(finished) if finished else USUAL_S[stage]


def range_left(left_s: Mapping[str, float]) -> tuple[float, float]:
    """Returns the shortest and the longest time that a job is expected to take still.

    left_s : the time that each of its stages still takes, by the name of the stage
    """
    unsure = {stage: UNSURE.get(stage, 1.0) for stage in left_s}
    shortest, longest = (
        sum(seconds * unsure[stage] ** power for stage, seconds in left_s.items()) for power in (-1, 1)
    )
    return shortest, longest


def seconds_left(so_far_s: float, usual_s: float, tasks_left_s: Sequence[float] = ()) -> float:
    """Returns how long a stage still takes, given how long it has taken and usually takes.

    tasks_left_s : the seconds that its present tasks still take at their pace
    """
    return max(usual_s - so_far_s, OVERRUN * so_far_s, *tasks_left_s)
