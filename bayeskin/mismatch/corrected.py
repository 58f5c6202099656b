"""A surrogate corrected by runs of the full model near by.

The surrogate's error over the size of its force is a Gaussian process of the box's coordinates u with the
correlation

    k(u, u') = exp(-sum_i (u_i - u'_i)^2 / (2 l_i^2)) ,

l_i as far as the surrogate's own error is alike (`error_lengths`): errors are the same all along a parameter
that the force does not know, and a length that were too short there would hold a posterior at the runs. What
several effects do to each other, which it does not know, goes far: their error has a mean of its own, of the
variance `common`. The forces of runs, and where a run has them its slopes, give the errors between by
kriging, and with them how much of the surrogate's variance is left: none at a run, all of it far away, and
with a single run as much again for the mean where there is one. Where errors at the runs are larger than the
surrogate says, what is left is larger by as much.

Rasmussen & Williams (2006), ch. 2.7, 4.2 and 9.4.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayeskin.mismatch.wrapper import Wrapper, innermost
from bayeskin.types import Array, Correlated, Prediction, Surrogate

LENGTH = 0.15  # l_i, of the box, where a surrogate does not say: less than training points are apart
LONGEST = 10.0  # of the box: alike all over it
APART = 0.1  # of the box, at which errors are compared
SLOPES = 0.02  # of a run's slopes: what they are wrong by, being those of a coarser mesh
ROUNDING = 1e-6  # variance of a run's force, over that of the surrogate's error
STEP = 1e-4  # of the box, for the surrogate's differences


@dataclass(frozen=True)
class FullRun:
    """theta (d,) in SI; force_n (m,); slopes_n (m, d) by coordinates of the box, None where it has none."""

    theta: Array
    force_n: Array
    slopes_n: Array | None


@dataclass(frozen=True)
class CorrectedSurrogate(Wrapper):
    """`inner` given `runs`.

    lengths (d,) : over which its error is alike, infinite where it makes none
    common : variance of its error's mean over that of the rest
    """

    runs: tuple[FullRun, ...]
    lengths: Array
    common: float = 0.0

    @property
    def provenance(self) -> Mapping[str, Any]:
        return {**self.inner.provenance, "corrected_by": [list(run.theta) for run in self.runs]}

    def predict(self, theta: ArrayLike) -> Prediction:
        """Force at theta (n, d) or (d,). Raises InputError outside the box."""
        theta = np.atleast_2d(np.asarray(theta, dtype=float))
        found = self.inner.predict(theta)
        shared = self._correlation(theta)
        weights = shared @ self._inverse
        left = 1.0 + self.common - np.einsum("na,na->n", weights, shared)
        left = self.excess * np.maximum(left, 0.0)[:, None]
        rows = found.factor.transpose(0, 2, 1) * np.sqrt(left)[:, None]
        mean = found.mean + _size(found.mean) * (weights @ self._errors)
        return Prediction(mean, rows.transpose(0, 2, 1), found.diagonal * left)

    def predict_mean(self, theta: ArrayLike) -> Array:
        """The mean (n, m) of `predict` alone."""
        theta = np.atleast_2d(np.asarray(theta, dtype=float))
        mean = self.inner.predict_mean(theta)
        return np.asarray(mean + _size(mean) * (self._correlation(theta) @ self._inverse @ self._errors))

    def _scaled(self, theta: Array) -> Array:
        """Coordinates (n, e) of those in which the surrogate errs, in lengths."""
        return np.asarray((self.space.box.to_unit(theta) / self.lengths)[:, self._inexact])

    @cached_property
    def _inexact(self) -> NDArray[np.bool_]:
        """In which coordinates it errs, (d,)."""
        return np.isfinite(self.lengths)

    @cached_property
    def _far(self) -> Array:
        """Their lengths (e, 1)."""
        return self.lengths[self._inexact, None]

    @cached_property
    def _places(self) -> Array:
        return self._scaled(np.array([run.theta for run in self.runs]))

    @cached_property
    def _here(self) -> Prediction:
        """The surrogate at the runs."""
        return self.inner.predict(np.array([run.theta for run in self.runs]))

    @cached_property
    def _sd(self) -> Array:
        """Of the surrogate at the runs, RMS over bins, (k,) [N]; next to nothing where it says none."""
        sd = np.sqrt(np.mean(self._here.sd() ** 2, axis=1))
        return np.maximum(sd, 1e-6 * _size(self._here.mean)[:, 0])

    @cached_property
    def _sloped(self) -> list[int]:
        return [i for i, run in enumerate(self.runs) if run.slopes_n is not None]

    @cached_property
    def _slopes(self) -> Array:
        """Of the runs that have them, by lengths, (s, e, m) [N]."""
        found = [
            self._far * run.slopes_n[:, self._inexact].T for run in self.runs if run.slopes_n is not None
        ]
        shape = (len(found), self._places.shape[1], self._here.mean.shape[1])
        return np.array(found).reshape(shape)

    def _correlation(self, theta: Array) -> Array:
        """Of the error at theta (n, d) with what is known: that at each run, then its slopes (n, a)."""
        away = self._scaled(theta)[:, None, :] - self._places
        near = np.exp(-0.5 * np.sum(away**2, axis=2))
        slopes = away[:, self._sloped] * near[:, self._sloped, None]
        slopes = slopes.reshape(len(theta), len(self._sloped) * away.shape[2])
        return np.concatenate([near + self.common, slopes], axis=1)

    @cached_property
    def _known(self) -> Array:
        """Correlations (a, a) of all that is known."""
        away = self._places[:, None, :] - self._places
        near = np.exp(-0.5 * np.sum(away**2, axis=2))
        s = self._sloped
        count = len(s) * self._places.shape[1]
        sides = (away[:, s] * near[:, s, None]).reshape(len(self.runs), count)
        apart = away[np.ix_(s, s)]
        both = np.eye(self._places.shape[1]) - apart[:, :, :, None] * apart[:, :, None, :]
        both = both * near[np.ix_(s, s)][:, :, None, None]
        inner = both.transpose(0, 2, 1, 3).reshape(count, count)
        sd = np.sqrt(self.excess) * self._sd[s, None]
        wrong = SLOPES * np.sqrt(np.mean(self._slopes**2, axis=2)) / sd
        forces = near + self.common + ROUNDING * np.eye(len(self.runs))
        return np.block([[forces, sides], [sides.T, inner + np.diag(wrong.ravel() ** 2)]])

    @cached_property
    def _inverse(self) -> Array:
        return np.asarray(np.linalg.inv(self._known))

    @cached_property
    def excess(self) -> float:
        """Mean square of the errors at the runs, in what the surrogate says of them; 1 at least."""
        own = (self._runs_n - self._here.mean) / self._sd[:, None]
        return max(float(np.mean(own**2)), 1.0)

    @cached_property
    def _runs_n(self) -> Array:
        """Forces of the runs (k, m) [N]."""
        return np.array([run.force_n for run in self.runs])

    @cached_property
    def _errors(self) -> Array:
        """Of the surrogate at each run, then of its slopes by lengths, (a, m), over the size of its force."""
        mean, size = self._here.mean, _size(self._here.mean)
        errors = (self._runs_n - mean) / size
        rows = [errors]
        for i, own in zip(self._sloped, self._slopes, strict=True):
            theirs = self._far * slopes(self.inner, self.runs[i].theta)[:, self._inexact].T
            growth = (theirs @ mean[i]) / (mean[i] @ mean[i])  # of the size of the force
            rows.append((own - theirs) / size[i] - growth[:, None] * errors[i])
        return np.concatenate(rows)


@dataclass(frozen=True)
class Undiminished(Wrapper):
    """The corrected force of `inner` with all of the surrogate's variance, at the runs as away from them.

    Draws are made by this. Where the variance grows with the distance from a run, along a ridge of parameters
    whose effects cancel, the density there falls by the volume of what is not known, not by any misfit: they
    would crowd about the runs, the more so the less the surrogate knows.
    """

    inner: CorrectedSurrogate

    def predict(self, theta: ArrayLike) -> Prediction:
        """Force at theta (n, d) or (d,). Raises InputError outside the box."""
        own, excess = self.inner.inner.predict(theta), self.inner.excess
        return Prediction(self.inner.predict_mean(theta), np.sqrt(excess) * own.factor, excess * own.diagonal)


def _size(mean_n: Array) -> Array:
    """RMS of forces (n, m) over bins, (n, 1)."""
    return np.asarray(np.sqrt(np.mean(mean_n**2, axis=1, keepdims=True)))


def slopes(surrogate: Surrogate, theta: Array) -> Array:
    """Of the surrogate's mean (m, d) by coordinates of the box, by differences toward its middle."""
    box = surrogate.space.box
    unit = box.to_unit(theta)
    steps = np.diag(np.where(unit > 0.5, -STEP, STEP))
    rows = np.vstack([theta, np.clip(box.from_unit(unit + steps), box.lower, box.upper)])
    mean = surrogate.predict_mean(rows)
    return np.asarray((mean[1:] - mean[0]).T / np.diag(steps))


