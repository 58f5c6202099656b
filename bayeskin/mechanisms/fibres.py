"""Fibres in the solid: they add stress along given directions. Several mechanisms share this law.

    W = k1 / (2 k2) (exp(k2 E^2) - 1) ,   E = kappa (I1 - 3) + (1 - 3 kappa) (I4 - 1) ,   I4 = |F a|^2

For k2 = 0 the energy is W = k1 E^2 / 2. The dispersion kappa is 0 if all fibres lie along a, and 1/3 if no
direction is preferred. The first Piola-Kirchhoff stress is P = W' D with
D = dE/dF = 2 kappa F + 2 (1 - 3 kappa) F a (x) a.

Source: Holzapfel, Gasser & Ogden, J. Elasticity 61 (2000), 1-48; with dispersion Gasser, Ogden & Holzapfel,
J. R. Soc. Interface 3 (2006), 15-35.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np

from bayeskin.finite_element.assembly import compiled
from bayeskin.finite_element.kernels import linearise_kernel, respond_kernel
from bayeskin.finite_element.problem import Sites
from bayeskin.finite_element.tissue import TissueLaw
from bayeskin.types import Array


@compiled
def _strain(f, a, kappa, gradient):
    """Returns E at F (3, 3) and direction a (3,), and fills `gradient` (3, 3) with dE/dF."""
    trace = along = 0.0
    for i in range(3):
        stretched = f[i, 0] * a[0] + f[i, 1] * a[1] + f[i, 2] * a[2]
        along += stretched * stretched
        for k in range(3):
            trace += f[i, k] * f[i, k]
            gradient[i, k] = 2.0 * kappa * f[i, k] + 2.0 * (1.0 - 3.0 * kappa) * stretched * a[k]
    return kappa * (trace - 3.0) + (1.0 - 3.0 * kappa) * (along - 1.0)


@respond_kernel
def add_stress(
    time_s, elapsed_s, par, data, deformation, pressure, gradient, before, after, stress, content, flux
):  # fmt: skip
    """Adds the stress of the fibres."""
    k2, kappa, everywhere = par[0], par[1], par[2] != 0.0
    slope = np.empty((3, 3))
    for n in range(len(pressure)):
        k1 = data[n, 0]
        if k1 == 0.0:
            continue
        strain = _strain(deformation[n], data[n, 1:], kappa, slope)
        if strain > 0.0 or everywhere:
            size = k1 * strain * np.exp(k2 * strain * strain)
            for i in range(3):
                for k in range(3):
                    stress[n, i, k] += size * slope[i, k]


@linearise_kernel
def add_derivatives(
    time_s, elapsed_s, par, data, deformation, pressure, gradient,
    before, stress_f, stress_p, content_f, content_p, flux_f, flux_g,
):  # fmt: skip
    """Adds dP = W'' D (D : dF) + W' (2 kappa dF + 2 (1 - 3 kappa) dF a (x) a)."""
    k2, kappa, everywhere = par[0], par[1], par[2] != 0.0
    slope = np.empty((3, 3))
    for point in range(len(pressure)):
        k1, a = data[point, 0], data[point, 1:]
        if k1 == 0.0:
            continue
        strain = _strain(deformation[point], a, kappa, slope)
        if strain > 0.0 or everywhere:
            grown = k1 * np.exp(k2 * strain * strain)
            size, curvature = grown * strain, grown * (1.0 + 2.0 * k2 * strain * strain)
            for i in range(3):
                for k in range(3):
                    row = 3 * i + k
                    for m in range(3):
                        for n in range(3):
                            stress_f[point, row, 3 * m + n] += curvature * slope[i, k] * slope[m, n]
                    stress_f[point, row, row] += 2.0 * size * kappa
                    for n in range(3):
                        stress_f[point, row, 3 * i + n] += 2.0 * size * (1.0 - 3.0 * kappa) * a[k] * a[n]


def fibres(
    sites: Sites,
    direction: Array,
    k1: Array | float,
    k2: float,
    kappa: float = 0.0,
    tension_only: bool = True,
) -> TissueLaw:
    """Returns the law of fibres.

    direction (n, 3) : unit vectors in the reference configuration, or one vector (3,) for all points
    k1 (n,) [Pa], or one number for all points; k2, kappa [-] : as in the equations above
    tension_only : True if the fibres go slack in compression
    """
    along = np.broadcast_to(direction, (len(sites.cutis), 3))
    par = np.array([k2, kappa, 0.0 if tension_only else 1.0])
    return TissueLaw(par=par, data=sites.table(k1, along), respond=add_stress, linearise=add_derivatives)
