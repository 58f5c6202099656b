"""Fits a normal distribution to draws of a posterior, for programs that take no draws."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayeskin.types import Array, ParameterSpace


@dataclass(frozen=True)
class FittedNormal:
    """A normal distribution of the parameters, or of their natural logarithms where `in_log` says so.

    mean (D,), covariance (D, D) : in SI units, or of the logarithm of the value in SI units
    """

    names: tuple[str, ...]
    in_log: tuple[bool, ...]
    mean: Array
    covariance: Array


def fitted_normal(space: ParameterSpace, draws: Array) -> FittedNormal:
    """Returns the normal distribution with the mean and the covariance of draws (s, D) in SI.

    A parameter is taken in logarithms if its prior is one of the logarithm and all of its draws are positive.
    """
    in_log = tuple(
        p.in_log and bool(column.min() > 0.0) for p, column in zip(space.parameters, draws.T, strict=True)
    )
    values = np.column_stack([
        np.log(column) if log else column for log, column in zip(in_log, draws.T, strict=True)
    ])  # fmt: skip
    return FittedNormal(space.names, in_log, values.mean(axis=0), np.atleast_2d(np.cov(values.T)))
