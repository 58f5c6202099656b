"""All moduli change slowly with time, as the tissue dries, warms or swells: P_e f(t), in both layers.

    f = 1 + r T (1 - exp(-t / T))

Here t is the time since the start of the test. For T -> infinity the factor is the straight line 1 + r t. The
factor multiplies the stress of everything that is elastic, fibres included. Branches of a viscous solid then
relax the result. The kernels also accept factors of several such pieces, each with its own start t_0 and its
factor f_0 at that time.

Moduli do not vanish. A rate below -1 / T would make them vanish and is refused. If the factor would fall
below `LEAST`, it stays at `LEAST`. For a rate near -1 / T this happens after four to five times T.

Range: chosen for this test; the moduli change by up to a third in its 347 s.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from bayeskin.errors import InputError
from bayeskin.finite_element.assembly import compiled, inverse_and_determinant
from bayeskin.finite_element.kernels import linearise_kernel, respond_kernel
from bayeskin.finite_element.problem import Sites
from bayeskin.finite_element.tissue import Rank, TissueLaw
from bayeskin.mechanisms.elastic import elastic_stress, scale_elastic
from bayeskin.mechanisms.mechanism import Mechanism, Tissue
from bayeskin.types import Parameter

LEAST = 0.01
Piece = tuple[float, float, float, float]  # t_0 [s], factor f_0 and rate r [1/s] at t_0, T [s]


@compiled
def factor_at(time_s, par):
    """Returns the factor at a time; `par` holds the pieces in the order of their starts."""
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
    """Changes the derivative to dP = f dP_e - d(p J F^-T)."""
    factor, inverse = factor_at(time_s, par), np.empty((3, 3))
    for n in range(len(pressure)):
        j = inverse_and_determinant(deformation[n], inverse)
        scale_elastic(factor, pressure[n], j, inverse, stress_f[n])


def drifting(sites: Sites, pieces: Sequence[Piece]) -> TissueLaw:
    """Returns the law of a factor that depends on time, given in pieces in the order of their starts."""
    return TissueLaw(
        rank=Rank.AGEING,
        par=np.array(pieces, dtype=float).ravel(),
        data=sites.table(),
        respond=factored,
        linearise=factored_derivatives,
    )


def bind(values: Mapping[str, float], sites: Sites) -> TissueLaw:
    """Returns the tissue law for `stiffness_rate` and `stiffness_time`.

    Raises InputError for a rate with which the moduli would vanish.
    """
    rate, time_s = values["stiffness_rate"], values["stiffness_time"]
    if 1.0 + rate * time_s < -LEAST:  # a step of a finite difference may pass the prior's bounds
        expected = f"at least {-1.0 / time_s:g} 1/s with a time constant of {time_s:g} s: moduli would vanish"
        raise InputError("parameters: stiffness_rate", f"{rate:g}", expected)
    return drifting(sites, [(0.0, 1.0, rate, time_s)])


def _told(values: Mapping[str, float]) -> str:
    rate, time_s = values["stiffness_rate"], values["stiffness_time"]
    word = "softens" if rate < 0.0 else "stiffens"
    return (
        f"The tissue {word} with time: its moduli change by {6e3 * rate:+.2f} % a minute at first, ever more "
        f"slowly with a time constant of {time_s:.0f} s."
    )


MECHANISM = Mechanism(
    name="stiffness-drift",
    parameters=(
        Parameter(
            "stiffness_rate", "1/s", -1e-3, 1e-3, "uniform", "initial relative rate of change of all moduli"
        ),
        Parameter(
            "stiffness_time", "s", 30.0, 1000.0, "log-uniform", "time constant with which this change settles"
        ),
    ),
    neutral={"stiffness_rate": 0.0, "stiffness_time": 300.0},
    statement=_told,
    act=Tissue(bind),
)
