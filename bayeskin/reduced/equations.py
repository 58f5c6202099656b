"""The equations of one reduced run, as `bayeskin.finite_element.stepping` integrates them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from bayeskin.finite_element.lagrangian import Stage, State, Step
from bayeskin.finite_element.problem import Material, Problem, Sites, material, nominal_force
from bayeskin.finite_element.series import SeriesSolver, Solved, on_the_way
from bayeskin.finite_element.tissue import Bind, SurfaceTerm, TissueLaw
from bayeskin.geometry import Geometry
from bayeskin.reduced import kernels
from bayeskin.reduced.calls import address
from bayeskin.reduced.operators import LinearParts, PointFields
from bayeskin.reduced.tangents import Tangent, Tangents
from bayeskin.types import Array, PadMotion

SOLVER_TOLERANCE = 1e-5  # of the amplitude of displacements, and of the nominal force
SurfaceUnit = Callable[[Problem], sp.csr_matrix]


@dataclass(frozen=True)
class ReducedSpace:
    """A basis at the points of a cubature, with what is integrated exactly.

    lengths : device and tissue; at : fields at the points
    exact : linear parts of the base law less what the points make of them
    surfaces : of unit surface terms, projected on all fields, (k + m, k + m)
    """

    lengths: Geometry
    at: PointFields
    exact: LinearParts
    surfaces: Callable[[SurfaceUnit], Array]

    @property
    def modes(self) -> tuple[int, int]:
        """Number of displacement fields, the pads' and the dual one among them, and of pressure modes."""
        return self.at.gradient.shape[2], self.at.pressure.shape[1]

    @property
    def sites(self) -> Sites:
        """The points as laws see them."""
        return Sites(self.at.cutis, self.at.points_m, self.lengths)


@dataclass(frozen=True)
class Bound:
    """Constants and laws of a run at the points, for values of all parameters.

    solid_by (s,), flow_by (t,) : coefficients of the exact parts' units (`exact_units`)
    """

    solid: Material
    laws: tuple[TissueLaw, ...]
    solid_by: Array
    flow_by: Array

    @property
    def par(self) -> Array:
        """Constants of all laws, flat."""
        return _flat([law.par for law in self.laws])

    @property
    def data(self) -> Array:
        """Constants of all laws at the points, flat."""
        return _flat([law.data for law in self.laws])


def bound(space: ReducedSpace, theta: Mapping[str, float], binds: Sequence[Bind]) -> Bound:
    """Binds base law and mechanisms to values of their parameters."""
    sites, cutis = space.sites, space.at.cutis
    solid = material(theta, cutis)
    laws = tuple(sorted((bind(theta, sites) for bind in binds), key=lambda law: law.rank))
    first, other = int(np.argmax(cutis)), int(np.argmin(cutis))  # a point of each layer

    def of_layers(name: str) -> Array:
        return np.array([getattr(solid, name)[first], getattr(solid, name)[other]])

    still, rates = surface_terms(laws)
    return Bound(
        solid, laws,
        np.concatenate([of_layers("mu"), of_layers("lam"), [term.value for term in still]]),
        np.concatenate([-of_layers("mobility"), [term.value for term in rates]]),
    )  # fmt: skip


def surface_terms(laws: Sequence[TissueLaw]) -> tuple[list[SurfaceTerm], list[SurfaceTerm]]:
    """The surface terms of laws: those of the displacement, and those that are rates of the fluid."""
    terms = [term for law in laws for term in law.surfaces]
    return [t for t in terms if not t.per_second], [t for t in terms if t.per_second]


def exact_units(space: ReducedSpace, laws: Sequence[TissueLaw]) -> tuple[Array, Array]:
    """The matrices (s, k, k) and (t, m, m) whose combinations are the exact parts."""
    k, exact = space.modes[0], space.exact
    still, rates = surface_terms(laws)
    solid = [*exact.shear, *exact.bulk, *(space.surfaces(term.unit)[:k, :k] for term in still)]
    flow = [*exact.flow, *(space.surfaces(term.unit)[k:, k:] for term in rates)]
    return np.array(solid), np.array(flow)


