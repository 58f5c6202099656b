"""Finds further maxima of the posterior of the most probable sets, from values that the force hardly informs.

A posterior often has several maxima whose forces hardly differ. The force hardly shows which of the layers
drains during the test, and whether the other layer drains at once or not at all. Intervals that ignore the
further maxima are too narrow. Besides, a set may be likelier than its rivals only because they were not at
their highest maxima.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from bayeskin.mismatch.candidates import shapes_of
from bayeskin.mismatch.full_checks import forward_error
from bayeskin.mismatch.hypotheses import weight
from bayeskin.mismatch.search_context import (
    SearchContext,
    correction,
    fit_again,
    gained,
    noise_of,
    title,
)
from bayeskin.mismatch.search_record import Check, Names
from bayeskin.mismatch.tasks import FitTask, FullRunTask
from bayeskin.mismatch.tissue_starts import nearest_tissues
from bayeskin.mismatch.trust_region import SetFit
from bayeskin.types import ParameterSpace


def find_further_maxima(context: SearchContext, weigh: Callable[[], None]) -> None:
    """Records further maxima of the rivals of the most probable set, then those of this set.

    weigh : compares the hypotheses again after a fit has changed
    """
    for rival in rivals(context, context.settings.rival):
        _record_maxima(context, rival, weigh)
    _record_maxima(context, context.record.chosen, weigh)


def rivals(context: SearchContext, behind: float) -> list[Names]:
    """Returns the sets that could become as likely as the most probable set, the likeliest first.

    A set that contains one of the others is no rival: `fit_larger_sets` fits it again from their new maxima.
    The set without mechanisms has no rivals, because all other sets contain it.

    behind : largest difference in log-probability from the most probable set
    """
    record, family = context.record, context.record.family
    if not record.chosen:
        return []
    sets = sorted((names for names in record.evidences if names), key=lambda names: -family.likeliest(names))
    least = family.likeliest(record.chosen) - behind
    near = [names for names in sets if family.likeliest(names) > least]
    smallest = [names for names in near if not any(set(other) < set(names) for other in near)]
    return [names for names in smallest if names != record.chosen]


def _record_maxima(context: SearchContext, names: Names, weigh: Callable[[], None]) -> None:
    """Records further maxima of a set.

    Their forces differ by so little that each maximum needs a run of the full model.
    """
    record, settings = context.record, context.settings
    if record.others_of(names):
        return
    best = record.fits[names]
    fits = _fits_elsewhere(context, best)
    forces = context.ask([FullRunTask(context.solved(names), context.solved_values(fit)) for fit in fits])
    maxima, checks = [best], list[Check]()
    for fit, full_n in zip(fits, forces, strict=True):
        if isinstance(full_n, str):
            continue
        error_n = forward_error(fit, full_n)
        check = Check(fit.run.theta, np.asarray(full_n), context.rms(error_n - fit.correction_n))
        corrected: object = fit
        if check.off > settings.exact * noise_of(context.binned):
            (corrected,) = context.ask([fit_again(fit, settings.runs, error_n)])
        for maximum in _distinct(context, [corrected], maxima, settings.close):
            context.tell(f"another maximum of {title(names)}: {gained(maximum, best):+.1f} nats")
            maxima.append(maximum)
            checks.append(check)
    highest = int(np.argmax([weight(fit.fit) for fit in maxima]))
    record.others += [*maxima[:highest], *maxima[highest + 1 :]]
    if highest:
        record.fits[names], record.checks[names] = maxima[highest], checks[highest - 1]
        fit_larger_sets(context, maxima[highest])
        weigh()


def fit_larger_sets(context: SearchContext, best: SetFit) -> None:
    """Repeats the fits of the sets that contain a set, from this set's new maximum."""
    record = context.record
    larger = [names for names in record.fits if set(best.fit.names) < set(names)]
    starts = [{**record.fits[names].fit.theta, **best.fit.theta} for names in larger]
    runs, correction_n = context.settings.runs, correction(best)
    climbs = [FitTask(names, start, runs, correction_n) for names, start in zip(larger, starts, strict=True)]
    for names, answer in zip(larger, context.ask(climbs), strict=True):
        before = record.fits[names]
        record.add(answer)
        if record.fits[names] is not before:
            record.checks.pop(names, None)


