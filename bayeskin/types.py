"""The values that flow through bayeskin: frozen, in SI units, with the unit in the name.

Arrays in these types are read-only; a change makes a new object (`dataclasses.replace`).
``n`` counts samples or parameter points, ``d`` parameters, ``m`` time bins, ``k`` corners.
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
    """A read-only copy of `values`."""
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
    """One sampled parameter: its symbol, SI unit, prior and where the prior comes from.

    stress_power : with all parameters multiplied by c**stress_power, the force is multiplied by c
        (1 for a modulus, -1 for a permeability, whose viscosity is fixed; 0: stays as it is)
    offset : a log-uniform prior is uniform in log(value + offset), so that it may reach down to 0
    centre, spread : of a normal prior its mean and sd; of a log-normal one its median and the sd of the
        logarithm; both are cut to the bounds
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
        return self.prior.startswith("log")

    @property
    def peaked(self) -> bool:
        """Whether some values within the bounds are likelier than others."""
        return self.prior.endswith("normal")


class Correlation(NamedTuple):
    """Of the normal priors of two parameters, by their names, on their lines."""

    one: str
    other: str
    value: float


@dataclass(frozen=True)
class ParameterSpace:
    """An ordered box of priors; the only place where theta meets the unit cube.

    `theta` is always in SI units, shape ``(..., d)``, columns in the order of `names`. Priors are independent
    but for normal and log-normal ones with `correlations`: a multivariate normal, cut to the bounds.
    Raises InputError for a name that stands twice, and for correlations that no multivariate normal has.
    """

    parameters: tuple[Parameter, ...]
    correlations: tuple[Correlation, ...] = ()

    def __post_init__(self) -> None:
        twice = next((name for name in self.names if self.names.count(name) > 1), None)
        if twice is not None:
            raise InputError(
                "parameters", f"{twice} twice", "names that differ, also from those of mechanisms"
            )
        peaked, pairs = [p.name for p in self.parameters if p.peaked], set[frozenset[str]]()
        for one, other, value in self.correlations:
            for name in (one, other):
                if name not in peaked:
                    found = f"{name}, whose prior is not normal" if name in self.names else repr(name)
                    raise InputError("correlations", found, "two parameters with normal or log-normal priors")
            if one == other or not abs(value) < 1.0:
                where = f"correlations: {one} and {other}"
                raise InputError(where, f"{value:g}", "two different parameters and a value between -1 and 1")
            if {one, other} in pairs:
                raise InputError(f"correlations: {one} and {other}", "two values", "one")
            pairs.add(frozenset((one, other)))
        if self.correlations and not np.linalg.eigvalsh(self._correlation).min() > 1e-9:
            stated = ", ".join(f"{one} and {other} {value:g}" for one, other, value in self.correlations)
            raise InputError("correlations", stated, "correlations that can hold together")

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(p.name for p in self.parameters)

    @property
    def dim(self) -> int:
        return len(self.parameters)

    @cached_property
    def lower(self) -> Array:
        return frozen_array([p.lower for p in self.parameters])

    @cached_property
    def upper(self) -> Array:
        return frozen_array([p.upper for p in self.parameters])

    @cached_property
    def is_log(self) -> NDArray[np.bool_]:
        return np.array([p.in_log for p in self.parameters])

    @cached_property
    def box(self) -> ParameterSpace:
        """The same bounds with nothing likelier than anything else on the line."""
        flat: dict[bool, Literal["uniform", "log-uniform"]] = {False: "uniform", True: "log-uniform"}
        return ParameterSpace(
            tuple(replace(p, prior=flat[p.in_log]) if p.peaked else p for p in self.parameters)
        )

    def draw(self, rng: np.random.Generator, count: int) -> Array:
        """Draws of the prior, (count, d); correlated ones by rejection of what lies beyond the bounds."""
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
        """Columns of parameters that enter as a stress to a power: 1 for moduli, -1 for permeabilities.

        Those with an offset, which do not scale, are not among them.
        """
        known = enumerate(self.parameters)
        found = [i for i, p in known if p.stress_power == power and p.in_log and p.offset == 0.0]
        return np.array(found, dtype=np.intp)

    def to_unit(self, theta: ArrayLike) -> Array:
        """Prior cumulative probability of each coordinate, shape (..., d); outside [0, 1] beyond the box.

        Each coordinate by itself, correlated or not, as in `from_unit`.
        """
        low, high = self._line
        line = self.to_line(theta)
        unit = np.asarray((line - low) / (high - low))
        for j, (centre, spread, side, below, share) in self._normals.items():
            unit[..., j] = (ndtr(side * (line[..., j] - centre) / spread) - below) / share
        return unit

    def from_unit(self, unit: ArrayLike) -> Array:
        """Inverse of `to_unit`, shape (..., d)."""
        low, high = self._line
        unit = np.asarray(unit, dtype=float)
        line = np.asarray(low + unit * (high - low))
        for j, (centre, spread, side, below, share) in self._normals.items():
            line[..., j] = centre + side * spread * ndtri(np.clip(below + unit[..., j] * share, 0.0, 1.0))
            line[..., j] = np.clip(line[..., j], low[j], high[j])
        return self.from_line(line)

    def log_density(self, line: ArrayLike) -> Array:
        """Log prior density (...,) on the line, at points (..., d) within the bounds.

        With correlations up to a constant.
        """
        line = np.asarray(line, dtype=float)
        low, high = self._line
        flat = [j for j in range(self.dim) if j not in self._normals]
        out = np.full(line.shape[:-1], -float(np.sum(np.log((high - low)[flat]))))
        for j, (centre, spread, _, _, share) in self._normals.items():
            z = (line[..., j] - centre) / spread
            out += -0.5 * z**2 - np.log(spread * abs(share) * np.sqrt(2.0 * np.pi))
        if self.correlations:
            centre, spread = np.array([own[:2] for own in self._normals.values()]).T
            z = (line[..., list(self._normals)] - centre) / spread
            out -= 0.5 * np.einsum("...i,ij,...j->...", z, self._shared_precision, z)
        return out

    def log_density_slopes(self, line: Array) -> tuple[Array, Array]:
        """Gradient (d,) of `log_density` at a point (d,) on the line, and its curvature (d, d), downward."""
        gradient, curvature = np.zeros(self.dim), np.zeros((self.dim, self.dim))
        if self._normals:
            columns = list(self._normals)
            centre, spread = np.array([own[:2] for own in self._normals.values()]).T
            precision = np.linalg.inv(self._correlation) / np.outer(spread, spread)
            curvature[np.ix_(columns, columns)] = precision
            gradient[columns] = precision @ (centre - np.asarray(line)[columns])
        return gradient, curvature

    def to_line(self, theta: ArrayLike) -> Array:
        """Coordinates (..., d) in which each prior is uniform or normal: the value, or its logarithm."""
        theta = np.asarray(theta, dtype=float)
        return np.where(self.is_log, np.log(np.where(self.is_log, theta + self._offset, 1.0)), theta)

    def from_line(self, line: ArrayLike) -> Array:
        """Inverse of `to_line`, (..., d)."""
        line = np.asarray(line, dtype=float)
        return np.where(self.is_log, np.exp(np.where(self.is_log, line, 0.0)) - self._offset, line)

    def contains(self, theta: ArrayLike) -> NDArray[np.bool_]:
        """Whether each point lies in the closed box, shape (...,)."""
        theta = np.asarray(theta, dtype=float)
        return np.all((theta >= self.lower) & (theta <= self.upper), axis=-1)

    @cached_property
    def _line(self) -> tuple[Array, Array]:
        return self.to_line(self.lower), self.to_line(self.upper)

    @cached_property
    def _normals(self) -> dict[int, tuple[float, float, float, float, float]]:
        """By column of a normal prior: centre and spread on the line, side, mass below the bounds, within.

        Where the lower bound is above the centre, side is -1, the mass is that above it, and that within is
        negative: far out, what is below cannot be told from one.
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
        """Of the normal priors, in the order of `_normals`."""
        place = {self.names[j]: k for k, j in enumerate(self._normals)}
        matrix = np.eye(len(place))
        for one, other, value in self.correlations:
            matrix[place[one], place[other]] = matrix[place[other], place[one]] = value
        return matrix

    @cached_property
    def _shared_precision(self) -> Array:
        """What correlations add to the precision of normal priors that have none."""
        return np.asarray(np.linalg.inv(self._correlation) - np.eye(len(self._correlation)))

    @cached_property
    def _offset(self) -> Array:
        return np.array([p.offset for p in self.parameters])


@dataclass(frozen=True)
class Phase(_FreezesArrays):
    """A stretch of the protocol in which the pads rest, load, hold or unload."""

    kind: PhaseKind
    cycle: int  # 1 for the first loading; the rest before it belongs to cycle 0
    start_s: float
    end_s: float


@dataclass(frozen=True)
class PadMotion(_FreezesArrays):
    """Protocol: the LVDT displacement over time as a piecewise-linear curve through its corners.

    `displacement_m` is the *full* LVDT reading; each pad of the symmetric model moves half of it.
    Both arrays have shape (k,); `time_s` increases strictly and starts at 0.
    """

    time_s: Array
    displacement_m: Array

    def at(self, time_s: ArrayLike) -> Array:
        """LVDT displacement [m] at the times given, same shape."""
        return np.interp(np.asarray(time_s, dtype=float), self.time_s, self.displacement_m)

    def times(self, step_s: float, beside_s: ArrayLike | None = None) -> Array:
        """Times (n,) [s] every `step_s` and at the corners, or `beside_s`; a microsecond apart at least."""
        kept = self.time_s if beside_s is None else np.asarray(beside_s, dtype=float)
        every = np.arange(0.0, self.time_s[-1], step_s)
        after = np.searchsorted(kept, every)
        nearest = np.minimum(
            np.abs(every - kept[np.maximum(after - 1, 0)]),
            np.abs(every - kept[np.minimum(after, len(kept) - 1)]),
        )
        return np.union1d(kept, every[nearest > 1e-6])  # rounding makes two of one


@dataclass(frozen=True)
class Recording(_FreezesArrays):
    """A recording as measured, in SI, nothing smoothed, nothing set to zero. Arrays (n,)."""

    time_s: Array
    displacement_m: Array
    force_n: Array
    name: str
    sha256: str  # of the source file's bytes
    notes: tuple[str, ...] = ()  # what the importer took for what


@dataclass(frozen=True)
class BinnedForce(_FreezesArrays):
    """Robust bin means of a recording's force, with what each mean's noise is known to be.

    edges_s (m+1,); force_n (m,) robust means; variance_n2 (m,) variance of each mean, the
    correlation of samples within the bin included; correlation (m-1,) of neighbouring bins' noise;
    phase (m,) index into `phases` of the phase that covers most of the bin.
    """

    edges_s: Array
    force_n: Array
    variance_n2: Array
    correlation: Array
    phase: NDArray[np.int64]
    phases: tuple[Phase, ...]

    @property
    def time_s(self) -> Array:
        """Bin centres, (m,)."""
        return 0.5 * (self.edges_s[1:] + self.edges_s[:-1])


@dataclass(frozen=True)
class Jumps(_FreezesArrays):
    """What a recording's samples allow its force to jump by.

    lowest_n, highest_n (n,) : from where to where, at time_s (n,); infinite where the samples do not say
    """

    time_s: Array
    lowest_n: Array
    highest_n: Array

    def refute(self, time_s: Array, size_n: Array) -> NDArray[np.bool_]:
        """Whether the samples speak against jumps of size_n (k,) [N] at time_s (k,)."""
        at = np.clip(np.searchsorted(self.time_s, time_s), 0, len(self.time_s) - 1)
        return np.asarray((size_n < self.lowest_n[at]) | (size_n > self.highest_n[at]))

    def until(self, end_s: float) -> Jumps:
        """What the samples up to a time allow."""
        known = self.time_s <= end_s
        return replace(
            self,
            lowest_n=np.where(known, self.lowest_n, -np.inf),
            highest_n=np.where(known, self.highest_n, np.inf),
        )


@dataclass(frozen=True)
class Simulation(_FreezesArrays):
    """One full run. A failed run is a value too: `status` is not "ok" and `message` says what to do.

    time_s, displacement_m, force_n (n,): accepted steps, corners of the protocol among them.
    `displacement_m` is the LVDT displacement. `corner` (n,) is True at the protocol's corners,
    where the slope of the force jumps. `stats` holds counts and seconds (floats). gradient_n (n, r):
    derivatives of the force by the parameters `gradient_names` that were asked for, each for its change.
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
        """Force [N] between steps: monotone cubic (PCHIP) inside each phase, continuous at corners."""
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
        """Mean force [N] over each bin, (m,): composite trapezoid on eleven points a bin."""
        edges = np.asarray(edges_s, dtype=float)
        fine = edges[:-1, None] + np.linspace(0.0, 1.0, 11) * np.diff(edges)[:, None]
        return np.asarray(np.trapezoid(self.at(fine), dx=0.1, axis=1))

    def gradient_bin_means(self, edges_s: ArrayLike) -> Array:
        """Mean of each column of `gradient_n` over each bin [N], (m, r)."""
        columns = [replace(self, force_n=column).bin_means(edges_s) for column in self.gradient_n.T]
        return np.stack(columns, axis=1)


