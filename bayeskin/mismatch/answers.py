"""Answers to the tasks of a search: any process works them out as JSON, and a search reads them back."""

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
from bayeskin.types import Array, PadMotion

TRUST = 0.15  # half width about a run within which a mechanism is searched for on its tangent, of the prior


def answer(context: DiagnosisContext, task: Task) -> dict[str, Any]:
    """Returns the answer to a task, as JSON has it; of a run that failed, its message."""
    if isinstance(task, RunTask | FullRunTask | OtherProtocolTask):
        force = _force(context, task)
        return {"message": force} if isinstance(force, str) else {"force_n": force.tolist()}
    if isinstance(task, ScoreTestTask):
        return {"nats": _promised_gain(context, task)}
    if isinstance(task, EvidenceTask):
        left = discrepancy(_fit_of(context, task.fit).fit, context.motion)
        return asdict(Evidences(left.without_log_evidence, left.log_evidence))
    if isinstance(task, FitWithAddedTask):
        beside = task.score_test
        names = with_one(beside.names, beside.name, context.known)
        start = {**context.neutral, **beside.theta, **_values_on_tangent(context, beside)}
        return _fitted(context, FitTask(names, start, task.runs, beside.correction_n))
    return _fitted(context, task)


def read_answer(context: DiagnosisContext, task: Task, said: Mapping[str, Any]) -> object:
    """Returns an answer as a search reads it: a fit, a gain [nats], a force, evidences, or a message."""
    if "message" in said:
        return said["message"]
    if isinstance(task, RunTask | FullRunTask | OtherProtocolTask):
        return np.array(said["force_n"])
    if isinstance(task, ScoreTestTask):
        return said["nats"]
    if isinstance(task, EvidenceTask):
        return Evidences(**said)
    found = _fit_of(context, said, task.until_s if isinstance(task, FitTask) else None)
    against = refuted(found.fit, context.known, context.motion, context.jumps)
    return f"the recording's samples show nothing of {', '.join(against)}" if against else found


def _force(context: DiagnosisContext, task: RunTask | FullRunTask | OtherProtocolTask) -> Array | str:
    if isinstance(task, OtherProtocolTask):
        motion = PadMotion(np.array(task.time_s), np.array(task.displacement_m))
        return context.reported_elsewhere(task.names, task.theta, motion, np.array(task.edges_s))
    run = context.force if isinstance(task, RunTask) else context.full_force
    return run(task.names, task.theta)


def _fitted(context: DiagnosisContext, task: FitTask) -> dict[str, Any]:
    start = dict(task.start)
    if {"E_c", "E_s"} <= set(start):
        start["E_c"] = max(start["E_c"], start["E_s"] / 1.9)  # the prior rules a stiffer subcutis out
    correction_n = _as_array(task.correction_n)
    posterior = partial(context.posterior, correction_n=correction_n, until_s=task.until_s)
    settings = TrustSettings(runs=task.runs)
    found = fit_set(task.names, start, context.run, posterior, settings, correction_n)
    return {"message": found} if isinstance(found, str) else as_json(found)


def _promised_gain(context: DiagnosisContext, task: ScoreTestTask) -> float:
    """Returns the gain [nats] that a mechanism promises by what it does to a force."""
    about, new = _posterior_beside(context, task)
    parts = [part for name in new for part in context.known[name].whole_or_parts]
    return promised(about, task.theta, context.neutral, parts, context.seed)


def _values_on_tangent(context: DiagnosisContext, task: ScoreTestTask) -> Mapping[str, float]:
    """Returns the best values of a set with one mechanism more, on the tangent of the run without it."""
    about, new = _posterior_beside(context, task)
    vector = np.clip(about.vector({**context.neutral, **task.theta}), *about.bounds)
    parts = [part for name in new for part in context.known[name].whole_or_parts]
    near = within(about, vector, TRUST)
    return fit((*task.names, *new), near, task.theta, context.neutral, context.seed, parts).theta


def _posterior_beside(context: DiagnosisContext, task: ScoreTestTask) -> tuple[LogPosterior, list[str]]:
    """Returns the posterior with one mechanism more about a run without it, and the names that are new."""
    new = [name for name in with_one(task.names, task.name, context.known) if name not in task.names]
    return context.posterior(task.names, [task.run], _as_array(task.correction_n), more=new), new


def _fit_of(context: DiagnosisContext, said: Mapping[str, Any], until_s: float | None = None) -> SetFit:
    """Returns a fit from what `as_json` made of it."""
    run = ModelRun(*(np.array(said["run"][name]) for name in ("theta", "force_n", "slopes_n")))
    correction_n = np.array(said["off_n"])
    about = context.posterior(
        said["fit"]["names"], [run], correction_n if correction_n.any() else None, until_s
    )
    return SetFit(restored(said["fit"], about), run, said["runs"], said["settled"], correction_n)


def _as_array(values: tuple[float, ...]) -> Array | None:
    return np.array(values) if values else None
