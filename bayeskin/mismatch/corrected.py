"""A surrogate corrected by runs of the full model near by.

The surrogate's error, in units of its own sd, is a Gaussian process of the box's coordinates u with the
rational quadratic correlation of half a power,

    k(u, u') = (1 + |u - u'|^2 / l^2)^(-1/2) ,

since a trained surrogate errs anew from one training point to the next. What several effects do to each
other, which it does not know, goes far: their error has a mean of its own, of the variance `common`. The
forces of runs, and where a run has them its slopes, give the errors between by kriging, and with them how
much of the surrogate's variance is left: none at a run, all of it far away, and as much again for the mean
where there is one.

Rasmussen & Williams (2006), ch. 2.7, 4.2 and 9.4.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayeskin.types import Array, ParameterSpace, Prediction, Surrogate

LENGTH = 0.15  # l, of the box: how far apart a surrogate's training points are
OWN_SLOPES = 1e-2  # variance of a run's slopes, which may be those of a coarser mesh; per l, of the error's
ROUNDING = 1e-6  # variance of its force
STEP = 1e-4  # of the box, for the surrogate's differences


@dataclass(frozen=True)
class FullRun:
    """theta (d,) in SI; force_n (m,); slopes_n (m, d) by coordinates of the box, None where it has none."""

    theta: Array
    force_n: Array
    slopes_n: Array | None


@dataclass(frozen=True)
class Corrected:
    """Satisfies `types.Surrogate`: `surrogate` given `runs`; `inexact` (d,) says in which it errs, `common`
    is the variance of its error's mean over that of the rest."""

    surrogate: Surrogate
    runs: tuple[FullRun, ...]
    inexact: NDArray[np.bool_]
    common: float = 0.0

    @property
    def space(self) -> ParameterSpace:
        return self.surrogate.space

    @property
    def edges_s(self) -> Array:
        return self.surrogate.edges_s

    @property
    def provenance(self) -> Mapping[str, Any]:
        return {**self.surrogate.provenance, "corrected_by": [list(run.theta) for run in self.runs]}

    def predict(self, theta: ArrayLike) -> Prediction:
        """Force at theta (n, d) or (d,). Raises InputError outside the box."""
        theta = np.atleast_2d(np.asarray(theta, dtype=float))
        found = self.surrogate.predict(theta)
        shared = self._correlation(theta)
        weights = shared @ self._inverse
        left = 1.0 + self.common - np.einsum("na,na->n", weights, shared)
        left = np.maximum(left, 0.0)[:, None]
        rows = found.factor.transpose(0, 2, 1) * np.sqrt(left)[:, None]
        return Prediction(found.mean + weights @ self._errors, rows.transpose(0, 2, 1), found.diagonal * left)

    def predict_mean(self, theta: ArrayLike) -> Array:
        """The mean (n, m) of `predict` alone."""
        theta = np.atleast_2d(np.asarray(theta, dtype=float))
        weights = self._correlation(theta) @ self._inverse
        return np.asarray(self.surrogate.predict_mean(theta) + weights @ self._errors)

    def _scaled(self, theta: Array) -> Array:
        """Coordinates (n, e) of those in which the surrogate errs, in lengths."""
        return np.asarray(self.space.box.to_unit(theta)[:, self.inexact] / LENGTH)

    @cached_property
    def _places(self) -> Array:
        return self._scaled(np.array([run.theta for run in self.runs]))

    @cached_property
    def _sloped(self) -> list[int]:
        return [i for i, run in enumerate(self.runs) if run.slopes_n is not None]

    def _correlation(self, theta: Array) -> Array:
        """Of the error at theta (n, d) with what is known: that at each run, then its slopes (n, a)."""
        away = self._scaled(theta)[:, None, :] - self._places
        near = 1.0 + np.sum(away**2, axis=2)
        slopes = away[:, self._sloped] * near[:, self._sloped, None] ** -1.5
        slopes = slopes.reshape(len(theta), len(self._sloped) * away.shape[2])
        return np.concatenate([near**-0.5 + self.common, slopes], axis=1)

    @cached_property
    def _inverse(self) -> Array:
        """Of the correlations (a, a) of all that is known."""
        away = self._places[:, None, :] - self._places
        near = 1.0 + np.sum(away**2, axis=2)
        s = self._sloped
        count = len(s) * self._places.shape[1]
        mixed = away[:, s] * near[:, s, None] ** -1.5
        apart, close = away[np.ix_(s, s)], near[np.ix_(s, s)][:, :, None, None]
        both = np.eye(self._places.shape[1]) * close**-1.5
        both = both - 3.0 * apart[:, :, :, None] * apart[:, :, None, :] * close**-2.5
        sides = mixed.reshape(len(self.runs), count)
        inner = both.transpose(0, 2, 1, 3).reshape(count, count) + OWN_SLOPES * np.eye(count)
        forces = near**-0.5 + self.common + ROUNDING * np.eye(len(self.runs))
        return np.asarray(np.linalg.inv(np.block([[forces, sides], [sides.T, inner]])))

    @cached_property
    def _errors(self) -> Array:
        """Of the surrogate at each run, then of its slopes by lengths, (a, m)."""
        theta = np.array([run.theta for run in self.runs])
        forces = np.array([run.force_n for run in self.runs]) - self.surrogate.predict_mean(theta)
        rows = [forces]
        for i in self._sloped:
            run = self.runs[i]
            assert run.slopes_n is not None
            wrong = run.slopes_n - slopes(self.surrogate, run.theta)
            rows.append(LENGTH * wrong[:, self.inexact].T)
        return np.concatenate(rows)


def slopes(surrogate: Surrogate, theta: Array) -> Array:
    """Of the surrogate's mean (m, d) by coordinates of the box, by differences toward its middle."""
    box = surrogate.space.box
    unit = box.to_unit(theta)
    steps = np.diag(np.where(unit > 0.5, -STEP, STEP))
    rows = np.vstack([theta, np.clip(box.from_unit(unit + steps), box.lower, box.upper)])
    mean = surrogate.predict_mean(rows)
    return np.asarray((mean[1:] - mean[0]).T / np.diag(steps))
