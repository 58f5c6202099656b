"""The moves of an ensemble: stretch, differential evolution and snooker, in straightened coordinates."""

from __future__ import annotations

from typing import Any

import emcee
import numpy as np

from bayeskin.inference.straighten import Shear
from bayeskin.types import Array

_GAMMA = 1.7  # of about 2.38 / sqrt(2), optimal for the difference of two projected points


class SnookerMove(emcee.moves.red_blue.RedBlueMove):
    """Moves each walker along the line through another, by the projected difference of two more.

    Source: ter Braak & Vrugt (2008), Statistics and Computing 18:435, equations 3 and 4. Not emcee's own
    `DESnookerMove`, which in 3.1.6 divides by the root of the norm where the unit vector is meant and
    halves the exponent of the acceptance ratio (emcee pull request 531): it leaves a unit Gaussian in
    eight dimensions with variance 0.63.
    """

    def get_proposal(self, walkers: Array, complement: list[Array], random: Any) -> tuple[Array, Array]:
        """Proposals (n, d) for `walkers` (n, d) and the log of their Hastings factors (n,)."""
        others = np.concatenate(complement)
        picks = random.random_sample((len(walkers), len(others))).argsort(axis=1)[:, :3]
        anchor, first, second = others[picks.T]
        line = walkers - anchor
        length = np.linalg.norm(line, axis=1)
        unit = line / length[:, None]
        step = _GAMMA * np.einsum("nd,nd->n", unit, first - second)
        proposal = walkers + step[:, None] * unit
        with np.errstate(divide="ignore"):
            factor = (walkers.shape[1] - 1) * np.log(np.abs(length + step) / length)
        return proposal, factor


def mixed_moves(shear: Shear | None) -> list[tuple[emcee.moves.Move, float]]:
    """The moves with their shares; with a shear they propose along straightened ridges.

    The chain itself stays in sampling coordinates. A shear keeps volumes, so that a move's acceptance
    ratio is the one it has without.
    """
    # Mostly differential evolution, which mixes fastest; the others keep it from any one scale.
    kinds = ((emcee.moves.DEMove, 0.8), (emcee.moves.StretchMove, 0.1), (SnookerMove, 0.1))
    if shear is None:
        return [(kind(), share) for kind, share in kinds]
    return [(_straightened(kind)(shear), share) for kind, share in kinds]


def _straightened(kind: type) -> type:
    class Straightened(kind):  # type: ignore[misc]
        def __init__(self, shear: Shear) -> None:
            super().__init__()
            self.shear = shear

        def get_proposal(self, walkers: Array, complement: list[Array], random: Any) -> tuple[Array, Array]:
            straight = self.shear.straight(np.concatenate([walkers, *complement]))
            ends = np.cumsum([len(walkers), *map(len, complement[:-1])])
            first, *others = np.split(straight, ends)
            proposal, factor = super().get_proposal(first, others, random)
            return self.shear.back(proposal), factor

    return Straightened
