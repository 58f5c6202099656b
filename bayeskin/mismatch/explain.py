"""Explains a recording: searches for mechanisms, judges the sets, and samples the most probable set.

All runs of the models that a diagnosis needs are made here, by tasks that worker processes answer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from bayeskin.mismatch.agreement import Agreement, agreements
from bayeskin.mismatch.context import DiagnosisContext
from bayeskin.mismatch.emulate import EmulatedPosterior, Learn
from bayeskin.mismatch.held_out import Beginning, end_of_second_hold, fit_beginning
from bayeskin.mismatch.hypotheses import Judgement, judge_family
from bayeskin.mismatch.misfit import explained_share
from bayeskin.mismatch.search import search
from bayeskin.mismatch.search_context import Tell
from bayeskin.mismatch.search_record import Names, SearchResult
from bayeskin.mismatch.set_posterior import posterior_by_emulator
from bayeskin.mismatch.tasks import AnswerTasks

POSSIBLE = 1e-6  # probability of a set below which it is not fitted to the recording's beginning


@dataclass(frozen=True)
class Explanation:
    """The sets of mechanisms that explain a recording.

    judgement : the verdict; explained : share of the base model's squared misfit that the best set explains
    split_s : end of the recording's beginning [s], or None where no third hold follows
    beginning : fits to the beginning, or None where they failed
    emulated : posterior of the best set
    agreement : how each of several recordings agrees with the others; empty for a single recording
    """

    search: SearchResult
    judgement: Judgement
    explained: float
    split_s: float | None
    beginning: Beginning | None
    emulated: EmulatedPosterior
    agreement: Sequence[Agreement] = ()

    @property
    def best(self) -> Names:
        """Returns the most probable set."""
        return self.search.chosen


def searched(context: DiagnosisContext, ask: AnswerTasks, tell: Tell) -> SearchResult:
    """Returns the result of the search for mechanisms; `tell` receives lines of progress.

    After a diagnosis it needs no model runs, because all answers to its tasks have been kept.
    """
    return search(
        ask, context.binned, context.base, context.known, context.forward.solves, context.noise,
        context.seed, lambda text: tell(f"search: {text}"),
    )  # fmt: skip


def explain(context: DiagnosisContext, ask: AnswerTasks, learn: Learn, tell: Tell) -> Explanation | None:
    """Returns the explanation of a recording, or None where no set of mechanisms has an evidence.

    learn : makes an emulator from runs of the forward model; tell : receives lines of progress
    """
    result = searched(context, ask, tell)
    if not result.evidences:
        return None
    family, best = result.family, result.chosen
    base_n, best_n = (result.fits[names].fit.force_n for names in ((), best))
    explained = explained_share(context.binned, base_n, best_n)
    judgement = judge_family(family, context.known, explained)
    split_s = end_of_second_hold(context.binned)
    possible = [result.fits[names] for names in result.evidences
                if not names or family.probability_of_set(names) > POSSIBLE]  # fmt: skip
    beginning = fit_beginning(ask, possible, split_s)
    tell("runs in the region of the posterior, and draws from it")
    maxima = [result.fits[best], *result.others_of(best)]
    emulated = posterior_by_emulator(context, ask, maxima, learn)
    agreement = agreements(ask, context, result.fits[best])
    return Explanation(result, judgement, explained, split_s, beginning, emulated, agreement)
