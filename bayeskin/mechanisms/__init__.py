"""The catalogue of mechanisms: effects that the base model leaves out, each in a file of its own.

Every module of this package that defines `MECHANISM` adds this entry to the catalogue. So does every entry
point of the group "bayeskin.mechanisms" of any installed package.
"""

from __future__ import annotations

import importlib
import pkgutil
import sys
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from importlib.metadata import entry_points

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

ENTRY_POINTS = "bayeskin.mechanisms"


def catalogue() -> dict[str, Mechanism]:
    """Returns all mechanisms by name, in alphabetical order.

    Raises InputError if two mechanisms or two parameters have the same name. It also raises InputError if a
    mechanism needs one that is not in the catalogue, or one that itself needs another.
    """
    return dict(_catalogue_on(tuple(sys.path)))


@cache  # entry points are searched for in every installed package, and models ask at each run
def _catalogue_on(_: tuple[str, ...]) -> dict[str, Mechanism]:
    """Returns the catalogue with the packages that are installed on a search path."""
    modules = [importlib.import_module(f"{__name__}.{m.name}") for m in pkgutil.iter_modules(__path__)]
    found = [module.MECHANISM for module in modules if hasattr(module, "MECHANISM")]
    found += [entry.load() for entry in entry_points(group=ENTRY_POINTS)]
    for names in ([m.name for m in found], [p.name for m in found for p in m.parameters]):
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise InputError("mechanisms", f"{twice[0]} twice", "different names")
    known = {m.name: m for m in sorted(found, key=lambda m: m.name)}
    for mechanism in found:
        for name in mechanism.needs:
            if name not in known or known[name].needs:
                expected = "a mechanism of the catalogue that needs none itself"
                raise InputError(mechanism.name, f"a need of {name}", expected)
    return _with_both_look_alikes(known)


def _with_both_look_alikes(known: Mapping[str, Mechanism]) -> dict[str, Mechanism]:
    """Returns mechanisms whose look-alikes name them in turn, wherever a pair is stated."""
    pairs = {(m.name, other) for m in known.values() for other in m.look_alikes}
    pairs |= {(other, name) for name, other in pairs}
    return {
        name: replace(m, look_alikes=tuple(sorted(other for one, other in pairs if one == name)))
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
