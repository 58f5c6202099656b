"""Chooses the parameter points at which the full model is run.

A design grows in waves. Wave 0 fills the prior box with a scrambled Sobol' sequence. Each later wave fills
the plausible part of the box (`history_matching`), or draws of a posterior. The surrogate is then most
accurate where the posterior can be. This module runs no model and reads or writes no file.

Reference: Sobol' (1967) with the scrambling of Matousek (1998) and Owen (1998), by `scipy.stats.qmc`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from bayeskin.errors import InputError
from bayeskin.types import Array, Design, Parameter, ParameterSpace, frozen_array


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
    return within(space, sobol_unit(space.dim, n, seed, skip))


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
    return wave_of(space, theta, 0, seed, record)


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
    region, chosen = enclosing(space.to_unit(draws)), draws[[*training, *testing]]
    record = {
        "rule": "spread out over draws of the posterior by the surrogate of the waves before",
        "kept_fraction": min(region.volume, 1.0),
        "lower": dict(zip(space.names, chosen.min(axis=0).tolist(), strict=True)),
        "upper": dict(zip(space.names, chosen.max(axis=0).tolist(), strict=True)),
    }
    return wave_of(space, [draws[training], draws[testing]], wave, seed, record)


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
    return wave_of(design.space, theta, 0, seed, record)


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
class Region:
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
        local = (2.0 * sobol_unit(len(self.half), count, seed, skip) - 1.0) * self.half
        unit = self.centre + local @ self.axes.T
        return unit[np.all((unit >= 0.0) & (unit <= 1.0), axis=1)]


def enclosing(unit: Array) -> Region:
    """Returns the smaller of two boxes around the points (n, d): along the coordinates or the principal axes.

    The box is a tenth wider on each side, because the points are only a sample of the plausible part.
    """
    principal = np.linalg.svd(unit - unit.mean(axis=0), full_matrices=False)[2].T
    regions = []
    for axes, least, most in ((np.eye(unit.shape[1]), 0.0, 1.0), (principal, -np.inf, np.inf)):
        low, high = (unit @ axes).min(axis=0), (unit @ axes).max(axis=0)
        margin = 0.1 * (high - low)
        low, high = np.maximum(low - margin, least), np.minimum(high + margin, most)
        regions.append(Region(axes @ (0.5 * (low + high)), axes, 0.5 * (high - low)))
    return min(regions, key=lambda region: region.volume)


def wave_of(
    space: ParameterSpace, theta: list[Array], number: int, seed: int, record: Mapping[str, Any]
) -> Wave:
    """Returns a wave of training points and held-out points (n, d), with their numbers in its record."""
    training, testing = (len(part) for part in theta)
    counted = {"wave": number, "seed": seed, "training": training, "held_out": testing, **record}
    return Wave(
        space, np.concatenate(theta), np.arange(training + testing) >= training, number, seed, counted
    )


def within(space: ParameterSpace, unit: Array) -> Array:
    """Returns points of the unit cube as theta in SI units, same shape, which lie exactly inside the box."""
    return np.clip(space.from_unit(unit), space.lower, space.upper)  # exp(log(x)) can overshoot by one ulp


def sobol_unit(dim: int, n: int, seed: int | Sequence[int], skip: int = 0) -> Array:
    """Returns the points `skip` to ``skip + n`` of a scrambled Sobol' sequence in the unit cube, (n, dim)."""
    from scipy.stats import qmc  # the import takes a second, which worker processes save

    if n < 0 or skip < 0 or np.min(seed) < 0:
        raise InputError(
            "Sobol' points",
            f"n = {n}, skip = {skip} and seed = {seed} are given",
            "none of them can be negative",
        )
    engine = qmc.Sobol(dim, scramble=True, seed=np.random.default_rng(seed))
    if skip:
        return engine.fast_forward(skip).random(n)
    # SciPy warns unless the first draw of a sequence has a power of two as its number of points.
    return engine.random(1 << max(n - 1, 0).bit_length())[:n]
