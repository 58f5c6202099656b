"""Computes the derivatives of a reduced run's force by its parameters, all together: tangent sensitivities.

Differentiating a solved stage R(x, history; theta) = 0 gives K dx + dR/dtheta + dR/dhistory dhistory = 0. The
left side is computed as the difference of two residuals: the residual of the stage, and the residual after a
small step of unknowns, parameter and history together. The solve starts from the derivatives at earlier
stages and drives this difference to zero. It reuses the inverse tangent of the stage's own solve, and
computes a new one only where that converges badly (`slopes.differentiate`). The time steps are held fixed.

A length of the tissue moves the nodes. Kinematics, weights and all exactly integrated parts change with them.
Its derivative therefore uses the residuals of two spaces, whose nodes are moved in opposite directions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bayeskin.errors import InputError
from bayeskin.finite_element.extrapolation import extrapolate
from bayeskin.finite_element.series import Memories, lost_slopes, memory_slopes, on_the_way, yielding
from bayeskin.finite_element.stages import Stage, State, Step
from bayeskin.finite_element.tissue import Bind
from bayeskin.geometry import LENGTHS
from bayeskin.reduced import kernels, slopes
from bayeskin.reduced.arrays import History
from bayeskin.reduced.binding import Bound, bound
from bayeskin.reduced.equations import REMEMBERED_STATES, ReducedEquations
from bayeskin.reduced.operators import ReducedSpace
from bayeskin.types import Array, PadMotion


@dataclass(frozen=True)
class SensitivitySettings:
    """Settings of the differences and of the solves.

    step : of a parameter's change; truncation error 1e-6, rounding error 1e-10
    length_step : of a length's change, in both directions. The moved fields are in single precision, so the
        truncation error is 1e-4 and the rounding error 1e-4 to 1e-3
    passes_by_length : largest number of passes of a solve for a length
    least_displacement, least_force : derivatives smaller than these are solved only as accurately as the
        stage itself. The first is a derivative of the modes' coefficients, which are of order one; the second
        is relative to the scale of the force
    """

    step: float = 1e-6
    length_step: float = 1e-2
    passes_by_length: int = 5
    least_displacement: float = 0.01
    least_force: float = 0.001


SENSITIVITY = SensitivitySettings()


@dataclass(frozen=True)
class _Derivatives:
    """Derivatives of a state, and derivatives (k, r) of the memories of the elements in series."""

    state: State
    slopes: slopes.Slopes
    lost: Memories


class ReducedGradients:
    """Differentiates the accepted steps of a reduced run; `force_n` holds the derivatives at each step.

    changes : change of each parameter, by its name; a derivative is the force in newtons for this change
    space_at : function that returns the run's space for given parameters, whose lengths move the nodes
    Raises InputError for a parameter that the run does not have.
    """

    def __init__(
        self, equations: ReducedEquations, theta: Mapping[str, float], changes: Mapping[str, float],
        binds: Sequence[Bind], protocol: PadMotion,
        space_at: Callable[[Mapping[str, float]], ReducedSpace],
    ) -> None:  # fmt: skip
        unknown = [name for name in changes if name not in theta]
        if unknown:
            raise InputError(
                "gradients", f"{unknown[0]} is not a parameter of the run", f"use some of {', '.join(theta)}"
            )
        self.names = tuple(changes)
        self._equations = equations
        self._moved: dict[int, list[ReducedEquations]] = {}
        runs = []
        for i, (name, change) in enumerate(changes.items()):
            if name in LENGTHS:
                ends = [
                    {**theta, name: theta[name] + way * SENSITIVITY.length_step * change}
                    for way in (1.0, -1.0)
                ]
                self._moved[i] = [ReducedEquations(space_at(end), end, binds, protocol) for end in ends]
                runs.append(equations.run)  # in the unmoved space a length changes only the history
            else:
                runs.append(
                    bound(equations.space, {**theta, name: theta[name] + SENSITIVITY.step * change}, binds)
                )
        self._drives = [on_the_way(protocol, run.laws) for run in runs]
        self._in_series = bool(equations.drive.elements)
        self._varied = _varied(equations, [*runs, *([equations.run] if self._in_series else [])])
        self._reach_m = equations.drive.largest_m
        self._start = self._at_rest(changes.get("p_init", 0.0))
        self._known: dict[int, _Derivatives] = {}
        self._zero_n = np.zeros(len(changes))
        least = np.array(
            [SENSITIVITY.least_displacement, SENSITIVITY.least_force * equations.nominal_force()]
        )
        self._scale = np.repeat(least[:, None], len(self._varied.mu), axis=1)
        self.force_n: list[Array] = [np.zeros(len(changes))]

    def _at_rest(self, change: float) -> _Derivatives:
        eq, (k, m) = self._equations, self._equations.space.modes
        r, n = len(self._varied.mu), len(eq.space.at.weight)
        by_p_init = change * np.array([float(name == "p_init") for name in self.names] + [0.0])[:r]
        x = np.zeros((r, k + m))
        x[:, k] = by_p_init / eq.space.at.pressure[0, 0]
        state = eq.initial_state(0.0)
        pressure = np.zeros((r, n)) + by_p_init[:, None]
        memory = np.zeros((r, len(state.memory[0])))
        lost = tuple(np.zeros((*before.shape, len(self.names))) for before in state.lost)
        return _Derivatives(state, slopes.Slopes(x, np.zeros((r, n)), pressure, memory), lost)

    def follow(self, step: Step) -> None:
        """Differentiates an accepted step and appends the derivatives (r,) of its force [N] to `force_n`."""
        for stage in step.stages:
            known, force = self._differentiate(stage)
            self._known[id(stage.state)] = known
        if abs(step.state.time_s - self._equations.starts_s) < 1e-6:
            self._zero_n = force
        self.force_n.append(force)
        self._known = dict(list(self._known.items())[-REMEMBERED_STATES:])

    def _derivatives_of(self, state: State) -> _Derivatives:
        return self._known.get(id(state), self._start)

    def _differentiate(self, stage: Stage) -> tuple[_Derivatives, Array]:
        eq, k = self._equations, self._equations.space.modes[0]
        sources = [(weight, self._derivatives_of(state)) for weight, state in stage.sources]
        last = sources[-1][1]
        before = slopes.Slopes(
            np.asarray(sum(w * s.slopes.x[:, :k] for w, s in sources)),
            np.asarray(sum(w * s.slopes.volume for w, s in sources)),
            np.asarray(sum(w * s.slopes.pressure for w, s in sources)), last.slopes.memory,
        )  # fmt: skip
        past, room = eq.past_of(stage), eq.make_room()
        x, t = stage.state.x.copy(), eq.tangent
        residual = np.empty(len(x))
        kernels.residual(eq.system, eq.packed, past, x, room, residual)
        out = slopes.Slopes(self._extrapolated(stage), *(np.empty_like(values) for values in last.slopes[1:]))
        out.x[:, 0], out.x[:, 1] = self._pads_by(stage.state.time_s, last.lost), 0.0
        by_length = {i: out.x[i].copy() for i in self._moved}
        force, tangents = slopes.differentiate(
            eq.system, eq.packed, past, x, room, self._varied, before, self._scale, t.inverse, t.force_row,
            t.by_pads, out,
        )  # fmt: skip
        for i, guess in by_length.items():
            out.x[i] = guess
            force[i] = self._by_length(i, past, x, before, out)
        eq.spent += (0, 1, tangents)
        if self._in_series:
            return self._corrected_for_series(stage, last.lost, out, force)
        return _Derivatives(stage.state, out, last.lost), force

    def _extrapolated(self, stage: Stage) -> Array:
        """Returns a guess of the derivatives (r, k + m) at a stage's end, extrapolated from its sources."""
        known = [(state.time_s, self._derivatives_of(state).slopes.x) for _, state in stage.sources]
        return extrapolate(known, stage.state.time_s)

    def _by_length(self, i: int, past: History, x: Array, before: slopes.Slopes, out: slopes.Slopes) -> float:
        """Fills row i of `out`, the derivatives by a length, and returns the derivative of the force [N].

        Row i of ``out.x`` is a guess at the start.
        """
        t, ways = self._equations.tangent, (SENSITIVITY.length_step, -SENSITIVITY.length_step)
        rooms = [equations.make_room() for equations in self._moved[i]]
        residuals = np.empty((2, len(x)))
        pasts = [
            History(
                past.volume + way * before.volume[i], past.pressure + way * before.pressure[i],
                past.memory + way * before.memory[i], past.displacement + way * before.x[i], past.length_s,
                past.elapsed_s, past.time_s,
            )
            for way in ways
        ]  # fmt: skip
        for _ in range(SENSITIVITY.passes_by_length):
            for n, moved in enumerate(self._moved[i]):
                moved_x = x + ways[n] * out.x[i]
                kernels.residual(moved.system, moved.packed, pasts[n], moved_x, rooms[n], residuals[n])
            derivative = (residuals[0] - residuals[1]) / (2.0 * SENSITIVITY.length_step)
            step = -t.inverse @ derivative[2:]
            out.x[i, 2:] += step
        up, down = rooms
        out.volume[i] = (up.volume - down.volume) / (2.0 * SENSITIVITY.length_step)
        out.pressure[i] = (up.at_pressure - down.at_pressure) / (2.0 * SENSITIVITY.length_step)
        out.memory[i] = (up.memory - down.memory) / (2.0 * SENSITIVITY.length_step)
        return float(2.0 * derivative[1] + t.force_row @ step)

    def _pads_by(self, time_s: float, lost: Memories) -> Array:
        """Returns derivatives of the pads' displacement [m], with the losses in series as before the stage.

        With elements in series a last entry follows: the derivative by the pads' travel itself.
        """
        nominal_m = self._equations.drive.motion.at(time_s)
        moved = np.array(
            [(float(drive.motion.at(time_s)) - nominal_m) / SENSITIVITY.step for drive in self._drives]
        )
        moved = moved - sum(memory[0] for memory in lost)
        return 0.5 * np.append(moved, [2.0 * self._reach_m] * self._in_series)

    def _corrected_for_series(
        self, stage: Stage, held: Memories, out: slopes.Slopes, force: Array
    ) -> tuple[_Derivatives, Array]:
        """Returns all derivatives, corrected for the response of the elements in series to the force.

        held : derivatives of these elements' memories at the start of the stage
        """
        eq, r = self._equations, len(self.names)
        stiffness, force_slopes = float(force[r]) / (2.0 * self._reach_m), force[:r]
        more_lost, lost = np.zeros(r), held
        if eq.drive.yields(stage.state.time_s):
            force_n = 2.0 * float(stage.residual[1]) - eq.zero_n
            before = stage.history.lost

            def memories(slopes_n: Array) -> Memories:
                return memory_slopes(
                    self._drives,
                    SENSITIVITY.step,
                    force_n,
                    slopes_n,
                    stage.elapsed_s,
                    before,
                    held,
                    stage.state.lost,
                )

            softness = yielding(
                lambda f: eq.drive.follow(f, stage.elapsed_s, before), force_n, 1e-5 * eq.nominal_force()
            )
            held_m = np.asarray(sum((memory[0] for memory in held), np.zeros(r)))
            more_lost, lost = lost_slopes(force_slopes - self._zero_n, held_m, softness, stiffness, memories)
            force_slopes = force_slopes - stiffness * more_lost
        travel = np.append(more_lost, 0.0) / (2.0 * self._reach_m)
        for values in out:
            values -= np.outer(travel, values[r])
            values[r] = 0.0  # the derivative by the next stage's travel has no history
        return _Derivatives(stage.state, out, lost), force_slopes


def _varied(equations: ReducedEquations, runs: Sequence[Bound]) -> slopes.Varied:
    """Returns the constants of runs that each differ by a step in one parameter, as the kernels need them."""
    unchanged, (solid_units, flow_units) = equations.run, equations.units
    return slopes.Varied(
        np.array([run.solid.mu for run in runs]), np.array([run.solid.lam for run in runs]),
        np.array([run.solid.mobility for run in runs]),
        np.array([run.par for run in runs]), np.array([run.data for run in runs]), solid_units, flow_units,
        np.array([(run.solid_by - unchanged.solid_by) / SENSITIVITY.step for run in runs]),
        np.array([(run.flow_by - unchanged.flow_by) / SENSITIVITY.step for run in runs]), SENSITIVITY.step,
    )  # fmt: skip
