"""The total-Lagrangian model's equations: one implicit stage of a step in time, and what it needs.

A stage is one solve of J - J* ... = h* div(...) with a history J*, p* and a length h* that `stepping` gives
it. What lies in series with the skin is solved along (`series`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from bayeskin.finite_element import assembly, poroelastic
from bayeskin.finite_element.newton import Equations, NewtonSolver
from bayeskin.finite_element.problem import Material, Problem, nominal_force
from bayeskin.finite_element.series import Drive, Memories, SeriesSolver, Solved, on_the_way
from bayeskin.finite_element.tissue import SurfaceTerm, TissueLaw
from bayeskin.types import Array, PadMotion

SOLVER_TOLERANCE = 1e-4  # of the largest displacement and pressure, before the last correction


@dataclass(frozen=True)
class State:
    """Everything that the next step needs: x (dofs,), J and p (e, q) at the quadrature points.

    memory : (e q, m) of each law; lost : (k,) of each element in series with the skin
    """

    time_s: float
    x: Array
    volume: Array
    pressure: Array
    memory: tuple[Array, ...] = ()
    lost: Memories = ()


class Evaluated(NamedTuple):
    """The residual (dofs,) at some unknowns, with J and p (e, q) and each law's memory (e q, m) there."""

    residual: Array
    volume: Array
    pressure: Array
    memory: tuple[Array, ...]


@dataclass(frozen=True)
class Stage:
    """One solved implicit equation J - J* ... = h* div(...).

    state : its end; length_s : h*; elapsed_s : since the last of `sources`; history : with J*, p*, which are
    the weighted sum of `sources`; residual : (dofs,) at the end, zero to the solver's tolerance but for the
    reactions
    """

    state: State
    length_s: float
    elapsed_s: float
    history: State
    sources: tuple[tuple[float, State], ...]
    residual: Array


@dataclass(frozen=True)
class Step:
    """One accepted step: end state, force there [N], estimated local error [N], and how it was solved."""

    state: State
    force_n: float
    error_n: float
    corner: bool
    stages: tuple[Stage, ...] = ()


