"""Tests how well fits to the beginning of a recording predict its end.

Sets of mechanisms are fitted to the part of the recording up to the end of the second hold. The fits start
from the values of fits to the whole recording. The likeliest set is chosen by this beginning alone. The rest
of the recording is held out: it tests the forces of the base model and of the chosen set.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bayeskin.mismatch.fit import Fit
from bayeskin.mismatch.hypotheses import weight
from bayeskin.mismatch.search_context import fit_again
from bayeskin.mismatch.tasks import AnswerTasks
from bayeskin.mismatch.trust_region import SetFit
from bayeskin.types import BinnedForce

RUNS = 6  # largest number of model runs of a fit


@dataclass(frozen=True)
class Beginning:
    """Fits of the base model and of the likeliest set to the beginning of a recording."""

    base: Fit
    best: Fit


def end_of_second_hold(binned: BinnedForce) -> float | None:
    """Returns the time [s] at which the held-out part starts, or None where no third hold follows.

    With several recordings, this is a part of the last one.
    """
    start_s = binned.spans[-1].start_s if binned.spans else -np.inf
    holds = [phase for phase in binned.phases if phase.kind == "hold" and phase.start_s >= start_s]
    return holds[1].end_s if len(holds) > 2 else None


def fit_beginning(ask: AnswerTasks, sets: Sequence[SetFit], split_s: float | None) -> Beginning | None:
    """Returns the fits of the base model and of the likeliest set to the beginning of a recording.

    The result is None where the base model's fit fails.

    sets : fits to the whole recording, the base model's among them
    split_s : end of the beginning [s]; if it is None, the result is None
    """
    if split_s is None:
        return None
    answers = ask([fit_again(fit, RUNS, fit.correction_n, split_s) for fit in sets])
    fits = [answer.fit for answer in answers if isinstance(answer, SetFit)]
    base = next((fit for fit in fits if not fit.names), None)
    return None if base is None else Beginning(base, max(fits, key=weight))