def _fits_elsewhere(context: SearchContext, best: SetFit) -> list[SetFit]:
    """Returns fits of a set that ended at other maxima and are not much less likely, the likeliest first."""
    settings, names, correction_n = context.settings, best.fit.names, correction(best)
    climbs = [
        FitTask(names, start, settings.first, correction_n) for start in _starts_elsewhere(context, best)
    ]
    first = _distinct(context, context.ask(climbs), [best], settings.behind)
    remaining = settings.runs - settings.first
    continued = context.ask([fit_again(fit, remaining, fit.correction_n) for fit in first if not fit.settled])
    ended = [*(fit for fit in first if fit.settled), *continued]
    return _distinct(context, ended, [best], settings.close)[: settings.maxima]


def _distinct(
    context: SearchContext, answers: Sequence[object], known: Sequence[SetFit], behind: float
) -> list[SetFit]:
    """Returns the fits among the answers that lie at new maxima: the likeliest fit of each maximum.

    known : fits at known maxima; behind : largest difference in weight [nats] from the first of them
    """
    fits = sorted((a for a in answers if isinstance(a, SetFit)), key=lambda fit: -weight(fit.fit))
    kept = list(known)
    for fit in fits:
        apart = not any(context.is_alike(fit, maximum.run.theta) for maximum in kept)
        if apart and gained(known[0], fit) <= behind:
            kept.append(fit)
    return kept[len(known) :]


def _starts_elsewhere(context: SearchContext, best: SetFit) -> list[dict[str, float]]:
    """Returns values from which further maxima may be reached.

    In some of them the permeabilities are equal, or exchanged, or one of them is near an end of its prior,
    and the moduli are those that suit the recording best. In others, a mechanism that the forward model
    solves has another shape.
    """
    theta, settings = best.fit.theta, context.settings
    limits = {p.name: (p.lower, p.upper) for p in context.base.parameters}
    flow = ParameterSpace(tuple(p for p in context.base.parameters if p.stress_power < 0))
    changes: list[dict[str, float]] = []
    if flow.dim:
        middle = float(np.exp(np.mean([np.log(theta[name]) for name in flow.names])))
        exchanged = {name: theta[partner] for name, partner in zip(flow.names, flow.names[::-1], strict=True)}
        changes = [dict.fromkeys(flow.names, middle), exchanged]
        for position in settings.ends:
            at_end = flow.from_unit(np.full(flow.dim, position))
            changes += [{name: float(value)} for name, value in zip(flow.names, at_end, strict=True)]
    changes = [{name: float(np.clip(value, *limits[name])) for name, value in change.items()}
               for change in changes]  # fmt: skip
    changes = [_with_best_moduli(context, {**theta, **change}, best) for change in changes]
    for name in context.solved(best.fit.names):
        mechanism = context.known[name]
        for _, *shapes in mechanism.whole_or_parts:
            changes += shapes_of(mechanism, shapes, settings.shapes) if shapes else []
    return [{**theta, **change} for change in changes]


def _with_best_moduli(context: SearchContext, theta: Mapping[str, float], best: SetFit) -> dict[str, float]:
    """Returns the base parameters, with the moduli changed so that the force is nearest to the recorded one.

    Several ratios of the moduli are tried, each at the stiffness that suits it best.
    """
    tissue = {name: theta[name] for name in context.base.names}
    first_modulus, *other_moduli = (p for p in context.base.parameters if p.stress_power > 0)
    tissues = [
        {**tissue, p.name: float(np.clip(ratio * tissue[first_modulus.name], p.lower, p.upper))}
        for p in other_moduli for ratio in context.settings.ratios
    ]  # fmt: skip
    nearest = nearest_tissues(context, best.fit.names, [tissue, *tissues], theta)
    return next(iter(nearest), tissue)
