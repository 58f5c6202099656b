"""Estimates the error of a reduced run on the full mesh, by a dual-weighted residual at some of its states.

A state of the reduced run, evaluated on the nodes of the mesh, nearly solves the equations of the full model.
Let r be the residual of these equations and y the adjoint of the force. The full model's force at that stage
is then, to first order,

    F = F(u) + y . r ,   K^T y = - dF/du .

The estimate contains the error of the modes and the error of the cubature. It contains errors of earlier
stages only as far as the history shows them. Laws with a memory are followed on all points, stage by stage.

Source: Becker & Rannacher, Acta Numerica 10 (2001), 1-102.
"""

from __future__ import annotations

import numpy as np

from bayeskin.finite_element.lagrangian import LagrangianModel
from bayeskin.finite_element.stages import Stage, State
from bayeskin.reduced.equations import REMEMBERED_STATES
from bayeskin.reduced.operators import Basis
from bayeskin.types import Array

SAME_PLACE = 0.6  # an adjoint is used again within this share of the largest displacement


class DualWeightedResidual:
    """Follows the accepted stages of a reduced run and estimates the error of its force at some of them.

    model : full model of the same run; basis : basis of the reduced model, on the nodes of the full model
    """

    def __init__(self, model: LagrangianModel, basis: Basis) -> None:
        self._model, self._basis = model, basis
        self._known: dict[int, tuple[State, State]] = {}
        self._dual: tuple[float, Array] | None = None  # pads' displacement, adjoint (free,)

    def follow(self, stage: Stage, force_n: float | None) -> float | None:
        """Follows a stage and returns the estimated error of its force [N], where `force_n` [N] is given.

        Returns infinity where the full model cannot be evaluated, because a cell is inside out. Returns None
        where no estimate is asked for.
        """
        model = self._model
        if force_n is None and not any(law.remembers for law in model.laws):
            return None
        sources = [(weight, self._on_nodes(state)) for weight, state in stage.sources]
        last = sources[-1][1]
        old = State(
            last.time_s, last.x, np.asarray(sum(w * s.volume for w, s in sources)),
            np.asarray(sum(w * s.pressure for w, s in sources)), last.memory,
        )  # fmt: skip
        x = self._basis.nodal(stage.state.x)
        values = model.residual(x, stage.length_s, old, stage.elapsed_s)
        if values is None:
            return np.inf
        end = State(stage.state.time_s, x, values.volume, values.pressure, values.memory)
        self._known[id(stage.state)] = stage.state, end
        for key in list(self._known)[:-REMEMBERED_STATES]:
            del self._known[key]
        if force_n is None:
            return None
        dual = self._adjoint(stage, old, x)
        reaction_n = model.problem.reaction(values.residual)
        return float(reaction_n - dual @ values.residual[model.problem.pattern.free]) - force_n

    def _on_nodes(self, state: State) -> State:
        known = self._known.get(id(state))
        if known is not None:
            return known[1]
        x, start = self._basis.nodal(state.x), self._model.initial_state(0.0)
        at = self._model.residual(x, 1.0, start)  # J and p do not depend on the history
        return start if at is None else State(state.time_s, x, at.volume, at.pressure, start.memory)

    def _adjoint(self, stage: Stage, old: State, x: Array) -> Array:
        """Returns the adjoint of the force (free,), at this state or an earlier one with the pads nearby."""
        model, pads_m = self._model, float(stage.state.x[0])
        if self._dual is None or abs(self._dual[0] - pads_m) > SAME_PLACE * model.drive.largest_m:
            equations = model.equations(stage.length_s, old, stage.elapsed_s)
            model.solver.renew(equations, x)
            self._dual = pads_m, model.solver.back_substitute(model.pad_gradient)
        return self._dual[1]
