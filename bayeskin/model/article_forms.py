"""Weak form of the article's formulation, compiled: residual and consistent tangent.

On the mesh at the start of the step, with "F" = I + grad u of the total displacement there,

    t = (mu (F F^T - I) + lambda ln(J) I) / J ,     int t : grad w - p div w = 0
    int q div(u - u_old) + q S (p - p_old) + dt (k / mu_f) grad p . grad q = 0

(the article's equations 12, 13 and 26-29 as its script discretises them).
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np

from bayeskin.model.forms import _compiled, _gather, _kinematics


@_compiled
def residual(x, old, nodes_u, nodes_p, grad_u, grad_p, value_p, weight, mu, lam, mobility, storage, dt, out):
    """Adds the residual (dofs,) to `out`; returns the smallest det F (not positive: inside out)."""
    n_nodes = (x.shape[0] - nodes_p.max() - 1) // 3  # the pressures follow the displacements
    na, nb = nodes_u.shape[1], nodes_p.shape[1]
    u, p = np.empty((na, 3)), np.empty(nb)
    u_old, p_old = np.empty((na, 3)), np.empty(nb)
    f, inverse, stress, flux = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    smallest = np.inf
    for e in range(nodes_u.shape[0]):
        _gather(x, nodes_u[e], nodes_p[e], n_nodes, u, p)
        _gather(old, nodes_u[e], nodes_p[e], n_nodes, u_old, p_old)
        for q in range(weight.shape[1]):
            j = _kinematics(u, grad_u[e, q], f, inverse)
            if not j > 0.0:
                return j
            smallest = min(smallest, j)
            pressure, change, rate = 0.0, 0.0, 0.0
            flux[:] = 0.0
            for b in range(nb):
                pressure += value_p[q, b] * p[b]
                change += value_p[q, b] * (p[b] - p_old[b])
                for i in range(3):
                    flux[i] += grad_p[e, q, b, i] * p[b]
            for a in range(na):
                for i in range(3):
                    rate += (u[a, i] - u_old[a, i]) * grad_u[e, q, a, i]
            for i in range(3):
                for k in range(3):
                    stress[i, k] = mu[e] / j * (f[i, 0] * f[k, 0] + f[i, 1] * f[k, 1] + f[i, 2] * f[k, 2])
                stress[i, i] += (lam[e] * np.log(j) - mu[e]) / j - pressure
            w = weight[e, q]
            for a in range(na):
                for i in range(3):
                    out[3 * nodes_u[e, a] + i] += w * (
                        stress[i, 0] * grad_u[e, q, a, 0]
                        + stress[i, 1] * grad_u[e, q, a, 1]
                        + stress[i, 2] * grad_u[e, q, a, 2]
                    )
            source = rate + storage[e] * change
            for b in range(nb):
                darcy = 0.0
                for i in range(3):
                    darcy += grad_p[e, q, b, i] * flux[i]
                out[3 * n_nodes + nodes_p[e, b]] -= w * (value_p[q, b] * source + dt * mobility[e] * darcy)
    return smallest


@_compiled
def tangent(
    x, nodes_u, nodes_p, grad_u, grad_p, value_p, weight, mu, lam, mobility, storage, dt, position, data
):
    """Adds the consistent tangent of `residual` to the sparse `data` at `position` (e, nd, nd).

    dt = -t tr(F^-1 dF) + mu/J (dF F^T + F dF^T) + lambda/J tr(F^-1 dF) I
    """
    n_nodes = (x.shape[0] - nodes_p.max() - 1) // 3
    na, nb = nodes_u.shape[1], nodes_p.shape[1]
    u, p = np.empty((na, 3)), np.empty(nb)
    cell = np.empty((3 * na + nb, 3 * na + nb))
    f, inverse = np.empty((3, 3)), np.empty((3, 3))
    g, along, loaded = np.empty((na, 3)), np.empty((na, 3)), np.empty((na, 3))
    for e in range(nodes_u.shape[0]):
        _gather(x, nodes_u[e], nodes_p[e], n_nodes, u, p)
        cell[:] = 0.0
        for q in range(weight.shape[1]):
            j = _kinematics(u, grad_u[e, q], f, inverse)
            w = weight[e, q]
            shear, spherical = mu[e] / j, (lam[e] * np.log(j) - mu[e]) / j
            for a in range(na):
                for i in range(3):
                    g[a, i] = along[a, i] = 0.0
                    for k in range(3):
                        g[a, i] += inverse[k, i] * grad_u[e, q, a, k]  # tr(F^-1 dF) = g . du
                        along[a, i] += f[k, i] * grad_u[e, q, a, k]  # F^T grad
            for a in range(na):  # elastic stress times grad
                for i in range(3):
                    loaded[a, i] = spherical * grad_u[e, q, a, i]
                    for k in range(3):
                        loaded[a, i] += shear * f[i, k] * along[a, k]
            for a in range(na):
                for b in range(na):
                    inner = 0.0
                    for i in range(3):
                        inner += along[a, i] * grad_u[e, q, b, i]
                    for i in range(3):
                        cell[3 * a + i, 3 * b + i] += w * shear * inner
                        fb = 0.0
                        for k in range(3):
                            fb += f[i, k] * grad_u[e, q, b, k]
                        for k in range(3):
                            cell[3 * a + i, 3 * b + k] += w * (
                                shear * fb * grad_u[e, q, a, k]
                                + (lam[e] / j * grad_u[e, q, a, i] - loaded[a, i]) * g[b, k]
                            )
            for b in range(nb):
                row = 3 * na + b
                for a in range(na):
                    for k in range(3):
                        coupling = w * grad_u[e, q, a, k] * value_p[q, b]
                        cell[3 * a + k, row] -= coupling
                        cell[row, 3 * a + k] -= coupling
                for c in range(nb):
                    inner = 0.0
                    for i in range(3):
                        inner += grad_p[e, q, b, i] * grad_p[e, q, c, i]
                    cell[row, 3 * na + c] -= w * (
                        storage[e] * value_p[q, b] * value_p[q, c] + dt * mobility[e] * inner
                    )
        for i in range(3 * na + nb):
            for k in range(3 * na + nb):
                if position[e, i, k] >= 0:
                    data[position[e, i, k]] += cell[i, k]