@dataclass
class LagrangianModel:
    """The equations of one run: a problem, a material and a protocol; knows nothing of step control.

    zero_n : the force when the test starts; what lies in series with the skin acts on the force beyond that
    drive : what `laws` leave of the protocol on its way to the pads
    """

    problem: Problem
    material: Material
    protocol: PadMotion
    laws: tuple[TissueLaw, ...] = ()
    solver: NewtonSolver = field(default_factory=NewtonSolver)
    zero_n: float = 0.0
    drive: Drive = field(init=False)
    full_residual: Array = field(init=False)

    def __post_init__(self) -> None:
        self.laws = tuple(sorted(self.laws, key=lambda law: law.rank))
        self.drive = on_the_way(self.protocol, self.laws)
        self._series = SeriesSolver(self.drive)
        self.full_residual = np.zeros(self.problem.space.dofs)
        shape = self.problem.space.weight.shape
        self._chunks = assembly.chunks(shape)
        self._data = np.empty(self.problem.pattern.size)  # overwritten by each tangent
        # the reaction's derivative (free,) by the free unknowns, at the last tangent
        self.pad_gradient = np.zeros(len(self.problem.pattern.free))
        self._measured = np.isin(self.problem.pattern.fixed, self.problem.measured_x).astype(float)
        self._travel: Array | None = None  # change of the unknowns a metre of the pads' travel

    @property
    def motion(self) -> PadMotion:
        """The protocol less what is lost whatever the force, from the opening of the pads on."""
        return self.drive.motion

    @property
    def starts_s(self) -> float:
        """When the test starts [s]."""
        return self.drive.starts_s

    def remember_travel(self, past: list[State]) -> None:
        """Keeps how the unknowns went with the pads, to guess how they set out again."""
        if len(past) < 2:
            return
        way_m = self._pad_of(past[-1]) - self._pad_of(past[-2])
        if abs(way_m) > 1e-3 * self.drive.largest_m:
            self._travel = (past[-1].x - past[-2].x) / way_m

    def _pad_of(self, state: State) -> float:
        """Displacement of the pads at that time [m]."""
        return float(state.x[3 * self.problem.pads[0]])

    def initial_state(self, p_init: float) -> State:
        space = self.problem.space
        x = np.zeros(space.dofs)
        x[3 * space.n_nodes :] = p_init
        shape = space.weight.shape
        memory = tuple(np.zeros((space.weight.size, law.remembers)) for law in self.laws)
        return State(0.0, x, np.ones(shape), np.full(shape, float(p_init)), memory, self.drive.at_rest)

    def residual(
        self,
        x: Array,
        h: float,
        old: State,
        elapsed_s: float | None = None,
        changed: tuple[Material, tuple[TissueLaw, ...]] | None = None,
    ) -> Evaluated | None:
        """Residual with a history `old` (memory: `elapsed_s` earlier, else h); None if a cell is inside out.

        `changed` takes the place of this model's material and laws.
        """
        s, (m, laws) = self.problem.space, changed or (self.material, self.laws)
        volume, pressure, out = np.empty(s.weight.shape), np.empty(s.weight.shape), np.zeros(s.dofs)
        elapsed_s = h if elapsed_s is None else elapsed_s
        memory = tuple(np.empty_like(before) for before in old.memory)
        for chunk in self._chunks:
            c, at, found = chunk.cells, chunk.at, chunk.found
            self._evaluate(x, chunk)
            pressure[c] = at.pressure
            smallest = poroelastic.respond(
                at.deformation, at.pressure, at.gradient, m.mu[c], m.lam[c], m.mobility[c], m.storage[c], h,
                old.volume[c], old.pressure[c], found.stress, found.content, found.flux, volume[c],
            )  # fmt: skip
            if not smallest > 0.0:
                return None
            for law, before, after in zip(laws, old.memory, memory, strict=True):
                if law.respond is not None:
                    n = chunk.points
                    law.respond(
                        self._since_start(old, elapsed_s), elapsed_s, law.par, law.data[n], *at.flat,
                        before[n], after[n], *found.flat,
                    )  # fmt: skip
            assembly.residual(
                s.n_nodes, s.nodes_u[c], s.nodes_p[c], s.grad_u[c], s.grad_p[c], s.value_p, s.weight[c],
                found.stress, found.content, found.flux, out,
            )  # fmt: skip
        for term in _surfaces(laws):
            out += _factor(term, h) * (self.problem.linear(term.unit).matrix @ x)
        return Evaluated(out, volume, pressure, memory) if np.isfinite(out).all() else None

    def tangent(
        self, x: Array, h: float, old: State, elapsed_s: float | None = None
    ) -> tuple[sp.csr_matrix, sp.csr_matrix]:
        """Derivative of the residual's free rows by the free and by the fixed unknowns."""
        s, m, data = self.problem.space, self.material, self._data
        elapsed_s = h if elapsed_s is None else elapsed_s
        data[:] = 0.0
        for chunk in self._chunks:
            c, at, by = chunk.cells, chunk.at, chunk.by
            self._evaluate(x, chunk)
            poroelastic.linearise(
                at.deformation, at.pressure, at.gradient, m.mu[c], m.lam[c], m.mobility[c],
                m.storage[c], h, old.pressure[c],
                by.stress_f, by.stress_p, by.content_f, by.content_p, by.flux_f, by.flux_g,
            )  # fmt: skip
            for law, before in zip(self.laws, old.memory, strict=True):
                if law.linearise is not None:
                    n = chunk.points
                    law.linearise(
                        self._since_start(old, elapsed_s), elapsed_s, law.par, law.data[n], *at.flat,
                        before[n], *by.flat,
                    )  # fmt: skip
            assembly.tangent(
                s.grad_u[c], s.grad_p[c], s.value_p, s.weight[c], by.stress_f, by.stress_p, by.content_f,
                by.content_p, by.flux_f, by.flux_g, self.problem.pattern.position[c], data,
            )  # fmt: skip
        for term in _surfaces(self.laws):
            linear = self.problem.linear(term.unit)
            np.add.at(data, linear.place, _factor(term, h) * linear.value)
        free_free, free_fixed = self.problem.pattern.matrices(data)
        self.pad_gradient = 2.0 * (free_fixed @ self._measured)
        return free_free, free_fixed

    def _evaluate(self, x: Array, chunk: assembly.Chunk) -> None:
        s, c, at = self.problem.space, chunk.cells, chunk.at
        assembly.evaluate(
            x, s.n_nodes, s.nodes_u[c], s.nodes_p[c], s.grad_u[c], s.grad_p[c], s.value_p,
            at.deformation, at.pressure, at.gradient,
        )  # fmt: skip

    def _since_start(self, old: State, elapsed_s: float) -> float:
        """Time of the test [s] when a solve ends that began at `old`; 0 before the test."""
        return max(old.time_s + elapsed_s - self.starts_s, 0.0)

    def equations(self, h: float, old: State, elapsed_s: float | None = None) -> Equations:
        s, m, pattern = self.problem.space, self.material, self.problem.pattern

        def residual(x: Array) -> Array | None:
            found = self.residual(x, h, old, elapsed_s)
            if found is None:
                return None
            self.full_residual, self._found = found.residual, found  # the last are at the solution
            return found.residual[pattern.free]

        n = 3 * s.n_nodes
        size_u = np.abs(self.problem_scale(old.x[:n]))
        size_p = max(float(np.abs(old.x[n:]).max()), 1e-3 * float(m.mu.min()))
        weight = np.concatenate([np.full(n, 1.0 / size_u), np.full(s.n_corners, 1.0 / size_p)])
        scale = np.where(np.arange(s.dofs) < n, 1.0, float(m.mu.max()) / self.problem.lengths.cutis_m)
        return Equations(
            pattern.free,
            residual,
            lambda x: self.tangent(x, h, old, elapsed_s),
            weight[pattern.free] / SOLVER_TOLERANCE,
            scale[pattern.free],
            np.array([np.log2(h), self.drive.pads_m(old.time_s, 0.0) / size_u]),
        )

    @cached_property
    def _drag(self) -> Array:
        """Viscous resistance (free,) of a falling body: the diagonal of the vector Laplacian, times mu."""
        s = self.problem.space
        drag, per_cell = np.zeros((s.n_nodes, 3)), np.einsum("eq,eqia->ea", s.weight, s.grad_u**2)
        np.add.at(drag, s.nodes_u, (self.material.mu[:, None] * per_cell)[..., None])
        return np.concatenate([drag.ravel(), np.zeros(s.n_corners)])[self.problem.pattern.free]

    def nominal_force(self) -> float:
        """Scale of the force [N] over the protocol."""
        return nominal_force(
            self.material, self.problem.mesh.cutis, self.problem.lengths, self.drive.largest_m
        )

    def problem_scale(self, u: Array) -> float:
        """Largest displacement of the protocol [m], against which a correction is small."""
        return max(self.drive.largest_m, float(np.abs(u).max()))

    def solve_stage(
        self,
        time_s: float,
        length_s: float,
        sources: tuple[tuple[float, State], ...],
        guess: Array,
        jump: bool,
        fall: bool = False,
    ) -> Stage | None:
        """Solves one implicit equation for time_s; `jump`: the guess knows nothing of the pads' motion.

        The last source's unknowns are where the pads have been. `fall`: solved for where the guess comes to
        rest, which may be far from it.
        """
        last = sources[-1][1]
        old = State(
            last.time_s,
            last.x,
            np.asarray(sum(weight * state.volume for weight, state in sources)),
            np.asarray(sum(weight * state.pressure for weight, state in sources)),
            last.memory,
            last.lost,
        )
        elapsed_s = time_s - old.time_s
        equations = self.equations(length_s, old, elapsed_s)

        def first(pad_m: float) -> Solved | None:
            return self._solve(equations, old, guess, pad_m, jump, fall)

        def again(near: Array, pad_m: float) -> Solved | None:
            return self._solve(equations, old, near, pad_m)

        known = self.drive.elements and not (jump or fall)
        expected_m = float(guess[3 * self.problem.pads[0]]) if known else None
        solved = self._series.solve(time_s, elapsed_s, old.lost, expected_m, first, again)
        if solved is None:
            return None
        (x, _), lost = solved
        state = State(time_s, x, self._found.volume, self._found.pressure, self._found.memory, lost)
        return Stage(state, length_s, elapsed_s, old, sources, self.full_residual)

    def _solve(
        self,
        equations: Equations,
        old: State,
        guess: Array,
        pad_m: float,
        jump: bool = False,
        fall: bool = False,
    ) -> Solved | None:
        """The unknowns with the pads at `pad_m`, and the force beyond that at the start; None if none."""
        target = self.problem.prescribe(guess, pad_m)
        x = None
        if fall:
            x = self.solver.relax(equations, target, self._drag)
        elif not jump:
            x = self.solver.solve(equations, target)
        elif self._travel is not None:
            ride = self._travel * (pad_m - self._pad_of(old))
            x = self.solver.solve(equations, self.problem.prescribe(guess + ride, pad_m))
        if x is None and jump:
            start = self.solver.respond(equations, guess, target, self.problem.pattern.fixed)
            x = None if start is None else self.solver.solve(equations, start)
        return None if x is None else (x, self.problem.reaction(self.full_residual) - self.zero_n)

    def finish(self, stages: tuple[Stage, ...], mass: Array) -> Step:
        """The step made of `stages`, with the local error `mass` (e, q) of the fluid mass."""
        force, last = self.problem.reaction(self.full_residual), stages[-1]
        error = self.force_of_mass_error(last, mass)
        return Step(last.state, force, error, corner=False, stages=stages)

    def force_of_mass_error(self, stage: Stage, mass: Array) -> float:
        """Change of the reaction [N] that an error of the fluid mass (e, q) makes, to first order."""
        s, free = self.problem.space, self.problem.pattern.free
        right = np.zeros(s.dofs)
        contribution = np.einsum("eq,qb->eb", s.weight * mass, s.value_p)
        np.subtract.at(right, 3 * s.n_nodes + s.nodes_p, contribution)
        moved = stage.state.x.copy()
        moved[free] += self.solver.back_substitute(right[free])
        found = self.residual(moved, stage.length_s, stage.history, stage.elapsed_s)
        if found is None:
            return np.inf
        before = self.problem.reaction(self.full_residual)
        return abs(self.problem.reaction(found.residual) - before)


def _surfaces(laws: Sequence[TissueLaw]) -> list[SurfaceTerm]:
    return [term for law in laws for term in law.surfaces]


def _factor(term: SurfaceTerm, h: float) -> float:
    """Factor of a term's unit matrix over a stage of length h."""
    return term.value * (h if term.per_second else 1.0)