def error_lengths(surrogate: Surrogate, theta: Array, exact: NDArray[np.bool_]) -> Array:
    """Over which the surrogate's error is alike about theta (d,), in coordinates of the box (d,); infinite in
    those that it has exactly.

    By what its processes say of the error's correlation, column by column of the factor, at points that are
    `APART`. What they take for noise of each point counts as alike, as the rest is.
    """
    lengths = np.where(exact, np.inf, LENGTH)
    if not isinstance(innermost(surrogate), Correlated):
        return lengths
    assert isinstance(surrogate, Correlated)
    box = surrogate.space.box
    unit = box.to_unit(theta)
    steps = np.diag(np.where(unit > 0.5, -APART, APART))[~exact]
    rows = np.vstack([theta, np.clip(box.from_unit(unit + steps), box.lower, box.upper)])
    size = np.sqrt(np.mean(surrogate.predict(rows).factor ** 2, axis=1))
    alike = np.sum(size * size[0] * surrogate.correlation(rows, theta), axis=1) / np.linalg.norm(size, axis=1)
    if not alike[0] > 0.0:  # at a run that it was trained on nothing but rounding is left
        return lengths
    share = np.clip(alike[1:] / alike[0], 1e-6, 1.0 - 1e-12)
    lengths[~exact] = np.minimum(APART / np.sqrt(-2.0 * np.log(share)), LONGEST)
    return lengths
