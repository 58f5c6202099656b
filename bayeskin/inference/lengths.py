"""Computes the share of the posterior variance that comes from uncertain lengths of the tissue."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bayeskin.geometry import LENGTHS
from bayeskin.types import Array, ParameterSpace

NOTABLE = 0.1  # share of a variance below which only moduli are reported


@dataclass(frozen=True)
class DueToLengths:
    """Share of one parameter's posterior variance that the uncertain lengths explain, also as a sentence.

    The share comes from a linear regression on the draws of these lengths. The variance is that of the
    parameter's logarithm where its prior is in logarithms.
    """

    name: str
    share: float
    sentence: str


def due_to_lengths(space: ParameterSpace, draws: ArrayLike) -> tuple[DueToLengths, ...]:
    """Returns the share that lengths explain of each modulus, and of other parameters where it is notable.

    draws (s, D) are in SI, with columns as in `space`. The result is empty where no length is among them.
    """
    line = space.to_line(draws)
    lengths = [j for j, name in enumerate(space.names) if name in LENGTHS]
    if not lengths:
        return ()
    listed = " and the ".join(space.parameters[j].description for j in lengths)
    results = []
    for j, parameter in enumerate(space.parameters):
        if j in lengths:
            continue
        share = _coefficient_of_determination(line[:, j], line[:, lengths])
        if parameter.stress_power == 1 or share >= NOTABLE:
            label = f"log {parameter.name}" if parameter.in_log else parameter.name
            percent = f"{100 * share:.0f} %" if share >= 0.01 else "less than 1 %"
            explain = "explain" if len(lengths) > 1 else "explains"
            sentence = f"The uncertain {listed} {explain} {percent} of the posterior variance of {label}."
            results.append(DueToLengths(parameter.name, share, sentence))
    return tuple(results)


def _coefficient_of_determination(values: Array, by: Array) -> float:
    """Returns the coefficient of determination of a linear regression of values (s,) on columns (s, k)."""
    centred, columns = values - values.mean(), by - by.mean(axis=0)
    total = float(centred @ centred)
    if total == 0.0:
        return 0.0
    columns = columns / np.maximum(columns.std(axis=0), np.finfo(float).tiny)
    residual = centred - columns @ np.linalg.lstsq(columns, centred, rcond=None)[0]
    return 1.0 - float(residual @ residual) / total
