"""Derivatives of the force history by the logarithms of the parameters, from the kept factorisations.

Differentiating a solved stage R(x, J*, p*; theta) = 0 gives K dx = -dR/dtheta - dR/d(J*, p*) d(J*, p*),
with the stage's own tangent K. For a guess v of dx the right-hand side less K v is the residual's derivative

    -r = [R(x + eps v, J* + eps dJ*, p* + eps dp*; theta + eps) - R(x, J*, p*; theta)] / eps

so that no tangent is formed: of the base model r is found exactly and for all parameters at once
(`directional`), with laws beyond it from two residuals a parameter. The guess combines the stages before as
their unknowns best combine to those of this one, and is corrected by back-substitutions of r with the kept
factorisation M nearest to the stage.

The reaction's derivative is that of the same residual on the pad's rows. A correction would add g M^-1 r to
it, with the reaction's derivative g by the unknowns; as M is symmetric, M^-1 g tells so before it is made.
What is small enough is added and no correction made, so that the force's error is the product of the errors
of v and of the factorisation.

Forces scale with stresses: were the fluid incompressible, F(c E_c, c E_s, k_c / c, k_s / c) = c F. Of the
base model three derivatives are therefore solved for and E_c's follows, to 3e-7 of the largest one
(docs/verification.md).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from bayeskin.model.directional import TangentAction
from bayeskin.model.lagrangian import Evaluated, LagrangianModel, Stage, State, Step
from bayeskin.model.newton import Equations
from bayeskin.model.problem import Material, material
from bayeskin.model.tissue import Bind, TissueLaw
from bayeskin.types import Array

DIFFERENTIATED = ("E_c", "E_s", "k_c", "k_s")
SCALING = np.array([1.0, 1.0, -1.0, -1.0])  # F = SCALING @ dF/dlog(theta), of the base model
EPSILON = 1e-5  # of a logarithm: truncation 1e-5, rounding 1e-9
TOLERANCE = 1e-4  # of what a correction would add to the force, relative to the nominal force
UNCORRECTED = 0.05  # times that for a bare guess, whose error adds up from stage to stage
MOST_CORRECTIONS = 12
ANDERSON_DEPTH = 4
GUESS_POINTS = 4
DUALS = 10  # kept


@dataclass(frozen=True)
class _Slopes:
    """Derivatives of a `State` by r logarithms: x (dofs, r), J and p (e, q, r), memories (e, q, k, r)."""

    state: State
    x: Array
    volume: Array
    pressure: Array
    memory: tuple[Array, ...]


class ForceGradients:
    """Follows a run, step by accepted step; `force_n` then holds the derivatives of each step's force."""

    def __init__(self, model: LagrangianModel, theta: Mapping[str, float], laws: Sequence[Bind] = ()) -> None:
        self._model = model
        names = DIFFERENTIATED if model.laws else DIFFERENTIATED[1:]  # E_c's follows
        self._changed = [_changed(model, theta, name, EPSILON, laws) for name in names]
        back = [_changed(model, theta, name, -EPSILON, laws) for name in names]
        self._rates = _rates([m for m, _ in self._changed], [m for m, _ in back])
        r, shape = len(names), model.problem.space.weight.shape
        zeros = np.zeros((*shape, r))
        memory = tuple(np.zeros((*shape, law.remembers, r)) for law in model.laws)
        rest = model.initial_state(theta["p_init"])
        self._start = _Slopes(rest, np.zeros((len(rest.x), r)), zeros, zeros, memory)
        self._known: dict[int, _Slopes] = {}  # by identity of the state, which they keep alive
        self._phase: list[_Slopes] = [self._start]  # ends of this phase's stages
        self._travel: Array | None = None
        self._duals: dict[int, tuple[Array, Array]] = {}  # by identity of the place, which they keep alive
        self.force_n: list[Array] = [np.zeros(len(DIFFERENTIATED))]
        self.corrections, self.seconds = 0, 0.0

    def follow(self, step: Step) -> None:
        """Differentiates an accepted step; appends dF/dlog(theta) [N], (4,), to `force_n`."""
        started = time.perf_counter()
        for stage in step.stages:
            slopes, force = self._differentiate(stage)
            self._known[id(stage.state)] = slopes
            self._phase.append(slopes)
        self.force_n.append(force if self._model.laws else _with_scaled(force, step.force_n))
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
        return self._model.pad_displacement(end.time_s) - self._model.pad_displacement(start.time_s)

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
        model, solver, free = self._model, self._model.solver, self._model.problem.pattern.free
        action = self._action(stage)
        equations = model.equations(stage.length_s, stage.history, stage.elapsed_s)
        dual = self._dual(solver.toward(equations.place))
        weight, allowed_n = equations.weight[:, None], TOLERANCE * model.nominal_force()
        x = self._guess(stage.state, equations)
        x[model.problem.pattern.fixed] = 0.0
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
        force = 2.0 * found.residual[model.problem.pad_x].sum(axis=0) + missing_n
        return _Slopes(stage.state, x, found.volume, found.pressure, found.memory), force

    def _dual(self, place: Array) -> Array:
        """M^-1 g (free,) with the factorisation M that was made at `place`, solved for once."""
        known = self._duals.get(id(place))
        if known is None:
            known = place, self._model.solver.back_substitute(self._model.pad_gradient)
            self._duals = dict([*self._duals.items(), (id(place), known)][-DUALS:])
        return known[1]

    def _action(self, stage: Stage) -> Callable[[Array], Evaluated]:
        """Derivatives of all that is `Evaluated` at the stage's end, from those of the unknowns there."""
        sources = [(weight, self._of(state)) for weight, state in stage.sources]
        volume_old = np.asarray(sum(weight * slopes.volume for weight, slopes in sources))
        pressure_old = np.asarray(sum(weight * slopes.pressure for weight, slopes in sources))
        if not self._model.laws:
            return TangentAction(self._model, stage, self._rates, volume_old, pressure_old)
        last = sources[-1][1]
        before = _Slopes(last.state, last.x, volume_old, pressure_old, last.memory)
        return lambda x: _differences(self._model, self._changed, stage, before, x)


