"""Derivatives of the force history by any parameters, from the kept factorisations.

Differentiating a solved stage R(x, J*, p*; theta) = 0 gives K dx = -dR/dtheta - dR/d(J*, p*) d(J*, p*),
with the stage's own tangent K. For a guess v of dx the right-hand side less K v is the residual's derivative

    -r = [R(x + eps v, J* + eps dJ*, p* + eps dp*; theta + eps) - R(x, J*, p*; theta)] / eps

so that no tangent is formed: of the base model r is found exactly and for all parameters at once
(`directional`), with laws beyond it from two residuals a parameter, and with a length of the tissue among
these too: there the residual further on is that of moved nodes, at the same unknowns.

The guess combines the stages before as their unknowns best combine to those of this one, and is corrected by
back-substitutions of r with the kept factorisation M nearest to the stage. Where residuals are differenced M
is the stage's own, which costs less than a correction.

The reaction's derivative is that of the same residual on the pad's rows. A correction would add g M^-1 r to
it, with the reaction's derivative g by the unknowns; as M is symmetric, M^-1 g tells so before it is made.
What is small enough is added and no correction made, so that the force's error is the product of the errors
of v and of the factorisation.

What lies in series with the skin loses a displacement before it reaches the pads. Its derivatives ds follow
(`series`) from those of the force with s held and the reaction of the stage's response y to the pads' travel
alone; with the derivatives x' for s held, dx = x' - y ds.

Forces scale with stresses: were the fluid incompressible, F(c E_c, c E_s, k_c / c, k_s / c) = c F. Of the
base model's four derivatives three are therefore solved for and E_c's follows, to 3e-7 of the largest one
(docs/verification.md).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Union

import numpy as np

from bayeskin.errors import InputError
from bayeskin.finite_element.directional import TangentAction
from bayeskin.finite_element.lagrangian import Evaluated, LagrangianModel, Stage, State, Step
from bayeskin.finite_element.newton import Equations
from bayeskin.finite_element.problem import Material, Problem, material
from bayeskin.finite_element.series import Drive, Memories, lost_slopes, memory_slopes, on_the_way, yielding
from bayeskin.finite_element.tissue import Bind, TissueLaw
from bayeskin.geometry import LENGTHS
from bayeskin.types import Array

SCALING = {"E_c": 1.0, "E_s": 1.0, "k_c": -1.0, "k_s": -1.0}  # F = sum of these times dF/dlog, base model
EPSILON = 1e-5  # of a parameter's change: truncation 1e-5, rounding 1e-9
TOLERANCE = 1e-4  # of what a correction would add to the force, relative to the nominal force
UNCORRECTED = 0.05  # times that for a bare guess, whose error adds up from stage to stage
MOST_CORRECTIONS = 12
ANDERSON_DEPTH = 4
GUESS_POINTS = 4
DUALS = 10  # kept


def logarithms(theta: Mapping[str, float]) -> dict[str, float]:
    """The changes by which `simulate` gives derivatives by logarithms of the base's four and of lengths."""
    return {name: theta[name] for name in (*SCALING, *LENGTHS) if name in theta}


@dataclass(frozen=True)
class _Varied:
    """Constants of a run in which one parameter is moved by EPSILON of its change.

    model : has the nodes where they are then; its own material and laws are the run's
    """

    model: LagrangianModel
    material: Material
    laws: tuple[TissueLaw, ...]
    drive: Drive


@dataclass(frozen=True)
class _Slopes:
    """Derivatives of a `State` by r parameters: x (dofs, r), J and p (e, q, r), memories (e q, m, r), what
    is lost in series (k, r). With such elements a last column of x is the response to the pads' travel."""

    state: State
    x: Array
    volume: Array
    pressure: Array
    memory: tuple[Array, ...]
    lost: Memories


_Evaluated = Union[Evaluated, "_Differences"]
ProblemAt = Callable[[Mapping[str, float]], Problem]


