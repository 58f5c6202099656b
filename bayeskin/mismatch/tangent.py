"""The force of a skin near runs of a forward model, by the runs' own derivatives.

Moduli multiplied by c and permeabilities by 1/c give forces multiplied by c (`surrogates.similarity`), which
holds here exactly. Beyond that, the force about one run is linear in a power of each modulus and in the
coordinates of the prior's box for all other parameters. Layers do not share a load as springs side by side,
whose force would be linear in their moduli. The best power goes from a half, for layers alike, to one, for a
cutis that is fifteen times as stiff as the subcutis; 0.8 serves all.

Between runs the force is an average of what each of them says, weighted by the inverse square of its distance
in the box, so that it has the value and the slopes of every run (Shepard 1968, Proc. 23rd ACM Nat. Conf.,
517; with slopes: Franke & Nielson 1980, Int. J. Numer. Meth. Eng. 15:1691).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayeskin.forward.interface import ModelRun
from bayeskin.types import Array, ParameterSpace, Prediction, _FreezesArrays

AT_A_RUN = 1e-12  # square of a distance in the box that is none
POWER = 0.8  # of a modulus, which the force is linear in


@dataclass(frozen=True)
class Tangent(_FreezesArrays):
    """Satisfies `types.Surrogate`.

    edges_s (m+1,) : of the bins whose means the runs' forces are; runs : one or more, each with slopes
    errors_n (r, m) : of the runs, as their model says, of one sd each; None for none
    """

    space: ParameterSpace
    edges_s: Array
    runs: tuple[ModelRun, ...]
    errors_n: Array | None = None

    @property
    def provenance(self) -> Mapping[str, Any]:
        return {"tangent_at": [[float(value) for value in run.theta] for run in self.runs]}

    def predict(self, theta: ArrayLike) -> Prediction:
        """Force at theta (n, d) or (d,)."""
        mean = self.predict_mean(theta)
        errors_n = np.zeros((1, mean.shape[1]))
        if self.errors_n is not None and len(self.errors_n):
            errors_n = self.errors_n
        factor = np.broadcast_to(errors_n.T, (len(mean), *errors_n.T.shape))
        return Prediction(mean, factor, np.zeros(mean.shape))

    def predict_mean(self, theta: ArrayLike) -> Array:
        """The mean (n, m) of `predict` alone."""
        theta = np.atleast_2d(np.asarray(theta, dtype=float))
        unit = self.space.box.to_unit(theta)
        found, weight = np.zeros((len(theta), len(self.edges_s) - 1)), np.zeros((len(theta), 1))
        for run in self.runs:
            change = unit - self.space.box.to_unit(run.theta)
            near = 1.0 / (np.sum(change**2, axis=1, keepdims=True) + AT_A_RUN)
            found += near * self._about(run, theta, change)
            weight += near
        return np.asarray(found / weight)

    def _about(self, run: ModelRun, theta: Array, change: Array) -> Array:
        """The force (n, m) at theta (n, d) by one run, from which it is `change` (n, d) away in the box."""
        assert run.slopes_n is not None
        moduli, flow = self.space.scaled(1), self.space.scaled(-1)
        if not len(moduli):
            return np.asarray(run.force_n + change @ run.slopes_n.T)
        by_modulus = run.slopes_n[:, moduli] / self._log_widths(moduli)
        by_flow = run.slopes_n[:, flow] / self._log_widths(flow)
        share = np.maximum(run.force_n @ by_modulus, 0.0) + 1e-12
        ratio = theta[:, moduli] / run.theta[moduli]
        scale = (ratio**POWER @ share / share.sum()) ** (1.0 / POWER)
        change = change.copy()
        power = ((ratio / scale[:, None]) ** POWER - 1.0) / POWER
        change[:, moduli] = power / self._log_widths(moduli)
        change[:, flow] += np.log(scale)[:, None] / self._log_widths(flow)
        unlike = run.force_n + by_flow.sum(axis=1) - by_modulus.sum(axis=1)  # none where the law is exact
        scaled = scale[:, None] * (run.force_n + change @ run.slopes_n.T)
        return np.asarray(scaled - np.outer(scale - 1.0, unlike))

    def _log_widths(self, columns: NDArray[np.intp]) -> Array:
        """Logarithms over which priors of parameters extend."""
        return np.asarray(np.log(self.space.upper[columns] / self.space.lower[columns]))
