"""Defines the equations of the total-Lagrangian model and solves one implicit stage of a time step.

A stage is one solve of J - J* ... = h* div(...). `stepping` chooses its history J*, p* and its length h*. If
elements lie in series with the skin, the stage solves for them as well (`series`).
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

SOLVER_TOLERANCE = 1e-4  # relative to the largest displacement and pressure, before the last correction


@dataclass(frozen=True)
class State:
    """The state at one time, with everything that the next step needs.

    x (dofs,) : unknowns
    volume, pressure (e, q) : J and p at the quadrature points
    memory : memory (e q, m) of each law
    lost : memory (k,) of each element in series with the skin
    """

    time_s: float
    x: Array
    volume: Array
    pressure: Array
    memory: tuple[Array, ...] = ()
    lost: Memories = ()


class Evaluated(NamedTuple):
    """The residual (dofs,) at given unknowns, with J and p (e, q) and each law's memory (e q, m) there."""

    residual: Array
    volume: Array
    pressure: Array
    memory: tuple[Array, ...]


@dataclass(frozen=True)
class Stage:
    """One solved implicit equation J - J* ... = h* div(...).

    state : state at the end of the stage
    length_s : h*
    elapsed_s : time since the last of `sources`
    history : state with J* and p*, which are weighted sums over `sources`
    sources : pairs of a weight and an earlier state
    residual (dofs,) : residual at the end; within the solver's tolerance it is zero except for the reactions
    """

    state: State
    length_s: float
    elapsed_s: float
    history: State
    sources: tuple[tuple[float, State], ...]
    residual: Array


@dataclass(frozen=True)
class Step:
    """One accepted step: its end state, the force there [N], the estimated local error [N], and its stages.

    corner : True if the step ends at a corner of the protocol
    """

    state: State
    force_n: float
    error_n: float
    corner: bool
    stages: tuple[Stage, ...] = ()


