"""The snooker move as its source has it.

emcee 3.1.6's own `DESnookerMove` divides by the root of the norm where the unit vector is meant and
halves the exponent of the acceptance ratio (corrected upstream after that release, emcee pull request
531); it leaves a unit Gaussian in eight dimensions with variance 0.63. This one keeps 1.
"""

from __future__ import annotations

from typing import Any

import emcee
import numpy as np

from bayeskin.types import Array

_GAMMA = 1.7  # of about 2.38 / sqrt(2), optimal for the difference of two projected points


class SnookerMove(emcee.moves.red_blue.RedBlueMove):
    """Moves each walker along the line through another, by the projected difference of two more.

    Source: ter Braak & Vrugt (2008), Statistics and Computing 18:435, equations 3 and 4.
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
