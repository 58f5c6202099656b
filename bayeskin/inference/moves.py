"""The moves of an ensemble, in coordinates made for them: tries, differential evolution, stretch, snooker."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import emcee
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from bayeskin.inference.coordinates import MoveCoordinates
from bayeskin.types import Array

_CROSSOVER = (0.15, 0.3, 1.0)  # shares of the coordinates that a step moves
_JUMP, _JITTER = 0.1, 1e-5  # share of steps of full length, from mode to mode; noise that fills space
_TRIES, _FREEDOM = 5, 5.0  # points that a walker chooses from; of the t-distribution that they are from
_WALKERS_A_COORDINATE = 3  # or no tries
_GAMMA = 1.7  # of about 2.38 / sqrt(2), optimal for the difference of two projected points


class SnookerMove(emcee.moves.red_blue.RedBlueMove):
    """Moves each walker along the line through another, by the projected difference of two more.

    Source: ter Braak & Vrugt (2008), Statistics and Computing 18:435, equations 3 and 4. Not emcee's own
    `DESnookerMove`, which in 3.1.6 divides by the root of the norm where the unit vector is meant and
    halves the exponent of the acceptance ratio (emcee pull request 531): it leaves a unit Gaussian in
    eight dimensions with variance 0.63.
    """

    def get_proposal(self, walkers: Array, complement: list[Array], random: Any) -> tuple[Array, Array]:
        """Proposals (n, d) for `walkers` (n, d) and the log of their Hastings factors (n,).

        A walker that stands where its anchor does, as one put back beside another can, has no line and stays.
        """
        others = np.concatenate(complement)
        picks = random.random_sample((len(walkers), len(others))).argsort(axis=1)[:, :3]
        anchor, first, second = others[picks.T]
        line = walkers - anchor
        length = np.linalg.norm(line, axis=1)
        apart = length > 0.0
        length = np.where(apart, length, 1.0)
        unit = line / length[:, None]
        step = _GAMMA * np.einsum("nd,nd->n", unit, first - second)
        proposal = walkers + step[:, None] * unit
        with np.errstate(divide="ignore"):
            factor = (walkers.shape[1] - 1) * np.log(np.abs(length + step) / length)
        return proposal, np.where(apart, factor, -np.inf)


class SubspaceMove(emcee.moves.red_blue.RedBlueMove):
    """Differential evolution in a random few of the coordinates: y + gamma (a - b) there, a and b others.

    A step in all coordinates at once is accepted as rarely as its worst one; where parameters are nearly
    independent a step in a few goes further. Source: Vrugt et al. (2009), International Journal of
    Nonlinear Sciences and Numerical Simulation 10:273, equation 4, with fixed crossover rates.
    """

    def get_proposal(self, walkers: Array, complement: list[Array], random: Any) -> tuple[Array, Array]:
        """Proposals (n, d) for `walkers` (n, d) and the log of their Hastings factors, which is 0 (n,)."""
        others = np.concatenate(complement)
        count, dim = walkers.shape
        picks = random.random_sample((count, len(others))).argsort(axis=1)[:, :2]
        first, second = others[picks.T]
        rate = random.choice(_CROSSOVER, size=count)[:, None]
        moved = random.random_sample((count, dim)) < rate
        moved[np.arange(count), random.randint(dim, size=count)] = True
        gamma = np.where(random.random_sample(count) < _JUMP, 1.0, 2.38 / np.sqrt(2.0 * moved.sum(axis=1)))
        step = gamma[:, None] * (first - second) + _JITTER * random.standard_normal((count, dim))
        return walkers + moved * step, np.zeros(count)


class TriesMove(emcee.moves.Move):
    """Moves each walker to one of several points of a t-distribution, fitted to the other half's walkers.

    A step that does not depend on where the walker is forgets that at once; of several tries one is more
    often worth it, and their densities cost little more together than one. Independent multiple-try
    Metropolis: Martino (2018), Digital Signal Processing 75:134, section 4.2.
    """

    def __init__(self, coordinates: MoveCoordinates) -> None:
        self.coordinates = coordinates

    def propose(self, model: Any, state: emcee.State) -> tuple[emcee.State, NDArray[np.bool_]]:
        """One step of all walkers, half after half, and which of them moved, (walkers,)."""
        count = len(state.coords)
        accepted, half = np.zeros(count, dtype=bool), np.arange(count) % 2
        model.random.shuffle(half)
        for part in (0, 1):
            own = np.flatnonzero(half == part)
            y = self.coordinates.forward(state.coords)
            around = _Around.of(y[half != part])
            tried = around.draw(len(own) * _TRIES, model.random)
            points = self.coordinates.back(tried)
            log_prob, _ = model.compute_log_prob_fn(points)
            weight = log_prob + self.coordinates.log_volume(tried) - around.log_density(tried)
            weight = weight.reshape(len(own), _TRIES)
            stay = state.log_prob[own] + self.coordinates.log_volume(y[own]) - around.log_density(y[own])
            top = np.maximum(weight.max(axis=1), stay)
            weight, stay = np.exp(weight - top[:, None]), np.exp(stay - top)
            total = weight.sum(axis=1)
            row, level = np.arange(len(own)), model.random.random_sample(len(own)) * total
            chosen = np.minimum((np.cumsum(weight, axis=1) < level[:, None]).sum(axis=1), _TRIES - 1)
            moves = model.random.random_sample(len(own)) * (total - weight[row, chosen] + stay) < total
            to, picks = own[moves], (row * _TRIES + chosen)[moves]
            state.coords[to], state.log_prob[to], accepted[to] = points[picks], log_prob[picks], True
        return state, accepted


@dataclass(frozen=True)
class _Around:
    """A t-distribution: its centre (d,) and the Cholesky factor (d, d) of its spread."""

    centre: Array
    root: Array

    @classmethod
    def of(cls, points: Array) -> _Around:
        """With the mean and covariance of points (n, d), correlations shrunk where these are few."""
        count, dim = points.shape
        spread = np.cov(points.T)
        own = np.diag(spread.diagonal())
        spread = (count * spread + dim * own) / (count + dim) + 1e-10 * np.eye(dim)
        return cls(points.mean(axis=0), np.linalg.cholesky(spread))

    def draw(self, count: int, random: Any) -> Array:
        """Points (count, d)."""
        size = np.sqrt(random.chisquare(_FREEDOM, (count, 1)) / _FREEDOM)
        return self.centre + random.standard_normal((count, len(self.centre))) / size @ self.root.T

    def log_density(self, points: Array) -> Array:
        """At points (n, d), up to a constant, (n,)."""
        apart = solve_triangular(self.root, (points - self.centre).T, lower=True)
        squared = np.sum(apart**2, axis=0)
        return np.asarray(-0.5 * (_FREEDOM + len(self.centre)) * np.log1p(squared / _FREEDOM))


def mixed_moves(coordinates: MoveCoordinates, walkers: int) -> list[tuple[emcee.moves.Move, float]]:
    """The moves with their shares, all made in `coordinates`.

    Tries only where half of the walkers tell a distribution in so many coordinates; elsewhere they miss.
    """
    # Tries forget fastest where they are accepted; differential evolution goes on where they are not, and the
    # others keep it from any one scale.
    tries = 0.6 if walkers >= _WALKERS_A_COORDINATE * len(coordinates.low) else 0.0
    kinds = ((SubspaceMove, 0.8), (emcee.moves.StretchMove, 0.1), (SnookerMove, 0.1))
    moves = [(_local(kind)(coordinates), (1.0 - tries) * share) for kind, share in kinds]
    return [(TriesMove(coordinates), tries), *moves] if tries else moves


def _local(kind: type) -> type:
    """A move of emcee's, made in other coordinates."""

    class Local(kind):  # type: ignore[misc]
        def __init__(self, coordinates: MoveCoordinates) -> None:
            super().__init__()
            self.coordinates = coordinates

        def get_proposal(self, walkers: Array, complement: list[Array], random: Any) -> tuple[Array, Array]:
            mapped = self.coordinates.forward(np.concatenate([walkers, *complement]))
            ends = np.cumsum([len(walkers), *map(len, complement[:-1])])
            first, *others = np.split(mapped, ends)
            proposal, factor = super().get_proposal(first, others, random)
            volume = self.coordinates.log_volume(proposal) - self.coordinates.log_volume(first)
            return self.coordinates.back(proposal), factor + volume

    return Local
