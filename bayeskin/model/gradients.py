"""Derivatives of the force history by the logarithms of the parameters, from the kept factorisations.

Differentiating a solved stage R(x, J*, p*; theta) = 0 gives K dx = -dR/dtheta - dR/d(J*, p*) d(J*, p*),
with the stage's own tangent K. The right-hand side less K v, for a guess v of dx, is one directional
derivative of the residual,

    r = -[R(x + eps v, J* + eps dJ*, p* + eps dp*; theta + eps) - R(x, J*, p*; theta)] / eps

so that no tangent is formed: v comes from the stages before (as x itself is guessed) and is corrected by
back-substitutions of r with the kept factorisation nearest to the stage. The reaction's derivative is that
of the same residual on the pad's rows; what the last correction adds to it counts to first order, so its
error is the product of the errors of v and of the factorisation.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from bayeskin.model.lagrangian import LagrangianModel, Stage, State, Step
from bayeskin.model.newton import EXTRAPOLATION_POINTS, extrapolate
from bayeskin.model.problem import Material, material
from bayeskin.model.tissue import Bind, TissueLaw
from bayeskin.types import Array

DIFFERENTIATED = ("E_c", "E_s", "k_c", "k_s")
EPSILON = 1e-5  # of a logarithm: truncation 1e-5, rounding 1e-9
TOLERANCE = 3e-3  # of the last correction, relative to the derivative of the unknowns
MOST_CORRECTIONS = 12
ANDERSON_DEPTH = 4


@dataclass(frozen=True)
class _Slopes:
    """Derivatives of a `State` by r logarithms: x (dofs, r), J and p (r, e, q), memories (r, e, q, k)."""

    time_s: float
    x: Array
    volume: Array
    pressure: Array
    memory: tuple[Array, ...]


class ForceGradients:
    """Follows a run, step by accepted step; `force_n` then holds the derivatives of each step's force."""

    def __init__(self, model: LagrangianModel, theta: Mapping[str, float], laws: Sequence[Bind] = ()) -> None:
        self._model = model
        self._changed = [
            _changed(model, {**theta, name: theta[name] * np.exp(EPSILON)}, laws) for name in DIFFERENTIATED
        ]
        r, shape = len(DIFFERENTIATED), model.problem.space.weight.shape
        zeros = np.zeros((r, *shape))
        memory = tuple(np.zeros((r, *shape, law.remembers)) for law in model.laws)
        self._start = _Slopes(0.0, np.zeros((model.problem.space.dofs, r)), zeros, zeros, memory)
        self._known: dict[int, tuple[State, _Slopes]] = {}  # by identity; the state keeps its number alive
        self._phase: list[_Slopes] = [self._start]  # ends of this phase's stages
        self._travel: Array | None = None
        self.force_n: list[Array] = [np.zeros(r)]
        self.corrections, self.seconds = 0, 0.0

    def follow(self, step: Step) -> None:
        """Differentiates an accepted step; appends dF/dlog(theta) [N], (r,), to `force_n`."""
        started = time.perf_counter()
        for stage in step.stages:
            slopes, force = self._differentiate(stage)
            self._known[id(stage.state)] = stage.state, slopes
            self._phase.append(slopes)
        self.force_n.append(force)
        self._known = dict(list(self._known.items())[-2 * EXTRAPOLATION_POINTS :])
        if step.corner:
            self._turn(step)
        self.seconds += time.perf_counter() - started

    def _turn(self, step: Step) -> None:
        """At a corner: how the slopes went with the pads, to guess how they set out again."""
        start, end = self._phase[-2:]
        way_m = self._model.pad_displacement(end.time_s) - self._model.pad_displacement(start.time_s)
        if abs(way_m) > 0.0:
            self._travel = (end.x - start.x) / way_m
        self._phase = [end]

    def _of(self, state: State) -> _Slopes:
        known = self._known.get(id(state))
        return known[1] if known else self._start

    def _guess(self, stage: Stage) -> Array:
        time_s, past = stage.state.time_s, [(slopes.time_s, slopes.x) for slopes in self._phase]
        if len(past) > 1 or self._travel is None:
            return extrapolate(past, time_s)
        way_m = self._model.pad_displacement(time_s) - self._model.pad_displacement(past[0][0])
        return past[0][1] + self._travel * way_m

    def _differentiate(self, stage: Stage) -> tuple[_Slopes, Array]:
        model, free = self._model, self._model.problem.pattern.free
        sources = [(weight, self._of(state)) for weight, state in stage.sources]
        volume_old = np.asarray(sum(weight * slopes.volume for weight, slopes in sources))
        pressure_old = np.asarray(sum(weight * slopes.pressure for weight, slopes in sources))
        memory_old = sources[-1][1].memory
        equations = model.equations(stage.length_s, stage.history, stage.elapsed_s)
        model.solver.toward(equations.place)
        weight = equations.weight[:, None]
        x = self._guess(stage)
        x[model.problem.pattern.fixed] = 0.0
        tried: list[tuple[Array, Array]] = []  # unknowns and the corrections that they asked for
        for _ in range(MOST_CORRECTIONS):
            along = _Slopes(stage.history.time_s, x, volume_old, pressure_old, memory_old)
            residual, volume, pressure, memory = self._directional(stage, along)
            correction = -model.solver.back_substitute(residual[free])
            tried = [*tried, (x[free] * weight, correction * weight)][-ANDERSON_DEPTH:]
            change = _accelerated(tried) / weight
            x[free] += change
            self.corrections += 1
            if np.all(
                np.abs(change * weight).max(axis=0) <= TOLERANCE * np.abs(x[free] * weight).max(axis=0)
            ):
                break
        force = 2.0 * residual[model.problem.pad_x].sum(axis=0) + model.pad_gradient @ change
        return _Slopes(stage.state.time_s, x, volume, pressure, memory), force

    def _directional(self, stage: Stage, along: _Slopes) -> tuple[Array, Array, Array, tuple[Array, ...]]:
        """Derivatives of the residual (dofs, r), J, p and memories at the stage's end.

        `along` has those of its unknowns and of its history.
        """
        model, base, history = self._model, stage.state, stage.history
        residuals, volumes, pressures, memories = [], [], [], []
        for r, changed in enumerate(self._changed):
            old = State(
                history.time_s,
                history.x,
                history.volume + EPSILON * along.volume[r],
                history.pressure + EPSILON * along.pressure[r],
                tuple(m + EPSILON * d[r] for m, d in zip(history.memory, along.memory, strict=True)),
            )
            x = base.x + EPSILON * along.x[:, r]
            found = model.residual(x, stage.length_s, old, stage.elapsed_s, changed)
            if found is None:  # the cells were upright a moment ago, at the same unknowns to a millionth
                raise FloatingPointError(f"no derivative at t = {base.time_s:.3f} s: a cell is all but flat")
            residuals.append((found.residual - stage.residual) / EPSILON)
            volumes.append((found.volume - base.volume) / EPSILON)
            pressures.append((found.pressure - base.pressure) / EPSILON)
            memories.append([(m - b) / EPSILON for m, b in zip(found.memory, base.memory, strict=True)])
        memory = tuple(np.stack(rows) for rows in zip(*memories, strict=True))
        return np.stack(residuals, axis=1), np.stack(volumes), np.stack(pressures), memory


def _changed(
    model: LagrangianModel, theta: Mapping[str, float], laws: Sequence[Bind]
) -> tuple[Material, tuple[TissueLaw, ...]]:
    """The model's material and laws at other parameters."""
    bound = sorted((bind(theta, model.problem) for bind in laws), key=lambda law: law.rank)
    return material(theta, model.problem.mesh.cutis), tuple(bound)


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
