"""Chooses the parameter points at which the full model is run.

A design grows in waves. Wave 0 fills the prior box with a scrambled Sobol' sequence. Each later wave fills
the plausible part of the box, which history matching against the recording has not ruled out. The surrogate
is then most accurate where the posterior can be. This module runs no model and reads or writes no file.

References: Sobol' (1967) with the scrambling of Matousek (1998) and Owen (1998), by `scipy.stats.qmc`; Craig,
Goldstein, Seheult & Smith (1997), Pressure matching for hydrocarbon reservoirs; Vernon, Goldstein & Bower
(2010), Galaxy formation: a Bayesian uncertainty analysis, Bayesian Analysis 5(4).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayeskin.errors import InputError
from bayeskin.types import Array, Design, Parameter, ParameterSpace, Prediction, frozen_array

Predict = Callable[[Array], Prediction]

SURROGATE_SDS = 3.0  # Pukelsheim (1994): 3 sd contain at least 95 % of any unimodal error
# With so many survivors, the kept fraction is known to about 6 %, and the bounding box to about 1 % of its
# width.
ENOUGH = 256
FIRST_CANDIDATES, MOST_CANDIDATES, ROUNDS = 2**13, 2**16, 8
CHUNK = 256  # points per prediction, whose factor (n, m, r) then takes a few tens of MB


@dataclass(frozen=True)
class Wave:
    """Parameter points to run, with the training points before the held-out points.

    theta : the points (n, d)
    held_out : which of them are held out, (n,) bool
    record : how the points were chosen, as plain numbers and text
    """

    space: ParameterSpace
    theta: Array
    held_out: NDArray[np.bool_]
    number: int
    seed: int
    record: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "theta", frozen_array(self.theta))
        object.__setattr__(self, "held_out", frozen_array(self.held_out, bool))


def default_space() -> ParameterSpace:
    """Returns the five sampled parameters of the base model with their default priors (d = 5, SI units).

    Source of each range: Lavigne et al., "Poromechanical modelling of the time-dependent response of in vivo
    human skin during extension", and the literature cited there.
    """
    article = "Lavigne et al., initial material parameters"
    stiffness = f"within the 5 kPa to 196 MPa of Payan & Ohayon (2017) in {article}; narrowed to a skin test"
    permeability = f"literature range 10⁻¹⁶ to 10⁻¹¹ m² in {article}"
    pressure = f"Wiig & Reed (1983), Hargens et al. (1981) in {article}"
    cutis, subcutis = "of the cutis", "of the subcutis"
    log: Literal["log-uniform"] = "log-uniform"
    return ParameterSpace(
        (
            Parameter("E_c", "Pa", 10e3, 2e6, log, f"Young's modulus {cutis}", stiffness, 1),
            Parameter("E_s", "Pa", 1e3, 500e3, log, f"Young's modulus {subcutis}", stiffness, 1),
            Parameter("k_c", "m^2", 1e-16, 1e-11, log, f"permeability {cutis}", permeability, -1),
            Parameter("k_s", "m^2", 1e-16, 1e-11, log, f"permeability {subcutis}", permeability, -1),
            Parameter("p_init", "Pa", -670.0, 2144.0, "uniform", "initial interstitial pressure", pressure),
        )
    )


def sobol_points(space: ParameterSpace, n: int, seed: int | Sequence[int], skip: int = 0) -> Array:
    """Returns points `skip` to ``skip + n`` of a scrambled Sobol' sequence over the prior, (n, d) in SI.

    A longer sequence with the same seed starts with the shorter sequence, so a design can be extended. Raises
    InputError for a negative count or seed.
    """
    return _within(space, _sobol_unit(space.dim, n, seed, skip))


def first_wave(space: ParameterSpace, n: int, held_out: int, seed: int) -> Wave:
    """Returns wave 0: `n` training and `held_out` test points over the whole box.

    The two sets of points come from independent sequences.
    """
    theta = [sobol_points(space, count, [seed, 0, part]) for part, count in enumerate((n, held_out))]
    record = {
        "rule": "scrambled Sobol' points over the whole prior box",
        "kept_fraction": 1.0,
        "lower": dict(zip(space.names, space.lower.tolist(), strict=True)),
        "upper": dict(zip(space.names, space.upper.tolist(), strict=True)),
    }
    return _wave(space, theta, 0, seed, record)


def misfit_bounds(mean: Array, sd: Array, force_n: ArrayLike, weights: ArrayLike) -> tuple[Array, Array]:
    """Returns the smallest and the largest RMS misfit [N] that the full model can have, each (n,).

    mean, sd : a surrogate's prediction and its standard deviation, (n, m) each
    force_n : the recording's bin means, (m,)
    weights : the weight of each bin, (m,), 0 where the bin is not fitted; a boolean mask is possible too

    By the triangle inequality, the model's misfit differs from D = rms(force - mean) by at most rms(model -
    mean). This error hardly ever exceeds `SURROGATE_SDS` times S = rms(sd), for any correlation of the error
    over bins.
    """
    weight = np.asarray(weights, dtype=float)
    used = weight > 0
    if not used.any():
        raise InputError("weights of the bins", "no bin with a weight above zero", "at least one fitted bin")
    share = weight[used] / weight[used].sum()
    misfit = np.sqrt((np.asarray(force_n)[used] - mean[:, used]) ** 2 @ share)
    spread = np.sqrt(sd[:, used] ** 2 @ share)
    return misfit - SURROGATE_SDS * spread, misfit + SURROGATE_SDS * spread


def next_wave(
    space: ParameterSpace,
    predict: Predict,
    force_n: ArrayLike,
    weights: ArrayLike,
    floor_n: float,
    n: int,
    held_out: int,
    wave: int,
    seed: int,
    factor: float = 1.5,
) -> Wave:
    """Returns `n` training and `held_out` test points that fill the plausible part of the box.

    predict : maps theta (n, d) to a Prediction of the bins of force_n (m,)
    weights : the weights of the bins, as in `misfit_bounds`
    floor_n : the noise floor [N], which is the RMS noise of the fitted bins

    History matching (Craig et al. 1997; Vernon et al. 2010) rules out a point whose misfit is many sd of
    noise and surrogate error. The skin model has a misfit to real recordings at every point, so this
    criterion would rule out all points. Here, the misfit is therefore compared with the smallest misfit that
    can be attained. With (low, high) = `misfit_bounds`, a point stays if ``low <= factor * max(min(high),
    floor_n)``. The plausible part thus contains all points that may be within `factor` of the best point, and
    a misfit below `floor_n` counts as `floor_n`.

    Both sets are scrambled Sobol' sequences over a region around the plausible part. They are filtered and
    taken in the order of the sequence, so they fill the plausible part. The sequence of the test points is
    independent. Fewer points are returned where the plausible part is too thin to find more. The record
    states the kept share of the prior's volume, and the bounding box of the plausible part.
    """

    def bounds(unit: Array) -> tuple[Array, Array]:
        """Returns the misfit bounds [N] of points (n, d) in the unit cube, each (n,)."""
        theta = _within(space, unit)
        parts = [predict(theta[i : i + CHUNK]) for i in range(0, len(theta), CHUNK)]
        pairs = [misfit_bounds(part.mean, part.sd(), force_n, weights) for part in parts]
        low, high = zip(*pairs, strict=True) if pairs else ((np.empty(0),), (np.empty(0),))
        return np.concatenate(low), np.concatenate(high)

    survey = _survey(space.dim, bounds, factor, floor_n, [seed, wave, 2])
    units = [_fill(survey, bounds, count, [seed, wave, part]) for part, count in enumerate((n, held_out))]
    theta = [_within(space, unit) for unit in units]
    plausible = _within(space, np.concatenate([survey.survivors, *units]))
    record = {
        "rule": f"lowest possible rms misfit <= {factor:g} x max(best attainable, noise floor); "
        f"surrogate error counted at {SURROGATE_SDS:g} sd",
        "floor_n": float(floor_n),
        "best_n": survey.best_n,
        "limit_n": survey.limit_n,
        "kept_fraction": survey.kept_fraction,
        "lower": dict(zip(space.names, plausible.min(axis=0).tolist(), strict=True)),
        "upper": dict(zip(space.names, plausible.max(axis=0).tolist(), strict=True)),
    }
    return _wave(space, theta, wave, seed, record)


def posterior_wave(
    space: ParameterSpace, draws: Array, inputs: Array, n: int, held_out: int, wave: int, seed: int
) -> Wave:
    """Returns `n` training and `held_out` test points among draws (k, d) of a posterior.

    Fewer points are returned where there are fewer distinct draws. Test points are taken at regular steps
    from the draws, so they are distributed as the posterior is. Training points spread out over the other
    draws, so they reach the tails. Their distances are measured in `inputs` (k, q), coordinates in which
    similar points have similar forces, in units of the sd of each.
    """
    rows = np.unique(draws, axis=0, return_index=True)[1]
    rows.sort()
    testing = rows[np.linspace(0, len(rows) - 1, min(held_out, len(rows))).astype(int)]
    rows = np.setdiff1d(rows, testing)
    scaled = inputs[rows] / np.maximum(inputs.std(axis=0), np.finfo(float).tiny)
    training = rows[spread_out(scaled, n)]
    region, chosen = _enclosing(space.to_unit(draws)), draws[[*training, *testing]]
    record = {
        "rule": "spread out over draws of the posterior by the surrogate of the waves before",
        "kept_fraction": min(region.volume, 1.0),
        "lower": dict(zip(space.names, chosen.min(axis=0).tolist(), strict=True)),
        "upper": dict(zip(space.names, chosen.max(axis=0).tolist(), strict=True)),
    }
    return _wave(space, [draws[training], draws[testing]], wave, seed, record)


def fine_wave(design: Design, inputs: Array, n: int, held_out: int, seed: int) -> Wave:
    """Returns `n` training and `held_out` held-out points of a design, at which a finer model is run too.

    The points spread out over `inputs` (rows, k), coordinates in which similar points have similar forces.
    The first half spreads over the last wave, where the posterior can be, and the rest spreads over all
    waves. Held-out points of the finer model are held out of the coarser model too.
    """

    def chosen(among: NDArray[np.bool_], count: int) -> list[int]:
        """Returns `count` rows among the given ones, the first half from the last wave."""
        rows = np.flatnonzero(among)
        late = np.flatnonzero(design.wave[rows] == design.wave[rows].max(initial=0))
        first = late[spread_out(inputs[rows[late]], (count + 1) // 2)]
        return list(rows[spread_out(inputs[rows], count, first.tolist())])

    training, testing = chosen(design.training, n), chosen(design.testing, held_out)
    record = {"rule": "points of the coarse design, spread out over its last wave and over all of it"}
    theta = [design.theta[training], design.theta[testing]]
    return _wave(design.space, theta, 0, seed, record)


def spread_out(points: Array, count: int, first: Sequence[int] = ()) -> list[int]:
    """Returns at most `count` rows of `points` (n, d) that lie far from each other.

    The rows `first` come first. Each further row is the row farthest from all rows before it. Without
    `first`, the selection starts with the point nearest to the mean.
    """
    chosen = list(first)
    if not chosen and len(points):
        chosen = [int(np.argmin(np.sum((points - points.mean(axis=0)) ** 2, axis=1)))]
    while len(chosen) < min(count, len(points)):
        square = np.sum((points[:, None] - points[chosen]) ** 2, axis=2).min(axis=1)
        chosen.append(int(np.argmax(square)))
    return chosen[:count]


@dataclass(frozen=True)
class _Region:
    """A box in the coordinates of the unit cube: centre (d,), orthonormal axes (d, d) as columns, half widths
    (d,)."""

    centre: Array
    axes: Array
    half: Array

    @property
    def volume(self) -> float:
        """Returns the volume of the box, as a share of the unit cube's."""
        return float(np.prod(2.0 * self.half))

    def points(self, count: int, seed: Sequence[int], skip: int = 0) -> Array:
        """Returns the sequence's points `skip` to ``skip + count`` that also lie in the unit cube, (<= count,
        d)."""
        local = (2.0 * _sobol_unit(len(self.half), count, seed, skip) - 1.0) * self.half
        unit = self.centre + local @ self.axes.T
        return unit[np.all((unit >= 0.0) & (unit <= 1.0), axis=1)]


