"""The data types that the parts of bayeskin exchange: frozen, in SI units, with the unit in the name.

Arrays in these types are read-only; `dataclasses.replace` makes a changed copy. In shapes, ``n`` counts
samples or parameter points, ``d`` parameters, ``m`` time bins, and ``k`` corners.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr, ndtri

from bayeskin.errors import InputError

Array = NDArray[np.float64]
PhaseKind = Literal["rest", "load", "hold", "unload"]
Observation = Literal["reaction", "article", "own"]


def frozen_array(values: ArrayLike, dtype: Any = np.float64) -> NDArray[Any]:
    """Returns a read-only copy of `values`."""
    array = np.array(values, dtype=dtype)
    array.setflags(write=False)
    return array


class _FreezesArrays:
    """Makes every array field of a frozen dataclass read-only."""

    def __post_init__(self) -> None:
        for name, value in list(vars(self).items()):
            if isinstance(value, np.ndarray) and value.flags.writeable:
                object.__setattr__(self, name, frozen_array(value, value.dtype))


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
    """The correlation of the normal priors of two parameters, given by their names, on their lines."""

    one: str
    other: str
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
                "parameters", f"{twice} twice", "different names for all parameters, also those of mechanisms"
            )
        peaked, pairs = [p.name for p in self.parameters if p.peaked], set[frozenset[str]]()
        for first, second, value in self.correlations:
            for name in (first, second):
                if name not in peaked:
                    found = f"{name}, whose prior is not normal" if name in self.names else repr(name)
                    raise InputError("correlations", found, "two parameters with normal or log-normal priors")
            if first == second or not abs(value) < 1.0:
                where = f"correlations: {first} and {second}"
                raise InputError(where, f"{value:g}", "two different parameters and a value between -1 and 1")
            if {first, second} in pairs:
                raise InputError(f"correlations: {first} and {second}", "two values", "one value")
            pairs.add(frozenset((first, second)))
        if self.correlations and not np.linalg.eigvalsh(self._correlation).min() > 1e-9:
            stated = ", ".join(
                f"{first} and {second} {value:g}" for first, second, value in self.correlations
            )
            raise InputError("correlations", stated, "correlations that form a positive definite matrix")

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


@dataclass(frozen=True)
class Phase(_FreezesArrays):
    """A phase of the protocol, in which the pads rest, load, hold or unload."""

    kind: PhaseKind
    cycle: int  # 1 for the first loading; the rest phase before it belongs to cycle 0
    start_s: float
    end_s: float


@dataclass(frozen=True)
class PadMotion(_FreezesArrays):
    """The protocol: the LVDT displacement over time, as straight lines between corners.

    `displacement_m` is the *full* LVDT reading; each pad of the symmetric model moves by half of it. Both
    arrays have shape (k,). `time_s` increases strictly and starts at 0.
    """

    time_s: Array
    displacement_m: Array

    def at(self, time_s: ArrayLike) -> Array:
        """Returns the LVDT displacement [m] at given times, same shape."""
        return np.interp(np.asarray(time_s, dtype=float), self.time_s, self.displacement_m)

    def times(self, step_s: float, beside_s: ArrayLike | None = None) -> Array:
        """Returns times (n,) [s] every `step_s`, and at the corners or at `beside_s`.

        Regular times closer than a microsecond to one of these are left out.
        """
        fixed = self.time_s if beside_s is None else np.asarray(beside_s, dtype=float)
        every = np.arange(0.0, self.time_s[-1], step_s)
        after = np.searchsorted(fixed, every)
        nearest = np.minimum(
            np.abs(every - fixed[np.maximum(after - 1, 0)]),
            np.abs(every - fixed[np.minimum(after, len(fixed) - 1)]),
        )
        return np.union1d(fixed, every[nearest > 1e-6])  # rounding could make two times out of one


@dataclass(frozen=True)
class Recording(_FreezesArrays):
    """A recording as measured, in SI units, without smoothing and without a zero correction; arrays (n,)."""

    time_s: Array
    displacement_m: Array
    force_n: Array
    name: str
    sha256: str  # hash of the source file's bytes
    notes: tuple[str, ...] = ()  # how the importer interpreted columns and units


@dataclass(frozen=True)
class BinnedForce(_FreezesArrays):
    """Robust bin means of a recording's force, with the noise of each mean.

    edges_s : the edges of the bins, (m+1,)
    force_n : robust means, (m,)
    variance_n2 : the variance of each mean, (m,), which includes the correlation of samples within the bin
    correlation : the correlation of the noise of neighbouring bins, (m-1,)
    phase : for each bin the index in `phases` of the phase that covers most of it, (m,)
    """

    edges_s: Array
    force_n: Array
    variance_n2: Array
    correlation: Array
    phase: NDArray[np.int64]
    phases: tuple[Phase, ...]

    @property
    def time_s(self) -> Array:
        """Returns the bin centres, (m,)."""
        return 0.5 * (self.edges_s[1:] + self.edges_s[:-1])


@dataclass(frozen=True)
class Jumps(_FreezesArrays):
    """The range of force jumps that a recording's samples allow.

    lowest_n, highest_n : the smallest and the largest jump at time_s, (n,) each; infinite where the samples
        do not limit it
    """

    time_s: Array
    lowest_n: Array
    highest_n: Array

    def refute(self, time_s: Array, size_n: Array) -> NDArray[np.bool_]:
        """Returns whether the samples contradict jumps of size_n (k,) [N] at time_s (k,)."""
        at = np.clip(np.searchsorted(self.time_s, time_s), 0, len(self.time_s) - 1)
        return np.asarray((size_n < self.lowest_n[at]) | (size_n > self.highest_n[at]))

    def until(self, end_s: float) -> Jumps:
        """Returns the range of jumps that the samples up to a given time allow."""
        known = self.time_s <= end_s
        return replace(
            self,
            lowest_n=np.where(known, self.lowest_n, -np.inf),
            highest_n=np.where(known, self.highest_n, np.inf),
        )


@dataclass(frozen=True)
class Simulation(_FreezesArrays):
    """One run of the full model.

    A failed run is a value too: its `status` is not "ok", and its `message` says what to do.

    time_s, displacement_m, force_n : the accepted time steps with the corners of the protocol, (n,) each;
        `displacement_m` is the LVDT displacement
    corner : True at the protocol's corners, where the slope of the force jumps, (n,)
    stats : counts and seconds, as floats
    gradient_n : derivatives of the force by the parameters `gradient_names`, (n, r); each is multiplied by
        the change that was requested for its parameter
    """

    theta: Mapping[str, float]
    time_s: Array
    displacement_m: Array
    force_n: Array
    corner: NDArray[np.bool_]
    status: Literal["ok", "failed"]
    message: str
    stats: Mapping[str, float]
    model_hash: str
    gradient_names: tuple[str, ...] = ()
    gradient_n: Array = field(default_factory=lambda: np.zeros((0, 0)))

    def at(self, time_s: ArrayLike) -> Array:
        """Returns the force [N] at given times.

        Between time steps, it is a monotone cubic (PCHIP) inside each phase. It is continuous at corners.
        """
        from scipy.interpolate import PchipInterpolator

        query = np.asarray(time_s, dtype=float)
        out = np.interp(query, self.time_s, self.force_n)
        breaks = np.unique(np.concatenate([[0], np.flatnonzero(self.corner), [len(self.time_s) - 1]]))
        for a, b in pairwise(breaks):
            inside = (query >= self.time_s[a]) & (query <= self.time_s[b])
            if b - a >= 2 and inside.any():
                steps = slice(a, b + 1)
                out[inside] = PchipInterpolator(self.time_s[steps], self.force_n[steps])(query[inside])
        return out

    def bin_means(self, edges_s: ArrayLike) -> Array:
        """Returns the mean force [N] over each bin, (m,), by the trapezoidal rule on eleven points."""
        edges = np.asarray(edges_s, dtype=float)
        fine = edges[:-1, None] + np.linspace(0.0, 1.0, 11) * np.diff(edges)[:, None]
        return np.asarray(np.trapezoid(self.at(fine), dx=0.1, axis=1))

    def gradient_bin_means(self, edges_s: ArrayLike) -> Array:
        """Returns the mean of each column of `gradient_n` over each bin [N], (m, r)."""
        columns = [replace(self, force_n=column).bin_means(edges_s) for column in self.gradient_n.T]
        return np.stack(columns, axis=1)


@dataclass(frozen=True)
class Design(_FreezesArrays):
    """Parameter points, and the full model's force at each of them.

    theta : the points, (n, d)
    force_n : bin means of the force, (n, m); a row of NaN where the run failed
    edges_s : the edges of the bins, (m+1,)
    wave : the wave of each point, (n,): 0, 1, ...
    held_out : which points are held out, (n,) bool
    ok : which runs succeeded, (n,) bool
    messages : the messages of failed runs, (n,)
    seconds : the duration of each run, (n,)
    """

    space: ParameterSpace
    edges_s: Array
    theta: Array
    force_n: Array
    wave: NDArray[np.int64]
    held_out: NDArray[np.bool_]
    ok: NDArray[np.bool_]
    messages: tuple[str, ...]
    seconds: Array
    seed: int
    model_hash: str

    @property
    def training(self) -> NDArray[np.bool_]:
        """Returns the rows that a surrogate may be trained on, (n,)."""
        return self.ok & ~self.held_out

    @property
    def testing(self) -> NDArray[np.bool_]:
        """Returns the rows that no surrogate may be trained on, (n,)."""
        return self.ok & self.held_out


@dataclass(frozen=True)
class Prediction:
    """The force at n points with its uncertainty, as a low-rank Gaussian.

    mean : (n, m) [N]
    factor : (n, m, r) [N]
    diagonal : (n, m) [N^2]

    The covariance at point i is ``factor[i] @ factor[i].T + diag(diagonal[i])``. A factor whose bins are
    adjacent in memory, which is the transposed view of an (n, r, m) array, is used without a copy.
    """

    mean: Array
    factor: Array
    diagonal: Array

    def sd(self) -> Array:
        """Returns the standard deviation of each bin, (n, m) [N]."""
        return np.sqrt(np.einsum("nmr,nmr->nm", self.factor, self.factor) + self.diagonal)


@runtime_checkable
class Surrogate(Protocol):
    """All that inference and sensitivity analysis need of a model: its box, its bins and its predictions."""

    @property
    def space(self) -> ParameterSpace:
        """Returns the parameters with their bounds."""
        ...

    @property
    def edges_s(self) -> Array:
        """Returns the edges of the bins, (m+1,)."""
        ...

    @property
    def provenance(self) -> Mapping[str, Any]:
        """Returns the origin of the surrogate, as plain values."""
        ...

    def predict(self, theta: ArrayLike) -> Prediction:
        """Returns the force at theta (n, d), vectorised. Raises InputError outside the box."""
        ...

    def predict_mean(self, theta: ArrayLike) -> Array:
        """Returns only the mean (n, m) of `predict`, which may be faster."""
        ...


@dataclass(frozen=True)
class Provenance:
    """The origin of a result, which is part of every file that bayeskin writes."""

    version: str
    config_sha256: str = ""
    recording_sha256: str = ""
    model_hash: str = ""
    seed: int = 0
    extra: Mapping[str, Any] = field(default_factory=dict)
