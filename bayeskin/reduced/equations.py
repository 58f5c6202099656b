"""States the equations of one run of the reduced model.

`bayeskin.finite_element.stepping` integrates them in time, as it integrates the full model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from bayeskin.finite_element.problem import nominal_force
from bayeskin.finite_element.series import SeriesSolver, Solved, on_the_way
from bayeskin.finite_element.stages import Stage, State, Step
from bayeskin.finite_element.tissue import Bind
from bayeskin.reduced import kernels, newton
from bayeskin.reduced.arrays import History, Room, System
from bayeskin.reduced.binding import bound, exact_units, packed
from bayeskin.reduced.operators import ReducedSpace
from bayeskin.reduced.tangents import Tangent, Tangents
from bayeskin.types import Array, PadMotion

SOLVER_TOLERANCE = 1e-5  # relative to the amplitude of displacements and to the nominal force
REMEMBERED_STATES = 8  # number of states for which further results are kept; a step needs at most three


class ReducedEquations:
    """The equations of one run: a reduced space, parameters, mechanisms and a protocol.

    Step control is not part of them.

    theta : values of all parameters; binds : functions that bind the mechanisms' laws
    zero_n : force at the start of the test [N]; elements in series with the skin act on the force beyond it
    """

    def __init__(
        self,
        space: ReducedSpace,
        theta: Mapping[str, float],
        binds: Sequence[Bind],
        protocol: PadMotion,
    ) -> None:
        self.space, self.run = space, bound(space, theta, binds)
        run = self.run
        self.drive = on_the_way(protocol, run.laws)
        self._series = SeriesSolver(self.drive)
        k, m = space.modes
        units = exact_units(space, run.laws)
        at, solid = space.at, run.solid
        self.units = units
        self.system = System(
            at.gradient, at.pressure, at.slope, at.weight, solid.mu, solid.lam, solid.mobility,
            solid.storage, np.tensordot(run.solid_by, units[0], 1), space.exact.coupling,
            np.tensordot(run.flow_by, units[1], 1),
        )  # fmt: skip
        self.packed = packed(run.laws, len(at.weight))
        self.tangent = Tangent(k + m - 2)
        self._tangents = Tangents()
        self.spent = np.zeros(3, np.int64)  # iterations, residuals, tangents
        self.zero_n = 0.0
        self._nominal_n = nominal_force(solid, at.cutis, space.lengths, self.drive.largest_m)
        self._travel: Array | None = None
        self.room: Room | None = None
        self.past: History | None = None
        self.counts = {"crawls": 0, "falls": 0}

    @property
    def solver(self) -> ReducedEquations:
        """Returns this object, since `stepping.integrate` reads the counts of a model from its solver."""
        return self

    def nominal_force(self) -> float:
        """Returns the scale of the force [N] over the protocol."""
        return self._nominal_n

    @property
    def motion(self) -> PadMotion:
        """Returns the protocol minus the displacement that is lost whatever the force is.

        An opening of the pads before the test comes first.
        """
        return self.drive.motion

    @property
    def starts_s(self) -> float:
        """Returns the time at which the test starts [s]."""
        return self.drive.starts_s

    def initial_state(self, p_init: float) -> State:
        """Returns the state of the skin at rest under a pressure [Pa]."""
        k, m = self.space.modes
        n = len(self.space.at.weight)
        x = np.zeros(k + m)
        x[k] = p_init / self.space.at.pressure[0, 0]
        memory = np.zeros(int(self.packed.memory_at[-1]))
        return State(0.0, x, np.ones(n), np.full(n, float(p_init)), (memory,), self.drive.at_rest)

    def remember_travel(self, past: list[State]) -> None:
        """Stores the change of the unknowns per metre of pad travel, to guess how the next phase begins."""
        if len(past) < 2:
            return
        travel_m = past[-1].x[0] - past[-2].x[0]
        if abs(travel_m) > 1e-3 * self.drive.largest_m:
            self._travel = (past[-1].x - past[-2].x) / travel_m

    def solve_stage(
        self,
        time_s: float,
        length_s: float,
        sources: tuple[tuple[float, State], ...],
        guess: Array,
        jump: bool,
        fall: bool = False,
    ) -> Stage | None:
        """Solves one implicit stage that ends at time_s, as `LagrangianModel.solve_stage` does.

        Returns None where no solution is found. The reduced model does not follow a fall.
        """
        if fall:
            return None
        last = sources[-1][1]
        past = self._history(sources, length_s, time_s)
        place = self._place(time_s, length_s)
        if not self._tangents.take(place, self.tangent):
            self._renew_tangent(past, last.x)

        def first(pads_m: float) -> Solved | None:
            return self._solve(past, self._guess_by_travel(past, last, pads_m) if jump else guess, pads_m)

        def again(near: Array, pads_m: float) -> Solved | None:
            return self._solve(past, near, pads_m)

        expected_m = None if jump else float(guess[0])
        solved = self._series.solve(time_s, past.elapsed_s, last.lost, expected_m, first, again)
        if solved is None:
            return None
        self._tangents.keep(place, self.tangent)
        ((x, force_n), lost), room = solved, self.room
        assert room is not None
        state = State(time_s, x, room.volume, room.at_pressure, (room.memory,), lost)
        history = State(last.time_s, last.x, past.volume, past.pressure, last.memory, last.lost)
        residual = np.array([0.0, 0.5 * (force_n + self.zero_n)])
        return Stage(state, length_s, past.elapsed_s, history, sources, residual)

    def _place(self, time_s: float, length_s: float) -> tuple[float, float]:
        """Returns coordinates of a stage: the relative opening of the pads, and the logarithm of its length.

        Stages that are near in these coordinates have similar tangents.
        """
        return float(self.drive.motion.at(time_s)) / self.drive.largest_m, float(np.log(length_s))

    def _history(self, sources: tuple[tuple[float, State], ...], length_s: float, time_s: float) -> History:
        """Returns the history of a stage that ends at a time; the last of its sources carries the memory."""
        last, k = sources[-1][1], self.space.modes[0]
        return History(
            np.asarray(sum(w * s.volume for w, s in sources)),
            np.asarray(sum(w * s.pressure for w, s in sources)), last.memory[0],
            np.asarray(sum(w * s.x[:k] for w, s in sources)), length_s, time_s - last.time_s,
            max(time_s - self.starts_s, 0.0),
        )  # fmt: skip

    def past_of(self, stage: Stage) -> History:
        """Returns the history of a solved stage."""
        return self._history(stage.sources, stage.length_s, stage.state.time_s)

    def make_room(self) -> Room:
        n = len(self.space.at.weight)
        return Room(
            np.empty((n, 3, 3)), np.empty(n), np.empty((n, 3)), np.empty((n, 3, 3)), np.empty(n),
            np.empty((n, 3)), np.empty(n), np.empty(int(self.packed.memory_at[-1])),
        )  # fmt: skip

    def _guess_by_travel(self, past: History, last: State, pads_m: float) -> Array:
        """Returns a guess of the unknowns where the pads start to move from the last state.

        It uses the stored change per pad travel, or the tangent where no change is stored yet.
        """
        travel_m = pads_m - last.x[0]
        if self._travel is not None:
            return np.asarray(last.x + self._travel * travel_m)
        right, x = np.empty(len(last.x)), last.x.copy()
        kernels.residual(self.system, self.packed, past, x, self.make_room(), right)
        self.spent[1] += 1
        x[2:] -= self.tangent.inverse @ (right[2:] + self.tangent.by_pads[:-1] * travel_m)
        return x

    def _renew_tangent(self, past: History, x: Array) -> None:
        """Computes a new tangent for a stage, at the unknowns x."""
        t = self.tangent
        newton.renew(self.system, self.packed, past, x, self.make_room(), t.inverse, t.force_row, t.by_pads)
        self.spent[2] += 1

    def _solve(self, past: History, guess: Array, pads_m: float) -> Solved | None:
        """Returns the unknowns with the pads at `pads_m`, and the force beyond that at the start of the test.

        Returns None where the solve does not converge.
        """
        t, room, x = self.tangent, self.make_room(), guess.copy()
        x[0], x[1] = pads_m, 0.0
        status, force_n = newton.solve(
            self.system, self.packed, past, x, SOLVER_TOLERANCE, self._nominal_n, room, t.inverse,
            t.force_row, t.by_pads, self.spent,
        )  # fmt: skip
        if status != newton.CONVERGED:
            self._tangents.forget()  # the next solve then computes a new tangent
            return None
        self.room, self.past = room, past
        return x, float(force_n) - self.zero_n

    def finish(self, stages: tuple[Stage, ...], mass: Array) -> Step:
        """Returns the step that consists of `stages`.

        Its local error [N] is the change of the force that an error `mass` (n,) of the fluid mass causes.
        """
        k = self.space.modes[0]
        at, t = self.space.at, self.tangent
        right = np.concatenate([np.zeros(k - 2), -(at.pressure.T @ (at.weight * mass))])
        error_n = abs(float(t.force_row @ (t.inverse @ right)))
        return Step(stages[-1].state, 2.0 * float(stages[-1].residual[1]), error_n, False, stages)

    def solid_stiffness(self) -> Array:
        """Returns the tangent stiffness (u, u) of the displacement modes at the last solved stage.

        It is the symmetric part of the tangent.
        """
        assert self.room is not None
        assert self.past is not None
        k = self.space.modes[0]
        tangent = kernels.tangent(self.system, self.packed, self.past, self.room)
        solid = tangent[2:k, 2:k]
        return np.asarray(0.5 * (solid + solid.T))

    def dual(self) -> Array:
        """Returns the adjoint of half the force (k + m,), from the last tangent."""
        out = np.zeros(sum(self.space.modes))
        out[1] = 1.0
        out[2:] = -0.5 * (self.tangent.inverse.T @ self.tangent.force_row)
        return out
