"""Searches for mechanisms; the forward model solves all mechanisms of a set together.

The search starts from the fit without mechanisms and adds mechanisms. Score tests rank all mechanisms that
could be added to the current set (`candidates`). The most promising ones are fitted, with all other
parameters free again. The set with the largest weight becomes the current set if it gains weight. A missing
mechanism biases the tissue's parameters, so the sets that gain most are also fitted from other tissues. Then
each mechanism of the best set is left out in turn. Where nothing gains any more, each mechanism of the best
set, or of its smallest likely part, is exchanged: it is left out, and every other mechanism is added to the
remaining ones, at the tissue of this set.

A mechanism that is not in the catalogue is imitated by several mechanisms of the catalogue, and each of these
gains. The search therefore continues from a larger set only if one of its two hypotheses, alone or with an
unnamed smooth discrepancy, is likelier than both hypotheses of the smaller set.

At the end, higher maxima are searched for the sets that could become as likely as the most probable one, and
mechanisms are added to those that are nearly as likely (`further_maxima`).

Runs of the full model check a fit before the search continues from its set, and all likely sets at the end
(`full_checks`). The weight of a set is its evidence times the prior odds of its mechanisms.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence

from scipy.stats import qmc

from bayeskin.errors import InputError
from bayeskin.mechanisms import Mechanism, without_one
from bayeskin.mismatch.candidates import Candidates
from bayeskin.mismatch.full_checks import check, check_likely_sets, checked_best, is_checked_nearby
from bayeskin.mismatch.further_maxima import find_further_maxima, rivals
from bayeskin.mismatch.hypotheses import Evidences, weight
from bayeskin.mismatch.search_context import SearchContext, Tell, correction, gained, title
from bayeskin.mismatch.search_record import Names, SearchResult
from bayeskin.mismatch.search_settings import SearchSettings
from bayeskin.mismatch.stiffness_ratio import subcutis_too_stiff
from bayeskin.mismatch.tasks import AnswerTasks, EvidenceTask, FitTask
from bayeskin.mismatch.tissue_starts import nearest_tissues
from bayeskin.mismatch.trust_region import SetFit, as_json
from bayeskin.types import BinnedForce, ParameterSpace


def search(
    ask: AnswerTasks, binned: BinnedForce, base: ParameterSpace, known: Mapping[str, Mechanism],
    solves: Collection[str], noise: Mapping[str, float], seed: int, tell: Tell,
    settings: SearchSettings = SearchSettings(),
) -> SearchResult:  # fmt: skip
    """Returns the fits of all sets that the search has fitted, and the evidences of the likely ones.

    ask : answers tasks by running the models; tell : receives lines of progress
    base : priors of the base model; known : mechanisms by name; solves : names of the mechanisms that the
        forward model solves; noise : values of the noise parameters from which fits start
    Raises InputError where the model runs with no tissue of these priors.
    """
    context = SearchContext(ask, binned, base, known, frozenset(solves), noise, seed, tell, settings)
    searcher = Searcher(context)
    searcher.fit_base_model()
    searcher.search_sets()
    searcher.weigh_likely_sets()
    if context.record.evidences:
        find_further_maxima(context, searcher.weigh_likely_sets)
        if searcher.search_beside_rivals():
            find_further_maxima(context, searcher.weigh_likely_sets)
    return context.record.result()


class Searcher:
    """Makes the steps of a search, each of which changes the context's record."""

    def __init__(self, context: SearchContext) -> None:
        self._context = context
        self._candidates = Candidates(context)
        self._tissues: list[dict[str, float]] = []
        self._weighed: dict[Names, SetFit] = {}  # the fit to which each evidence belongs
        self._exchanged: set[Names] = set()  # sets whose mechanisms were replaced by others

    def fit_base_model(self) -> None:
        """Fits the model without mechanisms. Raises InputError where no tissue of the priors runs."""
        context, settings = self._context, self._context.settings
        rows = context.base.from_unit(qmc.Sobol(context.base.dim, rng=context.seed).random(settings.skins))
        rows = rows[~subcutis_too_stiff(context.base, rows)]
        drawn = [dict(zip(context.base.names, map(float, row), strict=True)) for row in rows]
        self._tissues = nearest_tissues(context, (), drawn, {})
        answers = context.ask([FitTask((), {**context.noise, **tissue}, settings.first)
                               for tissue in self._tissues[: settings.starts]])  # fmt: skip
        context.keep(answers)
        if not context.record.fits:
            why = next((f" ({answer})" for answer in answers if isinstance(answer, str)), "")
            remedy = "they must allow tissues for which the model runs, with an E_s of at most twice E_c"
            raise InputError("priors", f"the model runs for no tissue that they allow{why}", remedy)

    def search_sets(self) -> None:
        """Adds, leaves out and exchanges mechanisms as long as this gains weight."""
        context, settings = self._context, self._context.settings
        for _ in range(2 * settings.most):
            current = checked_best(context)
            if current.fit.names not in self._candidates.expanded and len(current.fit.names) < settings.most:
                self._forward(current)
                if self._gains(current) and not self._beats_discrepancy(current.fit.names):
                    check_likely_sets(context)
                    return
            if not self._gains(current):
                self._exchange(current)
            if not self._gains(current):
                check_likely_sets(context)
            if not self._gains(current):
                return

    def weigh_likely_sets(self) -> None:
        """Computes the evidences of the likeliest sets, and of all sets that have been weighed before.

        The most probable set is then checked by the full model, until it has been checked.
        """
        record, settings = self._context.record, self._context.settings
        before = list(record.evidences)
        sets = [fit.fit.names for fit in record.likeliest(settings.weighed)]
        self._weigh(dict.fromkeys([*sets, *before]))
        for _ in range(settings.checks):
            if not record.evidences or record.chosen in record.checks:
                return
            names = record.chosen
            check(self._context, [record.fits[names]])
            self._weigh([names])

    def search_beside_rivals(self) -> bool:
        """Adds mechanisms to the rivals of the most probable set; returns whether there was one to add to.

        The search adds mechanisms to the likeliest set only. Where another set is nearly as likely, its
        larger sets must be compared too; otherwise the likeliest set would gain by their absence.
        """
        context, expanded = self._context, self._candidates.expanded
        new = [names for names in rivals(context, context.settings.close) if names not in expanded]
        for names in new:
            self._candidates.fit_beside(context.record.fits[names])
        if new:
            check_likely_sets(context)
            self.weigh_likely_sets()
        return bool(new)

    def _weigh(self, sets: Iterable[Names]) -> None:
        """Computes the evidences of sets that are new or whose fit has changed.

        A set for which this fails has no evidence.
        """
        record = self._context.record
        new = [names for names in sets if self._weighed.get(names) is not record.fits[names]]
        answers = self._context.ask([EvidenceTask(as_json(record.fits[names])) for names in new])
        for names, answer in zip(new, answers, strict=True):
            record.evidences.pop(names, None)
            self._weighed[names] = record.fits[names]
            if isinstance(answer, Evidences):
                record.evidences[names] = answer
            else:
                self._context.tell(f"{title(names)}: the evidence could not be computed: {answer}")

    def _beats_discrepancy(self, names: Names) -> bool:
        """Returns whether the best set is likelier than a smaller set, by more than the required gain.

        Each of the two sets is taken with or without an unnamed discrepancy, whichever is likelier.
        """
        record, gain = self._context.record, self._context.settings.gain
        best = record.best.fit.names
        self._weigh([names, best])
        if not {names, best} <= set(record.evidences):
            return True
        family = record.family
        difference = family.likeliest(best) - family.likeliest(names)
        if difference < gain:
            self._context.tell(
                f"{title(names)} with an unnamed smooth discrepancy is as likely as {title(best)} with or "
                f"without one: {-difference:+.1f} nats"
            )
        return difference >= gain

    def _gains(self, current: SetFit) -> bool:
        """Returns whether the best set gains enough over the current one for the search to continue."""
        record = self._context.record
        return gained(record.best, record.fits[current.fit.names]) >= self._context.settings.gain

    def _forward(self, current: SetFit) -> None:
        """Fits the sets with one mechanism more, and improves the fits of those that gain most.

        Sets that gain much may have gained by a better tissue, and not by a mechanism. So the current set is
        fitted again from their tissues, and they from the tissue of the best of them. The best set is also
        fitted from other tissues if it leaves more than noise. Then the full model checks the sets that gain
        much, since the forward model may be far off with one of their mechanisms. At last, each mechanism of
        the best set is left out.
        """
        context, record = self._context, self._context.record
        sets = self._candidates.fit_beside(current)
        if not self._gains(current):
            return
        strong = self._strongest(sets, current)
        starts = [(current, fit.fit.theta) for fit in strong]
        starts += [(fit, {**fit.fit.theta, **context.base_values(strong[0])}) for fit in strong[1:]]
        context.keep(context.ask([
            FitTask(fit.fit.names, theta, context.settings.first, correction(fit)) for fit, theta in starts
        ]))  # fmt: skip
        best = record.fits[strong[0].fit.names] if strong else current
        if context.leaves_more_than_noise(best):
            self._fit_from_other_tissues(best)
        check(context, [
            now for fit in strong
            if context.solved(fit.fit.names)
            and not is_checked_nearby(context, now := record.fits[fit.fit.names])
        ])  # fmt: skip
        self._fit_smaller_sets(record.best)

    def _strongest(self, sets: Sequence[Names], current: SetFit) -> list[SetFit]:
        """Returns the fits that gain so much that a missing mechanism may have biased the current tissue."""
        settings, record = self._context.settings, self._context.record
        fits = sorted((record.fits[names] for names in sets if names in record.fits),
                      key=lambda fit: -weight(fit.fit))  # fmt: skip
        least = max(settings.near * gained(fits[0], current), settings.astray)
        return [fit for fit in fits[: settings.alike] if gained(fit, current) >= least]

    def _exchange(self, current: SetFit) -> None:
        """Fits sets in which each mechanism of the smallest likely part of a set is replaced by another one.

        The tests of the other mechanisms use the tissue of this part. The tissue that fits best without the
        mechanism is biased, and at this tissue the tests may promise hardly any gain.
        """
        context, part = self._context, self._smallest_part(current)
        names = part.fit.names
        if names in self._exchanged:
            return
        self._exchanged.add(names)
        smaller_sets = dict.fromkeys(without_one(names, name, context.known) for name in names)
        for smaller in smaller_sets:
            correction_n = correction(part) if context.solved(smaller) == context.solved(names) else ()
            (at_tissue,) = context.ask([FitTask(smaller, part.fit.theta, 1, correction_n)])
            if isinstance(at_tissue, SetFit):
                self._candidates.fit_beside(at_tissue)

    def _smallest_part(self, current: SetFit) -> SetFit:
        """Returns the fit of the set with the fewest mechanisms among the likely parts of a set.

        The set itself is one of its parts. Of several sets with as few mechanisms it is the likeliest.
        """
        parts = [
            fit for names, fit in self._context.record.fits.items()
            if names and set(names) <= set(current.fit.names)
            and gained(current, fit) <= self._context.settings.close
        ]  # fmt: skip
        return min(parts, key=lambda fit: (len(fit.fit.names), -weight(fit.fit)), default=current)

    def _fit_from_other_tissues(self, current: SetFit) -> None:
        """Fits a set again from other tissues, with the present values of its mechanisms."""
        context, settings, names = self._context, self._context.settings, current.fit.names
        tissues = nearest_tissues(context, names, self._tissues[: settings.others], current.fit.theta)
        context.keep(context.ask([
            FitTask(names, {**current.fit.theta, **tissue}, settings.first, correction(current))
            for tissue in tissues[: settings.tried]
        ]))  # fmt: skip
        gain = gained(context.record.fits[names], current)
        context.tell(f"{title(names)}, fitted from other tissues: {gain:+.1f} nats")

    def _fit_smaller_sets(self, current: SetFit) -> None:
        """Fits the sets with one mechanism less that have not been fitted yet."""
        context, names = self._context, current.fit.names
        smaller = {without_one(names, name, context.known) for name in names} - {()}
        context.keep(context.ask([
            FitTask(part, current.fit.theta, context.settings.first)
            for part in sorted(smaller) if part not in context.record.fits
        ]))  # fmt: skip
