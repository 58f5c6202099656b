"""Predicts the force of the skin near runs of a forward model, from the derivatives of these runs.

If the moduli are multiplied by c and the permeabilities by 1/c, the force is multiplied by c
(`surrogates.similarity`). This law holds exactly here. Apart from it, the force near one run is linear in a
power of each modulus, and for all other parameters in the coordinates of the prior's box. Layers do not share
a load like parallel springs, whose force would be linear in their moduli. The best power ranges from a half
for layers of equal stiffness to one for a cutis that is fifteen times as stiff as the subcutis; 0.8 suits all
of them.

Between runs the force is an average of the linear forces of all runs, each weighted by the inverse square of
its distance in the box. It therefore has the value and the slopes of every run at that run (Shepard 1968,
Proc. 23rd ACM Nat. Conf., 517; with slopes: Franke & Nielson 1980, Int. J. Numer. Meth. Eng. 15:1691).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayeskin.forward.interface import ModelRun
from bayeskin.types import Array, FreezesArrays, ParameterSpace, Prediction

AT_A_RUN = 1e-12  # added to the square of a distance in the box, so that it is never zero
POWER = 0.8  # the force is linear in this power of a modulus


@dataclass(frozen=True)
class Tangent(FreezesArrays):
    """The force near runs of a forward model; it satisfies `types.Surrogate`.

    edges_s (m+1,) : edges of the bins over which the runs' forces are averaged
    runs : one run or several, each with slopes
    errors_n (r, m) : errors [N] of the runs that their model states, of one sd each; None for no errors
    """

    space: ParameterSpace
    edges_s: Array
    runs: tuple[ModelRun, ...]
    errors_n: Array | None = None

    @property
    def provenance(self) -> Mapping[str, Any]:
        return {"tangent_at": [[float(value) for value in run.theta] for run in self.runs]}

    def predict(self, theta: ArrayLike) -> Prediction:
        """Returns the force at theta (n, d) or (d,)."""
        mean = self.predict_mean(theta)
        errors_n = np.zeros((1, mean.shape[1]))
        if self.errors_n is not None and len(self.errors_n):
            errors_n = self.errors_n
        factor = np.broadcast_to(errors_n.T, (len(mean), *errors_n.T.shape))
        return Prediction(mean, factor, np.zeros(mean.shape))

    def predict_mean(self, theta: ArrayLike) -> Array:
        """Returns only the mean (n, m) of `predict`."""
        theta = np.atleast_2d(np.asarray(theta, dtype=float))
        unit = self.space.box.to_unit(theta)
        weighted_n, total_weight = np.zeros((len(theta), len(self.edges_s) - 1)), np.zeros((len(theta), 1))
        for run in self.runs:
            change = unit - self.space.box.to_unit(run.theta)
            run_weight = 1.0 / (np.sum(change**2, axis=1, keepdims=True) + AT_A_RUN)
            weighted_n += run_weight * self._force_near(run, theta, change)
            total_weight += run_weight
        return np.asarray(weighted_n / total_weight)

    def _force_near(self, run: ModelRun, theta: Array, change: Array) -> Array:
        """Returns the force (n, m) [N] at theta (n, d) by the derivatives of a single run.

        change : differences (n, d) between theta and the run in coordinates of the box
        """
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
        deviation_n = (
            run.force_n + by_flow.sum(axis=1) - by_modulus.sum(axis=1)
        )  # zero where the similarity law is exact
        scaled = scale[:, None] * (run.force_n + change @ run.slopes_n.T)
        return np.asarray(scaled - np.outer(scale - 1.0, deviation_n))

    def _log_widths(self, columns: NDArray[np.intp]) -> Array:
        """Returns the widths of the parameters' priors in logarithms."""
        return np.asarray(np.log(self.space.upper[columns] / self.space.lower[columns]))


@dataclass(frozen=True)
class MarkerTangent(FreezesArrays):
    """The displacements of markers near runs of a forward model; it satisfies `inference.PredictsMarkers`.

    Near one run they are linear in the coordinates of the prior's box. If moduli and permeabilities scale as
    the similarity law says, the displacements stay the same, and so do these in logarithmic coordinates.
    Between runs they are averages, as the forces of `Tangent` are.
    """

    space: ParameterSpace
    runs: tuple[ModelRun, ...]

    @property
    def provenance(self) -> Mapping[str, Any]:
        return {"tangent_at": [[float(value) for value in run.theta] for run in self.runs]}

    def predict_m(self, theta: ArrayLike) -> Array:
        """Returns displacements since the first image (n, t - 1, p, 2) [m] at theta (n, d)."""
        unit = self.space.box.to_unit(np.atleast_2d(np.asarray(theta, dtype=float)))
        changes = [unit - self.space.box.to_unit(run.theta) for run in self.runs]
        weights = np.array([1.0 / (np.sum(change**2, axis=1) + AT_A_RUN) for change in changes])
        shares = weights / weights.sum(axis=0)
        near = zip(self.runs, shares, changes, strict=True)
        return np.asarray(sum(_markers_near(*each) for each in near))


def _markers_near(run: ModelRun, share: Array, change: Array) -> Array:
    """Returns displacements (n, t - 1, p, 2) [m] by the derivatives of a single run, times shares (n,).

    change : differences (n, d) from the run in coordinates of the box
    """
    here_m, by_m = run.markers_m, run.marker_slopes_m
    assert here_m is not None
    assert by_m is not None
    moved_m = (share[:, None] * change) @ by_m.reshape(-1, change.shape[1]).T
    return np.multiply.outer(share, here_m) + moved_m.reshape(len(share), *here_m.shape)
