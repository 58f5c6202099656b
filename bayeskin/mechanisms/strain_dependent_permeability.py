"""The permeability changes with the volume: k = k0 exp(M (J - 1)) in both layers.

The form is from Lai & Mow, Biorheology 17 (1980), 111-123. J - 1 is of order 0.01 in this test.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayeskin.finite_element.assembly import inverse_and_determinant
from bayeskin.finite_element.kernels import linearise_kernel, respond_kernel
from bayeskin.finite_element.problem import Sites
from bayeskin.finite_element.tissue import TissueLaw
from bayeskin.mechanisms.mechanism import Mechanism, Tissue
from bayeskin.number_format import number
from bayeskin.types import Parameter


@respond_kernel
def scale(
    time_s, elapsed_s, par, data, deformation, pressure, gradient, before, after, stress, content, flux
):  # fmt: skip
    """Multiplies the flux by k / k0. `par` holds M."""
    inverse = np.empty((3, 3))
    for n in range(len(pressure)):
        j = inverse_and_determinant(deformation[n], inverse)
        factor = np.exp(par[0] * (j - 1.0))
        for i in range(3):
            flux[n, i] *= factor


@linearise_kernel
def scale_derivatives(
    time_s, elapsed_s, par, data, deformation, pressure, gradient,
    before, stress_f, stress_p, content_f, content_p, flux_f, flux_g,
):  # fmt: skip
    """Changes the derivatives to d(f Q) = f dQ + f M J tr(F^-1 dF) Q, with f = k / k0 and Q = dQ/dg g."""
    exponent, inverse = par[0], np.empty((3, 3))
    for point in range(len(pressure)):
        j = inverse_and_determinant(deformation[point], inverse)
        factor = np.exp(exponent * (j - 1.0))
        for i in range(3):
            flux = 0.0
            for k in range(3):
                flux += flux_g[point, i, k] * gradient[point, k]
                flux_g[point, i, k] *= factor
            for m in range(3):
                for n in range(3):
                    flux_f[point, i, 3 * m + n] = factor * (
                        flux_f[point, i, 3 * m + n] + exponent * j * inverse[n, m] * flux
                    )


def bind(values: Mapping[str, float], sites: Sites) -> TissueLaw:
    """Returns the tissue law for `M_k`."""
    exponent = np.array([values["M_k"]])
    return TissueLaw(par=exponent, data=sites.table(), respond=scale, linearise=scale_derivatives)


MECHANISM = Mechanism(
    name="strain-dependent-permeability",
    parameters=(
        Parameter(
            "M_k",
            "-",
            -100.0,
            100.0,
            "uniform",
            "exponent of the permeability, k = k0 exp(M_k (J - 1)) at the relative volume J",
        ),
    ),
    neutral={"M_k": 0.0},
    statement=lambda v: (
        f"The permeability changes by {number(100 * np.expm1(0.01 * v['M_k']), 2, sign=True)} % where the "
        "volume grows by 1 %."
    ),
    act=Tissue(bind),
)