_Changed = tuple[Material, tuple[TissueLaw, ...]]


def _changed(
    model: LagrangianModel, theta: Mapping[str, float], name: str, by: float, laws: Sequence[Bind]
) -> _Changed:
    """The model's material and laws with one parameter's logarithm changed."""
    values = {**theta, name: theta[name] * np.exp(by)}
    bound = sorted((bind(values, model.problem) for bind in laws), key=lambda law: law.rank)
    return material(values, model.problem.mesh.cutis), tuple(bound)


def _rates(up: Sequence[Material], down: Sequence[Material]) -> tuple[Array, Array, Array]:
    """Derivatives of mu, lam and mobility by r logarithms, (e, r) each, from materials at both sides."""

    def rate(of: Callable[[Material], Array]) -> Array:
        pairs = zip(up, down, strict=True)
        return np.stack([(of(high) - of(low)) / (2.0 * EPSILON) for high, low in pairs], axis=1)

    return rate(lambda m: m.mu), rate(lambda m: m.lam), rate(lambda m: m.mobility)


def _with_scaled(force: Array, force_n: float) -> Array:
    """All four of the base model's derivatives [N], from the last three and the force."""
    return np.concatenate([[(force_n - SCALING[1:] @ force) / SCALING[0]], force])


def _differences(
    model: LagrangianModel, changed: Sequence[_Changed], stage: Stage, before: _Slopes, x: Array
) -> Evaluated:
    """Derivatives by r logarithms at the stage's end, by differences of the residual.

    `before` has those of the stage's history, x (dofs, r) are those of its unknowns.
    """
    base, history, columns = stage.state, stage.history, []
    for r, to in enumerate(changed):
        old = State(
            history.time_s,
            history.x,
            history.volume + EPSILON * before.volume[..., r],
            history.pressure + EPSILON * before.pressure[..., r],
            tuple(m + EPSILON * d[..., r] for m, d in zip(history.memory, before.memory, strict=True)),
        )
        found = model.residual(base.x + EPSILON * x[:, r], stage.length_s, old, stage.elapsed_s, to)
        if found is None:  # the cells were upright a moment ago, at the same unknowns to a millionth
            raise FloatingPointError(f"no derivative at t = {base.time_s:.3f} s: a cell is all but flat")
        columns.append(found)

    def slope(of: Callable[[Evaluated], Array], at: Array) -> Array:
        return np.stack([(of(found) - at) / EPSILON for found in columns], axis=-1)

    memory = tuple(slope(lambda f, k=k: f.memory[k], m) for k, m in enumerate(base.memory))  # type: ignore[misc]
    return Evaluated(
        slope(lambda f: f.residual, stage.residual),
        slope(lambda f: f.volume, base.volume),
        slope(lambda f: f.pressure, base.pressure),
        memory,
    )


def _accelerated(tried: list[tuple[Array, Array]]) -> Array:
    """Anderson's step from the last of `tried`, column by column (SIAM J. Numer. Anal. 49, 2011, 1715)."""
    correction = tried[-1][1]
    if len(tried) == 1:
        return correction
    moves = np.stack([after[0] - before[0] for before, after in pairwise(tried)], axis=2)
    turns = np.stack([after[1] - before[1] for before, after in pairwise(tried)], axis=2)
    gram = np.einsum("nrk,nrl->rkl", turns, turns)
    ridge = 1e-12 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(gram.shape[1])
    gain = np.linalg.solve(gram + ridge, np.einsum("nrk,nr->rk", turns, correction)[:, :, None])[:, :, 0]
    return np.asarray(correction - np.einsum("nrk,rk->nr", moves + turns, gain))
