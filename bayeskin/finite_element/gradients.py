"""Computes the derivatives of the force history with respect to any parameters, from the kept factorisations.

Each time step consists of stages. A solved stage satisfies R(x, J*, p*; theta) = 0. Its
derivative is K dx = -dR/dtheta - dR/d(J*, p*) d(J*, p*), with the stage's own tangent K. For a guess v of dx,
the right-hand side minus K v is a directional derivative of the residual,

    -r = [R(x + eps v, J* + eps dJ*, p* + eps dp*; theta + eps) - R(x, J*, p*; theta)] / eps

so that no tangent needs to be formed. For the base model, `directional` computes r exactly and for all
parameters at once. With further laws, r is the difference of two residuals for each parameter
(`differences`). The same holds for all parameters if a length of the tissue is among them. For such a length
the changed residual is the one on moved nodes, at the same unknowns.

The guess is a linear combination of the derivatives at earlier stages. Its weights are
those with which the unknowns of these stages best approximate the unknowns of this stage. The guess is then
corrected by back-substitution of r with the kept factorisation M that is nearest to the stage. Where
residuals are differenced, M is the stage's own tangent, because factorising it costs less than a correction.

The derivative of the reaction is the same directional derivative on the pad's rows, and the term that a
correction would still add (`corrections`).

An element in series with the skin loses a displacement s before it reaches the pads.
The derivative ds follows (`series`) from two quantities: the derivative of the force with s held, and the
reaction of the stage's response y to the pads' travel alone. If x' are the derivatives with s held, then
dx = x' - y ds.

Forces scale with stresses. If the fluid were incompressible, F(c E_c, c E_s, k_c / c, k_s / c) = c F would
hold. Only three of the base model's four derivatives are therefore solved for. The derivative with respect to
E_c follows, to within 3e-7 of the largest derivative (docs/verification.md).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from bayeskin.errors import InputError
from bayeskin.finite_element.corrections import Corrector, Differentiated
from bayeskin.finite_element.differences import (
    EPSILON,
    ResidualDifferences,
    Slopes,
    material_rates,
    vary,
)
from bayeskin.finite_element.directional import TangentAction
from bayeskin.finite_element.lagrangian import LagrangianModel
from bayeskin.finite_element.newton import Equations
from bayeskin.finite_element.problem import ProblemAt, material
from bayeskin.finite_element.series import Memories, lost_slopes, memory_slopes, yielding
from bayeskin.finite_element.stages import Stage, State, Step
from bayeskin.finite_element.tissue import Bind
from bayeskin.geometry import LENGTHS
from bayeskin.types import Array

SCALING = {"E_c": 1.0, "E_s": 1.0, "k_c": -1.0, "k_s": -1.0}  # F = sum of these times dF/dlog (base model)
GUESS_POINTS = 4


def logarithms(theta: Mapping[str, float]) -> dict[str, float]:
    """Returns the changes with which `simulate` gives derivatives with respect to logarithms.

    They are the changes of the base model's four parameters and of the lengths in theta.
    """
    return {name: theta[name] for name in (*SCALING, *LENGTHS) if name in theta}


class ForceGradients:
    """Follows a run and differentiates each accepted step. `force_n` collects the derivatives of the force.

    theta : parameters of the run
    changes : for each parameter, by name, the change to which the derivative in newtons refers
    laws : the laws beyond the base model
    problem_at : function that returns the model's problem, with its nodes moved as the parameters demand
    Raises InputError for a parameter that the run does not have.
    """

    def __init__(
        self, model: LagrangianModel, theta: Mapping[str, float], changes: Mapping[str, float],
        laws: Sequence[Bind], problem_at: ProblemAt,
    ) -> None:  # fmt: skip
        unknown = [name for name in changes if name not in theta]
        if unknown:
            raise InputError(
                "gradients", f"{unknown[0]} is not a parameter of the run", f"use some of {', '.join(theta)}"
            )
        self.names = tuple(changes)
        self._model, self._follows = model, _scaling_rule(model, theta, changes)
        self._solved = tuple(name for name in changes if not (self._follows and name == "E_c"))
        self._by_differences = bool(model.laws) or not set(LENGTHS).isdisjoint(changes)
        self._varied = [
            vary(model, theta, name, EPSILON * changes[name], laws, problem_at) for name in self._solved
        ]
        back = [{**theta, name: theta[name] - EPSILON * changes[name]} for name in self._solved]
        self._rates = material_rates(
            [varied.material for varied in self._varied],
            [material(values, model.problem.mesh.cutis) for values in back],
        )
        self._in_series = bool(model.drive.elements)
        self._reach_m = 2.0 * model.drive.largest_m
        self._start = self._at_rest(theta["p_init"], changes.get("p_init", 0.0))
        self._known: dict[int, Slopes] = {}  # keys: id of the state, which the entry keeps alive
        self._phase: list[Slopes] = [self._start]  # derivatives at the ends of this phase's stages
        self._travel: Array | None = None
        self._corrector = Corrector(model)
        self._zero_n = np.zeros(len(self._solved))  # derivatives of the force when the test starts
        self.force_n: list[Array] = [np.zeros(len(changes))]
        self.seconds = 0.0

    def _at_rest(self, p_init: float, change: float) -> Slopes:
        """Returns the derivatives of the state of rest.

        change : change of p_init; 0 if the derivative with respect to p_init is not asked for
        """
        model, r, n = self._model, len(self._solved), 3 * self._model.problem.space.n_nodes
        rest = model.initial_state(p_init)
        by_p_init = change * np.array([float(name == "p_init") for name in self._solved])
        x = np.zeros((len(rest.x), r + self._in_series))
        x[n:, :r] = by_p_init
        shape = (*rest.volume.shape, r)
        memory = tuple(np.zeros((*before.shape, r)) for before in rest.memory)
        lost = tuple(np.zeros((*before.shape, r)) for before in rest.lost)
        return Slopes(rest, x, np.zeros(shape), np.zeros(shape) + by_p_init, memory, lost)

    def follow(self, step: Step) -> None:
        """Differentiates an accepted step, and appends the derivatives (r,) [N] of its force to `force_n`."""
        started = time.perf_counter()
        for stage in step.stages:
            slopes, force = self._differentiate(stage)
            self._known[id(stage.state)] = slopes
            self._phase.append(slopes)
        if abs(step.state.time_s - self._model.starts_s) < 1e-6:
            self._zero_n = force
        self.force_n.append(self._follows(force, step.force_n) if self._follows else force)
        self._known = dict(list(self._known.items())[-2 * GUESS_POINTS :])
        if step.corner:
            self._turn()
        self.seconds += time.perf_counter() - started

    def _turn(self) -> None:
        """Prepares for the next phase at a corner of the protocol.

        It stores how the derivatives changed with the pads' travel, for the guess at the start of the next
        phase.
        """
        start, end = self._phase[-2:]
        way_m = self._travel_m(start.state, end.state)
        if abs(way_m) > 0.0:
            self._travel = (end.x - start.x) / way_m
        self._phase = [end]

    def _travel_m(self, start: State, end: State) -> float:
        """Returns how far the pads travel between two states [m]."""
        drive = self._model.drive
        return drive.pads_m(end.time_s, 0.0) - drive.pads_m(start.time_s, 0.0)

    def _slopes_at(self, state: State) -> Slopes:
        """Returns the known derivatives of a state; a state that is not known is the state of rest."""
        return self._known.get(id(state), self._start)

    def _guess(self, state: State, equations: Equations) -> Array:
        """Returns a guess (dofs, r) of the derivatives at a state.

        It combines the derivatives of this phase's last stages with the weights with which their unknowns
        come nearest to those of the state.
        """
        *before, last = self._phase[-GUESS_POINTS:]
        if not before:
            travel = 0.0 if self._travel is None else self._travel * self._travel_m(last.state, state)
            return last.x + travel

        def weighted(x: Array) -> Array:
            return np.asarray((x - last.state.x)[equations.free] * equations.weight)

        moves = np.stack([weighted(slopes.state.x) for slopes in before], axis=1)
        shares = np.linalg.lstsq(moves, weighted(state.x), rcond=1e-10)[0]
        return last.x + sum(share * (old.x - last.x) for share, old in zip(shares, before, strict=True))

    def _differentiate(self, stage: Stage) -> tuple[Slopes, Array]:
        """Returns the derivatives of a stage's end, and of the force there (r,) [N]."""
        before = self._history_slopes(stage)
        equations = self._model.equations(stage.length_s, stage.history, stage.elapsed_s)
        x = self._guess(stage.state, equations)
        x[self._model.problem.pattern.fixed] = 0.0
        x[3 * self._model.problem.pads] = self._pad_slopes(stage.state.time_s, before)
        if self._by_differences:
            self._model.solver.renew(equations, stage.state.x)
        x, slopes, force = self._corrector.correct(equations, self._action(stage, before), x)
        if self._in_series:
            return self._subtract_lost(stage, before, x, slopes, force)
        return Slopes(stage.state, x, slopes.volume, slopes.pressure, slopes.memory, before.lost), force

    def _history_slopes(self, stage: Stage) -> Slopes:
        """Returns the derivatives of the stage's history."""
        sources = [(weight, self._slopes_at(state)) for weight, state in stage.sources]
        volume = np.asarray(sum(weight * slopes.volume for weight, slopes in sources))
        pressure = np.asarray(sum(weight * slopes.pressure for weight, slopes in sources))
        return replace(sources[-1][1], volume=volume, pressure=pressure)

    def _pad_slopes(self, time_s: float, before: Slopes) -> Array:
        """Returns the derivatives of the pads' displacement [m].

        The derivatives of the displacement lost in series are those before the stage. If elements lie in
        series with the skin, the last entry moves the pads apart by `_reach_m`.
        """
        now_m = self._model.motion.at(time_s)
        moved = np.array([(float(run.drive.motion.at(time_s)) - now_m) / EPSILON for run in self._varied])
        moved = moved - sum(lost[0] for lost in before.lost)
        return 0.5 * np.append(moved, [self._reach_m] * self._in_series)

    def _action(self, stage: Stage, before: Slopes) -> Callable[[Array], Differentiated]:
        """Returns a function that takes the derivatives of the unknowns at the stage's end.

        The function returns the derivatives of all that is `Evaluated` there.
        """
        if self._by_differences:
            return lambda x: ResidualDifferences(self._model, self._varied, stage, before, x)
        return TangentAction(self._model, stage, self._rates, before.volume, before.pressure)

    def _subtract_lost(
        self, stage: Stage, before: Slopes, x: Array, held: Differentiated, force: Array
    ) -> tuple[Slopes, Array]:
        """Returns all derivatives after the elements in series with the skin have responded to the force.

        x, held, force : the derivatives with the lost displacement held, with the response to the pads'
            travel as last column
        """
        model, r = self._model, len(self._varied)
        travel, stiffness = x[:, r] / self._reach_m, float(force[r]) / self._reach_m
        lost, lost_change = before.lost, np.zeros(r)
        if model.drive.yields(stage.state.time_s):
            lost_change, lost = self._lost(stage, before, force[:r], stiffness)
        columns = x.copy()
        columns[:, :r] -= np.outer(travel, lost_change)

        def less(values: Array) -> Array:
            return np.asarray(values[..., :r] - values[..., r:] / self._reach_m * lost_change)

        memory = tuple(less(slope) for slope in held.memory)
        slopes = Slopes(stage.state, columns, less(held.volume), less(held.pressure), memory, lost)
        return slopes, force[:r] - stiffness * lost_change

    def _lost(self, stage: Stage, before: Slopes, force: Array, stiffness: float) -> tuple[Array, Memories]:
        """Returns the change (r,) of the derivatives of the lost displacement during the stage.

        It also returns the derivatives (k, r) of the elements' memories.

        force (r,) : derivatives of the force with the lost displacement held
        stiffness : derivative of the force with respect to the pads' travel [N/m, LVDT]
        """
        model, elapsed_s, old = self._model, stage.elapsed_s, stage.history.lost
        force_n = model.problem.reaction(stage.residual) - model.zero_n
        drives = [varied.drive for varied in self._varied]

        def follow(slopes_n: Array) -> Memories:
            return memory_slopes(
                drives, EPSILON, force_n, slopes_n, elapsed_s, old, before.lost, stage.state.lost
            )

        softness = yielding(
            lambda n: model.drive.follow(n, elapsed_s, old), force_n, EPSILON * model.nominal_force()
        )
        held_m = np.asarray(sum(memory[0] for memory in before.lost))
        return lost_slopes(force - self._zero_n, held_m, softness, stiffness, follow)


def _scaling_rule(
    model: LagrangianModel, theta: Mapping[str, float], changes: Mapping[str, float]
) -> Callable[[Array, float], Array] | None:
    """Returns a function that adds the derivative with respect to E_c by the scaling of the base model.

    The function takes the other derivatives and the force, and returns all derivatives (r,). The result is
    None if the scaling does not hold because there are further laws, or if not all four base parameters are
    differentiated.
    """
    if model.laws or not set(SCALING) <= set(changes):
        return None
    names = [name for name in changes if name != "E_c"]
    share = np.array([SCALING.get(name, 0.0) * theta[name] / changes[name] for name in names])
    place, scale = tuple(changes).index("E_c"), changes["E_c"] / theta["E_c"]
    return lambda force, force_n: np.insert(force, place, scale * (force_n - share @ force))
