"""Samples the posterior of one set of mechanisms: with an emulator, or near a single run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bayeskin.mismatch.context import DiagnosisContext
from bayeskin.mismatch.emulate import EmulatedPosterior, EmulationSettings, Learn, emulate
from bayeskin.mismatch.fit import Fit
from bayeskin.mismatch.resample import PosteriorDraws, resample
from bayeskin.mismatch.search_context import noise_of
from bayeskin.mismatch.tasks import AnswerTasks, FullRunTask, RunTask, Task
from bayeskin.mismatch.trust_region import SetFit, within
from bayeskin.types import Array


def draws_near_run(fit: Fit, seed: int) -> PosteriorDraws:
    """Returns draws of the posterior near a fit's run, where an emulation has its first points."""
    posterior, reach = fit.log_posterior, EmulationSettings().first
    near = within(posterior, np.clip(posterior.vector(fit.theta), *posterior.bounds), reach)
    return resample(replace(fit, log_posterior=near), seed)


def posterior_by_emulator(
    context: DiagnosisContext, ask: AnswerTasks, maxima: Sequence[SetFit], learn: Learn
) -> EmulatedPosterior:
    """Returns the posterior of a set from an emulator, which learns from runs in the region of the posterior.

    If all runs of the first wave fail, the posterior near the fit's run is returned instead.

    maxima : fits of the set at its known maxima, the likeliest first
    """
    best = maxima[0]
    names, space = best.fit.names, context.space(best.fit.names)

    def forces(points: Array, count: int) -> tuple[list[Any], list[Any]]:
        thetas = [dict(zip(space.names, map(float, row), strict=True)) for row in points]
        tasks: list[Task] = [FullRunTask(names, theta) for theta in thetas[:count]]
        answers: list[Any] = ask([*tasks, *(RunTask(names, theta) for theta in thetas)])
        return answers[count:], answers[:count]

    emulated = emulate(maxima, forces, learn, noise_of(context.binned), context.seed)
    if isinstance(emulated, str):
        return EmulatedPosterior(best.fit, draws_near_run(best.fit, context.seed), 0, None, False)
    return emulated
