"""The tissue yields: beyond a threshold of stretch along the pull its rest length grows and does not return.

Let l = |F e_x| be the stretch along x, l_max its largest value so far at the same point, y the threshold, and
s the share of the excess that stays. Then

    l_p = 1 + s max(l_max - y, 0) ,   F_p = diag(l_p, l_p^-1/2, l_p^-1/2) ,   W = W_e(F F_p^-1)

with the energy W_e of the base solid. Because det F_p = 1, the stress differs from that of the base solid in
the first term, mu F, only:

    P = P_base + mu F (C_p^-1 - I) ,   C_p^-1 = diag(l_p^-2, l_p, l_p) .

The force still grows with stretch as long as s y < 1. Fibres of other mechanisms do not yield, and the damage
of `preconditioning` depends on the total stretch.

Source: Lee, J. Appl. Mech. 36 (1969), 1-6, for the split F = F_e F_p.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayeskin.finite_element.assembly import compiled
from bayeskin.finite_element.kernels import linearise_kernel, respond_kernel
from bayeskin.finite_element.problem import Sites, material
from bayeskin.finite_element.tissue import TissueLaw
from bayeskin.mechanisms.mechanism import Mechanism, Tissue
from bayeskin.types import Array, Parameter


@compiled
def stretch_along(f):
    """Returns the stretch |F e_x| along the pull."""
    return np.sqrt(f[0, 0] * f[0, 0] + f[1, 0] * f[1, 0] + f[2, 0] * f[2, 0])


@respond_kernel
def set_free(
    time_s, elapsed_s, par, data, deformation, pressure, gradient, before, after, stress, content, flux
):  # fmt: skip
    """Adds mu F (C_p^-1 - I) to the stress.

    `par` holds s and y, `data` holds mu, and the memory holds l_max.
    """
    for n in range(len(pressure)):
        f, mu = deformation[n], data[n, 0]
        largest = max(stretch_along(f), before[n, 0])
        after[n, 0] = largest
        grown = 1.0 + par[0] * max(largest - par[1], 0.0)
        along, across = mu * (1.0 / (grown * grown) - 1.0), mu * (grown - 1.0)
        for i in range(3):
            stress[n, i, 0] += along * f[i, 0]
            stress[n, i, 1] += across * f[i, 1]
            stress[n, i, 2] += across * f[i, 2]


@linearise_kernel
def set_free_derivatives(
    time_s, elapsed_s, par, data, deformation, pressure, gradient,
    before, stress_f, stress_p, content_f, content_p, flux_f, flux_g,
):  # fmt: skip
    """Adds mu dF (C_p^-1 - I) and, while the point yields, mu F dC_p^-1/dl_p s dl to the derivative.

    Here dl = (F e_x) . (dF e_x) / l.
    """
    for n in range(len(pressure)):
        f, mu = deformation[n], data[n, 0]
        stretch = stretch_along(f)
        grown = 1.0 + par[0] * max(max(stretch, before[n, 0]) - par[1], 0.0)
        along, across = mu * (1.0 / (grown * grown) - 1.0), mu * (grown - 1.0)
        growth = par[0] / stretch if stretch >= before[n, 0] and stretch > par[1] else 0.0
        for i in range(3):
            for k in range(3):
                row = 3 * i + k
                stress_f[n, row, row] += along if k == 0 else across
                slope = mu * f[i, k] * growth * (-2.0 / grown**3 if k == 0 else 1.0)
                for m in range(3):
                    stress_f[n, row, 3 * m] += slope * f[m, 0]


def setting(share: float, threshold: float, mu: Array) -> TissueLaw:
    """Returns the law for the share that stays [-] and the threshold of stretch [-]; mu (n, 1) is in Pa."""
    return TissueLaw(
        remembers=1,
        par=np.array([share, threshold]),
        data=mu,
        respond=set_free,
        linearise=set_free_derivatives,
    )


def bind(values: Mapping[str, float], sites: Sites) -> TissueLaw:
    """Returns the tissue law for `set_share` and `yield_stretch`, in both layers."""
    mu = sites.table(material(values, sites.cutis).mu)
    return setting(values["set_share"], values["yield_stretch"], mu)


MECHANISM = Mechanism(
    name="plastic-set",
    parameters=(
        Parameter("set_share", "-", 0.0, 0.6, "uniform", "share of the excess stretch that stays"),
        Parameter(
            "yield_stretch", "-", 1.02, 1.3, "uniform", "stretch along the pull above which skin yields"
        ),
    ),
    neutral={"set_share": 0.0, "yield_stretch": 1.1},
    statement=lambda v: (
        f"Skin that is stretched by more than {100 * (v['yield_stretch'] - 1):.0f} % along the pull stays "
        f"longer, by {100 * v['set_share']:.0f} % of the excess, so that in later cycles the force starts "
        "to rise later and is lower."
    ),
    look_alikes=("preconditioning",),
    act=Tissue(bind),
)
