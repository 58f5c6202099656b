"""The constitutive law of the article's formulation, on the mesh at the start of the time step.

Gradients are taken on that mesh. With "F" = I + grad u of the total displacement u, G = F^-1, and the
small-strain fluid balance, the Cauchy stress t, the fluid content m and the flux Q are

    t = (mu (F F^T - I) + lambda ln(J) I) / J - p I
    m = div(u - u_old) + S (p - p_old) ,     Q = dt (k / mu_f) grad p

These are the article's equations 12, 13 and 26-29, as its script discretises them.
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
    dt,
    divergence_old,
    pressure_old,
    stress,
    content,
    flux,
):
    """Fills stress, content and flux, and returns the smallest J = det F.

    A J that is not positive means that a cell has turned inside out; the function then stops there.

    mu, lam [Pa], mobility k/mu_f [m^2/(Pa s)] and storage S [1/Pa] are given for each cell (e,)
    divergence_old, pressure_old (e, q) : tr F and p at the start of the step, on the same mesh
    """
    inverse = np.empty((3, 3))
    smallest = np.inf
    for e in range(pressure.shape[0]):
        for q in range(pressure.shape[1]):
            f, p = deformation[e, q], pressure[e, q]
            j = inverse_and_determinant(f, inverse)
            if not j > 0.0:
                return j
            smallest = min(smallest, j)
            for i in range(3):
                for k in range(3):
                    left = f[i, 0] * f[k, 0] + f[i, 1] * f[k, 1] + f[i, 2] * f[k, 2]
                    stress[e, q, i, k] = mu[e] / j * left
                stress[e, q, i, i] += (lam[e] * np.log(j) - mu[e]) / j - p
                flux[e, q, i] = dt * mobility[e] * gradient[e, q, i]
            trace = f[0, 0] + f[1, 1] + f[2, 2]
            content[e, q] = trace - divergence_old[e, q] + storage[e] * (p - pressure_old[e, q])
    return smallest


@compiled
def linearise(
    deformation,
    mu,
    lam,
    mobility,
    storage,
    dt,
    stress_f,
    stress_p,
    content_f,
    content_p,
    flux_g,
):
    """Fills the derivatives of `respond`. The derivatives that it does not fill are zero.

    dt = -t_eff tr(G dF) + mu/J (dF F^T + F dF^T) + lambda/J tr(G dF) I - I dp
    """
    inverse = np.empty((3, 3))
    for e in range(deformation.shape[0]):
        for q in range(deformation.shape[1]):
            f = deformation[e, q]
            j = inverse_and_determinant(f, inverse)
            shear, spherical = mu[e] / j, (lam[e] * np.log(j) - mu[e] - lam[e]) / j
            content_p[e, q] = storage[e]
            for i in range(3):
                for k in range(3):
                    by_volume = -shear * (f[i, 0] * f[k, 0] + f[i, 1] * f[k, 1] + f[i, 2] * f[k, 2])
                    if i == k:
                        by_volume -= spherical
                    for m in range(3):
                        for n in range(3):
                            stress_f[e, q, 3 * i + k, 3 * m + n] = by_volume * inverse[n, m]
                    for n in range(3):
                        stress_f[e, q, 3 * i + k, 3 * i + n] += shear * f[k, n]
                        stress_f[e, q, 3 * i + k, 3 * k + n] += shear * f[i, n]
                    same = 1.0 if i == k else 0.0
                    stress_p[e, q, 3 * i + k] = -same
                    content_f[e, q, 3 * i + k] = same
                    flux_g[e, q, i, k] = same * dt * mobility[e]
