"""Solves one implicit stage of a time step of the total-Lagrangian model.

A stage is one solve of the balances (`balances`). If elements lie in series with the skin, the stage solves
for them as well (`series`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from bayeskin.finite_element.balances import Balances
from bayeskin.finite_element.newton import SOLVER_TOLERANCE, Equations, NewtonSolver
from bayeskin.finite_element.problem import nominal_force
from bayeskin.finite_element.relaxation import relax
from bayeskin.finite_element.series import SeriesSolver, Solved
from bayeskin.finite_element.stages import Stage, State, Step
from bayeskin.types import Array


@dataclass
class LagrangianModel(Balances):
    """The balances of one run with a solver of its stages, without step control.

    zero_n : force at the start of the test; elements in series with the skin respond to the force beyond it
    full_residual (dofs,) : residual at the last evaluation by the solver; after a solve it is the residual at
        the solution
    """

    solver: NewtonSolver = field(default_factory=NewtonSolver)
    zero_n: float = 0.0
    full_residual: Array = field(init=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.series_solver = SeriesSolver(self.drive)
        self.full_residual = np.zeros(self.problem.space.dofs)
        self._travel: Array | None = None  # change of the unknowns for a metre of the pads' travel

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
            x = relax(self.solver, equations, target, self._drag)
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
