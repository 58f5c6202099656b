"""Defines the interface of a forward model (a Python protocol) and the result of its run."""

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
    """A run of a forward model.

    theta (d,) : parameters in SI units; force_n (m,) : means of the force over bins [N]
    slopes_n (m, d) : derivatives of force_n by coordinates of the prior's box [N], or None
    markers_m (t - 1, p, 2), marker_slopes_m (t - 1, p, 2, d) : displacements of markers since the first image
        [m], and their derivatives; None without markers
    """

    theta: Array
    force_n: Array
    slopes_n: Array | None
    markers_m: Array | None = None
    marker_slopes_m: Array | None = None


class ForwardModel(Protocol):
    """Runs the test on the skin; `solves` names the mechanisms that it solves, `hash` identifies it."""

    @property
    def solves(self) -> frozenset[str]: ...

    @property
    def hash(self) -> str: ...

    @property
    def spec(self) -> ModelSpec:
        """Returns the specification of the full model that it replaces."""
        ...

    def run(
        self, space: ParameterSpace, at: Array, mechanisms: Sequence[Mechanism], derive: bool
    ) -> ModelRun | str:
        """Returns a run at parameters `at` (d,) of a space, or the reason why it failed.

        derive : True to compute derivatives as well
        """
        ...

    def errors(self, at: Array) -> Array:
        """Returns the errors (r, m) [N] that the model states at parameters (d,), each of one sd."""
        ...


def change(space: ParameterSpace, theta: Array) -> Array:
    """Returns the change of each parameter (d,) for a unit of its coordinate of the prior's box."""
    unit, h = space.box.to_unit(theta), 1e-6
    return np.asarray((space.box.from_unit(unit + h) - space.box.from_unit(unit - h)) / (2.0 * h))
