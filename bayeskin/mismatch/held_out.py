"""Prediction of the end of a recording by fits to its beginning.

Sets of mechanisms are fitted to what ends with the second hold, from their values in fits to the whole
recording, and the likeliest of them is chosen by the beginning alone. What follows is held out: it tests the
forces of the base model and of the chosen set.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from bayeskin.mismatch.fit import Fit
from bayeskin.mismatch.hypotheses import weight
from bayeskin.mismatch.search_context import correction
from bayeskin.mismatch.tasks import AnswerTasks, FitTask
from bayeskin.mismatch.trust_region import SetFit
from bayeskin.types import BinnedForce

RUNS = 6  # of a fit, at most


@dataclass(frozen=True)
class Beginning:
    """Fits of the base model and of the likeliest set to the beginning of a recording."""

    base: Fit
    best: Fit


def end_of_second_hold(binned: BinnedForce) -> float | None:
    """Returns the time at which the held-out part starts; None where no third hold follows."""
    holds = [phase for phase in binned.phases if phase.kind == "hold"]
    return holds[1].end_s if len(holds) > 2 else None


def fit_beginning(ask: AnswerTasks, sets: Sequence[SetFit], split_s: float | None) -> Beginning | None:
    """Returns the fits of some sets, the base model among them, to the beginning; None where it has no end.

    It is also None where the base model's fit fails.
    """
    if split_s is None:
        return None
    answers = ask([FitTask(one.fit.names, one.fit.theta, RUNS, correction(one), split_s) for one in sets])
    fits = [one.fit for one in answers if isinstance(one, SetFit)]
    base = next((one for one in fits if not one.names), None)
    return None if base is None else Beginning(base, max(fits, key=weight))
