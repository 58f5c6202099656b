"""States which mechanisms may be taken for each other, because one force can hardly tell them apart."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import permutations

from bayeskin.proof.plans import CONCEALED

# Groups that one force channel at one speed cannot tell apart. No other group is allowed.
LOOK_ALIKES = (
    {"solid-viscoelasticity", "strain-dependent-permeability", "friction-creep"},
    {"device-friction", "viscous-drag"},
    {"preconditioning", "pad-slip", "slow-recovery"},
    {"force-offset", "device-friction"},
)
# These two sets may be taken for each other, but only as whole sets.
TAKEN_FOR_EACH_OTHER = ({"pre-stretch"}, {"force-offset", "strain-stiffening"})


def is_listed(name: str, group: Iterable[str]) -> bool:
    """Returns whether a mechanism and its group lie within one of the known groups of look-alikes.

    Mechanisms that no set conceals are ignored.
    """
    listed = (*LOOK_ALIKES, set.union(*TAKEN_FOR_EACH_OTHER))
    concealed = {name, *group} & set(CONCEALED)
    return name not in CONCEALED or len(concealed) == 1 or any(concealed <= known for known in listed)


def group_of(name: str) -> set[str]:
    """Returns the mechanism and all mechanisms that may be taken for it."""
    return {name}.union(*(group for group in LOOK_ALIKES if name in group))


def stands_for(named: set[str], truth: set[str]) -> bool:
    """Returns whether each mechanism of `named` can stand for one of `truth`, one to one.

    A mechanism can stand for itself and for its look-alikes.
    """
    if named in TAKEN_FOR_EACH_OTHER and truth in TAKEN_FOR_EACH_OTHER:
        return True
    if len(named) != len(truth):
        return False
    fixed = sorted(named)
    return any(
        all(n in group_of(t) for n, t in zip(fixed, order, strict=True)) for order in permutations(truth)
    )
