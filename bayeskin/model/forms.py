"""Weak form of the total-Lagrangian model, compiled: residual and consistent tangent.

With F = I + Grad u, J = det F, C = F^T F, the first Piola-Kirchhoff stress is

    P = mu (F - F^-T) + lambda ln(J) F^-T - p J F^-T                       (momentum, Biot 1)

and over a time step (or Runge-Kutta stage) of length h, from the stage's history J*, p*,

    (J - J*) + J S (p - p*) - h Div( (k / mu_f) J C^-1 Grad p ) = 0         (fluid mass)

Source: the article's equations 12-13 and 26-29, pulled back to the reference configuration. The
fluid rows carry the opposite sign, which makes the tangent symmetric up to the dependence of
J C^-1 on u.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numba
import numpy as np

_compiled = numba.njit(cache=True, error_model="numpy")


@_compiled
def _kinematics(displacement, gradient, f, inverse):
    """Fills F and its inverse (3, 3) at one quadrature point; returns the determinant."""
    for i in range(3):
        for k in range(3):
            f[i, k] = 1.0 if i == k else 0.0
    for a in range(gradient.shape[0]):
        for i in range(3):
            for k in range(3):
                f[i, k] += displacement[a, i] * gradient[a, k]
    for i in range(3):
        i1, i2 = (i + 1) % 3, (i + 2) % 3
        for k in range(3):
            k1, k2 = (k + 1) % 3, (k + 2) % 3
            inverse[k, i] = f[i1, k1] * f[i2, k2] - f[i1, k2] * f[i2, k1]
    j = f[0, 0] * inverse[0, 0] + f[0, 1] * inverse[1, 0] + f[0, 2] * inverse[2, 0]
    for i in range(3):
        for k in range(3):
            inverse[i, k] /= j
    return j


@_compiled
def _gather(x, nodes_u, nodes_p, n_nodes, u, p):
    for a in range(nodes_u.shape[0]):
        for i in range(3):
            u[a, i] = x[3 * nodes_u[a] + i]
    for b in range(nodes_p.shape[0]):
        p[b] = x[3 * n_nodes + nodes_p[b]]


@_compiled
def _push_forward(gradient, f_inverse, out):
    """Spatial gradients F^-T Grad N, (a, 3)."""
    for a in range(gradient.shape[0]):
        for i in range(3):
            out[a, i] = (
                f_inverse[0, i] * gradient[a, 0]
                + f_inverse[1, i] * gradient[a, 1]
                + f_inverse[2, i] * gradient[a, 2]
            )


@_compiled
def residual(
    x,
    nodes_u,
    nodes_p,
    grad_u,
    grad_p,
    value_p,
    weight,
    mu,
    lam,
    mobility,
    storage,
    h,
    volume_old,
    pressure_old,
    out,
    volume,
    pressure,
):
    """Adds the residual (dofs,) to `out`; fills J and p (e, q) at the quadrature points.

    mu, lam [Pa], mobility k/mu_f [m^2/(Pa s)], storage S [1/Pa] are per cell (e,). Returns the
    smallest J: a value of zero or less (or NaN) means that a cell has turned inside out.
    """
    n_nodes = (x.shape[0] - nodes_p.max() - 1) // 3  # the pressures follow the displacements
    na, nb = nodes_u.shape[1], nodes_p.shape[1]
    u, p = np.empty((na, 3)), np.empty(nb)
    g, s = np.empty((na, 3)), np.empty((nb, 3))
    f, f_inverse, flux = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    smallest = np.inf
    for e in range(nodes_u.shape[0]):
        _gather(x, nodes_u[e], nodes_p[e], n_nodes, u, p)
        for q in range(weight.shape[1]):
            j = _kinematics(u, grad_u[e, q], f, f_inverse)
            if not j > 0.0:
                return j
            smallest = min(smallest, j)
            _push_forward(grad_u[e, q], f_inverse, g)
            _push_forward(grad_p[e, q], f_inverse, s)
            pq = 0.0
            flux[:] = 0.0
            for b in range(nb):
                pq += value_p[q, b] * p[b]
                for i in range(3):
                    flux[i] += s[b, i] * p[b]
            volume[e, q], pressure[e, q] = j, pq
            w = weight[e, q]
            spherical = lam[e] * np.log(j) - mu[e] - pq * j
            for a in range(na):
                for i in range(3):
                    elastic = 0.0
                    for k in range(3):
                        elastic += f[i, k] * grad_u[e, q, a, k]
                    out[3 * nodes_u[e, a] + i] += w * (mu[e] * elastic + spherical * g[a, i])
            source = j - volume_old[e, q] + j * storage[e] * (pq - pressure_old[e, q])
            for b in range(nb):
                darcy = s[b, 0] * flux[0] + s[b, 1] * flux[1] + s[b, 2] * flux[2]
                out[3 * n_nodes + nodes_p[e, b]] -= w * (value_p[q, b] * source + h * mobility[e] * j * darcy)
    return smallest


@_compiled
def tangent(
    x,
    nodes_u,
    nodes_p,
    grad_u,
    grad_p,
    value_p,
    weight,
    mu,
    lam,
    mobility,
    storage,
    h,
    pressure_old,
    position,
    data,
):
    """Adds the consistent tangent of `residual` to the sparse `data` at `position` (e, nd, nd)."""
    n_nodes = (x.shape[0] - nodes_p.max() - 1) // 3  # the pressures follow the displacements
    na, nb = nodes_u.shape[1], nodes_p.shape[1]
    u, p = np.empty((na, 3)), np.empty(nb)
    g, s = np.empty((na, 3)), np.empty((nb, 3))
    f, f_inverse, flux = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    cell = np.empty((3 * na + nb, 3 * na + nb))
    for e in range(nodes_u.shape[0]):
        _gather(x, nodes_u[e], nodes_p[e], n_nodes, u, p)
        cell[:] = 0.0
        for q in range(weight.shape[1]):
            j = _kinematics(u, grad_u[e, q], f, f_inverse)
            _push_forward(grad_u[e, q], f_inverse, g)
            _push_forward(grad_p[e, q], f_inverse, s)
            pq = 0.0
            flux[:] = 0.0
            for b in range(nb):
                pq += value_p[q, b] * p[b]
                for i in range(3):
                    flux[i] += s[b, i] * p[b]
            w = weight[e, q]
            transposed = w * (mu[e] - lam[e] * np.log(j) + pq * j)
            dyadic = w * (lam[e] - pq * j)
            _add_solid(cell, grad_u[e, q], g, w * mu[e], transposed, dyadic)
            compressed = w * j * (1.0 + storage[e] * (pq - pressure_old[e, q]))
            _add_fluid(
                cell,
                g,
                s,
                flux,
                value_p[q],
                na,
                w * j,
                compressed,
                w * h * mobility[e] * j,
                w * j * storage[e],
            )
        for i in range(3 * na + nb):
            for k in range(3 * na + nb):
                if position[e, i, k] >= 0:
                    data[position[e, i, k]] += cell[i, k]


@_compiled
def _add_solid(cell, gradient, g, isotropic, transposed, dyadic):
    """w Grad a : dP/dF : Grad b, with dP = mu dF + c1 F^-T dF^T F^-T + c2 (F^-T : dF) F^-T."""
    na = g.shape[0]
    for a in range(na):
        for b in range(na):
            inner = isotropic * (
                gradient[a, 0] * gradient[b, 0]
                + gradient[a, 1] * gradient[b, 1]
                + gradient[a, 2] * gradient[b, 2]
            )
            for i in range(3):
                cell[3 * a + i, 3 * b + i] += inner
                for k in range(3):
                    cell[3 * a + i, 3 * b + k] += transposed * g[b, i] * g[a, k] + dyadic * g[a, i] * g[b, k]


@_compiled
def _add_fluid(cell, g, s, flux, value, na, coupling, compressed, darcy, storage):
    """Coupling blocks and the pressure block of one quadrature point."""
    for b in range(s.shape[0]):
        row = 3 * na + b
        along = s[b, 0] * flux[0] + s[b, 1] * flux[1] + s[b, 2] * flux[2]
        for a in range(na):
            to_flux = g[a, 0] * flux[0] + g[a, 1] * flux[1] + g[a, 2] * flux[2]
            to_row = g[a, 0] * s[b, 0] + g[a, 1] * s[b, 1] + g[a, 2] * s[b, 2]
            for k in range(3):
                cell[3 * a + k, row] -= coupling * g[a, k] * value[b]
                cell[row, 3 * a + k] -= compressed * g[a, k] * value[b] + darcy * (
                    g[a, k] * along - to_flux * s[b, k] - to_row * flux[k]
                )
        for c in range(s.shape[0]):
            inner = s[b, 0] * s[c, 0] + s[b, 1] * s[c, 1] + s[b, 2] * s[c, 2]
            cell[row, 3 * na + c] -= storage * value[b] * value[c] + darcy * inner