class ForceGradients:
    """Follows a run, step by accepted step; `force_n` then holds the derivatives of each step's force.

    changes : of each parameter, by name, what counts as one; derivatives are in newtons for that
    problem_at : the model's problem with its nodes where parameters have them
    Raises InputError for a parameter that the run does not have.
    """

    def __init__(
        self, model: LagrangianModel, theta: Mapping[str, float], changes: Mapping[str, float],
        laws: Sequence[Bind], problem_at: ProblemAt,
    ) -> None:  # fmt: skip
        unknown = [name for name in changes if name not in theta]
        if unknown:
            raise InputError("gradients", unknown[0], f"among {', '.join(theta)}")
        self.names = tuple(changes)
        self._model, self._follows = model, _follows(model, theta, changes)
        self._solved = tuple(name for name in changes if not (self._follows and name == "E_c"))
        self._by_differences = bool(model.laws) or not set(LENGTHS).isdisjoint(changes)
        self._varied = [
            _varied(model, theta, name, EPSILON * changes[name], laws, problem_at) for name in self._solved
        ]
        back = [{**theta, name: theta[name] - EPSILON * changes[name]} for name in self._solved]
        self._rates = _rates(
            [one.material for one in self._varied],
            [material(values, model.problem.mesh.cutis) for values in back],
        )
        self._in_series = bool(model.drive.elements)
        self._reach_m = 2.0 * model.drive.largest_m
        self._start = self._at_rest(theta["p_init"], changes.get("p_init", 0.0))
        self._known: dict[int, _Slopes] = {}  # by identity of the state, which they keep alive
        self._phase: list[_Slopes] = [self._start]  # ends of this phase's stages
        self._travel: Array | None = None
        self._duals: dict[int, tuple[Array, Array]] = {}  # by identity of the place, which they keep alive
        self._zero_n = np.zeros(len(self._solved))  # of the force when the test starts
        self.force_n: list[Array] = [np.zeros(len(changes))]
        self.corrections, self.seconds = 0, 0.0

    def _at_rest(self, p_init: float, change: float) -> _Slopes:
        model, r, n = self._model, len(self._solved), 3 * self._model.problem.space.n_nodes
        rest = model.initial_state(p_init)
        by_p_init = change * np.array([float(name == "p_init") for name in self._solved])
        x = np.zeros((len(rest.x), r + self._in_series))
        x[n:, :r] = by_p_init
        shape = (*rest.volume.shape, r)
        memory = tuple(np.zeros((*before.shape, r)) for before in rest.memory)
        lost = tuple(np.zeros((*before.shape, r)) for before in rest.lost)
        return _Slopes(rest, x, np.zeros(shape), np.zeros(shape) + by_p_init, memory, lost)

    def follow(self, step: Step) -> None:
        """Differentiates an accepted step; appends the force's derivatives [N], (r,), to `force_n`."""
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
        """At a corner: how the slopes went with the pads, to guess how they set out again."""
        start, end = self._phase[-2:]
        way_m = self._way_m(start.state, end.state)
        if abs(way_m) > 0.0:
            self._travel = (end.x - start.x) / way_m
        self._phase = [end]

    def _way_m(self, start: State, end: State) -> float:
        drive = self._model.drive
        return drive.pads_m(end.time_s, 0.0) - drive.pads_m(start.time_s, 0.0)

    def _of(self, state: State) -> _Slopes:
        return self._known.get(id(state), self._start)

    def _guess(self, state: State, equations: Equations) -> Array:
        """The slopes of this phase's last stages, combined as their unknowns come nearest to the state's."""
        *before, last = self._phase[-GUESS_POINTS:]
        if not before:
            travel = 0.0 if self._travel is None else self._travel * self._way_m(last.state, state)
            return last.x + travel

        def weighted(x: Array) -> Array:
            return np.asarray((x - last.state.x)[equations.free] * equations.weight)

        moves = np.stack([weighted(slopes.state.x) for slopes in before], axis=1)
        shares = np.linalg.lstsq(moves, weighted(state.x), rcond=1e-10)[0]
        return last.x + sum(share * (old.x - last.x) for share, old in zip(shares, before, strict=True))

    def _differentiate(self, stage: Stage) -> tuple[_Slopes, Array]:
        before = self._before(stage)
        equations = self._model.equations(stage.length_s, stage.history, stage.elapsed_s)
        x = self._guess(stage.state, equations)
        x[self._model.problem.pattern.fixed] = 0.0
        x[3 * self._model.problem.pads] = self._of_pads(stage.state.time_s, before)
        x, found, force = self._solve(stage, equations, self._action(stage, before), x)
        if self._in_series:
            return self._less_lost(stage, before, x, found, force)
        return _Slopes(stage.state, x, found.volume, found.pressure, found.memory, before.lost), force

    def _before(self, stage: Stage) -> _Slopes:
        """Derivatives of the stage's history."""
        sources = [(weight, self._of(state)) for weight, state in stage.sources]
        volume = np.asarray(sum(weight * slopes.volume for weight, slopes in sources))
        pressure = np.asarray(sum(weight * slopes.pressure for weight, slopes in sources))
        return replace(sources[-1][1], volume=volume, pressure=pressure)

    def _of_pads(self, time_s: float, before: _Slopes) -> Array:
        """Derivatives of the pads' displacement [m], with what was lost before; and their travel."""
        here = self._model.motion.at(time_s)
        moved = np.array([(float(one.drive.motion.at(time_s)) - here) / EPSILON for one in self._varied])
        moved = moved - sum(lost[0] for lost in before.lost)
        return 0.5 * np.append(moved, [self._reach_m] * self._in_series)

    def _solve(
        self,
        stage: Stage,
        equations: Equations,
        action: Callable[[Array], _Evaluated],
        x: Array,
    ) -> tuple[Array, _Evaluated, Array]:
        """From a guess x (dofs, r) whose fixed rows are right: x, what is `Evaluated` there, the force."""
        model, solver, free = self._model, self._model.solver, self._model.problem.pattern.free
        if self._by_differences:
            solver.renew(equations, stage.state.x)
        dual = self._dual(solver.toward(equations.place))
        weight, allowed_n = equations.weight[:, None], TOLERANCE * model.nominal_force()
        tried: list[tuple[Array, Array]] = []  # unknowns and the corrections that they asked for
        for _ in range(MOST_CORRECTIONS):
            found = action(x)
            missing_n = -dual @ found.residual[free]
            if np.abs(missing_n).max() <= (allowed_n if tried else UNCORRECTED * allowed_n):
                break
            correction = -solver.back_substitute(found.residual[free])
            tried = [*tried, (x[free] * weight, correction * weight)][-ANDERSON_DEPTH:]
            x[free] += _accelerated(tried) / weight
            self.corrections += 1
        return x, found, 2.0 * found.residual[model.problem.measured_x].sum(axis=0) + missing_n

    def _dual(self, place: Array) -> Array:
        """M^-1 g (free,) with the factorisation M that was made at `place`, solved for once."""
        known = self._duals.get(id(place))
        if known is None:
            known = place, self._model.solver.back_substitute(self._model.pad_gradient)
            self._duals = dict([*self._duals.items(), (id(place), known)][-DUALS:])
        return known[1]

    def _action(self, stage: Stage, before: _Slopes) -> Callable[[Array], _Evaluated]:
        """Derivatives of all that is `Evaluated` at the stage's end, from those of the unknowns there."""
        if self._by_differences:
            return lambda x: _Differences(self._model, self._varied, stage, before, x)
        return TangentAction(self._model, stage, self._rates, before.volume, before.pressure)

    def _less_lost(
        self, stage: Stage, before: _Slopes, x: Array, found: _Evaluated, force: Array
    ) -> tuple[_Slopes, Array]:
        """All derivatives once what lies in series with the skin has answered to the force's."""
        model, r = self._model, len(self._varied)
        travel, stiffness = x[:, r] / self._reach_m, float(force[r]) / self._reach_m
        lost, more = before.lost, np.zeros(r)
        if model.drive.yields(stage.state.time_s):
            more, lost = self._lost(stage, before, force[:r], stiffness)
        columns = x.copy()
        columns[:, :r] -= np.outer(travel, more)

        def less(values: Array) -> Array:
            return np.asarray(values[..., :r] - values[..., r:] / self._reach_m * more)

        memory = tuple(less(one) for one in found.memory)
        slopes = _Slopes(stage.state, columns, less(found.volume), less(found.pressure), memory, lost)
        return slopes, force[:r] - stiffness * more

    def _lost(self, stage: Stage, before: _Slopes, force: Array, stiffness: float) -> tuple[Array, Memories]:
        """Derivatives (r,) of what is lost beyond those before, and of the elements' memories (k, r).

        force (r,), stiffness : the force's derivatives with the lost held, and by what is lost [N/m]
        """
        model, elapsed_s, old = self._model, stage.elapsed_s, stage.history.lost
        force_n = model.problem.reaction(stage.residual) - model.zero_n
        drives = [one.drive for one in self._varied]

        def follow(slopes_n: Array) -> Memories:
            return memory_slopes(
                drives, EPSILON, force_n, slopes_n, elapsed_s, old, before.lost, stage.state.lost
            )

        softness = yielding(
            lambda n: model.drive.follow(n, elapsed_s, old), force_n, EPSILON * model.nominal_force()
        )
        held_m = np.asarray(sum(memory[0] for memory in before.lost))
        return lost_slopes(force - self._zero_n, held_m, softness, stiffness, follow)