@dataclass(frozen=True)
class _Survey:
    """The result of history matching: where to draw points, and which points pass.

    region : the box in which points are drawn
    survivors : points (n, d) in the unit cube that pass
    best_n : the smallest of the largest possible misfits [N]
    limit_n : the misfit [N] that a point's smallest possible misfit must not exceed
    kept_fraction : the share of the prior's volume that passes
    """

    region: _Region
    best_n: float
    limit_n: float
    kept_fraction: float
    survivors: Array  # (n, d) in the unit cube


def _survey(
    dim: int,
    bounds: Callable[[Array], tuple[Array, Array]],
    factor: float,
    floor_n: float,
    seed: Sequence[int],
) -> _Survey:
    """Returns a region around the plausible part, in which enough candidates of one draw pass the limit.

    The region shrinks step by step around the candidates with the smallest misfits.
    """
    region = _Region(np.full(dim, 0.5), np.eye(dim), np.full(dim, 0.5))
    count, best, fraction = FIRST_CANDIDATES, np.inf, np.nan
    nearest, nearest_low = np.empty((0, dim)), np.empty(0)
    for turn in range(ROUNDS):
        unit = region.points(count, [*seed, turn])
        low, high = bounds(unit)
        best = float(np.min(high, initial=best))
        limit = factor * max(best, floor_n)
        alive = int(np.sum(low <= limit))
        fraction = region.volume * alive / count if alive else fraction
        nearest, nearest_low = np.concatenate([nearest, unit]), np.concatenate([nearest_low, low])
        # A few survivors do not show the directions that the data leave free. The region therefore always
        # encloses at least ENOUGH points, even if some of them did not survive.
        first = np.argsort(nearest_low, kind="stable")[: max(ENOUGH, int(np.sum(nearest_low <= limit)))]
        nearest, nearest_low = nearest[first], nearest_low[first]
        if alive >= ENOUGH:
            break
        closer = _enclosing(nearest)
        if closer.volume < 0.5 * region.volume:
            region = closer
        else:  # a curved plausible part fills its box badly, so more candidates are drawn in the same box
            count = min(4 * count, MOST_CANDIDATES)
    return _Survey(region, best, limit, fraction, nearest[nearest_low <= limit])


