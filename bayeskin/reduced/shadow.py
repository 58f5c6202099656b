"""Follows a reduced run on all points of the mesh.

The difference to the run shows what the chosen points of its cubature leave out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bayeskin.finite_element.stages import Stage, State
from bayeskin.finite_element.tissue import Bind
from bayeskin.reduced import kernels
from bayeskin.reduced.arrays import History, Room
from bayeskin.reduced.equations import REMEMBERED_STATES, ReducedEquations
from bayeskin.reduced.operators import ReducedSpace
from bayeskin.types import Array, PadMotion


@dataclass(frozen=True)
class Followed:
    """One stage at all points: the arrays there, the history, and the residual (k + m,) of all points."""

    room: Room
    past: History
    residual: Array


class Shadow:
    """Evaluates the stages of a reduced run at all points, with the unknowns that the run has solved for."""

    def __init__(
        self, whole: ReducedSpace, theta: Mapping[str, float], binds: Sequence[Bind], protocol: PadMotion
    ) -> None:
        self.equations = ReducedEquations(whole, theta, binds, protocol)
        self._start = self.equations.initial_state(theta["p_init"])
        self._known: dict[int, tuple[State, State]] = {}  # keys: id of the run's state, which is kept

    def follow(self, stage: Stage, time_s: float) -> Followed | None:
        """Returns a stage at all points, or None where a point is inside out.

        time_s : time from the start of the test to the end of the stage [s]
        """
        eq, k = self.equations, self.equations.space.modes[0]
        sources = [(weight, self._at_all_points(state), state) for weight, state in stage.sources]
        past = History(
            np.asarray(sum(w * s.volume for w, s, _ in sources)),
            np.asarray(sum(w * s.pressure for w, s, _ in sources)), sources[-1][1].memory[0],
            np.asarray(sum(w * run.x[:k] for w, _, run in sources)), stage.length_s, stage.elapsed_s, time_s,
        )  # fmt: skip
        room, out = eq.make_room(), np.empty(len(stage.state.x))
        if not kernels.residual(eq.system, eq.packed, past, stage.state.x, room, out) > 0.0:
            return None
        end = State(stage.state.time_s, stage.state.x, room.volume, room.at_pressure, (room.memory,))
        self._known[id(stage.state)] = stage.state, end
        for old in list(self._known)[:-REMEMBERED_STATES]:
            del self._known[old]
        return Followed(room, past, out)

    def _at_all_points(self, state: State) -> State:
        known = self._known.get(id(state))
        return self._start if known is None else known[1]

    def nonlinear_integrands(self, followed: Followed) -> Array:
        """Returns the contribution of each point to each row of the residual, over its weight, (n, k + m).

        The linear part of the base law at rest is subtracted, since it is integrated exactly.
        """
        room, past, system = followed.room, followed.past, self.equations.system
        at = self.equations.space.at
        n, strain = len(at.weight), room.deformation - np.eye(3)
        trace = strain.trace(axis1=1, axis2=2)
        stress = room.stress - system.mu[:, None, None] * (strain + strain.transpose(0, 2, 1))
        stress[:, [0, 1, 2], [0, 1, 2]] -= (system.lam * trace - room.at_pressure)[:, None]
        old_trace = at.gradient[:, [0, 4, 8]].sum(axis=1) @ past.displacement
        content = room.content - (trace - old_trace)
        flux = room.flux - (past.length_s * system.mobility)[:, None] * room.at_slope
        solid = np.matmul(stress.reshape(n, 1, 9), at.gradient)[:, 0]
        fluid = at.pressure * content[:, None] + np.matmul(flux[:, None], at.slope)[:, 0]
        return np.concatenate([solid, -fluid], axis=1)
