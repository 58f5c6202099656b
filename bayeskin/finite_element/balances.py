"""Defines the total-Lagrangian balances of momentum and of fluid mass over one stage of a time step.

Over a stage they are J - J* ... = h* div(...). `stepping` chooses the stage's history J*, p* and its length
h*. The response at the quadrature points is that of the base law (`poroelastic`), which further laws change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from bayeskin.finite_element import assembly, poroelastic
from bayeskin.finite_element.problem import Material, Problem
from bayeskin.finite_element.series import Drive, on_the_way
from bayeskin.finite_element.stages import State
from bayeskin.finite_element.tissue import SurfaceTerm, TissueLaw
from bayeskin.types import Array, PadMotion


class Evaluated(NamedTuple):
    """The residual (dofs,) at given unknowns, with J and p (e, q) and each law's memory (e q, m) there."""

    residual: Array
    volume: Array
    pressure: Array
    memory: tuple[Array, ...]


@dataclass
class Balances:
    """The balances of one run, with a problem, a material, a protocol and laws.

    drive : the protocol after the laws that change it on its way to the pads
    pad_gradient (free,) : derivative of the reaction with respect to the free unknowns, at the last tangent
    """

    problem: Problem
    material: Material
    protocol: PadMotion
    laws: tuple[TissueLaw, ...] = ()
    drive: Drive = field(init=False)
    pad_gradient: Array = field(init=False)

    def __post_init__(self) -> None:
        self.laws = tuple(sorted(self.laws, key=lambda law: law.rank))
        self.drive = on_the_way(self.protocol, self.laws)
        self.pad_gradient = np.zeros(len(self.problem.pattern.free))
        self._chunks = assembly.chunks(self.problem.space.weight.shape)
        self._data = np.empty(self.problem.pattern.size)  # each tangent overwrites it
        self._measured = np.isin(self.problem.pattern.fixed, self.problem.measured_x).astype(float)

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
            c, at, response = chunk.cells, chunk.at, chunk.response
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


def _surface_terms(laws: Sequence[TissueLaw]) -> list[SurfaceTerm]:
    """Returns the surface terms of all laws."""
    return [term for law in laws for term in law.surfaces]


def _term_factor(term: SurfaceTerm, h: float) -> float:
    """Returns the factor of a surface term's unit matrix in a stage of length h [s]."""
    return term.value * (h if term.per_second else 1.0)
