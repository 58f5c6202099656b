"""Checks fits by runs of the full model, and repeats fits for which the forward model is too far off.

The forward model has an error, which differs from one set of mechanisms to another. A run of the full model
at a fit shows it. The error is then added to the force of the forward model, and the set is fitted again. The
sets that compete at the end are therefore compared by forces that are as exact as the noise requires.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bayeskin.mismatch.search_context import SearchContext, fit_again, gained, noise_of, title
from bayeskin.mismatch.search_record import Check, Names
from bayeskin.mismatch.tasks import FitTask, FullRunTask
from bayeskin.mismatch.trust_region import SetFit
from bayeskin.types import Array


def checked_best(context: SearchContext) -> SetFit:
    """Returns the likeliest set; if the forward model solves mechanisms of the set, it is checked before.

    Without the check, an error of the forward model with these mechanisms could pass for further mechanisms.
    """
    for _ in range(context.settings.checks):
        best = context.record.best
        if not context.solved(best.fit.names) or is_checked_nearby(context, best):
            break
        check(context, [best])
    return context.record.best


def check_likely_sets(context: SearchContext) -> None:
    """Checks the likely sets until no unchecked set is likely."""
    for _ in range(context.settings.checks):
        if not (unchecked := _unchecked(context)):
            return
        check(context, unchecked)


def check(context: SearchContext, fits: Sequence[SetFit]) -> None:
    """Runs the full model at fits, and repeats the fits for which the forward model is too far off.

    Fits with the same mechanisms of the tissue share one run, at the first of them.
    """
    groups: dict[Names, list[SetFit]] = {}
    for fit in fits:
        groups.setdefault(context.solved(fit.fit.names), []).append(fit)
    firsts = [members[0] for members in groups.values()]
    forces = context.ask([FullRunTask(names, context.solved_values(first))
                          for names, first in zip(groups, firsts, strict=True)])  # fmt: skip
    again: list[FitTask] = []
    for first, members, full_n in zip(firsts, groups.values(), forces, strict=True):
        again += _record_checks(context, first, members, full_n)
    for task, answer in zip(again, context.ask(again), strict=True):
        if isinstance(answer, SetFit):
            context.record.fits[task.names] = answer


def is_checked_nearby(context: SearchContext, fit: SetFit) -> bool:
    """Returns whether the full model was run near a fit, with the same mechanisms of the tissue."""
    solved = context.solved(fit.fit.names)
    return any(
        context.solved(names) == solved and context.is_alike(fit, checked.theta)
        for names, checked in context.record.checks.items()
    )


def forward_error(fit: SetFit, full_n: object) -> Array:
    """Returns the error (m,) [N] of the forward model at a fit's run, before the fit's own correction.

    full_n : force (m,) [N] of the full model at the same values
    """
    return np.asarray(full_n) - (fit.run.force_n - fit.correction_n)


def _unchecked(context: SearchContext) -> list[SetFit]:
    """Returns the fits to check.

    These are the likely sets, the likeliest set itself if its run has changed since its check, and subsets of
    it that have the same mechanisms of the tissue and are not far behind.
    """
    record, settings = context.record, context.settings
    order = record.likeliest(len(record.fits))
    best = order[0]
    likely = [fit for fit in order[: settings.compared] if gained(best, fit) <= settings.close]
    solved = context.solved(best.fit.names)
    subsets = [
        fit for fit in order
        if set(fit.fit.names) < set(best.fit.names) and context.solved(fit.fit.names) == solved
        and gained(best, fit) <= settings.behind
    ]  # fmt: skip
    unchecked = {
        fit.fit.names: fit for fit in (*likely, *subsets)
        if fit.fit.names not in record.checks and not is_checked_nearby(context, fit)
    }  # fmt: skip
    last = record.checks.get(best.fit.names)
    best_is_checked = last is not None and np.array_equal(last.theta, best.run.theta)
    return list(unchecked.values() if best_is_checked else {best.fit.names: best, **unchecked}.values())


def _record_checks(
    context: SearchContext, first: SetFit, members: Sequence[SetFit], full_n: object
) -> list[FitTask]:
    """Records the result of a full run at the first of some fits for all of them; returns the fits to repeat.

    All fits have the same mechanisms of the tissue, so they are taken to have the same error of the forward
    model.
    """
    tasks = []
    for fit in members:
        names = fit.fit.names
        if isinstance(full_n, str):
            context.record.checks[names] = Check(first.run.theta, full_n, np.inf)
            context.tell(f"{title(names)}: the full model fails at the fit: {full_n}")
            continue
        error_n = forward_error(first, full_n)
        off = context.rms(error_n - fit.correction_n)
        context.record.checks[names] = Check(first.run.theta, np.asarray(full_n), off)
        if off > context.settings.exact * noise_of(context.binned):
            tasks.append(fit_again(fit, context.settings.runs, error_n))
            difference = f"the full model differs by {1e3 * off:.1f} mN RMS"
            context.tell(f"{title(names)}: {difference}; the set is fitted again with this correction")
    return tasks
