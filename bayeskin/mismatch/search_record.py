"""Records the sets of mechanisms that a search has fitted, the checks of these fits, and the evidences.

While a search runs it keeps a `SearchRecord`, which changes. It returns a `SearchResult`, which is frozen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from bayeskin.mismatch.hypotheses import Evidences, Family, hypotheses_of, weight
from bayeskin.mismatch.trust_region import SetFit
from bayeskin.types import Array

Names = tuple[str, ...]  # the sorted names of a set's mechanisms


@dataclass(frozen=True)
class Check:
    """A run of the full model that checks a fit.

    theta : values of the forward model's parameters at this run
    full_n : force (m,) [N] of the skin by the full model, or the message of a run that failed
    off : difference between full model and forward model after the fit's correction, RMS over bins [N];
        infinite where the run failed
    """

    theta: Array
    full_n: Array | str
    off: float


class _Sets:
    """Computes properties of the fits and the evidences of sets."""

    fits: Mapping[Names, SetFit]
    evidences: Mapping[Names, Evidences]
    others: Sequence[SetFit]

    @property
    def best(self) -> SetFit:
        """Returns the fit of the set with the largest weight."""
        return max(self.fits.values(), key=lambda fit: weight(fit.fit))

    @property
    def family(self) -> Family:
        """Returns the hypotheses that are compared."""
        return Family(
            [h for names, evidences in self.evidences.items() for h in hypotheses_of(names, evidences)]
        )

    @property
    def chosen(self) -> Names:
        """Returns the most probable of the compared sets, with or without a discrepancy."""
        return max(self.evidences, key=self.family.probability_of_set)

    def others_of(self, names: Names) -> list[SetFit]:
        """Returns the further maxima of a set."""
        return [fit for fit in self.others if fit.fit.names == names]

    def likeliest(self, count: int) -> list[SetFit]:
        """Returns the `count` fits with the largest weights, and always the fit without mechanisms."""
        order = sorted(self.fits.values(), key=lambda fit: -weight(fit.fit))
        with_mechanisms = [fit for fit in order if fit.fit.names]
        return sorted([*with_mechanisms[: count - 1], self.fits[()]], key=lambda fit: -weight(fit.fit))


@dataclass(frozen=True)
class SearchResult(_Sets):
    """The result of a search.

    fits : the fit with the largest weight, for each set; checks : the last check of each set
    evidences : evidences of the sets whose hypotheses are compared
    others : further maxima of the most probable set and of a subset of it, less likely than those in `fits`
    """

    fits: Mapping[Names, SetFit]
    checks: Mapping[Names, Check]
    evidences: Mapping[Names, Evidences]
    others: tuple[SetFit, ...]


@dataclass
class SearchRecord(_Sets):
    """The record that a search keeps while it runs; its fields are those of `SearchResult`."""

    fits: dict[Names, SetFit] = field(default_factory=dict)
    checks: dict[Names, Check] = field(default_factory=dict)
    evidences: dict[Names, Evidences] = field(default_factory=dict)
    others: list[SetFit] = field(default_factory=list)

    def add(self, answer: object) -> None:
        """Keeps a fit if it is the likeliest of its set; an answer that is no fit is ignored."""
        if isinstance(answer, SetFit) and np.isfinite(answer.fit.value):
            names = answer.fit.names
            if names not in self.fits or weight(answer.fit) > weight(self.fits[names].fit):
                self.fits[names] = answer

    def result(self) -> SearchResult:
        """Returns the record as it stands, frozen."""
        fits, checks, evidences = (
            MappingProxyType(dict(values)) for values in (self.fits, self.checks, self.evidences)
        )
        return SearchResult(fits, checks, evidences, tuple(self.others))  # type: ignore[arg-type]