@dataclass(frozen=True)
class Design(_FreezesArrays):
    """Points, and the force that the full model gave at them (bin means; NaN row where it failed).

    theta (n, d); force_n (n, m); edges_s (m+1,); wave (n,) 0, 1, ...; held_out (n,) bool;
    ok (n,) bool; messages (n,) of failed runs; seconds (n,) of each run.
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
        """Rows that a surrogate may learn from, (n,)."""
        return self.ok & ~self.held_out

    @property
    def testing(self) -> NDArray[np.bool_]:
        """Rows that no surrogate may learn from, (n,)."""
        return self.ok & self.held_out


@dataclass(frozen=True)
class Prediction:
    """Force at n points with its own uncertainty, as a low-rank Gaussian.

    mean (n, m) [N]; factor (n, m, r) [N]; diagonal (n, m) [N^2].
    Covariance at point i: ``factor[i] @ factor[i].T + diag(diagonal[i])``. A factor whose bins lie next to
    each other in memory, the transposed view of an (n, r, m) array, is used without a copy.
    """

    mean: Array
    factor: Array
    diagonal: Array

    def sd(self) -> Array:
        """Standard deviation of each bin, (n, m) [N]."""
        return np.sqrt(np.einsum("nmr,nmr->nm", self.factor, self.factor) + self.diagonal)


@runtime_checkable
class Surrogate(Protocol):
    """All that inference and sensitivity know of a model: a box, bins, and predictions in them."""

    @property
    def space(self) -> ParameterSpace: ...

    @property
    def edges_s(self) -> Array: ...

    @property
    def provenance(self) -> Mapping[str, Any]: ...

    def predict(self, theta: ArrayLike) -> Prediction:
        """Force at theta (n, d), vectorised. Raises InputError outside the box."""
        ...

    def predict_mean(self, theta: ArrayLike) -> Array:
        """The mean (n, m) of `predict` alone, which may be had for less."""
        ...


@dataclass(frozen=True)
class Provenance:
    """What a result was made from; stands in every file that bayeskin writes."""

    version: str
    config_sha256: str = ""
    recording_sha256: str = ""
    model_hash: str = ""
    seed: int = 0
    extra: Mapping[str, Any] = field(default_factory=dict)
