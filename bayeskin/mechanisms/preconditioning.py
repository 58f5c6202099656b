"""Damage by the largest strain energy so far: the first stretch is stiffer, later ones repeat.

With W the base solid's stored energy and W_max its largest value up to now at the same point,

    P = (1 - D) dW/dF ,   D = d (1 - exp(-W_max / W_d)) .

Stress grows with stretch all the same for d up to 0.6. Fibres of other mechanisms are not damaged.

Source: Simo, Comput. Methods Appl. Mech. Eng. 60 (1987), 153-173 (damage by the largest energy); the
effect in rubber: Mullins, Rubber Chem. Technol. 42 (1969), 339-362.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayeskin.mechanisms.mechanism import Mechanism, Tissue
from bayeskin.model.assembly import Chunk, compiled, inverse_and_determinant
from bayeskin.model.problem import Problem, material
from bayeskin.model.tissue import Passage, TissueLaw
from bayeskin.types import Array, Parameter
from bayeskin.words import number


@compiled
def stored_energy(f, mu, lam, inverse, slope):
    """W = mu / 2 (I1 - 3 - 2 ln J) + lambda / 2 ln^2 J at F (3, 3), and ln J; fills F^-1 and dW/dF."""
    log = np.log(inverse_and_determinant(f, inverse))
    spherical, square = lam * log - mu, 0.0
    for i in range(3):
        for k in range(3):
            square += f[i, k] * f[i, k]
            slope[i, k] = mu * f[i, k] + spherical * inverse[k, i]
    return 0.5 * mu * (square - 3.0 - 2.0 * log) + 0.5 * lam * log * log, log


@compiled
def weaken(deformation, mu, lam, most, scale, before, stress, after):
    """Takes D dW/dF off the stress; `before`, `after` (e, q, 1) hold W_max."""
    inverse, slope = np.empty((3, 3)), np.empty((3, 3))
    for e in range(stress.shape[0]):
        for q in range(stress.shape[1]):
            energy, _ = stored_energy(deformation[e, q], mu[e], lam[e], inverse, slope)
            largest = max(energy, before[e, q, 0])
            after[e, q, 0] = largest
            damage = most * (1.0 - np.exp(-largest / scale))
            for i in range(3):
                for k in range(3):
                    stress[e, q, i, k] -= damage * slope[i, k]


@compiled
def weaken_derivatives(deformation, mu, lam, most, scale, before, stress_f):
    """- D d2W/dF2 and, while W is the largest, - dD/dW dW/dF (x) dW/dF."""
    inverse, slope = np.empty((3, 3)), np.empty((3, 3))
    for e in range(stress_f.shape[0]):
        for q in range(stress_f.shape[1]):
            energy, log = stored_energy(deformation[e, q], mu[e], lam[e], inverse, slope)
            left = np.exp(-max(energy, before[e, q, 0]) / scale)
            damage, growth = most * (1.0 - left), 0.0
            if energy >= before[e, q, 0]:
                growth = most * left / scale
            transposed = damage * (mu[e] - lam[e] * log)
            for i in range(3):
                for k in range(3):
                    row = 3 * i + k
                    for m in range(3):
                        for n in range(3):
                            stress_f[e, q, row, 3 * m + n] -= (
                                transposed * inverse[k, m] * inverse[n, i]
                                + damage * lam[e] * inverse[k, i] * inverse[n, m]
                                + growth * slope[i, k] * slope[m, n]
                            )
                    stress_f[e, q, row, row] -= damage * mu[e]


class Damage(TissueLaw):
    """Largest damage d [-] and its energy scale [Pa], for Lame's constants (e,) of the cells."""

    remembers = 1

    def __init__(self, most: float, scale: float, mu: Array, lam: Array) -> None:
        self._damage, self._mu, self._lam = (float(most), float(scale)), mu, lam

    def respond(self, chunk: Chunk, passage: Passage) -> None:
        c, found = chunk.cells, chunk.found
        lame = (self._mu[c], self._lam[c])
        weaken(chunk.at.deformation, *lame, *self._damage, passage.before, found.stress, passage.after)

    def linearise(self, chunk: Chunk, passage: Passage) -> None:
        c, by = chunk.cells, chunk.by
        lame = (self._mu[c], self._lam[c])
        weaken_derivatives(chunk.at.deformation, *lame, *self._damage, passage.before, by.stress_f)


def bind(values: Mapping[str, float], problem: Problem) -> TissueLaw:
    """The law of `damage` in both layers."""
    solid = material(values, problem.mesh.cutis)
    return Damage(values["damage"], values["damage_energy"], solid.mu, solid.lam)


MECHANISM = Mechanism(
    name="preconditioning",
    parameters=(
        Parameter("damage", "-", 0.0, 0.6, "uniform", "largest loss of stiffness, as a share"),
        Parameter(
            "damage_energy",
            "Pa",
            1e2,
            1e5,
            "log-uniform",
            "stored energy at which 63 % of that is lost",
            stress_power=1,
        ),
    ),
    neutral={"damage": 0.0, "damage_energy": 1e3},
    statement=lambda v: (
        f"The first stretch softens the skin, by {100 * v['damage']:.0f} % at most, most of it where it "
        f"has stored {number(1e-3 * v['damage_energy'], 3)} kPa; later cycles repeat."
    ),
    group=("preconditioning", "pad-slip", "slow-recovery"),
    act=Tissue(bind),
)
