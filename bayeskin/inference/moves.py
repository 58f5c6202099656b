"""The moves of an ensemble, in coordinates made for them: differential evolution, stretch, snooker."""

from __future__ import annotations

from typing import Any

import emcee
import numpy as np

from bayeskin.inference.coordinates import MoveCoordinates
from bayeskin.types import Array

_CROSSOVER = (0.15, 0.3, 1.0)  # shares of the coordinates that a step moves
_JUMP, _JITTER = 0.1, 1e-5  # share of steps of full length, from mode to mode; noise that fills space
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


def mixed_moves(coordinates: MoveCoordinates) -> list[tuple[emcee.moves.Move, float]]:
    """The moves with their shares, all made in `coordinates`."""
    # Mostly differential evolution, which mixes fastest; the others keep it from any one scale.
    kinds = ((SubspaceMove, 0.8), (emcee.moves.StretchMove, 0.1), (SnookerMove, 0.1))
    return [(_local(kind)(coordinates), share) for kind, share in kinds]


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