def _varied(
    model: LagrangianModel, theta: Mapping[str, float], name: str, by: float, laws: Sequence[Bind],
    problem_at: ProblemAt,
) -> _Varied:  # fmt: skip
    """Raises InputError for a change that makes of a run another one."""
    values = {**theta, name: theta[name] + by}
    if name in LENGTHS:
        model = LagrangianModel(problem_at(values), model.material, model.protocol, model.laws)
    bound = tuple(sorted((bind(values, model.problem.sites) for bind in laws), key=lambda law: law.rank))
    drive = on_the_way(model.protocol, bound)
    if drive.starts_s != model.starts_s:
        raise InputError(f"gradients: {name}", theta[name], "pads that were opened before the test")
    return _Varied(model, material(values, model.problem.mesh.cutis), bound, drive)


def _rates(up: Sequence[Material], down: Sequence[Material]) -> tuple[Array, Array, Array]:
    """Derivatives of mu, lam and mobility by r parameters, (e, r) each, from materials at both sides."""

    def rate(of: Callable[[Material], Array]) -> Array:
        pairs = zip(up, down, strict=True)
        return np.stack([(of(high) - of(low)) / (2.0 * EPSILON) for high, low in pairs], axis=1)

    return rate(lambda m: m.mu), rate(lambda m: m.lam), rate(lambda m: m.mobility)


