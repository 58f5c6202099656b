"""Predicts the force of a case by the shipped models, well enough to choose the size of its effect."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from bayeskin.mechanisms import Mechanism, bin_means, catalogue, observed, solved
from bayeskin.proof.protocol import EDGES_S, MOTION, SURROGATE
from bayeskin.proof.refit_residual import Refit
from bayeskin.reduced.files import load_reduced
from bayeskin.reduced.model import ReducedModel
from bayeskin.reduced.region import REGION
from bayeskin.reduced.simulate import simulate_reduced
from bayeskin.shipped import shipped
from bayeskin.surrogates import load_surrogate
from bayeskin.types import Array

REDUCED = "surrogates/article-device-reduced.h5"


@dataclass(frozen=True)
class Screen:
    """Predicts the force of a case, well enough to choose the size of its effect.

    refit : the base model, by its surrogate
    model : the reduced model, which predicts how mechanisms change the force
    known : mechanisms by name
    """

    refit: Refit
    model: ReducedModel
    known: Mapping[str, Mechanism]

    def force(self, names: Sequence[str], theta: Array, values: Mapping[str, Array]) -> Array:
        """Returns bin means (n, m) at theta (n, 5), with mechanisms at values (n,) each.

        They are NaN where a run fails.
        """
        changes = [self._change(names, row, {name: value[i] for name, value in values.items()})
                   for i, row in enumerate(theta)]  # fmt: skip
        return np.asarray(self.refit.force(theta) + np.array(changes))

    def by_name(self, theta: Array) -> dict[str, float]:
        """Returns the base model's parameters theta (5,) by name."""
        return dict(zip(self.refit.surrogate.space.names, theta.tolist(), strict=True))

    def _change(self, names: Sequence[str], theta: Array, values: Mapping[str, float]) -> Array:
        """Returns the change (m,) of the bin means that mechanisms make at theta (5,)."""
        mechanisms = [self.known[name] for name in names]
        theta_named, within_model = self.by_name(theta), solved(mechanisms)
        least = REGION.least_stiffness_if_checked
        runs = [simulate_reduced(self.model, MOTION, {**theta_named, **values}, used, least_stiffness=least)
                for used in (within_model, [])]  # fmt: skip
        if any(run.status != "ok" for run in runs):
            return np.full(len(EDGES_S) - 1, np.nan)
        on_force = [mechanism for mechanism in mechanisms if mechanism not in within_model]
        rows = {name: np.array([value]) for name, value in values.items()}
        reported = observed(on_force, rows, MOTION, lambda time_s: np.atleast_2d(runs[0].at(time_s)))
        return np.asarray(bin_means(reported, MOTION, EDGES_S, on_force)[0] - runs[1].bin_means(EDGES_S))


@cache
def shipped_screen() -> Screen:
    """Returns a screen with the surrogate and the reduced model that come with bayeskin."""
    model = load_reduced(shipped(REDUCED))
    return Screen(Refit(load_surrogate(shipped(SURROGATE))), model, catalogue())
