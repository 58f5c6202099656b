"""The share of a posterior's variance that comes from lengths of the tissue which are not known exactly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bayeskin.geometry import LENGTHS
from bayeskin.types import Array, ParameterSpace

NOTABLE = 0.1  # share of a variance below which only moduli are told of


@dataclass(frozen=True)
class DueToLengths:
    """One parameter: the share of its posterior variance, of its logarithm where the prior is in logarithms,
    that a linear regression on the draws of the uncertain lengths explains; and that in a sentence."""

    name: str
    share: float
    sentence: str


def due_to_lengths(space: ParameterSpace, draws: ArrayLike) -> tuple[DueToLengths, ...]:
    """Returns what lengths explain of the moduli, and of other parameters where it is notable.

    draws (s, D) in SI, columns as in `space`; nothing is returned where no length is among them.
    """
    line = space.to_line(draws)
    lengths = [j for j, name in enumerate(space.names) if name in LENGTHS]
    if not lengths:
        return ()
    what = " and the ".join(space.parameters[j].description for j in lengths)
    found = []
    for j, parameter in enumerate(space.parameters):
        if j in lengths:
            continue
        share = _explained(line[:, j], line[:, lengths])
        if parameter.stress_power == 1 or share >= NOTABLE:
            of = f"log {parameter.name}" if parameter.in_log else parameter.name
            percent = f"{100 * share:.0f} %" if share >= 0.01 else "less than 1 %"
            explain = "explain" if len(lengths) > 1 else "explains"
            sentence = f"The uncertain {what} {explain} {percent} of the posterior variance of {of}."
            found.append(DueToLengths(parameter.name, share, sentence))
    return tuple(found)


def _explained(values: Array, by: Array) -> float:
    """The coefficient of determination of a linear regression of values (s,) on columns (s, k)."""
    centred, columns = values - values.mean(), by - by.mean(axis=0)
    total = float(centred @ centred)
    if total == 0.0:
        return 0.0
    columns = columns / np.maximum(columns.std(axis=0), np.finfo(float).tiny)
    left = centred - columns @ np.linalg.lstsq(columns, centred, rcond=None)[0]
    return 1.0 - float(left @ left) / total