def _follows(
    model: LagrangianModel, theta: Mapping[str, float], changes: Mapping[str, float]
) -> Callable[[Array, float], Array] | None:
    """All derivatives (r,) from the force and those without E_c's; of a base model asked for its four."""
    if model.laws or not set(SCALING) <= set(changes):
        return None
    names = [name for name in changes if name != "E_c"]
    share = np.array([SCALING.get(name, 0.0) * theta[name] / changes[name] for name in names])
    place, scale = tuple(changes).index("E_c"), changes["E_c"] / theta["E_c"]
    return lambda force, force_n: np.insert(force, place, scale * (force_n - share @ force))


class _Differences:
    """Derivatives by r parameters at a stage's end, by differences of the residual; `Evaluated`'s fields.

    `before` has those of the stage's history, x (dofs, r) those of its unknowns; a last column beyond r is
    of the pads' travel, of which no history knows.
    """

    def __init__(
        self, model: LagrangianModel, varied: Sequence[_Varied], stage: Stage, before: _Slopes, x: Array
    ) -> None:
        self._base, self._columns = stage.state, []
        for r, column in enumerate(x.T):
            at, old, to = model, stage.history, (model.material, model.laws)
            if r < len(varied):
                one, old = varied[r], _moved(old, before, r)
                at, to = one.model, (one.material, one.laws)
            moved = self._base.x + EPSILON * column
            found = at.residual(moved, stage.length_s, old, stage.elapsed_s, to)
            if found is None:  # the cells were upright a moment ago, at the same unknowns to a millionth
                at_s = self._base.time_s
                raise FloatingPointError(f"no derivative at t = {at_s:.3f} s: a cell is all but flat")
            self._columns.append(found)
        self.residual = self._slope(lambda f: f.residual, stage.residual)

    @property
    def volume(self) -> Array:
        return self._slope(lambda f: f.volume, self._base.volume)

    @property
    def pressure(self) -> Array:
        return self._slope(lambda f: f.pressure, self._base.pressure)

    @property
    def memory(self) -> tuple[Array, ...]:
        return tuple(self._slope(lambda f, k=k: f.memory[k], m) for k, m in enumerate(self._base.memory))  # type: ignore[misc]

    def _slope(self, of: Callable[[Evaluated], Array], at: Array) -> Array:
        return np.stack([(of(found) - at) / EPSILON for found in self._columns], axis=-1)


def _moved(history: State, before: _Slopes, r: int) -> State:
    """A stage's history, EPSILON of parameter r's change further."""
    memory = zip(history.memory, before.memory, strict=True)
    return State(
        history.time_s,
        history.x,
        history.volume + EPSILON * before.volume[..., r],
        history.pressure + EPSILON * before.pressure[..., r],
        tuple(m + EPSILON * slope[..., r] for m, slope in memory),
    )


def _accelerated(tried: list[tuple[Array, Array]]) -> Array:
    """Anderson's step from the last of `tried`, column by column (SIAM J. Numer. Anal. 49, 2011, 1715)."""
    correction = tried[-1][1]
    if len(tried) == 1:
        return correction
    moves = np.stack([after[0] - before[0] for before, after in pairwise(tried)], axis=2)
    turns = np.stack([after[1] - before[1] for before, after in pairwise(tried)], axis=2)
    gram = np.einsum("nrk,nrl->rkl", turns, turns)
    size = np.trace(gram, axis1=1, axis2=2) + np.finfo(float).tiny  # 0 of what nothing depends on
    ridge = 1e-12 * size[:, None, None] * np.eye(gram.shape[1])
    gain = np.linalg.solve(gram + ridge, np.einsum("nrk,nr->rk", turns, correction)[:, :, None])[:, :, 0]
    return np.asarray(correction - np.einsum("nrk,rk->nr", moves + turns, gain))
