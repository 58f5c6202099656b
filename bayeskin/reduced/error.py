"""The error of a reduced run, estimated on the full mesh: a dual-weighted residual at some of its states.

A state of the reduced run, written out on the nodes, nearly solves the full model's equations. With the
residual r that it leaves there and the adjoint y of the force, the full model's force at that stage is to
first order

    F = F(u) + y . r ,   K^T y = - dF/du .

So missing modes are seen as well as missing points; what former stages missed is seen only as far as the
history tells. Laws with a memory are followed on all points from stage to stage.

Source: Becker & Rannacher, Acta Numerica 10 (2001), 1-102.
"""

from __future__ import annotations

import numpy as np

from bayeskin.finite_element.lagrangian import LagrangianModel, Stage, State
from bayeskin.reduced.operators import Basis
from bayeskin.types import Array

REMEMBERED = 8  # states that are kept on the nodes; a step asks for three at most
SAME_PLACE = 0.6  # of the largest displacement: an adjoint serves for states whose pads are this near


class DualWeightedResidual:
    """Takes the accepted stages of a reduced run and estimates the error of its force at some of them.

    model : the full model of the same run; basis : that of the reduced one, on its nodes
    """

    def __init__(self, model: LagrangianModel, basis: Basis) -> None:
        self._model, self._basis = model, basis
        self._known: dict[int, tuple[State, State]] = {}
        self._dual: tuple[float, Array] | None = None  # pads' displacement, adjoint (free,)

    def follow(self, stage: Stage, force_n: float | None) -> float | None:
        """Follows a stage; with its force [N] given, returns the estimated error of that force [N]."""
        model = self._model
        if force_n is None and not any(law.remembers for law in model.laws):
            return None
        sources = [(weight, self._of(state)) for weight, state in stage.sources]
        last = sources[-1][1]
        old = State(
            last.time_s, last.x, np.asarray(sum(w * s.volume for w, s in sources)),
            np.asarray(sum(w * s.pressure for w, s in sources)), last.memory,
        )  # fmt: skip
        x = self._basis.nodal(stage.state.x)
        found = model.residual(x, stage.length_s, old, stage.elapsed_s)
        if found is None:
            return np.inf
        end = State(stage.state.time_s, x, found.volume, found.pressure, found.memory)
        self._known[id(stage.state)] = stage.state, end
        for key in list(self._known)[:-REMEMBERED]:
            del self._known[key]
        if force_n is None:
            return None
        dual = self._adjoint(stage, old, x)
        right = model.problem.reaction(found.residual)
        return float(right - dual @ found.residual[model.problem.pattern.free]) - force_n

    def _of(self, state: State) -> State:
        known = self._known.get(id(state))
        if known is not None:
            return known[1]
        x, rest = self._basis.nodal(state.x), self._model.initial_state(0.0)
        found = self._model.residual(x, 1.0, rest)  # its history is nothing to J and p
        return rest if found is None else State(state.time_s, x, found.volume, found.pressure, rest.memory)

    def _adjoint(self, stage: Stage, old: State, x: Array) -> Array:
        """The adjoint of the force (free,), of this state or of one whose pads were near."""
        model, pads_m = self._model, float(stage.state.x[0])
        if self._dual is None or abs(self._dual[0] - pads_m) > SAME_PLACE * model.drive.largest_m:
            equations = model.equations(stage.length_s, old, stage.elapsed_s)
            model.solver.renew(equations, x)
            self._dual = pads_m, model.solver.back_substitute(model.pad_gradient)
        return self._dual[1]
