"""Decides the verdict by one rule, from the probabilities of a family of hypotheses.

A hypothesis is a set of mechanisms, with or without an unnamed smooth discrepancy (a Gaussian process,
`discrepancy`). Every mechanism has the same prior probability, and the discrepancy has it, too. The evidence
of every hypothesis takes the force as linear near the set's fit, and uses the measured noise
(`Unexplained.log_evidence`). This evidence has an error: the posterior is curved, and the fit may have ended
at a lower maximum of it. Each mechanism is taken to add an independent normal error to the log-evidences of
all sets that contain it. A probability is a share of the weights of all hypotheses that were compared,
averaged over these errors. Sets that were never fitted do not count.

A mechanism is named if its probability is at least 0.9. It is also named if its group of look-alikes has this
probability together, and it is the likeliest of the group. There is an exception: nothing is named where the
discrepancy is likelier than not and the likeliest set explains less than nine tenths of the squared misfit. A
Gaussian process is a poor model of a missing mechanism, and mechanisms that fill the gaps of this model gain
evidence, too. Where nothing is named the verdict is unknown, unless it is likelier than not that nothing is
missing.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.stats import norm, qmc

from bayeskin.mechanisms import Mechanism
from bayeskin.mismatch.fit import Fit
from bayeskin.types import Array

ERRORS = 1024  # number of draws of the evidences' errors, a power of two


@dataclass(frozen=True)
class VerdictSettings:
    """Probabilities of the rule that gives the verdict.

    prior : prior probability that a mechanism acts
    probable : probability of a mechanism, or of its look-alikes, from which it is named
    likelier_than_not : probability from which a discrepancy, or that nothing is missing, is likelier than not
    most_of_it : share of the squared misfit that named mechanisms must explain where a discrepancy is
        likelier than not
    evidence_sd : sd of the error that each mechanism of a set adds to its log-evidence [nats]
    `benchmarks/diagnosis_scoreboard.py` shows which verdicts other values would give.
    """

    prior: float = 0.05
    probable: float = 0.9
    likelier_than_not: float = 0.5
    most_of_it: float = 0.9
    evidence_sd: float = 3.0

    @property
    def log_odds(self) -> float:
        """Returns the logarithm of the prior odds that a mechanism acts."""
        return float(np.log(self.prior / (1.0 - self.prior)))


@dataclass(frozen=True)
class Evidences:
    """Log-evidences of a set: alone, and with an unnamed smooth discrepancy."""

    alone: float
    with_discrepancy: float


@dataclass(frozen=True)
class Hypothesis:
    """A set of mechanisms, with or without an unnamed discrepancy (`smooth`), and its log weight."""

    names: tuple[str, ...]
    smooth: bool
    log_weight: float


@dataclass(frozen=True)
class NamedMechanism:
    """A named mechanism and its probability.

    group : the look-alikes of the mechanism, with its own name
    group_probability : probability that one of them acts, without those that are named already
    """

    name: str
    probability: float
    group: tuple[str, ...]
    group_probability: float


@dataclass(frozen=True)
class Judgement:
    """The verdict and the named mechanisms.

    nothing_probability : probability that nothing is missing
    smooth_probability : probability that an unnamed smooth discrepancy acts
    """

    verdict: Literal["nothing-missing", "named", "unknown"]
    named: tuple[NamedMechanism, ...]
    nothing_probability: float
    smooth_probability: float


def weight(fit: Fit, settings: VerdictSettings = VerdictSettings()) -> float:
    """Returns the logarithm of a set's weight: its evidence times the prior odds of its mechanisms."""
    return fit.log_evidence + len(fit.names) * settings.log_odds


def hypotheses_of(
    names: tuple[str, ...], evidences: Evidences, settings: VerdictSettings = VerdictSettings()
) -> tuple[Hypothesis, Hypothesis]:
    """Returns both hypotheses of a set: without and with an unnamed discrepancy."""
    log_prior = len(names) * settings.log_odds
    return (
        Hypothesis(names, False, evidences.alone + log_prior),
        Hypothesis(names, True, evidences.with_discrepancy + log_prior + settings.log_odds),
    )


@dataclass(frozen=True)
class Family:
    """All hypotheses that are compared.

    evidence_sd : sd of the error that each mechanism of a set adds to its log-evidence [nats]
    """

    hypotheses: Sequence[Hypothesis]
    evidence_sd: float = VerdictSettings().evidence_sd

    def probability(self, names: Collection[str]) -> float:
        """Returns the probability that at least one of these mechanisms acts."""
        return self._share([bool(set(names) & set(hypothesis.names)) for hypothesis in self.hypotheses])

    def probability_of_set(self, names: tuple[str, ...]) -> float:
        """Returns the probability that exactly these mechanisms act, with or without a discrepancy."""
        return self._share([hypothesis.names == names for hypothesis in self.hypotheses])

    def likeliest(self, names: tuple[str, ...]) -> float:
        """Returns the logarithm of the weight of a set's likeliest hypothesis."""
        return max(hypothesis.log_weight for hypothesis in self.hypotheses if hypothesis.names == names)

    @property
    def smooth(self) -> float:
        """Returns the probability that an unnamed smooth discrepancy acts."""
        return self._share([hypothesis.smooth for hypothesis in self.hypotheses])

    @property
    def nothing(self) -> float:
        """Returns the probability that nothing is missing."""
        return self._share([not hypothesis.names and not hypothesis.smooth for hypothesis in self.hypotheses])

    def _share(self, among: Sequence[bool]) -> float:
        """Returns the probability that some of the hypotheses have together."""
        return float(self._probabilities[np.array(among)].sum())

    @cached_property
    def _probabilities(self) -> Array:
        """Returns the probability (h,) of each hypothesis, as the mean over errors of the evidences."""
        log_weights = np.array([hypothesis.log_weight for hypothesis in self.hypotheses])
        names = sorted({name for hypothesis in self.hypotheses for name in hypothesis.names})
        if names:
            errors = self.evidence_sd * norm.ppf(qmc.Sobol(len(names), rng=0).random(ERRORS))
            acts = np.array([[name in h.names for name in names] for h in self.hypotheses], dtype=float)
            log_weights = log_weights + errors @ acts.T
        else:
            log_weights = log_weights[None]
        weights = np.exp(log_weights - log_weights.max(axis=1, keepdims=True))
        return np.asarray((weights / weights.sum(axis=1, keepdims=True)).mean(axis=0))


def judge_family(
    family: Family, known: Mapping[str, Mechanism], explained: float,
    settings: VerdictSettings = VerdictSettings(),
) -> Judgement:  # fmt: skip
    """Returns the verdict with the named mechanisms.

    known : all mechanisms by name
    explained : share of the base model's squared misfit that the likeliest set explains
    """
    alone = {name: family.probability([name]) for name in known}
    named: list[NamedMechanism] = []
    for name, probability in sorted(alone.items(), key=lambda item: -item[1]):
        already_named = [mechanism.name for mechanism in named]
        group = [member for member in known[name].group if member in known and member not in already_named]
        together = family.probability(group)
        likeliest = probability >= max(alone[member] for member in group)
        if probability >= settings.probable or (likeliest and together >= settings.probable):
            named.append(NamedMechanism(name, probability, known[name].group, together))
    if family.smooth > settings.likelier_than_not and explained < settings.most_of_it:
        named = []
    if named:
        verdict: Literal["nothing-missing", "named", "unknown"] = "named"
    else:
        verdict = "nothing-missing" if family.nothing > settings.likelier_than_not else "unknown"
    return Judgement(verdict, tuple(named), family.nothing, family.smooth)