def _enclosing(unit: Array) -> _Region:
    """Returns the smaller of two boxes around the points (n, d): along the coordinates or the principal axes.

    The box is a tenth wider on each side, because the points are only a sample of the plausible part.
    """
    principal = np.linalg.svd(unit - unit.mean(axis=0), full_matrices=False)[2].T
    regions = []
    for axes, least, most in ((np.eye(unit.shape[1]), 0.0, 1.0), (principal, -np.inf, np.inf)):
        low, high = (unit @ axes).min(axis=0), (unit @ axes).max(axis=0)
        margin = 0.1 * (high - low)
        low, high = np.maximum(low - margin, least), np.minimum(high + margin, most)
        regions.append(_Region(axes @ (0.5 * (low + high)), axes, 0.5 * (high - low)))
    return min(regions, key=lambda region: region.volume)


def _fill(
    survey: _Survey, bounds: Callable[[Array], tuple[Array, Array]], count: int, seed: Sequence[int]
) -> Array:
    """Returns the first `count` points of a sequence over the region that pass the limit, (<= count, d)."""
    passing, drawn, batch = np.empty((0, len(survey.region.half))), 0, 2**11
    while len(passing) < count and drawn < ROUNDS * MOST_CANDIDATES:
        unit = survey.region.points(batch, seed, skip=drawn)
        passing = np.concatenate([passing, unit[bounds(unit)[0] <= survey.limit_n]])
        drawn += batch
    return passing[:count]


