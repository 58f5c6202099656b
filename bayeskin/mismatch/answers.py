"""Answers the tasks of a search: any process computes an answer as JSON, and the search reads it back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np

from bayeskin.forward.interface import ModelRun
from bayeskin.inference import LogPosterior
from bayeskin.mechanisms import with_one
from bayeskin.mismatch.context import DiagnosisContext
from bayeskin.mismatch.discrepancy import discrepancy
from bayeskin.mismatch.fit import fit, promised, restored
from bayeskin.mismatch.hypotheses import Evidences
from bayeskin.mismatch.refuted import refuted
from bayeskin.mismatch.tasks import (
    EvidenceTask,
    FitTask,
    FitWithAddedTask,
    FullRunTask,
    OtherProtocolTask,
    RunTask,
    ScoreTestTask,
    Task,
)
from bayeskin.mismatch.trust_region import SetFit, TrustSettings, as_json, fit_set, within
from bayeskin.types import STIFFEST_BELOW, Array, PadMotion

TRUST = 0.15  # half width, as a share of the prior, of the region near a run in which its tangent is trusted


def answer(context: DiagnosisContext, task: Task) -> dict[str, Any]:
    """Returns the answer to a task in JSON's types; if a run fails, the answer is its message."""
    context = _context_of(context, task)
    if isinstance(task, RunTask | FullRunTask | OtherProtocolTask):
        force = _force(context, task)
        return {"message": force} if isinstance(force, str) else {"force_n": force.tolist()}
    if isinstance(task, ScoreTestTask):
        return {"nats": _promised_gain(context, task)}
    if isinstance(task, EvidenceTask):
        unnamed = discrepancy(_fit_from_json(context, task.fit).fit, context.motion)
        return asdict(Evidences(unnamed.without_log_evidence, unnamed.log_evidence))
    if isinstance(task, FitWithAddedTask):
        test = task.score_test
        names = with_one(test.names, test.name, context.known)
        start = {**context.neutral, **test.theta, **_values_on_tangent(context, test)}
        return _fit_answer(context, FitTask(names, start, task.runs, test.correction_n))
    return _fit_answer(context, task)


def read_answer(context: DiagnosisContext, task: Task, reply: Mapping[str, Any]) -> object:
    """Returns an answer in the form that a search uses: a fit, gain [nats], force, evidences, or message."""
    if "message" in reply:
        return reply["message"]
    context = _context_of(context, task)
    if isinstance(task, RunTask | FullRunTask | OtherProtocolTask):
        return np.array(reply["force_n"])
    if isinstance(task, ScoreTestTask):
        return reply["nats"]
    if isinstance(task, EvidenceTask):
        return Evidences(**reply)
    set_fit = _fit_from_json(context, reply, task.until_s if isinstance(task, FitTask) else None)
    contradicted = refuted(set_fit.fit, context.known, context.motion, context.jumps)
    return f"the samples of the recording contradict {', '.join(contradicted)}" if contradicted else set_fit


def _context_of(context: DiagnosisContext, task: Task) -> DiagnosisContext:
    """Returns the context of the recording that a task is about, or of all recordings."""
    recording = task.recording if isinstance(task, FitTask) else None
    return context if recording is None else context.alone[recording]


def _force(context: DiagnosisContext, task: RunTask | FullRunTask | OtherProtocolTask) -> Array | str:
    """Returns the force (m,) [N] that a task asks for, or the message of a run that failed."""
    if isinstance(task, OtherProtocolTask):
        motion = PadMotion(np.array(task.time_s), np.array(task.displacement_m))
        return context.reported_elsewhere(task.names, task.theta, motion, np.array(task.edges_s))
    run = context.force if isinstance(task, RunTask) else context.full_force
    return run(task.names, task.theta)


def _fit_answer(context: DiagnosisContext, task: FitTask) -> dict[str, Any]:
    """Returns the fit that a task asks for, or the message of a run that failed, in JSON's types."""
    start = dict(task.start)
    if {"E_c", "E_s"} <= set(start):
        # The prior is zero where the subcutis is stiffer than `STIFFEST_BELOW` times the cutis.
        start["E_c"] = max(start["E_c"], start["E_s"] / (0.95 * STIFFEST_BELOW))
    correction_n = _as_array(task.correction_n)
    posterior = partial(context.posterior, correction_n=correction_n, until_s=task.until_s)
    settings = TrustSettings(runs=task.runs)
    result = fit_set(task.names, start, context.run, posterior, settings, correction_n, task.first)
    return {"message": result} if isinstance(result, str) else as_json(result)


def _promised_gain(context: DiagnosisContext, task: ScoreTestTask) -> float:
    """Returns the gain [nats] that the score test promises for a mechanism that acts on the force."""
    posterior, new = _posterior_with_added(context, task)
    parts = [part for name in new for part in context.known[name].whole_or_parts]
    return promised(posterior, task.theta, context.neutral, parts, context.seed)


def _values_on_tangent(context: DiagnosisContext, task: ScoreTestTask) -> Mapping[str, float]:
    """Returns the best values of a set with one mechanism added, on the tangent of a run without it."""
    posterior, new = _posterior_with_added(context, task)
    vector = np.clip(posterior.vector({**context.neutral, **task.theta}), *posterior.bounds)
    parts = [part for name in new for part in context.known[name].whole_or_parts]
    near = within(posterior, vector, TRUST)
    return fit((*task.names, *new), near, task.theta, context.neutral, context.seed, parts).theta


def _posterior_with_added(context: DiagnosisContext, task: ScoreTestTask) -> tuple[LogPosterior, list[str]]:
    """Returns the posterior with one mechanism added, near a run without it, and the names of the new ones.

    The new mechanisms are the added one and those that it needs.
    """
    new = [name for name in with_one(task.names, task.name, context.known) if name not in task.names]
    return context.posterior(task.names, [task.run], _as_array(task.correction_n), added=new), new


def _fit_from_json(
    context: DiagnosisContext, plain: Mapping[str, Any], until_s: float | None = None
) -> SetFit:
    """Returns the fit that `as_json` converted to JSON's types."""
    run = ModelRun(*(np.array(plain["run"][name]) for name in ("theta", "force_n", "slopes_n")))
    correction_n = np.array(plain["off_n"])
    posterior = context.posterior(
        plain["fit"]["names"], [run], correction_n if correction_n.any() else None, until_s
    )
    return SetFit(restored(plain["fit"], posterior), run, plain["runs"], plain["settled"], correction_n)


def _as_array(values: tuple[float, ...]) -> Array | None:
    """Returns the values (m,) as an array, and None where there are none."""
    return np.array(values) if values else None