@dataclass
class LagrangianModel:
    """The equations of one run with a problem, a material, a protocol and laws, without step control.

    zero_n : force at the start of the test; elements in series with the skin respond to the force beyond it
    drive : the protocol after the laws that change it on its way to the pads
    full_residual (dofs,) : residual at the last evaluation by the solver; after a solve it is the residual at
        the solution
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
        self.series_solver = SeriesSolver(self.drive)
        self.full_residual = np.zeros(self.problem.space.dofs)
        shape = self.problem.space.weight.shape
        self._chunks = assembly.chunks(shape)
        self._data = np.empty(self.problem.pattern.size)  # each tangent overwrites it
        # derivative (free,) of the reaction with respect to the free unknowns, at the last tangent
        self.pad_gradient = np.zeros(len(self.problem.pattern.free))
        self._measured = np.isin(self.problem.pattern.fixed, self.problem.measured_x).astype(float)
        self._travel: Array | None = None  # change of the unknowns for a metre of the pads' travel

    @property
    def motion(self) -> PadMotion:
        """Returns the protocol from the opening of the pads on.

        Displacement that is lost independently of the force is already subtracted.
        """
        return self.drive.motion

    @property
    def starts_s(self) -> float:
        """Returns the time at which the test starts [s]."""
        return self.drive.starts_s

    def remember_travel(self, past: list[State]) -> None:
        """Stores how the unknowns change with the pads' travel.

        The next phase starts with a guess from this.

        past : states of the phase that ends
        """
        if len(past) < 2:
            return
        way_m = self.pad_displacement_m(past[-1]) - self.pad_displacement_m(past[-2])
        if abs(way_m) > 1e-3 * self.drive.largest_m:
            self._travel = (past[-1].x - past[-2].x) / way_m

    def pad_displacement_m(self, state: State) -> float:
        """Returns the displacement of the pads in a state [m]."""
        return float(state.x[3 * self.problem.pads[0]])

    def initial_state(self, p_init: float) -> State:
        """Returns the state of rest with the interstitial pressure p_init [Pa]."""
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
        """Returns the residual and what comes with it, or None if a cell is inside out.

        x (dofs,) : unknowns
        h : length of the stage [s]
        old : history with J* and p*; its memory is `elapsed_s` old, or h if that is None
        changed : material and laws to use instead of the model's own
        """
        s, (m, laws) = self.problem.space, changed or (self.material, self.laws)
        volume, pressure, out = np.empty(s.weight.shape), np.empty(s.weight.shape), np.zeros(s.dofs)
        elapsed_s = h if elapsed_s is None else elapsed_s
        memory = tuple(np.empty_like(before) for before in old.memory)
        for chunk in self._chunks:
            c, at, response = chunk.cells, chunk.at, chunk.found
            self._evaluate(x, chunk)
            pressure[c] = at.pressure
            smallest = poroelastic.respond(
                at.deformation, at.pressure, at.gradient, m.mu[c], m.lam[c], m.mobility[c], m.storage[c], h,
                old.volume[c], old.pressure[c], response.stress, response.content, response.flux, volume[c],
            )  # fmt: skip
            if not smallest > 0.0:
                return None
            for law, before, after in zip(laws, old.memory, memory, strict=True):
                if law.respond is not None:
                    n = chunk.points
                    law.respond(
                        self._since_start(old, elapsed_s), elapsed_s, law.par, law.data[n], *at.flat,
                        before[n], after[n], *response.flat,
                    )  # fmt: skip
            assembly.residual(
                s.n_nodes, s.nodes_u[c], s.nodes_p[c], s.grad_u[c], s.grad_p[c], s.value_p, s.weight[c],
                response.stress, response.content, response.flux, out,
            )  # fmt: skip
        for term in _surface_terms(laws):
            out += _term_factor(term, h) * (self.problem.linear(term.unit).matrix @ x)
        return Evaluated(out, volume, pressure, memory) if np.isfinite(out).all() else None

    def tangent(
        self, x: Array, h: float, old: State, elapsed_s: float | None = None
    ) -> tuple[sp.csr_matrix, sp.csr_matrix]:
        """Returns the tangent: the derivatives of the residual's free rows.

        The first matrix holds the derivatives with respect to the free unknowns, the second those with
        respect to the fixed ones. The arguments are those of `residual`.
        """
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
        for term in _surface_terms(self.laws):
            linear = self.problem.linear(term.unit)
            np.add.at(data, linear.place, _term_factor(term, h) * linear.value)
        free_free, free_fixed = self.problem.pattern.matrices(data)
        self.pad_gradient = 2.0 * (free_fixed @ self._measured)
        return free_free, free_fixed

    def _evaluate(self, x: Array, chunk: assembly.Chunk) -> None:
        """Fills F, p and grad p of a chunk from the unknowns."""
        s, c, at = self.problem.space, chunk.cells, chunk.at
        assembly.evaluate(
            x, s.n_nodes, s.nodes_u[c], s.nodes_p[c], s.grad_u[c], s.grad_p[c], s.value_p,
            at.deformation, at.pressure, at.gradient,
        )  # fmt: skip

    def _since_start(self, old: State, elapsed_s: float) -> float:
        """Returns the time of the test [s] when a solve ends that starts from `old`; 0 before the test."""
        return max(old.time_s + elapsed_s - self.starts_s, 0.0)

    def equations(self, h: float, old: State, elapsed_s: float | None = None) -> Equations:
        """Returns the equations of one stage; the arguments are those of `residual`."""
        s, m, pattern = self.problem.space, self.material, self.problem.pattern

        def residual(x: Array) -> Array | None:
            evaluated = self.residual(x, h, old, elapsed_s)
            if evaluated is None:
                return None
            # the solver's last evaluation is at the solution
            self.full_residual, self._found = evaluated.residual, evaluated
            return evaluated.residual[pattern.free]

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
        """Returns the viscous resistance (free,) of a body that snaps from one equilibrium to another.

        It is the diagonal of the vector Laplacian, times mu.
        """
        s = self.problem.space
        drag, per_cell = np.zeros((s.n_nodes, 3)), np.einsum("eq,eqia->ea", s.weight, s.grad_u**2)
        np.add.at(drag, s.nodes_u, (self.material.mu[:, None] * per_cell)[..., None])
        return np.concatenate([drag.ravel(), np.zeros(s.n_corners)])[self.problem.pattern.free]

    def nominal_force(self) -> float:
        """Returns a scale of the force [N] over the protocol."""
        return nominal_force(
            self.material, self.problem.mesh.cutis, self.problem.lengths, self.drive.largest_m
        )

    def problem_scale(self, u: Array) -> float:
        """Returns a scale of the displacements [m], with which the solver's corrections are compared.

        It is the largest displacement of a pad in the protocol, or the largest component of u if that is
        larger.
        """
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
        """Solves one implicit equation for the state at time_s; returns None if there is no convergence.

        length_s : h*, the length of the stage
        sources : weights and earlier states, whose weighted sums are J* and p*; the last gives the position
            of the pads before the stage
        guess : starting point (dofs,)
        jump : True if the guess does not include the pads' motion during the stage
        fall : True to follow the body from the guess to where it comes to rest, which may be far away
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
        solved = self.series_solver.solve(time_s, elapsed_s, old.lost, expected_m, first, again)
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
        """Returns the unknowns and the force [N] with the pads at `pad_m`, or None without convergence.

        The force is relative to the force at the start of the test.
        """
        target = self.problem.prescribe(guess, pad_m)
        x = None
        if fall:
            x = self.solver.relax(equations, target, self._drag)
        elif not jump:
            x = self.solver.solve(equations, target)
        elif self._travel is not None:
            ride = self._travel * (pad_m - self.pad_displacement_m(old))
            x = self.solver.solve(equations, self.problem.prescribe(guess + ride, pad_m))
        if x is None and jump:
            start = self.solver.respond(equations, guess, target, self.problem.pattern.fixed)
            x = None if start is None else self.solver.solve(equations, start)
        return None if x is None else (x, self.problem.reaction(self.full_residual) - self.zero_n)

    def finish(self, stages: tuple[Stage, ...], mass: Array) -> Step:
        """Returns the step made of `stages`, with the error of its force.

        mass (e, q) : local error of the fluid mass
        """
        force, last = self.problem.reaction(self.full_residual), stages[-1]
        error = self.force_of_mass_error(last, mass)
        return Step(last.state, force, error, corner=False, stages=stages)

    def force_of_mass_error(self, stage: Stage, mass: Array) -> float:
        """Returns the change of the reaction [N] due to an error of the fluid mass (e, q), to first order."""
        s, free = self.problem.space, self.problem.pattern.free
        right = np.zeros(s.dofs)
        contribution = np.einsum("eq,qb->eb", s.weight * mass, s.value_p)
        np.subtract.at(right, 3 * s.n_nodes + s.nodes_p, contribution)
        moved = stage.state.x.copy()
        moved[free] += self.solver.back_substitute(right[free])
        evaluated = self.residual(moved, stage.length_s, stage.history, stage.elapsed_s)
        if evaluated is None:
            return np.inf
        before = self.problem.reaction(self.full_residual)
        return abs(self.problem.reaction(evaluated.residual) - before)


def _surface_terms(laws: Sequence[TissueLaw]) -> list[SurfaceTerm]:
    """Returns the surface terms of all laws."""
    return [term for law in laws for term in law.surfaces]


def _term_factor(term: SurfaceTerm, h: float) -> float:
    """Returns the factor of a surface term's unit matrix in a stage of length h [s]."""
    return term.value * (h if term.per_second else 1.0)
