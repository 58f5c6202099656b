"""The protocol of a forward model, and what a run of it returns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from bayeskin.finite_element.simulate import ModelSpec
from bayeskin.mechanisms import Mechanism
from bayeskin.types import Array, ParameterSpace


@dataclass(frozen=True)
class ModelRun:
    """A run of a forward model: theta (d,) in SI; force_n (m,), means over bins [N].

    slopes_n (m, d) : derivatives by coordinates of the prior's box [N], None where it has none
    """

    theta: Array
    force_n: Array
    slopes_n: Array | None


class ForwardModel(Protocol):
    """Runs the skin; `solves` names the mechanisms that it solves, `hash` identifies it."""

    @property
    def solves(self) -> frozenset[str]: ...

    @property
    def hash(self) -> str: ...

    @property
    def spec(self) -> ModelSpec:
        """The full model in whose place it is."""
        ...

    def run(
        self, space: ParameterSpace, at: Array, mechanisms: Sequence[Mechanism], derive: bool
    ) -> ModelRun | str:
        """Returns a run at parameters (d,) of a space, with derivatives or not; or why it failed."""
        ...

    def errors(self, at: Array) -> Array:
        """Returns errors (r, m) [N] that the model says it has at parameters (d,), of one sd each."""
        ...


def change(space: ParameterSpace, theta: Array) -> Array:
    """Returns the change of each parameter (d,) along one coordinate of the prior's box."""
    unit, h = space.box.to_unit(theta), 1e-6
    return np.asarray((space.box.from_unit(unit + h) - space.box.from_unit(unit - h)) / (2.0 * h))
