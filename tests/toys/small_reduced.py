"""Small reduced models: on 80 bricks, built as `bayeskin reduce` does, and one that cannot run."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bayeskin.design import default_space
from bayeskin.finite_element.simulate import ModelSpec
from bayeskin.geometry import Geometry
from bayeskin.mechanisms import catalogue
from bayeskin.reduced.build import BuildSettings, base_model, with_mechanisms
from bayeskin.reduced.cases import Protocols, Trained
from bayeskin.reduced.files import save_reduced
from bayeskin.reduced.library import Library, Modes
from bayeskin.reduced.model import Cubatures, ReducedModel
from bayeskin.reduced.operators import Rule
from bayeskin.reduced.runs import FullRuns
from bayeskin.store import Store
from bayeskin.types import ParameterSpace

NAMES = ("preconditioning", "solid-viscoelasticity")
SETTINGS = BuildSettings(
    base_runs=7,
    runs=5,
    base=(34, 26),
    each=(14, 8),
    base_points=200,
    set_points=260,
    base_shadows=6,
    set_shadows=10,
)


def one_by_one(
    function: Callable[[Any], Any], items: Sequence[Any]
) -> Generator[tuple[int, Any], None, None]:
    """Maps in this process."""
    yield from ((number, function(item)) for number, item in enumerate(items))


def trained() -> Trained:
    """The region: no subcutis stiffer than twice the softest cutis, short holds, two mechanisms."""
    spaces = {name: ParameterSpace(catalogue()[name].parameters) for name in NAMES}
    base = tuple(
        replace(p, **{"E_c": {"lower": 50e3}, "E_s": {"upper": 100e3}}.get(p.name, {}))
        for p in default_space().parameters
    )
    return Trained(Geometry(), ParameterSpace(base), spaces, Protocols(holds_s=(2.0, 60.0)))


def built(path: Path) -> ReducedModel:
    """The reduced model, from full runs that are kept in a store."""
    with Store(path, "training runs") as store:
        full = FullRuns(ModelSpec(refinement=0), store)
        base = base_model(trained(), full, SETTINGS, one_by_one, unheard)
        return with_mechanisms(base, trained(), full, SETTINGS, one_by_one, unheard)


def unheard(what: str, share: float) -> None:
    """Takes a word of progress."""


def hollow(path: Path, geometry: Geometry = Geometry(), size: float = 1.0) -> Path:
    """The file of a reduced model that knows its region, and has no modes to run with."""
    nothing, rule = size * np.ones((1, 3)), Rule(np.zeros(1, dtype=np.int64), np.ones(1))
    spec = ModelSpec(geometry=geometry)
    model = ReducedModel(
        Trained(geometry, default_space(), {}), spec.refinement, Library(Modes(nothing, nothing), {}),
        Cubatures(rule, rule), spec.hash,
    )  # fmt: skip
    save_reduced(path, model, {})
    return path
