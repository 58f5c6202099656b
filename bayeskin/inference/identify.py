"""Compares posterior with prior: what the data teach about each parameter, and which form ridges."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter1d
from scipy.stats import rankdata

from bayeskin.inference.problem import UNIFORM_PRECISION
from bayeskin.number_format import interval, number, quantity
from bayeskin.types import Array, Parameter, ParameterSpace

Side = Literal["lower", "upper"]


@dataclass(frozen=True)
class IdentifiabilitySettings:
    """Thresholds with which a posterior is compared with its prior.

    nothing_nats, nothing_contraction : below both, the posterior counts as equal to the prior
    weak : contraction below which the data narrow a parameter only a little
    edge, leans : a posterior leans on a bound where the outermost share `edge` of the prior holds more than
        the share `leans` of the draws, three times the prior's mass there
    ridge : rank correlation above which two parameters form a ridge
    valley : share of the lower of two peaks; they are separate where the density between them falls below it
    side : smallest share of the draws that counts as a separate range
    cells : number of cells of the histogram in which separate ranges are looked for
    """

    nothing_nats: float = 0.03
    nothing_contraction: float = 0.1
    weak: float = 0.5
    edge: float = 0.02
    leans: float = 0.06
    ridge: float = 0.8
    valley: float = 0.4
    side: float = 0.05
    cells: int = 200


class Informed(StrEnum):
    """A grade of how well the data inform a parameter."""

    NOT = "not informed"
    WEAKLY = "weakly informed"
    WELL = "informed"


_OUTCOMES = {
    Informed.NOT: "the data does not inform it (posterior = prior)",
    Informed.WEAKLY: "the data informs it weakly",
    Informed.WELL: "the data informs it",
}


def grade_of(contraction: float, settings: IdentifiabilitySettings = IdentifiabilitySettings()) -> Informed:
    """Returns the grade of a parameter by its contraction alone, where there are no draws."""
    if contraction < settings.nothing_contraction:
        return Informed.NOT
    return Informed.WEAKLY if contraction < settings.weak else Informed.WELL


@dataclass(frozen=True)
class Learned:
    """The information about one parameter that the posterior has gained over the prior.

    contraction : 1 - posterior variance / prior variance, in the coordinate in which the prior is uniform
    gain_nats : Kullback-Leibler divergence of the posterior from the prior [nats]
    quantiles : 5, 50 and 95 % quantiles in SI
    leans_on : bounds of the prior near which the posterior has too much of its mass
    ranges : 5 and 95 % quantiles in SI of each separate range of the draws; empty if there is only one range
    """

    parameter: Parameter
    contraction: float
    gain_nats: float
    informed: Informed
    quantiles: tuple[float, float, float]
    leans_on: tuple[Side, ...]
    ranges: tuple[tuple[float, float], ...]

    @property
    def name(self) -> str:
        return self.parameter.name

    @property
    def outcome(self) -> str:
        """Returns what the data say about the parameter, without its name, median and interval."""
        return "; ".join([_OUTCOMES[self.informed], *self._remarks])

    @property
    def statement(self) -> str:
        """Returns the outcome with the name, the median and the 90 % interval."""
        if self.informed is Informed.NOT:
            return f"{self.name}: {self.outcome}"
        (low, middle, high), unit = self.quantiles, self.parameter.unit
        numbers = f"median {quantity(middle, unit)}, 90 % interval {interval(low, high, unit)}"
        return "; ".join([f"{self.name}: {_OUTCOMES[self.informed]}: {numbers}", *self._remarks])

    @property
    def sentence(self) -> str:
        """Returns a sentence without statistics on what the test taught about the parameter."""
        p, (low, middle, high) = self.parameter, self.quantiles
        text, between = f"{p.description or 'parameter'} ({p.name})", interval(low, high, p.unit)
        if self.informed is Informed.NOT:
            return (
                f"This test says nothing about the {text}, which is only known to lie in the assumed range, "
                f"{interval(p.lower, p.upper, p.unit)}."
            )
        if self.informed is Informed.WEAKLY:
            return f"This test narrows the {text} only a little: with 90 % probability it is {between}."
        times = 1.0 / np.sqrt(max(1.0 - self.contraction, 1e-12))
        return (
            f"The {text} is about {quantity(middle, p.unit)}, with 90 % probability {between}; this range is "
            f"{number(times, 2)} times narrower than assumed before the test."
        )

    @property
    def _remarks(self) -> list[str]:
        """Returns remarks on bounds and separate ranges."""
        p = self.parameter
        remarks = [
            f"leans on the prior's {side} bound, {quantity(bound, p.unit)}, so that the prior shapes it"
            for side, bound in (("lower", p.lower), ("upper", p.upper))
            if side in self.leans_on
        ]
        if self.ranges:
            listed = " and ".join(interval(low, high, p.unit) for low, high in self.ranges)
            remarks.append(f"{len(self.ranges)} separate ranges fit: {listed}")
        return remarks


@dataclass(frozen=True)
class Ridge:
    """Two parameters that the data tie together, possibly along a curve.

    `correlation` is the correlation of their ranks.
    """

    first: str
    second: str
    correlation: float

    @property
    def statement(self) -> str:
        """Returns the names, the correlation and what it means."""
        how = "they rise and fall together" if self.correlation > 0 else "one compensates for the other"
        correlation = number(self.correlation, 2, sign=True)
        return f"{self.first} and {self.second} form a ridge (rank correlation {correlation}): {how}"


@dataclass(frozen=True)
class Identifiability:
    """All parameters in the order of their space, and the ridges, the strongest first."""

    parameters: tuple[Learned, ...]
    ridges: tuple[Ridge, ...]


def identifiability(
    space: ParameterSpace, draws: ArrayLike, settings: IdentifiabilitySettings = IdentifiabilitySettings()
) -> Identifiability:
    """Returns what posterior draws (s, D) in SI say beyond the prior of `space`."""
    unit = space.to_unit(np.asarray(draws, dtype=float))
    learned = tuple(_learn(p, own, settings) for p, own in zip(space.parameters, unit.T, strict=True))
    with np.errstate(invalid="ignore"):
        correlation: Array = np.nan_to_num(np.atleast_2d(np.corrcoef(rankdata(unit, axis=0), rowvar=False)))
    pairs = [(i, j) for j in range(space.dim) for i in range(j) if abs(correlation[i, j]) > settings.ridge]
    pairs.sort(key=lambda pair: -abs(correlation[pair]))
    ridges = [Ridge(space.names[i], space.names[j], float(correlation[i, j])) for i, j in pairs]
    return Identifiability(learned, tuple(ridges))


def parts(
    unit: ArrayLike, settings: IdentifiabilitySettings = IdentifiabilitySettings()
) -> list[tuple[float, float]]:
    """Returns the separate ranges of the prior-uniform coordinate in which draws (s,) lie.

    Each range spans the 5 to 95 % quantiles of its draws. There is a single range unless valleys of the
    density separate the draws. The density is a normal kernel estimate, mirrored at the ends of the unit
    interval. The width of the kernel follows from the smaller of sd and scaled interquartile range
    (Silverman 1986, eq. 3.31), because two distant peaks would otherwise blur it.
    """
    unit, cells = np.asarray(unit, dtype=float), settings.cells
    quartiles = np.diff(np.quantile(unit, [0.25, 0.75]))[0] / 1.34
    width = 0.9 * min(unit.std(), quartiles or unit.std()) * len(unit) ** -0.2
    counts, edges = np.histogram(unit, cells, (0.0, 1.0))
    density = gaussian_filter1d(counts.astype(float), max(width * cells, 0.5), mode="reflect")
    cuts, start = [0], 0
    for valley in np.flatnonzero((density[1:-1] <= density[:-2]) & (density[1:-1] < density[2:])) + 1:
        left, right = density[start:valley], density[valley:]
        mass = counts[start:valley].sum(), counts[valley:].sum()
        is_deep = density[valley] < settings.valley * min(left.max(), right.max())
        if is_deep and min(mass) > settings.side * len(unit):
            cuts.append(int(valley))
            start = int(valley)
    pieces = [unit[(unit >= edges[a]) & (unit <= edges[b])] for a, b in pairwise([*cuts, cells])]
    return [(float(low), float(high)) for low, high in (np.quantile(piece, [0.05, 0.95]) for piece in pieces)]


def noise_remarks(learned: Identifiability) -> tuple[str, ...]:
    """Returns a remark where noise parameters lie at their bounds, since this points to a misfit.

    The likelihood then takes the misfit for noise. The noise of a load cell is neither correlated over
    minutes nor of infinite variance.
    """
    leaning = [
        remark
        for name, side, remark in (
            ("tau_noise", "upper", "correlated for as long as its prior allows"),
            ("nu_noise", "lower", "with the heaviest tails that its prior allows"),
        )
        for parameter in learned.parameters
        if parameter.name == name and side in parameter.leans_on
    ]
    if not leaning:
        return ()
    return (
        f"The residual is {' and '.join(leaning)}: this is hardly noise but rather something that the model "
        "leaves out, and it biases the parameters; `bayeskin diagnose` looks for it.",
    )


def information_gain_nats(unit: ArrayLike) -> float:
    """Returns the KL divergence [nats], at least 0, of draws (s,) from the prior.

    The draws are those of a coordinate in which the prior is uniform. The divergence comes from the spacing
    estimate of the entropy (Vasicek 1976, J. R. Stat. Soc. B 38:54) with window sqrt(s). The estimate is
    taken relative to that of evenly spread draws, so that a posterior equal to the prior gives 0. Spacings
    follow the draws, so that narrow posteriors need no finer bins.
    """
    unit = np.sort(np.asarray(unit, dtype=float))
    return max(0.0, _spacing_entropy((np.arange(len(unit)) + 0.5) / len(unit)) - _spacing_entropy(unit))


def _spacing_entropy(ordered: Array) -> float:
    n = len(ordered)
    window = max(1, int(np.sqrt(n)))
    index = np.arange(n)
    low, high = np.maximum(index - window, 0), np.minimum(index + window, n - 1)
    spacing = np.maximum(ordered[high] - ordered[low], 1e-12)
    return float(np.mean(np.log(spacing * n / (high - low))))


def _learn(parameter: Parameter, unit: Array, settings: IdentifiabilitySettings) -> Learned:
    box = ParameterSpace((parameter,))

    def in_si(places: ArrayLike) -> list[float]:
        return [float(value) for value in box.from_unit(np.asarray(places)[:, None])[:, 0]]

    contraction = float(1.0 - UNIFORM_PRECISION * unit.var())
    gain_nats = information_gain_nats(unit)
    informed = Informed.WELL if contraction >= settings.weak else Informed.WEAKLY
    if gain_nats < settings.nothing_nats and abs(contraction) < settings.nothing_contraction:
        informed = Informed.NOT
    low, middle, high = in_si(np.quantile(unit, [0.05, 0.5, 0.95]))
    leans_on: list[Side] = []
    ranges: list[list[float]] = []
    if informed is not Informed.NOT and not parameter.peaked:
        leans_on += ["lower"] if np.mean(unit < settings.edge) > settings.leans else []
        leans_on += ["upper"] if np.mean(unit > 1.0 - settings.edge) > settings.leans else []
        ranges = [in_si(ends) for ends in parts(unit, settings)]
    separate = tuple((first, last) for first, last in ranges) if len(ranges) > 1 else ()
    return Learned(
        parameter, contraction, gain_nats, informed, (low, middle, high), tuple(leans_on), separate
    )
