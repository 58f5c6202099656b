"""Fibres in the solid: stress along given directions, shared by the mechanisms that have them.

    W = k1 / (2 k2) (exp(k2 E^2) - 1) ,   E = kappa (I1 - 3) + (1 - 3 kappa) (I4 - 1) ,   I4 = |F a|^2

(k2 = 0: W = k1 E^2 / 2). Dispersion kappa from 0, all fibres along a, to 1/3, none more than others. First
Piola stress P = W' D with D = dE/dF = 2 kappa F + 2 (1 - 3 kappa) F a (x) a.

Source: Holzapfel, Gasser & Ogden, J. Elasticity 61 (2000), 1-48; with dispersion Gasser, Ogden & Holzapfel,
J. R. Soc. Interface 3 (2006), 15-35.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np

from bayeskin.model.assembly import Chunk, compiled
from bayeskin.model.tissue import Passage, TissueLaw
from bayeskin.types import Array


@compiled
def _strain(f, a, kappa, gradient):
    """E at F (3, 3) and direction a (3,); fills dE/dF (3, 3)."""
    trace = along = 0.0
    for i in range(3):
        stretched = f[i, 0] * a[0] + f[i, 1] * a[1] + f[i, 2] * a[2]
        along += stretched * stretched
        for k in range(3):
            trace += f[i, k] * f[i, k]
            gradient[i, k] = 2.0 * kappa * f[i, k] + 2.0 * (1.0 - 3.0 * kappa) * stretched * a[k]
    return kappa * (trace - 3.0) + (1.0 - 3.0 * kappa) * (along - 1.0)


@compiled
def add_stress(deformation, direction, k1, k2, kappa, tension_only, stress):
    """Adds the fibres' stress (e, q, 3, 3); k1 per cell (e,)."""
    gradient = np.empty((3, 3))
    for e in range(stress.shape[0]):
        if k1[e] == 0.0:
            continue
        for q in range(stress.shape[1]):
            strain = _strain(deformation[e, q], direction[e, q], kappa, gradient)
            if strain > 0.0 or not tension_only:
                slope = k1[e] * strain * np.exp(k2 * strain * strain)
                for i in range(3):
                    for k in range(3):
                        stress[e, q, i, k] += slope * gradient[i, k]


@compiled
def add_derivatives(deformation, direction, k1, k2, kappa, tension_only, stress_f):
    """dP = W'' D (D : dF) + W' (2 kappa dF + 2 (1 - 3 kappa) dF a (x) a)."""
    gradient = np.empty((3, 3))
    for e in range(stress_f.shape[0]):
        if k1[e] == 0.0:
            continue
        for q in range(stress_f.shape[1]):
            a = direction[e, q]
            strain = _strain(deformation[e, q], a, kappa, gradient)
            if strain > 0.0 or not tension_only:
                grown = k1[e] * np.exp(k2 * strain * strain)
                slope, curvature = grown * strain, grown * (1.0 + 2.0 * k2 * strain * strain)
                for i in range(3):
                    for k in range(3):
                        row = 3 * i + k
                        for m in range(3):
                            for n in range(3):
                                stress_f[e, q, row, 3 * m + n] += curvature * gradient[i, k] * gradient[m, n]
                        stress_f[e, q, row, row] += 2.0 * slope * kappa
                        for n in range(3):
                            stress_f[e, q, row, 3 * i + n] += 2.0 * slope * (1.0 - 3.0 * kappa) * a[k] * a[n]


class Fibres(TissueLaw):
    """direction (e, q, 3), of length one in the reference configuration; k1 (e,) [Pa]; k2, kappa [-]."""

    def __init__(
        self, direction: Array, k1: Array, k2: float, kappa: float = 0.0, tension_only: bool = True
    ) -> None:
        self._direction, self._k1, self._rest = direction, k1, (float(k2), float(kappa), tension_only)

    def respond(self, chunk: Chunk, passage: Passage) -> None:
        c = chunk.cells
        add_stress(chunk.at.deformation, self._direction[c], self._k1[c], *self._rest, chunk.found.stress)

    def linearise(self, chunk: Chunk, passage: Passage) -> None:
        c = chunk.cells
        add_derivatives(chunk.at.deformation, self._direction[c], self._k1[c], *self._rest, chunk.by.stress_f)
