"""Permeability that follows the volume: k = k0 exp(M (J - 1)) in both layers.

Form: Lai & Mow, Biorheology 17 (1980), 111-123; J - 1 is of order 0.01 in this test.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayeskin.mechanisms.mechanism import Mechanism, Tissue
from bayeskin.model.assembly import Chunk, compiled, inverse_and_determinant
from bayeskin.model.problem import Problem
from bayeskin.model.tissue import Passage, TissueLaw
from bayeskin.types import Parameter


@compiled
def scale(deformation, exponent, flux):
    """Multiplies the flux (e, q, 3) by k / k0."""
    inverse = np.empty((3, 3))
    for e in range(flux.shape[0]):
        for q in range(flux.shape[1]):
            j = inverse_and_determinant(deformation[e, q], inverse)
            factor = np.exp(exponent * (j - 1.0))
            for i in range(3):
                flux[e, q, i] *= factor


@compiled
def scale_derivatives(deformation, gradient, exponent, flux_f, flux_g):
    """d(f Q) = f dQ + f M J tr(F^-1 dF) Q, with Q = dQ/dg g."""
    inverse = np.empty((3, 3))
    for e in range(flux_f.shape[0]):
        for q in range(flux_f.shape[1]):
            j = inverse_and_determinant(deformation[e, q], inverse)
            factor = np.exp(exponent * (j - 1.0))
            for i in range(3):
                flux = 0.0
                for k in range(3):
                    flux += flux_g[e, q, i, k] * gradient[e, q, k]
                    flux_g[e, q, i, k] *= factor
                for m in range(3):
                    for n in range(3):
                        flux_f[e, q, i, 3 * m + n] = factor * (
                            flux_f[e, q, i, 3 * m + n] + exponent * j * inverse[n, m] * flux
                        )


class StrainDependentPermeability(TissueLaw):
    """The law with the exponent M."""

    def __init__(self, exponent: float) -> None:
        self._exponent = exponent

    def respond(self, chunk: Chunk, passage: Passage) -> None:
        scale(chunk.at.deformation, self._exponent, chunk.found.flux)

    def linearise(self, chunk: Chunk, passage: Passage) -> None:
        at, by = chunk.at, chunk.by
        scale_derivatives(at.deformation, at.gradient, self._exponent, by.flux_f, by.flux_g)


def bind(values: Mapping[str, float], problem: Problem) -> TissueLaw:
    """The law of `M_k`."""
    return StrainDependentPermeability(float(values["M_k"]))


MECHANISM = Mechanism(
    name="strain-dependent-permeability",
    parameters=(
        Parameter("M_k", "-", -100.0, 100.0, "uniform", "k = k0 exp(M_k (J - 1)), J the relative volume"),
    ),
    neutral={"M_k": 0.0},
    statement=lambda v: (
        f"Permeability changes by {100 * np.expm1(0.01 * v['M_k']):+.0f} % where the volume grows by 1 %."
    ),
    group=("strain-dependent-permeability", "solid-viscoelasticity", "friction-creep"),
    act=Tissue(bind),
)
