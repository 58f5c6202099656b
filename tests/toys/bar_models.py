"""Finite-element models of a bar of one material, of bricks or of tetrahedra."""

from __future__ import annotations

import numpy as np
import skfem

from bayeskin.finite_element.lagrangian import LagrangianModel
from bayeskin.finite_element.mesh import SkinMesh
from bayeskin.finite_element.problem import Material, Problem
from bayeskin.finite_element.space import sparsity, taylor_hood
from bayeskin.types import PadMotion

STILL = PadMotion(np.array([0.0, 1.0]), np.zeros(2))
YOUNG, NU = 2e4, 0.3
MU, LAM = YOUNG / (2 * (1 + NU)), YOUNG * NU / ((1 + NU) * (1 - 2 * NU))


def bar(kind: str, cells: int = 3, width: float = 1.0, distort: float = 0.0) -> SkinMesh:
    """A bar of unit length along x: bricks or tetrahedra, inner vertices moved at random if asked."""
    lines = [np.linspace(0, 1, cells + 1), np.linspace(0, width, 3), np.linspace(0, width, 3)]
    flat = skfem.MeshHex.init_tensor(*lines)
    if distort:
        rng = np.random.default_rng(3)
        low, high = flat.p.min(axis=1, keepdims=True), flat.p.max(axis=1, keepdims=True)
        inner = np.all((flat.p > low + 1e-9) & (flat.p < high - 1e-9), axis=0)
        moved = flat.p + distort * rng.uniform(-1, 1, flat.p.shape) * inner
        flat = skfem.MeshHex(moved, flat.t)
    mesh = skfem.MeshHex2.from_mesh(flat) if kind == "bricks" else flat.to_meshtet()
    return SkinMesh(mesh, {}, np.zeros(mesh.nelements, bool), kind)


def model(mesh: SkinMesh, fixed: np.ndarray, pad: np.ndarray, permeability: float = 1e-12) -> LagrangianModel:
    space = taylor_hood(mesh)
    n = len(mesh.cutis)
    material = Material(np.full(n, MU), np.full(n, LAM), np.full(n, permeability / 5e-3), np.full(n, 1e-12))
    return LagrangianModel(Problem(mesh, space, sparsity(space, fixed), pad, pad), material, STILL)


def drained_bar(kind: str) -> LagrangianModel:
    """A bar without pressure, pulled at its end and free to contract beside."""
    mesh = bar(kind, cells=2)
    space = taylor_hood(mesh)
    x0, y0, z0 = (np.flatnonzero(np.isclose(c, 0.0)) for c in space.points_u)
    end = np.flatnonzero(np.isclose(space.points_u[0], 1.0))
    drained = 3 * space.n_nodes + np.arange(space.n_corners)
    return model(mesh, np.concatenate([3 * x0, 3 * y0 + 1, 3 * z0 + 2, 3 * end, drained]), end)
