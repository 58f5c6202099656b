"""The catalogue of mechanisms: effects that the base model leaves out, each in a file of its own.

Every module of this package that defines `MECHANISM` adds this entry to the catalogue. So does every entry
point of the group "bayeskin.mechanisms" of any installed package.
"""

from __future__ import annotations

import importlib
import pkgutil
import sys
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from importlib.metadata import EntryPoint, entry_points

import numpy as np

from bayeskin.errors import InputError
from bayeskin.mechanisms.mechanism import (
    Bins,
    Mechanism,
    bin_means,
    laws,
    observed,
    solved,
    with_one,
    without_one,
)
from bayeskin.types import ParameterSpace

ENTRY_POINTS = "bayeskin.mechanisms"


def catalogue() -> dict[str, Mechanism]:
    """Returns all mechanisms by name, in alphabetical order.

    Raises InputError if two mechanisms or two parameters have the same name. It also raises InputError if a
    mechanism needs one that is not in the catalogue, or one that itself needs another, and if an entry point
    provides no mechanism.
    """
    return dict(_catalogue_on(tuple(sys.path)))


@cache  # entry points are searched for in every installed package, and models ask at each run
def _catalogue_on(_: tuple[str, ...]) -> dict[str, Mechanism]:
    """Returns the catalogue with the packages that are installed on a search path."""
    modules = [importlib.import_module(f"{__name__}.{m.name}") for m in pkgutil.iter_modules(__path__)]
    mechanisms = [module.MECHANISM for module in modules if hasattr(module, "MECHANISM")]
    mechanisms += [_checked(_loaded(entry)) for entry in entry_points(group=ENTRY_POINTS)]
    _check_names(mechanisms)
    known = {m.name: m for m in sorted(mechanisms, key=lambda m: m.name)}
    for mechanism in mechanisms:
        for name in mechanism.needs:
            if name not in known or known[name].needs:
                raise InputError(
                    mechanism.name,
                    f"it needs {name}",
                    "it can need only mechanisms of the catalogue that need none themselves",
                )
    return _with_both_look_alikes(known)


def _loaded(entry: EntryPoint) -> Mechanism:
    """Returns the mechanism of an entry point. Raises InputError if it cannot be imported or is none."""
    where = f"entry point {entry.name} = {entry.value}"
    try:
        mechanism = entry.load()
    except Exception as error:  # the file of another package can raise any exception
        remedy = f'correct its file (python -c "import {entry.module}" may show more)'
        raise InputError(where, f"it cannot be imported ({type(error).__name__}: {error})", remedy) from None
    if not isinstance(mechanism, Mechanism):
        raise InputError(
            where, f"it is an object of the type {type(mechanism).__name__}", "it must be a Mechanism"
        )
    return mechanism


def _checked(mechanism: Mechanism) -> Mechanism:
    """Returns a mechanism whose `neutral` has all parameters: those that it lacks get their prior's median.

    Raises InputError if `neutral` names another parameter, or none, and if a prior has no such bounds.
    """
    where, names = f"mechanism {mechanism.name}", [p.name for p in mechanism.parameters]
    for p in mechanism.parameters:
        if not p.lower < p.upper or (p.in_log and not p.lower + p.offset > 0.0):
            remedy = "the lower bound must be below the upper, and above 0 where the prior is logarithmic"
            raise InputError(
                f"{where}: {p.name}", f"its prior is {p.prior} from {p.lower:g} to {p.upper:g}", remedy
            )
    if not mechanism.neutral or not set(names).issuperset(mechanism.neutral):
        problem = f"`neutral` names {', '.join(mechanism.neutral) or 'no parameter'}"
        raise InputError(
            where, problem, f"it must name at least one of its parameters {', '.join(names)}, and no other"
        )
    medians = ParameterSpace(mechanism.parameters).from_unit(np.full(len(names), 0.5)).tolist()
    return replace(mechanism, neutral={**dict(zip(names, medians, strict=True)), **mechanism.neutral})


def _check_names(mechanisms: Sequence[Mechanism]) -> None:
    """Raises InputError if two mechanisms, or two of their parameters, have the same name."""
    owners = defaultdict[str, list[str]](list)
    for mechanism in mechanisms:
        for parameter in mechanism.parameters:
            owners[parameter.name].append(mechanism.name)
    for name, count in Counter(m.name for m in mechanisms).items():
        if count > 1:
            raise InputError("mechanisms", f"two of them have the name {name}", "rename one of them")
    for name, both in owners.items():
        if len(both) > 1:
            at = " and ".join(both)
            raise InputError("mechanisms", f"{at} have a parameter {name} each", "rename one of them")


def _with_both_look_alikes(known: Mapping[str, Mechanism]) -> dict[str, Mechanism]:
    """Returns mechanisms whose look-alikes name them in turn, wherever a pair is stated."""
    pairs = {(m.name, other) for m in known.values() for other in m.look_alikes}
    pairs |= {(other, name) for name, other in pairs}
    return {
        name: replace(m, look_alikes=tuple(sorted(other for first, other in pairs if first == name)))
        for name, m in known.items()
    }


__all__ = [
    "ENTRY_POINTS",
    "Bins",
    "Mechanism",
    "bin_means",
    "catalogue",
    "laws",
    "observed",
    "solved",
    "with_one",
    "without_one",
]
