"""History matching: chooses points in the part of the prior box that a recording has not ruled out.

References: Craig, Goldstein, Seheult & Smith (1997), Pressure matching for hydrocarbon reservoirs; Vernon,
Goldstein & Bower (2010), Galaxy formation: a Bayesian uncertainty analysis, Bayesian Analysis 5(4).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bayeskin.design import Region, Wave, enclosing, wave_of, within
from bayeskin.errors import InputError
from bayeskin.types import POINTS_AT_ONCE, Array, ParameterSpace, Prediction

Predict = Callable[[Array], Prediction]


@dataclass(frozen=True)
class MatchingSettings:
    """Settings of history matching.

    surrogate_sds : number of sd of the surrogate beyond which its error is ruled out; 3 sd contain at least
        95 % of any unimodal error (Pukelsheim 1994)
    enough : number of survivors with which the kept fraction is known to about 6 %, and the bounding box
        to about 1 % of its width
    first_candidates, most_candidates : number of candidates of the first round, and largest number of a round
    rounds : largest number of rounds
    batch : number of points that are drawn at once to fill the plausible part
    """

    surrogate_sds: float = 3.0
    enough: int = 256
    first_candidates: int = 2**13
    most_candidates: int = 2**16
    rounds: int = 8
    batch: int = 2**11


MATCHING = MatchingSettings()


def misfit_bounds(mean: Array, sd: Array, force_n: ArrayLike, weights: ArrayLike) -> tuple[Array, Array]:
    """Returns the smallest and the largest RMS misfit [N] that the full model can have, each (n,).

    mean, sd : a surrogate's prediction and its standard deviation, (n, m) each
    force_n : the recording's bin means, (m,)
    weights : the weight of each bin, (m,), 0 where the bin is not fitted; a boolean mask is possible too

    By the triangle inequality, the model's misfit differs from D = rms(force - mean) by at most rms(model -
    mean). This error hardly ever exceeds `surrogate_sds` times S = rms(sd), for any correlation of the error
    over bins.
    """
    weight = np.asarray(weights, dtype=float)
    used = weight > 0
    if not used.any():
        raise InputError("weights of the bins", "no weight is above zero", "at least one bin must be fitted")
    share = weight[used] / weight[used].sum()
    misfit = np.sqrt((np.asarray(force_n)[used] - mean[:, used]) ** 2 @ share)
    spread = np.sqrt(sd[:, used] ** 2 @ share)
    return misfit - MATCHING.surrogate_sds * spread, misfit + MATCHING.surrogate_sds * spread


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
        theta = within(space, unit)
        parts = [predict(theta[i : i + POINTS_AT_ONCE]) for i in range(0, len(theta), POINTS_AT_ONCE)]
        pairs = [misfit_bounds(part.mean, part.sd(), force_n, weights) for part in parts]
        low, high = zip(*pairs, strict=True) if pairs else ((np.empty(0),), (np.empty(0),))
        return np.concatenate(low), np.concatenate(high)

    survey = _survey(space.dim, bounds, factor, floor_n, [seed, wave, 2])
    units = [_fill(survey, bounds, count, [seed, wave, part]) for part, count in enumerate((n, held_out))]
    theta = [within(space, unit) for unit in units]
    plausible = within(space, np.concatenate([survey.survivors, *units]))
    record = {
        "rule": f"lowest possible rms misfit <= {factor:g} x max(best attainable, noise floor); "
        f"surrogate error counted at {MATCHING.surrogate_sds:g} sd",
        "floor_n": float(floor_n),
        "best_n": survey.best_n,
        "limit_n": survey.limit_n,
        "kept_fraction": survey.kept_fraction,
        "lower": dict(zip(space.names, plausible.min(axis=0).tolist(), strict=True)),
        "upper": dict(zip(space.names, plausible.max(axis=0).tolist(), strict=True)),
    }
    return wave_of(space, theta, wave, seed, record)


@dataclass(frozen=True)
class _Survey:
    """The result of history matching: where to draw points, and which points pass.

    region : the box in which points are drawn
    survivors : points (n, d) in the unit cube that pass
    best_n : the smallest of the largest possible misfits [N]
    limit_n : the misfit [N] that a point's smallest possible misfit must not exceed
    kept_fraction : the share of the prior's volume that passes
    """

    region: Region
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
    region = Region(np.full(dim, 0.5), np.eye(dim), np.full(dim, 0.5))
    count, best, fraction = MATCHING.first_candidates, np.inf, np.nan
    nearest, nearest_low = np.empty((0, dim)), np.empty(0)
    for turn in range(MATCHING.rounds):
        unit = region.points(count, [*seed, turn])
        low, high = bounds(unit)
        best = float(np.min(high, initial=best))
        limit = factor * max(best, floor_n)
        alive = int(np.sum(low <= limit))
        fraction = region.volume * alive / count if alive else fraction
        nearest, nearest_low = np.concatenate([nearest, unit]), np.concatenate([nearest_low, low])
        # A few survivors do not show the directions that the data leave free. The region therefore always
        # encloses at least `enough` points, even if some of them did not survive.
        first = np.argsort(nearest_low, kind="stable")[
            : max(MATCHING.enough, int(np.sum(nearest_low <= limit)))
        ]
        nearest, nearest_low = nearest[first], nearest_low[first]
        if alive >= MATCHING.enough:
            break
        closer = enclosing(nearest)
        if closer.volume < 0.5 * region.volume:
            region = closer
        else:  # a curved plausible part fills its box badly, so more candidates are drawn in the same box
            count = min(4 * count, MATCHING.most_candidates)
    return _Survey(region, best, limit, fraction, nearest[nearest_low <= limit])


def _fill(
    survey: _Survey, bounds: Callable[[Array], tuple[Array, Array]], count: int, seed: Sequence[int]
) -> Array:
    """Returns the first `count` points of a sequence over the region that pass the limit, (<= count, d)."""
    passing, drawn, batch = np.empty((0, len(survey.region.half))), 0, MATCHING.batch
    while len(passing) < count and drawn < MATCHING.rounds * MATCHING.most_candidates:
        unit = survey.region.points(batch, seed, skip=drawn)
        passing = np.concatenate([passing, unit[bounds(unit)[0] <= survey.limit_n]])
        drawn += batch
    return passing[:count]
