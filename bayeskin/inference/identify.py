"""Compares posterior with prior: what the data teach about each parameter, and which parameters form ridges.

Each parameter gets a statement with numbers, and a sentence in plain words.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter1d
from scipy.stats import rankdata

from bayeskin.number_format import at_edge
from bayeskin.types import Array, Parameter, ParameterSpace

_NOTHING_NATS, _NOTHING_CONTRACTION = 0.03, 0.1  # below both, the posterior counts as equal to the prior
_WEAK = 0.5  # contraction below which the data narrow a parameter only a little
# A posterior leans on a bound where the outermost 2 % of the prior hold three times their prior mass.
_EDGE, _LEANS = 0.02, 0.06
_RIDGE = 0.8  # rank correlation above which two parameters form a ridge
# Two peaks are separate where the density between them falls below this share of the lower peak.
_VALLEY = 0.4
_SIDE = 0.05  # smallest share of the draws that counts as a part
_CELLS = 200


@dataclass(frozen=True)
class Learned:
    """The information about one parameter that the posterior has gained over the prior.

    contraction : 1 - posterior variance / prior variance, in the coordinate in which the prior is uniform
    gain_nats : Kullback-Leibler divergence of the posterior from the prior [nats]
    quantiles : 5, 50 and 95 % quantiles in SI
    statement, sentence : the result with these numbers, and in a sentence without statistics
    """

    name: str
    contraction: float
    gain_nats: float
    quantiles: tuple[float, float, float]
    statement: str
    sentence: str


@dataclass(frozen=True)
class Ridge:
    """Two parameters that the data tie together, possibly along a curve.

    `correlation` is the correlation of their ranks.
    """

    first: str
    second: str
    correlation: float
    statement: str


@dataclass(frozen=True)
class Identifiability:
    """All parameters in the order of their space, and the ridges, the strongest first."""

    parameters: tuple[Learned, ...]
    ridges: tuple[Ridge, ...]


def identifiability(space: ParameterSpace, draws: ArrayLike) -> Identifiability:
    """Returns what posterior draws (s, D) in SI say beyond the prior of `space`."""
    unit = space.to_unit(np.asarray(draws, dtype=float))
    learned = tuple(_learn(p, unit[:, j], space, j) for j, p in enumerate(space.parameters))
    with np.errstate(invalid="ignore"):
        correlation: Array = np.nan_to_num(np.atleast_2d(np.corrcoef(rankdata(unit, axis=0), rowvar=False)))
    pairs = [(i, j) for j in range(space.dim) for i in range(j) if abs(correlation[i, j]) > _RIDGE]
    pairs.sort(key=lambda pair: -abs(correlation[pair]))
    return Identifiability(learned, tuple(_ridge(space, i, j, float(correlation[i, j])) for i, j in pairs))


def parts(unit: ArrayLike) -> list[tuple[float, float]]:
    """Returns the separate ranges of the prior-uniform coordinate in which draws (s,) lie.

    Each range spans the 5 to 95 % quantiles of its draws. There is a single range unless valleys of the
    density separate the draws. The density is a normal kernel estimate, mirrored at the ends of the unit
    interval. The width of the kernel follows from the smaller of sd and scaled interquartile range
    (Silverman 1986, eq. 3.31), because two distant peaks would otherwise blur it.
    """
    unit = np.asarray(unit, dtype=float)
    quartiles = np.diff(np.quantile(unit, [0.25, 0.75]))[0] / 1.34
    width = 0.9 * min(unit.std(), quartiles or unit.std()) * len(unit) ** -0.2
    counts, edges = np.histogram(unit, _CELLS, (0.0, 1.0))
    density = gaussian_filter1d(counts.astype(float), max(width * _CELLS, 0.5), mode="reflect")
    cuts, start = [0], 0
    for valley in np.flatnonzero((density[1:-1] <= density[:-2]) & (density[1:-1] < density[2:])) + 1:
        left, right = density[start:valley], density[valley:]
        mass = counts[start:valley].sum(), counts[valley:].sum()
        if density[valley] < _VALLEY * min(left.max(), right.max()) and min(mass) > _SIDE * len(unit):
            cuts.append(int(valley))
            start = int(valley)
    pieces = [unit[(unit >= edges[a]) & (unit <= edges[b])] for a, b in pairwise([*cuts, _CELLS])]
    return [(float(low), float(high)) for low, high in (np.quantile(piece, [0.05, 0.95]) for piece in pieces)]


def noise_remarks(found: Identifiability) -> tuple[str, ...]:
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
        for parameter in found.parameters
        if parameter.name == name and f"leans on the prior's {side} bound" in parameter.statement
    ]
    if not leaning:
        return ()
    return (
        f"the residual is {' and '.join(leaning)}: this is hardly noise but rather something that the model "
        "leaves out, and it biases the parameters; `bayeskin diagnose` looks for it",
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


def _learn(parameter: Parameter, unit: Array, space: ParameterSpace, column: int) -> Learned:
    contraction = float(1.0 - 12.0 * unit.var())  # a uniform coordinate has variance 1/12
    gain = information_gain_nats(unit)
    corners = np.full((3, space.dim), 0.5)
    corners[:, column] = np.quantile(unit, [0.05, 0.5, 0.95])
    low, middle, high = (float(v) for v in space.from_unit(corners)[:, column])
    quantiles = (low, middle, high)
    statement = _statement(parameter, unit, contraction, gain, quantiles)
    sentence = _sentence(parameter, contraction, gain, quantiles)
    return Learned(parameter.name, contraction, gain, quantiles, statement, sentence)


def _statement(
    p: Parameter, unit: Array, contraction: float, gain: float, quantiles: tuple[float, float, float]
) -> str:
    if gain < _NOTHING_NATS and abs(contraction) < _NOTHING_CONTRACTION:
        return f"{p.name}: the data does not inform it (posterior = prior)"
    factor, unit_name = at_edge(p.unit)
    low, middle, high = (factor * value for value in quantiles)
    of_unit = "" if unit_name == "1" else f" {unit_name}"
    numbers = f"median {middle:.3g}, 90 % interval {low:.3g} to {high:.3g}{of_unit}"
    leans = [
        f"leans on the prior's {side} bound, {factor * bound:.3g}{of_unit}, so that the prior shapes it"
        for side, bound, mass in (
            ("lower", p.lower, np.mean(unit < _EDGE)), ("upper", p.upper, np.mean(unit > 1 - _EDGE)),
        )
        if mass > _LEANS and not p.peaked
    ]  # fmt: skip
    ranges = parts(unit)
    if len(ranges) > 1 and not p.peaked:
        box = ParameterSpace((p,))
        ends = [factor * box.from_unit(np.array(limits)[:, None])[:, 0] for limits in ranges]
        listed = " and ".join(f"{a:.3g} to {b:.3g}{of_unit}" for a, b in ends)
        leans.append(f"{len(ranges)} separate ranges fit: {listed}")
    strength = "the data informs it" if contraction >= _WEAK else "the data informs it weakly"
    return "; ".join([f"{p.name}: {strength}: {numbers}", *leans])


def _sentence(p: Parameter, contraction: float, gain: float, quantiles: tuple[float, float, float]) -> str:
    factor, name = at_edge(p.unit)
    unit = "" if name == "1" else f" {name}"
    text = f"{p.description or 'parameter'} ({p.name})"
    if gain < _NOTHING_NATS and abs(contraction) < _NOTHING_CONTRACTION:
        return (
            f"This test says nothing about the {text}, which is only known to lie in the assumed range, "
            f"{factor * p.lower:.3g} to {factor * p.upper:.3g}{unit}."
        )
    low, middle, high = (factor * value for value in quantiles)
    range_ = f"{low:.3g} to {high:.3g}{unit}"
    if contraction < _WEAK:
        return f"This test narrows the {text} only a little: with 90 % probability it is {range_}."
    times = 1.0 / np.sqrt(max(1.0 - contraction, 1e-12))
    return (
        f"The {text} is about {middle:.3g}{unit}, with 90 % probability {range_}; this range is {times:.2g} "
        f"times narrower than assumed before the test."
    )


def _ridge(space: ParameterSpace, i: int, j: int, correlation: float) -> Ridge:
    first, second = space.names[i], space.names[j]
    how = "they rise and fall together" if correlation > 0 else "one compensates for the other"
    statement = f"{first} and {second} form a ridge (rank correlation {correlation:+.2f}): {how}"
    return Ridge(first, second, correlation, statement)
