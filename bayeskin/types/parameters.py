"""Sampled parameters with their priors, and the map of their values to the unit cube."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr, ndtri

from bayeskin.errors import InputError
from bayeskin.types.arrays import Array, frozen_array

# Largest modulus of the subcutis over that of the cutis: a cutis folds on a stiffer one, and fat is softer.
STIFFEST_BELOW = 2.0


@dataclass(frozen=True)
class Parameter:
    """One sampled parameter: its symbol, its SI unit, its prior, and the source of the prior.

    stress_power : if all parameters are multiplied by c**stress_power, the force is multiplied by c (1 for a
        modulus; -1 for a permeability, whose viscosity is fixed; a parameter with 0 stays unchanged)
    offset : a log-uniform prior is uniform in log(value + offset), so that it may reach down to 0
    centre, spread : the mean and sd of a normal prior; the median and the sd of the logarithm of a log-normal
        prior; both priors are truncated at the bounds
    """

    name: str
    unit: str
    lower: float
    upper: float
    prior: Literal["uniform", "log-uniform", "normal", "log-normal"]
    description: str = ""
    source: str = ""
    stress_power: int = 0
    offset: float = 0.0
    centre: float = 0.0
    spread: float = 1.0

    @property
    def in_log(self) -> bool:
        """Returns whether the prior is a distribution of the logarithm."""
        return self.prior.startswith("log")

    @property
    def peaked(self) -> bool:
        """Returns whether some values within the bounds are likelier than others."""
        return self.prior.endswith("normal")


class Correlation(NamedTuple):
    """The correlation of two normal priors, or of the logarithms of log-normal ones; parameters are named."""

    first: str
    second: str
    value: float


@dataclass(frozen=True)
class ParameterSpace:
    """An ordered list of parameters with their priors; only this class maps theta to the unit cube and back.

    `theta` is always in SI units, shape ``(..., d)``, with columns in the order of `names`. Priors are
    independent, except normal and log-normal priors with `correlations`. These are a multivariate normal
    distribution that is truncated at the bounds. Raises InputError for a name that occurs twice, and for
    correlations that no multivariate normal distribution has.
    """

    parameters: tuple[Parameter, ...]
    correlations: tuple[Correlation, ...] = ()

    def __post_init__(self) -> None:
        twice = next((name for name in self.names if self.names.count(name) > 1), None)
        if twice is not None:
            raise InputError(
                "parameters",
                f"{twice} is the name of two parameters",
                "all need different names, also those of mechanisms",
            )
        peaked, pairs = [p.name for p in self.parameters if p.peaked], set[frozenset[str]]()
        for first, second, value in self.correlations:
            for name in (first, second):
                if name not in peaked:
                    known = name in self.names
                    problem = f"the prior of {name} is not normal" if known else f"{name!r} is not known"
                    raise InputError(
                        "correlations", problem, "both parameters need normal or log-normal priors"
                    )
            if first == second or not abs(value) < 1.0:
                where = f"correlations: {first} and {second}"
                raise InputError(
                    where,
                    f"the value is {value:g}",
                    "two different parameters and a value between -1 and 1 are needed",
                )
            if {first, second} in pairs:
                raise InputError(f"correlations: {first} and {second}", "two values are given", "give one")
            pairs.add(frozenset((first, second)))
        if self.correlations and not np.linalg.eigvalsh(self._correlation).min() > 1e-9:
            stated = ", ".join(
                f"{first} and {second} {value:g}" for first, second, value in self.correlations
            )
            raise InputError(
                "correlations",
                f"{stated} cannot be true together",
                "the matrix of correlations must be positive definite",
            )

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Returns the names of the parameters, in order."""
        return tuple(p.name for p in self.parameters)

    @property
    def dim(self) -> int:
        """Returns the number of parameters."""
        return len(self.parameters)

    @cached_property
    def lower(self) -> Array:
        """Returns the lower bounds, (d,) in SI."""
        return frozen_array([p.lower for p in self.parameters])

    @cached_property
    def upper(self) -> Array:
        """Returns the upper bounds, (d,) in SI."""
        return frozen_array([p.upper for p in self.parameters])

    @cached_property
    def is_log(self) -> NDArray[np.bool_]:
        """Returns which priors are distributions of the logarithm, (d,)."""
        return np.array([p.in_log for p in self.parameters])

    @cached_property
    def box(self) -> ParameterSpace:
        """Returns the space with the same bounds and with priors that are uniform on the line."""
        flat: dict[bool, Literal["uniform", "log-uniform"]] = {False: "uniform", True: "log-uniform"}
        return ParameterSpace(
            tuple(replace(p, prior=flat[p.in_log]) if p.peaked else p for p in self.parameters)
        )

    @property
    def without_texts(self) -> ParameterSpace:
        """Returns the space without descriptions and sources, as hashes of stored results take it.

        A better sentence then leaves the results valid.
        """
        return replace(self, parameters=tuple(replace(p, description="", source="") for p in self.parameters))

    def draw(self, rng: np.random.Generator, count: int) -> Array:
        """Returns draws of the prior, (count, d).

        Correlated draws beyond the bounds are rejected and drawn again.
        """
        theta = self.from_unit(rng.uniform(size=(count, self.dim)))
        if not self.correlations:
            return np.clip(theta, self.lower, self.upper)
        line, (low, high) = self.to_line(theta), self._line
        columns = list(self._normals)
        centre, spread = np.array([self._normals[j][:2] for j in columns]).T
        root = np.linalg.cholesky(self._correlation)
        missing = np.arange(count)
        while len(missing):
            trial = centre + spread * (rng.standard_normal((len(missing), len(columns))) @ root.T)
            inside = np.all((trial >= low[columns]) & (trial <= high[columns]), axis=1)
            line[missing[inside][:, None], columns] = trial[inside]
            missing = missing[~inside]
        return np.clip(self.from_line(line), self.lower, self.upper)

    def scaled(self, power: int) -> NDArray[np.intp]:
        """Returns the columns of parameters that enter as a stress to a power.

        The power is 1 for moduli and -1 for permeabilities. Parameters with an offset do not scale in this
        way, so they are left out.
        """
        numbered = enumerate(self.parameters)
        columns = [i for i, p in numbered if p.stress_power == power and p.in_log and p.offset == 0.0]
        return np.array(columns, dtype=np.intp)

    def to_unit(self, theta: ArrayLike) -> Array:
        """Returns the prior cumulative probability of each coordinate, (..., d).

        The result leaves [0, 1] outside the box. Each coordinate is treated by itself, without its
        correlations, as in `from_unit`.
        """
        low, high = self._line
        line = self.to_line(theta)
        unit = np.asarray((line - low) / (high - low))
        for j, (centre, spread, side, below, share) in self._normals.items():
            unit[..., j] = (ndtr(side * (line[..., j] - centre) / spread) - below) / share
        return unit

    def from_unit(self, unit: ArrayLike) -> Array:
        """Returns theta for points of the unit cube, (..., d); this is the inverse of `to_unit`."""
        low, high = self._line
        unit = np.asarray(unit, dtype=float)
        line = np.asarray(low + unit * (high - low))
        for j, (centre, spread, side, below, share) in self._normals.items():
            line[..., j] = centre + side * spread * ndtri(np.clip(below + unit[..., j] * share, 0.0, 1.0))
            line[..., j] = np.clip(line[..., j], low[j], high[j])
        return self.from_line(line)

    def log_density(self, line: ArrayLike) -> Array:
        """Returns the log prior density (...,) on the line, at points (..., d) within the bounds.

        With correlations, the density is not normalised: the result lacks a constant.
        """
        line = np.asarray(line, dtype=float)
        low, high = self._line
        flat = [j for j in range(self.dim) if j not in self._normals]
        out = np.full(line.shape[:-1], -float(np.sum(np.log((high - low)[flat]))))
        for j, (centre, spread, _, _, share) in self._normals.items():
            z = (line[..., j] - centre) / spread
            out += -0.5 * z**2 - np.log(spread * abs(share) * np.sqrt(2.0 * np.pi))
        if self.correlations:
            centre, spread = np.array([normal[:2] for normal in self._normals.values()]).T
            z = (line[..., list(self._normals)] - centre) / spread
            out -= 0.5 * np.einsum("...i,ij,...j->...", z, self._shared_precision, z)
        return out

    def log_density_slopes(self, line: Array) -> tuple[Array, Array]:
        """Returns gradient (d,) and negative Hessian (d, d) of `log_density` at a point (d,) on the line."""
        gradient, curvature = np.zeros(self.dim), np.zeros((self.dim, self.dim))
        if self._normals:
            columns = list(self._normals)
            centre, spread = np.array([normal[:2] for normal in self._normals.values()]).T
            precision = np.linalg.inv(self._correlation) / np.outer(spread, spread)
            curvature[np.ix_(columns, columns)] = precision
            gradient[columns] = precision @ (centre - np.asarray(line)[columns])
        return gradient, curvature

    def to_line(self, theta: ArrayLike) -> Array:
        """Returns coordinates (..., d) on the line, in which each prior is uniform or normal.

        The coordinate is the value, or its logarithm where the prior is a distribution of the logarithm.
        """
        theta = np.asarray(theta, dtype=float)
        return np.where(self.is_log, np.log(np.where(self.is_log, theta + self._offset, 1.0)), theta)

    def from_line(self, line: ArrayLike) -> Array:
        """Returns theta for points on the line, (..., d); this is the inverse of `to_line`."""
        line = np.asarray(line, dtype=float)
        return np.where(self.is_log, np.exp(np.where(self.is_log, line, 0.0)) - self._offset, line)

    def contains(self, theta: ArrayLike) -> NDArray[np.bool_]:
        """Returns whether each point lies in the closed box, (...,)."""
        theta = np.asarray(theta, dtype=float)
        return np.all((theta >= self.lower) & (theta <= self.upper), axis=-1)

    @cached_property
    def _line(self) -> tuple[Array, Array]:
        """Returns the lower and upper bounds on the line, (d,) each."""
        return self.to_line(self.lower), self.to_line(self.upper)

    @cached_property
    def _normals(self) -> dict[int, tuple[float, float, float, float, float]]:
        """Returns numbers of each normal prior by its column.

        The numbers are centre and spread on the line, the side, the probability below the lower bound, and
        the probability between the bounds. Where the lower bound lies above the centre, the side is -1. The
        first number is then the probability above the lower bound, and the second is negative. The numbers
        stay accurate far from the centre, where the probability below a bound is one after rounding.
        """
        low, high = self._line
        out = {}
        for j, p in enumerate(self.parameters):
            if p.peaked:
                centre = float(np.log(p.centre + p.offset)) if p.in_log else p.centre
                side = -1.0 if low[j] > centre else 1.0
                left, right = (float(ndtr(side * (end - centre) / p.spread)) for end in (low[j], high[j]))
                out[j] = (centre, p.spread, side, left, right - left)
        return out

    @cached_property
    def _correlation(self) -> Array:
        """Returns the correlation matrix of the normal priors, in the order of `_normals`."""
        place = {self.names[j]: k for k, j in enumerate(self._normals)}
        matrix = np.eye(len(place))
        for first, second, value in self.correlations:
            matrix[place[first], place[second]] = matrix[place[second], place[first]] = value
        return matrix

    @cached_property
    def _shared_precision(self) -> Array:
        """Returns what the correlations add to the precision matrix of the standardised normal priors."""
        return np.asarray(np.linalg.inv(self._correlation) - np.eye(len(self._correlation)))

    @cached_property
    def _offset(self) -> Array:
        """Returns the offsets of the parameters, (d,)."""
        return np.array([p.offset for p in self.parameters])
