"""Applies the base model's exact tangent to several directions at once.

The gradients of the force with respect to the parameters need this product (`gradients`). With G = F^-1,
A = G dF and s = F^-T grad p, the responses of the base law (`poroelastic`) change by

    dP = mu dF + (mu - lambda ln J + p J) (A G)^T + [(lambda - p J) tr A - J dp] F^-T
         + dmu (F - F^-T) + dlambda ln J F^-T
    dm = dJ - dJ* + dJ S (p - p*) + J S (dp - dp*) ,  dJ = J tr A
    dQ = h J [ k/mu_f (tr A G s - A G s + G F^-T (d grad p - dF^T s)) + d(k/mu_f) G s ]

F, J and G are computed once for all directions. The maps from the unknowns to the quadrature points and back
are products of small dense matrices for each cell. Three directions cost as much as two to three residuals.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np

from bayeskin.finite_element import assembly
from bayeskin.finite_element.assembly import compiled, inverse_and_determinant
from bayeskin.finite_element.balances import Evaluated
from bayeskin.finite_element.lagrangian import LagrangianModel
from bayeskin.finite_element.space import TaylorHood
from bayeskin.finite_element.stages import Stage
from bayeskin.types import Array


class TangentAction:
    """Gives the derivatives of a solved stage's residual, J and p along r directions.

    The model must not have laws beyond the base law.

    rates : derivatives of mu, lam and mobility, (e, r) each
    volume_old, pressure_old : derivatives of J* and p*, (e, q, r) each
    """

    def __init__(
        self,
        model: LagrangianModel,
        stage: Stage,
        rates: tuple[Array, Array, Array],
        volume_old: Array,
        pressure_old: Array,
    ) -> None:
        self._space, self._material, self._rates = model.problem.space, model.material, rates
        self._stage, self._volume_old, self._pressure_old = stage, volume_old, pressure_old
        s, shape = self._space, self._space.weight.shape
        self._at = assembly.Points(np.empty((*shape, 3, 3)), np.empty(shape), np.empty((*shape, 3)))
        assembly.evaluate(
            stage.state.x, s.n_nodes, s.nodes_u, s.nodes_p, s.grad_u, s.grad_p, s.value_p,
            self._at.deformation, self._at.pressure, self._at.gradient,
        )  # fmt: skip

    def __call__(self, x: Array) -> Evaluated:
        """Returns the derivatives of the residual (dofs, r), and of J and p (e, q, r).

        x (dofs, r) : derivatives of the unknowns
        """
        n, r = 3 * self._space.n_nodes, x.shape[1]
        out, volume = np.zeros_like(x), np.empty_like(self._volume_old)
        pressure = np.empty_like(volume)
        for c in _cells(self._space):
            s_u, s_p = _matrices(self._space.grad_u, c), _matrices(self._space.grad_p, c)
            points, nodes_u = volume[c].shape[:2], self._space.nodes_u[c]
            nodes_p, value_p = self._space.nodes_p[c], self._space.value_p
            at_corners = x[n + nodes_p]
            stress = (s_u @ x[:n].reshape(-1, 3 * r)[nodes_u]).reshape(*points, 3, 3, r)
            flux = (s_p @ at_corners).reshape(*points, 3, r)
            np.matmul(value_p, at_corners, out=pressure[c])
            content = pressure[c].copy()
            self._respond(c, stress, content, flux, volume[c])
            forces = s_u.transpose(0, 2, 1) @ stress.reshape(len(s_u), -1, 3 * r)
            fluid = value_p.T @ content + s_p.transpose(0, 2, 1) @ flux.reshape(len(s_p), -1, r)
            _add(nodes_u, forces, 1.0, out[:n].reshape(-1, 3 * r))
            _add(nodes_p, fluid, -1.0, out[n:])
        return Evaluated(out, volume, pressure, ())

    def _respond(self, c: slice, stress: Array, content: Array, flux: Array, volume: Array) -> None:
        m, at, (mu, lam, mobility) = self._material, self._at, self._rates
        _respond(
            at.deformation[c], at.pressure[c], at.gradient[c], self._space.weight[c], self._stage.length_s,
            m.mu[c], m.lam[c], m.mobility[c], m.storage[c], mu[c], lam[c], mobility[c],
            self._stage.history.pressure[c], self._volume_old[c], self._pressure_old[c],
            stress, content, flux, volume,
        )  # fmt: skip


def _cells(space: TaylorHood) -> list[slice]:
    """Returns slices that divide the cells into chunks."""
    count = len(space.nodes_u)
    return [slice(a, min(a + assembly.CHUNK, count)) for a in range(0, count, assembly.CHUNK)]


def _matrices(gradients: Array, c: slice) -> Array:
    """Returns the gradients (e, q, 3, a) of the cells `c` as matrices (e, 3 q, a)."""
    return gradients[c].reshape(c.stop - c.start, -1, gradients.shape[3])


@compiled
def _respond(
    deformation,
    pressure,
    gradient,
    weight,
    h,
    mu,
    lam,
    mobility,
    storage,
    d_mu,
    d_lam,
    d_mobility,
    pressure_old,
    d_volume_old,
    d_pressure_old,
    stress,
    content,
    flux,
    volume,
):
    """Replaces the derivatives of the state by those of the response, in place.

    stress (e, q, j, i, r) : dF before, dP after
    content (e, q, r) : dp before, dm after
    flux (e, q, 3, r) : d grad p before, dQ after
    volume (e, q, r) : receives dJ

    The function multiplies dP, dm and dQ by the quadrature weight.
    """
    g, a, d = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    spatial, along, turned, back = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for e in range(pressure.shape[0]):
        for q in range(pressure.shape[1]):
            f, p, w = deformation[e, q], pressure[e, q], weight[e, q]
            j = inverse_and_determinant(f, g)
            log_j, stored = np.log(j), storage[e] * (p - pressure_old[e, q])
            transposed, dyadic = mu[e] - lam[e] * log_j + p * j, lam[e] - p * j
            for i in range(3):
                spatial[i] = (
                    g[0, i] * gradient[e, q, 0] + g[1, i] * gradient[e, q, 1] + g[2, i] * gradient[e, q, 2]
                )
            for i in range(3):
                along[i] = g[i, 0] * spatial[0] + g[i, 1] * spatial[1] + g[i, 2] * spatial[2]
            for r in range(content.shape[2]):
                for i in range(3):
                    for k in range(3):
                        d[i, k] = stress[e, q, k, i, r]
                for i in range(3):
                    for k in range(3):
                        a[i, k] = g[i, 0] * d[0, k] + g[i, 1] * d[1, k] + g[i, 2] * d[2, k]
                trace, dp, dmu = a[0, 0] + a[1, 1] + a[2, 2], content[e, q, r], d_mu[e, r]
                spherical = dyadic * trace - j * dp - dmu + d_lam[e, r] * log_j
                for i in range(3):
                    for k in range(3):
                        ag = a[k, 0] * g[0, i] + a[k, 1] * g[1, i] + a[k, 2] * g[2, i]
                        stress[e, q, k, i, r] = w * (
                            mu[e] * d[i, k] + dmu * f[i, k] + transposed * ag + spherical * g[k, i]
                        )
                volume[e, q, r] = j * trace
                content[e, q, r] = w * (
                    j * trace * (1.0 + stored)
                    - d_volume_old[e, q, r]
                    + j * storage[e] * (dp - d_pressure_old[e, q, r])
                )
                for i in range(3):
                    turned[i] = flux[e, q, i, r] - (
                        d[0, i] * spatial[0] + d[1, i] * spatial[1] + d[2, i] * spatial[2]
                    )
                for i in range(3):
                    back[i] = g[0, i] * turned[0] + g[1, i] * turned[1] + g[2, i] * turned[2]
                straight = mobility[e] * trace + d_mobility[e, r]
                for i in range(3):
                    gs = g[i, 0] * back[0] + g[i, 1] * back[1] + g[i, 2] * back[2]
                    ags = a[i, 0] * along[0] + a[i, 1] * along[1] + a[i, 2] * along[2]
                    flux[e, q, i, r] = w * h * j * (straight * along[i] + mobility[e] * (gs - ags))


@compiled
def _add(nodes, values, sign, out):
    """Adds the values (e, a, n) at the cells' nodes, times `sign`, to `out` (m, n) for all nodes."""
    for e in range(nodes.shape[0]):
        for a in range(nodes.shape[1]):
            for k in range(values.shape[2]):
                out[nodes[e, a], k] += sign * values[e, a, k]
