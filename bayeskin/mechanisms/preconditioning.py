"""Damage by the largest strain energy so far: the first stretch is stiffer, and later stretches repeat.

Let W be the stored energy of the base solid, and W_max its largest value so far at the same point. Then

    P = (1 - D) dW/dF ,   D = d (1 - exp(-W_max / W_d)) .

The stress still grows with stretch for d up to 0.6. Fibres of other mechanisms are not damaged.

Source: Simo, Comput. Methods Appl. Mech. Eng. 60 (1987), 153-173, for damage by the largest energy; Mullins,
Rubber Chem. Technol. 42 (1969), 339-362, for the effect in rubber.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayeskin.finite_element.assembly import compiled, inverse_and_determinant
from bayeskin.finite_element.kernels import linearise_kernel, respond_kernel
from bayeskin.finite_element.problem import Sites, material
from bayeskin.finite_element.tissue import TissueLaw
from bayeskin.mechanisms.mechanism import Mechanism, Tissue
from bayeskin.number_format import number
from bayeskin.types import Array, Parameter


@compiled
def stored_energy(f, mu, lam, inverse, slope):
    """Returns W and ln J at F (3, 3), and fills F^-1 and dW/dF.

    W = mu / 2 (I1 - 3 - 2 ln J) + lambda / 2 ln^2 J
    """
    log = np.log(inverse_and_determinant(f, inverse))
    spherical, square = lam * log - mu, 0.0
    for i in range(3):
        for k in range(3):
            square += f[i, k] * f[i, k]
            slope[i, k] = mu * f[i, k] + spherical * inverse[k, i]
    return 0.5 * mu * (square - 3.0 - 2.0 * log) + 0.5 * lam * log * log, log


@respond_kernel
def weaken(
    time_s, elapsed_s, par, data, deformation, pressure, gradient, before, after, stress, content, flux
):  # fmt: skip
    """Subtracts D dW/dF from the stress.

    `par` holds d and W_d, `data` holds mu and lambda, and the memory holds W_max.
    """
    most, scale = par[0], par[1]
    inverse, slope = np.empty((3, 3)), np.empty((3, 3))
    for n in range(len(pressure)):
        energy, _ = stored_energy(deformation[n], data[n, 0], data[n, 1], inverse, slope)
        largest = max(energy, before[n, 0])
        after[n, 0] = largest
        damage = most * (1.0 - np.exp(-largest / scale))
        for i in range(3):
            for k in range(3):
                stress[n, i, k] -= damage * slope[i, k]


@linearise_kernel
def weaken_derivatives(
    time_s, elapsed_s, par, data, deformation, pressure, gradient,
    before, stress_f, stress_p, content_f, content_p, flux_f, flux_g,
):  # fmt: skip
    """Adds - D d2W/dF2 and, while W is at its largest value, - dD/dW dW/dF (x) dW/dF to the derivative."""
    most, scale = par[0], par[1]
    inverse, slope = np.empty((3, 3)), np.empty((3, 3))
    for point in range(len(pressure)):
        mu, lam = data[point, 0], data[point, 1]
        energy, log = stored_energy(deformation[point], mu, lam, inverse, slope)
        left = np.exp(-max(energy, before[point, 0]) / scale)
        damage, growth = most * (1.0 - left), 0.0
        if energy >= before[point, 0]:
            growth = most * left / scale
        transposed = damage * (mu - lam * log)
        for i in range(3):
            for k in range(3):
                row = 3 * i + k
                for m in range(3):
                    for n in range(3):
                        stress_f[point, row, 3 * m + n] -= (
                            transposed * inverse[k, m] * inverse[n, i]
                            + damage * lam * inverse[k, i] * inverse[n, m]
                            + growth * slope[i, k] * slope[m, n]
                        )
                stress_f[point, row, row] -= damage * mu


def damaged(most: float, scale_pa: float, lame: Array) -> TissueLaw:
    """Returns the law for a largest damage [-] and its energy scale [Pa]; lame (n, 2): mu and lambda [Pa]."""
    return TissueLaw(
        remembers=1,
        par=np.array([most, scale_pa]),
        data=lame,
        respond=weaken,
        linearise=weaken_derivatives,
    )


def bind(values: Mapping[str, float], sites: Sites) -> TissueLaw:
    """Returns the tissue law for `damage` and `damage_energy`, in both layers."""
    solid = material(values, sites.cutis)
    return damaged(values["damage"], values["damage_energy"], sites.table(solid.mu, solid.lam))


MECHANISM = Mechanism(
    name="preconditioning",
    parameters=(
        Parameter("damage", "-", 0.0, 0.6, "uniform", "largest loss of stiffness, as a share"),
        Parameter(
            "damage_energy",
            "Pa",
            1e2,
            1e5,
            "log-uniform",
            "stored energy at which 63 % of this loss is reached",
            stress_power=1,
        ),
    ),
    neutral={"damage": 0.0, "damage_energy": 1e3},
    statement=lambda v: (
        f"The first stretch softens the skin by at most {100 * v['damage']:.0f} %, of which 63 % is reached "
        f"at a stored energy of {number(1e-3 * v['damage_energy'], 3)} kPa; later cycles repeat this."
    ),
    look_alikes=("slow-recovery",),
    act=Tissue(bind),
)