def _flat(arrays: Sequence[Array]) -> Array:
    return np.concatenate([np.zeros(0), *(np.ravel(array) for array in arrays)])


def packed(laws: Sequence[TissueLaw], points: int) -> kernels.Laws:
    """Laws as the compiled driver is given them."""
    par, widths = [len(law.par) for law in laws], [law.data.shape[1] for law in laws]
    memory = [law.remembers for law in laws]

    def starts(counts: Sequence[int]) -> np.ndarray:
        return np.concatenate([[0], np.cumsum(np.asarray(counts, dtype=np.int64))]).astype(np.int64)

    return kernels.Laws(
        np.array([address(law.respond) for law in laws], dtype=np.int64),
        np.array([address(law.linearise) for law in laws], dtype=np.int64),
        _flat([law.par for law in laws]), starts(par), _flat([law.data for law in laws]),
        np.array(widths, dtype=np.int64), points * starts(widths),
        np.array(memory, dtype=np.int64), points * starts(memory),
    )  # fmt: skip


class ReducedEquations:
    """The equations of one run: a reduced space, parameters, mechanisms and a protocol; no step control.

    theta : values of all parameters; binds : of the mechanisms' laws
    zero_n : the force when the test starts; what lies in series with the skin acts on the force beyond that
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
        self.system = kernels.System(
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
        self.room: kernels.Room | None = None
        self.past: kernels.History | None = None
        self.counts = {"crawls": 0, "falls": 0}

    @property
    def solver(self) -> ReducedEquations:
        """Carries the counts, as `stepping.integrate` asks of a model's solver."""
        return self

    def nominal_force(self) -> float:
        """Scale of the force [N] over the protocol."""
        return self._nominal_n

    @property
    def motion(self) -> PadMotion:
        """The protocol less what is lost whatever the force, from the opening of the pads on."""
        return self.drive.motion

    @property
    def starts_s(self) -> float:
        """When the test starts [s]."""
        return self.drive.starts_s

    def initial_state(self, p_init: float) -> State:
        """The skin at rest under a pressure [Pa]."""
        k, m = self.space.modes
        n = len(self.space.at.weight)
        x = np.zeros(k + m)
        x[k] = p_init / self.space.at.pressure[0, 0]
        memory = np.zeros(int(self.packed.memory_at[-1]))
        return State(0.0, x, np.ones(n), np.full(n, float(p_init)), (memory,), self.drive.at_rest)

    def remember_travel(self, past: list[State]) -> None:
        """Keeps how the unknowns went with the pads, to guess how they set out again."""
        if len(past) < 2:
            return
        way_m = past[-1].x[0] - past[-2].x[0]
        if abs(way_m) > 1e-3 * self.drive.largest_m:
            self._travel = (past[-1].x - past[-2].x) / way_m

    def solve_stage(
        self,
        time_s: float,
        length_s: float,
        sources: tuple[tuple[float, State], ...],
        guess: Array,
        jump: bool,
        fall: bool = False,
    ) -> Stage | None:
        """Solves one implicit equation for time_s, as `LagrangianModel.solve_stage`; it follows no fall."""
        if fall:
            return None
        last = sources[-1][1]
        past = self._history(sources, length_s, time_s)
        place = self._place(time_s, length_s)
        if not self._tangents.take(place, self.tangent):
            self._renew(past, last.x)

        def first(pads_m: float) -> Solved | None:
            return self._solve(past, self._set_out(past, last, pads_m) if jump else guess, pads_m)

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
        """Returns how far the pads are open in a stage, and its length: near ones have near tangents."""
        return float(self.drive.motion.at(time_s)) / self.drive.largest_m, float(np.log(length_s))

    def _history(
        self, sources: tuple[tuple[float, State], ...], length_s: float, time_s: float
    ) -> kernels.History:
        """Returns the history that a stage at a time has from its sources; the last carries the memory."""
        last, k = sources[-1][1], self.space.modes[0]
        return kernels.History(
            np.asarray(sum(w * s.volume for w, s in sources)),
            np.asarray(sum(w * s.pressure for w, s in sources)), last.memory[0],
            np.asarray(sum(w * s.x[:k] for w, s in sources)), length_s, time_s - last.time_s,
            max(time_s - self.starts_s, 0.0),
        )  # fmt: skip

    def past_of(self, stage: Stage) -> kernels.History:
        """The history that a solved stage had."""
        return self._history(stage.sources, stage.length_s, stage.state.time_s)

    def make_room(self) -> kernels.Room:
        n = len(self.space.at.weight)
        return kernels.Room(
            np.empty((n, 3, 3)), np.empty(n), np.empty((n, 3)), np.empty((n, 3, 3)), np.empty(n),
            np.empty((n, 3)), np.empty(n), np.empty(int(self.packed.memory_at[-1])),
        )  # fmt: skip

    def _set_out(self, past: kernels.History, last: State, pads_m: float) -> Array:
        """A guess where the pads set out from the last state: as they did before, or by the tangent."""
        way_m = pads_m - last.x[0]
        if self._travel is not None:
            return np.asarray(last.x + self._travel * way_m)
        right, x = np.empty(len(last.x)), last.x.copy()
        kernels.residual(self.system, self.packed, past, x, self.make_room(), right)
        self.spent[1] += 1
        x[2:] -= self.tangent.inverse @ (right[2:] + self.tangent.by_pads[:-1] * way_m)
        return x

    def _renew(self, past: kernels.History, x: Array) -> None:
        """Makes the tangent anew for a stage, at the unknowns x."""
        t = self.tangent
        kernels.renew(self.system, self.packed, past, x, self.make_room(), t.inverse, t.force_row, t.by_pads)
        self.spent[2] += 1

    def _solve(self, past: kernels.History, guess: Array, pads_m: float) -> Solved | None:
        """The unknowns with the pads at `pads_m`, and the force beyond that at the start; None if none."""
        t, room, x = self.tangent, self.make_room(), guess.copy()
        x[0], x[1] = pads_m, 0.0
        status, force_n = kernels.solve(
            self.system, self.packed, past, x, SOLVER_TOLERANCE, self._nominal_n, room, t.inverse,
            t.force_row, t.by_pads, self.spent,
        )  # fmt: skip
        if status != kernels.CONVERGED:
            self._tangents.forget()  # the next solve makes its own
            return None
        self.room, self.past = room, past
        return x, float(force_n) - self.zero_n

    def finish(self, stages: tuple[Stage, ...], mass: Array) -> Step:
        """The step made of `stages`, with the local error that an error (n,) of the fluid mass makes."""
        k = self.space.modes[0]
        at, t = self.space.at, self.tangent
        right = np.concatenate([np.zeros(k - 2), -(at.pressure.T @ (at.weight * mass))])
        error_n = abs(float(t.force_row @ (t.inverse @ right)))
        return Step(stages[-1].state, 2.0 * float(stages[-1].residual[1]), error_n, False, stages)

    def solid_stiffness(self) -> Array:
        """The tangent of the displacement modes (u, u) at the last solved stage, its symmetric part."""
        assert self.room is not None
        assert self.past is not None
        k = self.space.modes[0]
        whole = kernels.tangent(self.system, self.packed, self.past, self.room)
        solid = whole[2:k, 2:k]
        return np.asarray(0.5 * (solid + solid.T))

    def dual(self) -> Array:
        """The adjoint of half the force (k + m,) by the last tangent."""
        out = np.zeros(sum(self.space.modes))
        out[1] = 1.0
        out[2:] = -0.5 * (self.tangent.inverse.T @ self.tangent.force_row)
        return out
