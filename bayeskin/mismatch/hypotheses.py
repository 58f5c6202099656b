"""One rule for the verdict: probabilities of hypotheses in one family.

A hypothesis is a set of mechanisms, alone or with something beside it that has no name: something smooth (a
Gaussian process, `discrepancy`), or something local, that acts within one window of the recording only. Each
mechanism is there with the same prior probability, and so is each kind of what has no name. The evidence of a
set, alone or with something smooth, is that of the force linear about the set's fit, with the measured noise
(`Unexplained.log_evidence`). How much likelier something local makes the residual is not known, since nobody
knows its form. But with p, the chance that noise alone leaves a window as far off (`locate`), it is at most
1 / (-e p log p), whatever form it has of those whose p falls steadily (Sellke, Bayarri & Berger 2001, Am.
Stat. 55:62). That is what it counts for. Probabilities are shares of all hypotheses that were weighed; sets
that were never fitted count as nothing.

A mechanism is named where it has nine chances in ten, or its look-alikes have them together and it is the
likeliest of these. Where none is named the mismatch is unknown if something without a name is likelier than
not; elsewhere nothing is missing.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from bayeskin.mechanisms import Mechanism
from bayeskin.mismatch.search import PRIOR

PROBABLE = 0.9  # of a mechanism or its look-alikes, to be named
LIKELIER_THAN_NOT = 0.5
Unnamed = Literal["smooth", "local"]


@dataclass(frozen=True)
class Evidences:
    """What speaks for a set: its log evidences alone and with something smooth beside it.

    chance : that noise leaves some window as far off as the farthest that the set leaves
    """

    alone: float
    with_smooth: float
    chance: float


@dataclass(frozen=True)
class Hypothesis:
    """A set of mechanisms, what without a name is beside it, if anything, and the logarithm of its weight."""

    names: tuple[str, ...]
    unnamed: Unnamed | None
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
    """The verdict; probabilities that nothing is missing, and that something smooth or local has no name."""

    verdict: Literal["nothing-missing", "named", "unknown"]
    named: tuple[NamedMechanism, ...]
    nothing_probability: float
    smooth_probability: float
    local_probability: float


def hypotheses_of(names: tuple[str, ...], said: Evidences) -> tuple[Hypothesis, ...]:
    """Returns the hypotheses of a set."""
    odds = float(np.log(PRIOR / (1.0 - PRIOR)))
    own = len(names) * odds
    with_local = said.alone + _most_for(said.chance)
    return (
        Hypothesis(names, None, said.alone + own),
        Hypothesis(names, "smooth", said.with_smooth + own + odds),
        Hypothesis(names, "local", with_local + own + odds),
    )


def _most_for(chance: float) -> float:
    """Returns the most nats that a chance under a hypothesis can speak for another one."""
    chance = max(chance, np.finfo(float).tiny)
    return 0.0 if chance > 1.0 / np.e else float(-1.0 - np.log(chance) - np.log(-np.log(chance)))


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

    def unnamed(self, kind: Unnamed) -> float:
        """Returns the probability that something of this kind acts that has no name."""
        return self._share([one.unnamed == kind for one in self.hypotheses])

    @property
    def nothing(self) -> float:
        """Probability that nothing is missing."""
        return self._share([not one.names and not one.unnamed for one in self.hypotheses])

    def _share(self, among: Sequence[bool]) -> float:
        logs = np.array([one.log_weight for one in self.hypotheses])
        share = np.exp(logs - logs.max())
        return float(share[np.array(among)].sum() / share.sum())


def judge_family(family: Family, known: Mapping[str, Mechanism]) -> Judgement:
    """Returns the verdict."""
    alone = {name: family.probability([name]) for name in known}
    smooth, local = family.unnamed("smooth"), family.unnamed("local")
    named: list[NamedMechanism] = []
    for name, probability in sorted(alone.items(), key=lambda item: -item[1]):
        likelier = [one.name for one in named]
        group = [other for other in known[name].group if other in known and other not in likelier]
        together = family.probability(group)
        likeliest = probability >= max(alone[other] for other in group)
        if probability >= PROBABLE or (likeliest and together >= PROBABLE):
            named.append(NamedMechanism(name, probability, known[name].group, together))
    if named:
        verdict: Literal["nothing-missing", "named", "unknown"] = "named"
    else:
        verdict = "unknown" if smooth + local > LIKELIER_THAN_NOT else "nothing-missing"
    return Judgement(verdict, tuple(named), family.nothing, smooth, local)
