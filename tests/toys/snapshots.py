"""Modes of one full run, for a reduced model that holds them all."""

from __future__ import annotations

from collections.abc import Sequence

import scipy.sparse as sp

from bayeskin.finite_element.lagrangian import LagrangianModel
from bayeskin.finite_element.problem import Problem, material
from bayeskin.finite_element.tissue import Bind
from bayeskin.mechanisms import catalogue, laws
from bayeskin.reduced.basis import Inner, pod
from bayeskin.reduced.cases import Case
from bayeskin.reduced.library import Modes, scaled_basis
from bayeskin.reduced.operators import Basis
from bayeskin.reduced.training import training_run
from bayeskin.types import Array

KEPT = 1e-6  # modes with singular values below this share of the largest are left out


def binds_of(names: Sequence[str]) -> list[Bind]:
    """The laws of mechanisms by their names."""
    return laws([catalogue()[name] for name in names])


def full_model(problem: Problem, case: Case) -> LagrangianModel:
    """The full model of a case."""
    bound = tuple(bind(case.theta, problem.sites) for bind in binds_of(case.mechanisms))
    return LagrangianModel(problem, material(case.theta, problem.mesh.cutis), case.motion, bound)


def snapshot_basis(problem: Problem, inner: Inner, case: Case) -> Basis:
    """The modes of one full run: its states and adjoint solutions."""
    run = training_run(problem, inner, case, binds_of(case.mechanisms))
    assert run.message == ""
    u, p = _modes(run.displacement, inner.displacement), _modes(run.pressure, inner.pressure)
    return scaled_basis(Modes(u, p), inner)


def _modes(rows: Array, inner: sp.csr_matrix) -> Array:
    values, modes = pod(rows.astype(float), inner)
    return modes[values > KEPT * values[0]]
