"""The solid itself relaxes: generalised Maxwell branches act on the elastic stress of both layers.

Let S_e be the elastic second Piola-Kirchhoff stress at equilibrium. Each branch b adds

    Q_b = g_b S_e - A_b ,   A_b' = (g_b S_e - A_b) / tau_b .

Over a time h in which S_e goes linearly from S_0 to S_1, with z = h / tau and phi = (1 - e^-z) / z, exactly

    A_1 = e^-z A_0 + g [ (phi - e^-z) S_0 + (1 - phi) S_1 ] ,

so that the relaxation after a step of the stretch is exponential for time steps of any length.

The effect on a force F without branches can be estimated. If all points between the pads are stretched alike,
by l = 1 + u / 2 L, then S is proportional to F / l. The branches add about l times their response to F / l.

Source: Simo, Comput. Methods Appl. Mech. Eng. 60 (1987), 153-173; the recursion follows Taylor, Pister &
Goudreau, Int. J. Numer. Methods Eng. 2 (1970), 45-59.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayeskin.finite_element.assembly import compiled, inverse_and_determinant
from bayeskin.finite_element.kernels import linearise_kernel, respond_kernel
from bayeskin.finite_element.problem import Sites
from bayeskin.finite_element.tissue import Rank, TissueLaw
from bayeskin.mechanisms.elastic import elastic_stress, scale_elastic
from bayeskin.mechanisms.mechanism import Mechanism, Tissue
from bayeskin.number_format import number
from bayeskin.types import Parameter


@compiled
def _decay(elapsed_s, tau_s):
    """Returns e^-z and phi over a time h, with z = h / tau."""
    z = elapsed_s / tau_s
    return np.exp(-z), -np.expm1(-z) / z


@respond_kernel
def relax(
    time_s, elapsed_s, par, data, deformation, pressure, gradient, before, after, stress, content, flux
):  # fmt: skip
    """Adds the stress of the branches.

    `par` holds g and tau of each branch. The memory holds S_e and then A of each branch, row by row.
    """
    count = len(par) // 2
    weight, over = np.empty((count, 3)), 0.0  # weights of A_0, S_0 and S_1 in A_1; sum of g
    for b in range(count):
        g = par[2 * b]
        keep, phi = _decay(elapsed_s, par[2 * b + 1])
        weight[b, 0], weight[b, 1], weight[b, 2] = keep, g * (phi - keep), g * (1.0 - phi)
        over += g
    inverse, elastic, second = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for n in range(len(pressure)):
        f = deformation[n]
        elastic_stress(f, pressure[n], stress[n], inverse, elastic)
        for i in range(3):
            for k in range(3):
                total = 0.0
                for m in range(3):
                    total += inverse[i, m] * elastic[m, k]
                second[i, k] = over * total
                after[n, 3 * i + k] = total
        for b in range(count):
            for r in range(9):
                place = 9 * (b + 1) + r
                grown = (
                    weight[b, 0] * before[n, place] + weight[b, 1] * before[n, r] + weight[b, 2] * after[n, r]
                )
                after[n, place] = grown
                second[r // 3, r % 3] -= grown
        for i in range(3):
            for k in range(3):
                for m in range(3):
                    stress[n, i, k] += f[i, m] * second[m, k]


@linearise_kernel
def relax_derivatives(
    time_s, elapsed_s, par, data, deformation, pressure, gradient,
    before, stress_f, stress_p, content_f, content_p, flux_f, flux_g,
):  # fmt: skip
    """Changes the derivative to dP = (1 + left) dP_e - dF C, where `left` is the sum of g_b phi_b.

    C is the part of A_1 that follows from the past.
    """
    count, left = len(par) // 2, 0.0
    weight = np.empty((count, 2))  # weights of A_0 and S_0 in A_1
    for b in range(count):
        g = par[2 * b]
        keep, phi = _decay(elapsed_s, par[2 * b + 1])
        weight[b, 0], weight[b, 1] = keep, g * (phi - keep)
        left += g * phi
    inverse, past = np.empty((3, 3)), np.empty(9)
    for point in range(len(pressure)):
        j = inverse_and_determinant(deformation[point], inverse)
        scale_elastic(1.0 + left, pressure[point], j, inverse, stress_f[point])
        past[:] = 0.0
        for b in range(count):
            for r in range(9):
                past[r] += weight[b, 0] * before[point, 9 * (b + 1) + r] + weight[b, 1] * before[point, r]
        for i in range(3):
            for k in range(3):
                for n in range(3):
                    stress_f[point, 3 * i + k, 3 * i + n] -= past[3 * n + k]


def bind(values: Mapping[str, float], sites: Sites) -> TissueLaw:
    """Returns the law of two branches, in both layers."""
    par = np.array([values["g_1"], values["tau_1"], values["g_2"], values["tau_2"]])
    return TissueLaw(
        rank=Rank.VISCOUS,
        remembers=9 * (1 + len(par) // 2),
        par=par,
        data=sites.table(),
        respond=relax,
        linearise=relax_derivatives,
    )


MECHANISM = Mechanism(
    name="solid-viscoelasticity",
    parameters=(
        Parameter("g_1", "-", 0.0, 2.0, "uniform", "stress of the first branch over the long-run one"),
        Parameter("tau_1", "s", 0.2, 15.0, "log-uniform", "relaxation time of the first branch"),
        Parameter("g_2", "-", 0.0, 2.0, "uniform", "stress of the second branch over the long-run one"),
        Parameter("tau_2", "s", 15.0, 300.0, "log-uniform", "relaxation time of the second branch"),
    ),
    neutral={"g_1": 0.0, "tau_1": 2.0, "g_2": 0.0, "tau_2": 60.0},
    statement=lambda v: (
        f"The solid itself is viscoelastic: right after a sudden stretch its stress is "
        f"{100 * (v['g_1'] + v['g_2']):.0f} % above the long-run stress; {100 * v['g_1']:.0f} % of the "
        f"long-run stress relaxes with a time constant of {number(v['tau_1'], 2)} s, and "
        f"{100 * v['g_2']:.0f} % with one of {number(v['tau_2'], 2)} s."
    ),
    look_alikes=("strain-dependent-permeability",),
    act=Tissue(bind),
    parts=(("g_1", "tau_1"), ("g_2", "tau_2")),
)