def _wave(
    space: ParameterSpace, theta: list[Array], number: int, seed: int, record: Mapping[str, Any]
) -> Wave:
    """Returns a wave of training points and held-out points (n, d), with their numbers in its record."""
    training, testing = (len(part) for part in theta)
    counted = {"wave": number, "seed": seed, "training": training, "held_out": testing, **record}
    return Wave(
        space, np.concatenate(theta), np.arange(training + testing) >= training, number, seed, counted
    )


def _within(space: ParameterSpace, unit: Array) -> Array:
    """Returns points of the unit cube as theta in SI units, same shape, which lie exactly inside the box."""
    return np.clip(space.from_unit(unit), space.lower, space.upper)  # exp(log(x)) can overshoot by one ulp


def _sobol_unit(dim: int, n: int, seed: int | Sequence[int], skip: int = 0) -> Array:
    """Returns the points `skip` to ``skip + n`` of a scrambled Sobol' sequence in the unit cube, (n, dim)."""
    from scipy.stats import qmc  # the import takes a second, which worker processes save

    if n < 0 or skip < 0 or np.min(seed) < 0:
        raise InputError("Sobol' points", f"n = {n}, skip = {skip}, seed = {seed}", "values of at least 0")
    engine = qmc.Sobol(dim, scramble=True, seed=np.random.default_rng(seed))
    if skip:
        return engine.fast_forward(skip).random(n)
    # SciPy warns unless the first draw of a sequence has a power of two as its number of points.
    return engine.random(1 << max(n - 1, 0).bit_length())[:n]
