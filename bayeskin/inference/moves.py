"""Moves of an ensemble, made in suitable coordinates: tries, differential evolution, stretch and snooker."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import emcee
import numpy as np
from numpy.typing import NDArray

from bayeskin.inference.coordinates import MoveCoordinates
from bayeskin.inference.proposal import Mixture, Product
from bayeskin.types import Array


@dataclass(frozen=True)
class MoveSettings:
    """Settings of the moves of an ensemble.

    Differential evolution
    crossover : shares of the coordinates that a step moves
    jump : share of steps of full length, which can lead from mode to mode
    jitter : sd of the noise that lets steps fill space
    snooker : factor on the projected difference of two walkers, about 2.38 / sqrt(2), which is optimal

    Tries
    tries : number of points from which a walker chooses
    walkers_a_coordinate : number of walkers for each coordinate below which no tries are made

    Shares of the steps
    known_tries, own_tries : share of tries from a known distribution, and from one fitted to the walkers
    others : shares of differential evolution, stretch and snooker among the remaining steps. Accepted tries
        forget the position fastest. Differential evolution makes progress where tries are rejected. Stretch
        and snooker moves keep it from depending on a single scale.
    """

    crossover: tuple[float, ...] = (0.15, 0.3, 1.0)
    jump: float = 0.1
    jitter: float = 1e-5
    snooker: float = 1.7
    tries: int = 5
    walkers_a_coordinate: int = 3
    known_tries: float = 0.8
    own_tries: float = 0.6
    others: tuple[float, float, float] = (0.8, 0.1, 0.1)


MOVES = MoveSettings()


class SnookerMove(emcee.moves.red_blue.RedBlueMove):
    """Moves each walker along the line through another walker, by the projected difference of two others.

    Source: ter Braak & Vrugt (2008), Statistics and Computing 18:435, equations 3 and 4. This is not emcee's
    own `DESnookerMove`. In emcee 3.1.6, that move divides by the root of the norm where the unit vector is
    meant, and halves the exponent of the acceptance ratio (emcee pull request 531). It gives a unit Gaussian
    in eight dimensions a variance of 0.63.
    """

    def get_proposal(self, walkers: Array, complement: list[Array], random: Any) -> tuple[Array, Array]:
        """Returns proposals (n, d) for `walkers` (n, d) and the log of their Hastings factors (n,).

        A walker at the same point as its anchor has no line and stays. This can happen after a walker has
        been moved to another one.
        """
        others = np.concatenate(complement)
        picks = random.random_sample((len(walkers), len(others))).argsort(axis=1)[:, :3]
        anchor, first, second = others[picks.T]
        line = walkers - anchor
        length = np.linalg.norm(line, axis=1)
        apart = length > 0.0
        length = np.where(apart, length, 1.0)
        unit = line / length[:, None]
        step = MOVES.snooker * np.einsum("nd,nd->n", unit, first - second)
        proposal = walkers + step[:, None] * unit
        with np.errstate(divide="ignore"):
            factor = (walkers.shape[1] - 1) * np.log(np.abs(length + step) / length)
        return proposal, np.where(apart, factor, -np.inf)


class SubspaceMove(emcee.moves.red_blue.RedBlueMove):
    """Moves each walker y by differential evolution, y + gamma (a - b), in a few random coordinates.

    a and b are two other walkers. A step in all coordinates at once is accepted as rarely as its worst
    coordinate. Where parameters are nearly independent, a step in a few coordinates goes further. Source:
    Vrugt et al. (2009), International Journal of Nonlinear Sciences and Numerical Simulation 10:273, equation
    4, with fixed crossover rates.
    """

    def get_proposal(self, walkers: Array, complement: list[Array], random: Any) -> tuple[Array, Array]:
        """Returns proposals (n, d) for `walkers` (n, d), and the log (n,) of their Hastings factors, 0."""
        others = np.concatenate(complement)
        count, dim = walkers.shape
        picks = random.random_sample((count, len(others))).argsort(axis=1)[:, :2]
        first, second = others[picks.T]
        rate = random.choice(MOVES.crossover, size=count)[:, None]
        moved = random.random_sample((count, dim)) < rate
        moved[np.arange(count), random.randint(dim, size=count)] = True
        full = random.random_sample(count) < MOVES.jump
        gamma = np.where(full, 1.0, 2.38 / np.sqrt(2.0 * moved.sum(axis=1)))
        step = gamma[:, None] * (first - second) + MOVES.jitter * random.standard_normal((count, dim))
        return walkers + moved * step, np.zeros(count)


class TriesMove(emcee.moves.Move):
    """Moves each walker to one of several points of a distribution that does not depend on its position.

    Such a step forgets the position at once. Several tries are accepted more often than a single try, and
    their densities together take little more time than one. The distribution is `known`, or a t-distribution
    fitted to the walkers of the other half. Source: independent multiple-try Metropolis, Martino (2018),
    Digital Signal Processing 75:134, section 4.2.
    """

    def __init__(self, coordinates: MoveCoordinates, known: Product | None = None) -> None:
        self.coordinates, self.known = coordinates, known

    def propose(self, model: Any, state: emcee.State) -> tuple[emcee.State, NDArray[np.bool_]]:
        """Makes one step of all walkers; returns the state and which walkers moved, (walkers,)."""
        count = len(state.coords)
        accepted = np.zeros(count, dtype=bool)
        if self.known is not None:
            self._move(np.arange(count), self.known, model, state, accepted)
            return state, accepted
        half = np.arange(count) % 2
        model.random.shuffle(half)
        for part in (0, 1):
            others = self.coordinates.forward(state.coords[half != part])
            self._move(np.flatnonzero(half == part), Mixture.around(others), model, state, accepted)
        return state, accepted

    def _move(
        self, own: NDArray[np.int64], proposal: Mixture | Product, model: Any, state: emcee.State,
        accepted: NDArray[np.bool_],
    ) -> None:  # fmt: skip
        """Moves the walkers `own` in `state`, and marks in `accepted` which of them have moved."""
        y, count = self.coordinates.forward(state.coords[own]), MOVES.tries
        tries = proposal.draw(len(own) * count, model.random)
        points = self.coordinates.back(tries)
        log_prob, _ = model.compute_log_prob_fn(points)
        weight = log_prob + self.coordinates.log_volume(tries) - proposal.log_density(tries)
        weight = weight.reshape(len(own), count)
        stay = state.log_prob[own] + self.coordinates.log_volume(y) - proposal.log_density(y)
        top = np.maximum(weight.max(axis=1), stay)
        weight, stay = np.exp(weight - top[:, None]), np.exp(stay - top)
        total = weight.sum(axis=1)
        row, level = np.arange(len(own)), model.random.random_sample(len(own)) * total
        chosen = np.minimum((np.cumsum(weight, axis=1) < level[:, None]).sum(axis=1), count - 1)
        moves = model.random.random_sample(len(own)) * (total - weight[row, chosen] + stay) < total
        movers, picks = own[moves], (row * count + chosen)[moves]
        state.coords[movers], state.log_prob[movers], accepted[movers] = points[picks], log_prob[picks], True


def mixed_moves(
    coordinates: MoveCoordinates, walkers: int, known: Product | None = None
) -> list[tuple[emcee.moves.Move, float]]:
    """Returns the moves with their shares, all made in `coordinates`.

    Tries come from the distribution `known`. Without a known distribution, tries are made only if the walkers
    are many enough: half of them must define a distribution in so many coordinates. Otherwise the tries miss.
    """
    enough = walkers >= MOVES.walkers_a_coordinate * len(coordinates.low)
    tries = MOVES.known_tries if known is not None else MOVES.own_tries if enough else 0.0
    kinds = zip((SubspaceMove, emcee.moves.StretchMove, SnookerMove), MOVES.others, strict=True)
    moves = [(_in_move_coordinates(kind)(coordinates), (1.0 - tries) * share) for kind, share in kinds]
    return [(TriesMove(coordinates, known), tries), *moves] if tries else moves


def _in_move_coordinates(kind: type) -> type:
    """Returns the class of a move that is made in move coordinates instead of sampling coordinates."""

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
