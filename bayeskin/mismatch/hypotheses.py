"""One rule for the verdict: probabilities of hypotheses in one family.

A hypothesis is a set of mechanisms, with or without something smooth beside it that has no name (a Gaussian
process, `discrepancy`). Each mechanism is there with the same prior probability, and so is what has no name.
The evidence of both kinds is that of the force linear about the set's fit, with the measured noise
(`Unexplained.log_evidence`). Probabilities are shares of all hypotheses that were weighed; sets that were
never fitted count as nothing.

A mechanism is named where it has nine chances in ten, or its look-alikes have them together and it is the
likeliest of these. But where something smooth is likelier than not, and the likeliest set explains less than
nine tenths of the squared misfit, nothing is named: a Gaussian process is a poor model of what is missing,
and mechanisms that fill its gaps gain beside it, too. Where none is named the mismatch is unknown, unless it
is likelier than not that nothing is missing.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from bayeskin.mechanisms import Mechanism
from bayeskin.mismatch.fit import Fit

PRIOR = 0.05  # of a mechanism to be at work, before the recording is seen
ODDS = float(np.log(PRIOR / (1.0 - PRIOR)))
PROBABLE = 0.9  # of a mechanism or its look-alikes, to be named
LIKELIER_THAN_NOT = 0.5
MOST_OF_IT = 0.9  # of the squared misfit, which names beside something smooth have to explain


@dataclass(frozen=True)
class Evidences:
    """Log evidences of a set: alone, and with something smooth beside it."""

    alone: float
    with_discrepancy: float


@dataclass(frozen=True)
class Hypothesis:
    """A set of mechanisms, with something smooth beside it or not; the logarithm of its weight."""

    names: tuple[str, ...]
    smooth: bool
    log_weight: float


@dataclass(frozen=True)
class NamedMechanism:
    """A mechanism that is named, its probability, and that of its look-alikes that are not named already."""

    name: str
    probability: float
    group: tuple[str, ...]
    group_probability: float


@dataclass(frozen=True)
class Judgement:
    """The verdict; probability that nothing is missing, and that something smooth without a name acts."""

    verdict: Literal["nothing-missing", "named", "unknown"]
    named: tuple[NamedMechanism, ...]
    nothing_probability: float
    smooth_probability: float


def weight(found: Fit) -> float:
    """Returns the logarithm of a set's weight: its evidence times the prior of its mechanisms."""
    return found.log_evidence + len(found.names) * ODDS


def hypotheses_of(names: tuple[str, ...], said: Evidences) -> tuple[Hypothesis, Hypothesis]:
    """Returns both hypotheses of a set."""
    own = len(names) * ODDS
    return (
        Hypothesis(names, False, said.alone + own),
        Hypothesis(names, True, said.with_discrepancy + own + ODDS),
    )


@dataclass(frozen=True)
class Family:
    """All hypotheses that are compared."""

    hypotheses: Sequence[Hypothesis]

    def probability(self, names: Collection[str]) -> float:
        """Returns the probability that any of these mechanisms acts."""
        return self._share([bool(set(names) & set(one.names)) for one in self.hypotheses])

    def probability_of_set(self, names: tuple[str, ...]) -> float:
        """Returns the probability that just these mechanisms act, something smooth beside them or not."""
        return self._share([one.names == names for one in self.hypotheses])

    def likeliest(self, names: tuple[str, ...]) -> float:
        """Returns the logarithm of the weight of a set's likeliest hypothesis."""
        return max(one.log_weight for one in self.hypotheses if one.names == names)

    @property
    def smooth(self) -> float:
        """Probability that something smooth without a name acts."""
        return self._share([one.smooth for one in self.hypotheses])

    @property
    def nothing(self) -> float:
        """Probability that nothing is missing."""
        return self._share([not one.names and not one.smooth for one in self.hypotheses])

    def _share(self, among: Sequence[bool]) -> float:
        logs = np.array([one.log_weight for one in self.hypotheses])
        share = np.exp(logs - logs.max())
        return float(share[np.array(among)].sum() / share.sum())


def judge_family(family: Family, known: Mapping[str, Mechanism], explained: float) -> Judgement:
    """Returns the verdict.

    explained : share of the base model's squared misfit that the likeliest set explains
    """
    alone = {name: family.probability([name]) for name in known}
    named: list[NamedMechanism] = []
    for name, probability in sorted(alone.items(), key=lambda item: -item[1]):
        likelier = [one.name for one in named]
        group = [other for other in known[name].group if other in known and other not in likelier]
        together = family.probability(group)
        likeliest = probability >= max(alone[other] for other in group)
        if probability >= PROBABLE or (likeliest and together >= PROBABLE):
            named.append(NamedMechanism(name, probability, known[name].group, together))
    if family.smooth > LIKELIER_THAN_NOT and explained < MOST_OF_IT:
        named = []
    if named:
        verdict: Literal["nothing-missing", "named", "unknown"] = "named"
    else:
        verdict = "nothing-missing" if family.nothing > LIKELIER_THAN_NOT else "unknown"
    return Judgement(verdict, tuple(named), family.nothing, family.smooth)
