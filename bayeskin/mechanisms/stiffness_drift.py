"""All moduli change slowly with time, as tissue dries, warms or swells: P_e f(t), in both layers.

    f = f_0 + r T (1 - exp(-(t - t_0) / T)) ,   straight, f_0 + r (t - t_0), for T -> infinity,

piece by piece, each with its own start t_0. The factor is on the elastic stress of all that is elastic,
fibres too; branches of a viscous solid then relax what is left. It never falls below `LEAST`.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bayeskin.mechanisms.elastic import elastic_stress, scale_elastic
from bayeskin.model.assembly import compiled, inverse_and_determinant
from bayeskin.model.kernels import linearise_kernel, respond_kernel
from bayeskin.model.problem import Sites
from bayeskin.model.tissue import Rank, TissueLaw

LEAST = 0.01
Piece = tuple[float, float, float, float]  # start t_0 [s], factor f_0 and its rate r [1/s] there, T [s]


@compiled
def factor_at(time_s, par):
    """The factor; `par` holds the pieces one after the other, in the order of their starts."""
    place = 0
    while place + 4 < len(par) and par[place + 4] <= time_s:
        place += 4
    since, first, rate, constant = time_s - par[place], par[place + 1], par[place + 2], par[place + 3]
    if np.isinf(constant):
        return max(first + rate * since, LEAST)
    return max(first - rate * constant * np.expm1(-since / constant), LEAST)


@respond_kernel
def factored(
    time_s, elapsed_s, par, data, deformation, pressure, gradient, before, after, stress, content, flux
):  # fmt: skip
    """Multiplies the elastic part of the stress by the factor."""
    more = factor_at(time_s, par) - 1.0
    inverse, elastic = np.empty((3, 3)), np.empty((3, 3))
    for n in range(len(pressure)):
        elastic_stress(deformation[n], pressure[n], stress[n], inverse, elastic)
        for i in range(3):
            for k in range(3):
                stress[n, i, k] += more * elastic[i, k]


@linearise_kernel
def factored_derivatives(
    time_s, elapsed_s, par, data, deformation, pressure, gradient,
    before, stress_f, stress_p, content_f, content_p, flux_f, flux_g,
):  # fmt: skip
    """dP = f dP_e - d(p J F^-T)."""
    factor, inverse = factor_at(time_s, par), np.empty((3, 3))
    for n in range(len(pressure)):
        j = inverse_and_determinant(deformation[n], inverse)
        scale_elastic(factor, pressure[n], j, inverse, stress_f[n])


def drifting(sites: Sites, pieces: Sequence[Piece]) -> TissueLaw:
    """Returns the law of a factor of the test's time, in pieces that are in the order of their starts."""
    return TissueLaw(
        rank=Rank.AGEING,
        par=np.array(pieces, dtype=float).ravel(),
        data=sites.table(),
        respond=factored,
        linearise=factored_derivatives,
    )
