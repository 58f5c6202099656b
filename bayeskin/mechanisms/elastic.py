"""Extracts and scales the elastic stress at quadrature points, for laws that change or remember it.

The stress of a chunk is P = P_e - p J F^-T. P_e is the elastic stress that earlier laws have left. The second
term is carried by the fluid and is not part of the solid's stress.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from bayeskin.finite_element.assembly import compiled, inverse_and_determinant


@compiled
def elastic_stress(f, p, stress, inverse, elastic):
    """Fills F^-1 and P_e (3, 3) at one point from F, the pressure and P there, and returns J."""
    j = inverse_and_determinant(f, inverse)
    for i in range(3):
        for k in range(3):
            elastic[i, k] = stress[i, k] + p * j * inverse[k, i]
    return j


@compiled
def scale_elastic(factor, p, j, inverse, stress_f):
    """Multiplies dP_e/dF by a factor, in place, within the derivative (9, 9) of the total stress.

    The fluid's term d(p J F^-T)/dF_mn = p J (F^-T F^-1_nm - F^-1_ni F^-1_km) does not change.
    """
    less = (factor - 1.0) * p * j
    for i in range(3):
        for k in range(3):
            row = 3 * i + k
            for m in range(3):
                for n in range(3):
                    stress_f[row, 3 * m + n] = factor * stress_f[row, 3 * m + n] + less * (
                        inverse[k, i] * inverse[n, m] - inverse[n, i] * inverse[k, m]
                    )
