"""Corrects guessed derivatives of the unknowns by back-substitutions with the kept factorisations.

A correction M^-1 r adds g M^-1 r to the derivative of the reaction, where g is the derivative of the reaction
with respect to the unknowns. Since M is symmetric, M^-1 g gives this term before the correction is made. If
the term is small enough, it is added and no correction is made. The error of the force is then the product of
the errors of the guess and of the factorisation. The corrections of several iterations are accelerated by
Anderson's method (SIAM J. Numer. Anal. 49, 2011, 1715).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from bayeskin.finite_element.balances import Evaluated
from bayeskin.finite_element.differences import ResidualDifferences
from bayeskin.finite_element.lagrangian import LagrangianModel
from bayeskin.finite_element.newton import Equations
from bayeskin.types import Array

Differentiated = Evaluated | ResidualDifferences


@dataclass(frozen=True)
class CorrectionSettings:
    """Settings of the correction of derivatives.

    tolerance : largest force that a correction may still add, relative to the nominal force
    uncorrected : factor on the tolerance for an uncorrected guess, whose error adds up from stage to stage
    most_corrections : largest number of corrections
    anderson_depth : number of corrections that are combined in a step
    duals : largest number of kept dual solutions
    """

    tolerance: float = 1e-4
    uncorrected: float = 0.05
    most_corrections: int = 12
    anderson_depth: int = 4
    duals: int = 10


CORRECTION = CorrectionSettings()


class Corrector:
    """Corrects the derivatives of one run's unknowns."""

    def __init__(self, model: LagrangianModel) -> None:
        self._model = model
        self._duals: dict[int, tuple[Array, Array]] = {}  # keys: id of the place, which the entry keeps alive

    def correct(
        self, equations: Equations, action: Callable[[Array], Differentiated], x: Array
    ) -> tuple[Array, Differentiated, Array]:
        """Corrects a guess x (dofs, r) in place, whose fixed rows must already be right.

        action : function of derivatives of the unknowns, which returns those of all that is `Evaluated`
        Returns the corrected x, the derivatives of all that is `Evaluated` there, and of the force (r,) [N].
        """
        model, solver, free = self._model, self._model.solver, self._model.problem.pattern.free
        dual = self._dual(solver.toward(equations.place))
        weight, allowed_n = equations.weight[:, None], CORRECTION.tolerance * model.nominal_force()
        tried: list[tuple[Array, Array]] = []  # unknowns, and the correction computed at each
        for _ in range(CORRECTION.most_corrections):
            evaluated = action(x)
            missing_n = -dual @ evaluated.residual[free]
            if np.abs(missing_n).max() <= (allowed_n if tried else CORRECTION.uncorrected * allowed_n):
                break
            correction = -solver.back_substitute(evaluated.residual[free])
            tried = [*tried, (x[free] * weight, correction * weight)][-CORRECTION.anderson_depth :]
            x[free] += _anderson_step(tried) / weight
        return x, evaluated, 2.0 * evaluated.residual[model.problem.measured_x].sum(axis=0) + missing_n

    def _dual(self, place: Array) -> Array:
        """Returns M^-1 g (free,) for the factorisation M made at `place`; the result is kept."""
        known = self._duals.get(id(place))
        if known is None:
            known = place, self._model.solver.back_substitute(self._model.pad_gradient)
            self._duals = dict([*self._duals.items(), (id(place), known)][-CORRECTION.duals :])
        return known[1]


def _anderson_step(tried: list[tuple[Array, Array]]) -> Array:
    """Returns Anderson's step from the last of the tried points.

    tried : unknowns and corrections (free, r) of the last iterations; each column is accelerated by itself
    """
    correction = tried[-1][1]
    if len(tried) == 1:
        return correction
    moves = np.stack([after[0] - before[0] for before, after in pairwise(tried)], axis=2)
    turns = np.stack([after[1] - before[1] for before, after in pairwise(tried)], axis=2)
    gram = np.einsum("nrk,nrl->rkl", turns, turns)
    size = (
        np.trace(gram, axis1=1, axis2=2) + np.finfo(float).tiny
    )  # the trace is 0 for a parameter without effect
    ridge = 1e-12 * size[:, None, None] * np.eye(gram.shape[1])
    gain = np.linalg.solve(gram + ridge, np.einsum("nrk,nr->rk", turns, correction)[:, :, None])[:, :, 0]
    return np.asarray(correction - np.einsum("nrk,rk->nr", moves + turns, gain))
