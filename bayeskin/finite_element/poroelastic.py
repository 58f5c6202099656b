"""The base model's constitutive law: a neo-Hookean solid with Darcy flow, on the reference configuration.

With F, J = det F and C = F^T F, the first Piola-Kirchhoff stress is

    P = mu (F - F^-T) + lambda ln(J) F^-T - p J F^-T                       (Biot 1)

A stage is a time step or a stage of a Runge-Kutta step. Over a stage of length h, with the stage's history
J*, p*, the fluid content and the flux are

    m = J - J* + J S (p - p*) ,     Q = h (k / mu_f) J C^-1 Grad p

The tangent is symmetric except for the dependence of J C^-1 on u.

Source: the article's equations 12-13 and 26-29, pulled back to the reference configuration.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np

from bayeskin.finite_element.assembly import compiled, inverse_and_determinant


@compiled
def respond(
    deformation,
    pressure,
    gradient,
    mu,
    lam,
    mobility,
    storage,
    h,
    volume_old,
    pressure_old,
    stress,
    content,
    flux,
    volume,
):
    """Fills stress, content, flux and J (e, q), and returns the smallest J.

    A J that is not positive means that a cell has turned inside out; the function then stops there.

    mu, lam [Pa], mobility k/mu_f [m^2/(Pa s)] and storage S [1/Pa] are per cell (e,).
    """
    inverse, spatial = np.empty((3, 3)), np.empty(3)
    smallest = np.inf
    for e in range(pressure.shape[0]):
        for q in range(pressure.shape[1]):
            f, p = deformation[e, q], pressure[e, q]
            j = inverse_and_determinant(f, inverse)
            if not j > 0.0:
                return j
            smallest = min(smallest, j)
            volume[e, q] = j
            spherical = lam[e] * np.log(j) - mu[e] - p * j
            for i in range(3):
                spatial[i] = 0.0
                for k in range(3):
                    stress[e, q, i, k] = mu[e] * f[i, k] + spherical * inverse[k, i]
                    spatial[i] += inverse[k, i] * gradient[e, q, k]
            content[e, q] = j - volume_old[e, q] + j * storage[e] * (p - pressure_old[e, q])
            conductance = h * mobility[e] * j
            for i in range(3):
                flux[e, q, i] = conductance * (
                    inverse[i, 0] * spatial[0] + inverse[i, 1] * spatial[1] + inverse[i, 2] * spatial[2]
                )
    return smallest


@compiled
def linearise(
    deformation,
    pressure,
    gradient,
    mu,
    lam,
    mobility,
    storage,
    h,
    pressure_old,
    stress_f,
    stress_p,
    content_f,
    content_p,
    flux_f,
    flux_g,
):
    """Fills the derivatives of `respond`. With G = F^-1 they are

    dP = mu dF + (mu - lambda ln J + p J) F^-T dF^T F^-T + (lambda - p J) tr(G dF) F^-T - J F^-T dp
    dQ = h k/mu_f J [ tr(G dF) G s - G dF G s - G (G dF)^T grad p + G F^-T d grad p ],  s = F^-T grad p
    """
    inverse, spatial, along = np.empty((3, 3)), np.empty(3), np.empty(3)
    for e in range(pressure.shape[0]):
        for q in range(pressure.shape[1]):
            p = pressure[e, q]
            j = inverse_and_determinant(deformation[e, q], inverse)
            transposed = mu[e] - lam[e] * np.log(j) + p * j
            dyadic = lam[e] - p * j
            stored = storage[e] * (p - pressure_old[e, q])
            conductance = h * mobility[e] * j
            content_p[e, q] = j * storage[e]
            for i in range(3):
                spatial[i] = along[i] = 0.0
                for k in range(3):
                    spatial[i] += inverse[k, i] * gradient[e, q, k]
            for i in range(3):
                for k in range(3):
                    along[i] += inverse[i, k] * spatial[k]
            for i in range(3):
                for k in range(3):
                    row = 3 * i + k
                    stress_p[e, q, row] = -j * inverse[k, i]
                    content_f[e, q, row] = j * (1.0 + stored) * inverse[k, i]
                    total = 0.0
                    for m in range(3):
                        total += inverse[i, m] * inverse[k, m]
                    flux_g[e, q, i, k] = conductance * total
                    for m in range(3):
                        for n in range(3):
                            stress_f[e, q, row, 3 * m + n] = (
                                transposed * inverse[k, m] * inverse[n, i]
                                + dyadic * inverse[k, i] * inverse[n, m]
                            )
                    stress_f[e, q, row, row] += mu[e]
            for i in range(3):
                for m in range(3):
                    for n in range(3):
                        # flux_g holds the conductance times the entry (i, n) of G G^T, which d(F^-T) needs
                        flux_f[e, q, i, 3 * m + n] = (
                            conductance * (inverse[n, m] * along[i] - inverse[i, m] * along[n])
                            - flux_g[e, q, i, n] * spatial[m]
                        )
