"""Writes the fields of a run for ParaView: a time series in XDMF, with its data in an HDF5 file beside it.

The fields belong to the corners and cells of the reference mesh. In ParaView, use "Warp By Vector" with
`displacement` to see the deformed skin.

- Displacement [m] and pressure [Pa] are given at the corners.
- The other fields are means over each cell: porosity ``1 - (1 - porosity_0) / J`` (from the solid's mass
  balance), effective stress ``P_eff F^T / J`` and total stress ``effective - p I`` [Pa], and fluid velocity
  ``v_l = -k / (mu_f porosity) grad p + v_s`` [m/s] (the article's Darcy law, with the fluid's viscosity
  mu_f).
"""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import meshio
import numpy as np
import skfem

from bayeskin.finite_element.problem import Constants, Problem, material
from bayeskin.types import Array

SLACK_S = 1e-6  # the last time of a run is a difference, and may miss the protocol's end by so much


@dataclass(frozen=True)
class Fields:
    """The fields at one time, at c corners and in e cells.

    displacement (c, 3) [m], pressure (c,) [Pa], porosity (e,), effective_stress and total_stress (e, 3, 3),
    both Cauchy stresses [Pa], fluid_velocity (e, 3) [m/s]
    """

    displacement: Array
    pressure: Array
    porosity: Array
    effective_stress: Array
    total_stress: Array
    fluid_velocity: Array


def fields_of(problem: Problem, theta: Mapping[str, float], x: Array, rate: Array) -> Fields:
    """Returns the fields at the unknowns x (dofs,) with their rate (dofs,) [per s].

    theta : parameters of the run
    """
    s, c = problem.space, Constants()
    cells = material(theta, problem.mesh.cutis)
    u, v = (a[: 3 * s.n_nodes].reshape(-1, 3)[s.nodes_u] for a in (x, rate))
    p = x[3 * s.n_nodes + s.nodes_p]
    f = np.eye(3) + np.einsum("eai,eqja->eqij", u, s.grad_u)
    j = np.linalg.det(f)
    inverse = np.linalg.inv(f)
    mu, lam = cells.mu[:, None, None, None], cells.lam[:, None, None, None]
    left = np.einsum("eqik,eqjk->eqij", f, f)
    log_j = np.log(j)[..., None, None]
    effective = (mu * (left - np.eye(3)) + lam * log_j * np.eye(3)) / j[..., None, None]
    pressure = np.einsum("qb,eb->eq", s.value_p, p)
    total = effective - pressure[..., None, None] * np.eye(3)
    initial = np.where(problem.mesh.cutis, c.porosity_c, c.porosity_s)[:, None]
    porosity = 1.0 - (1.0 - initial) / j
    gradient = np.einsum("eqji,eqjb,eb->eqi", inverse, s.grad_p, p)
    weight = s.weight / s.weight.sum(axis=1, keepdims=True)
    darcy = -(cells.mobility[:, None] / porosity)[..., None] * gradient
    corner_u = _corner_displacement(problem, x)
    corner_p = np.zeros(len(corner_u))
    corner_p[_corner_numbers(problem)] = x[3 * s.n_nodes + s.nodes_p]
    return Fields(
        displacement=corner_u,
        pressure=corner_p,
        porosity=np.einsum("eq,eq->e", weight, porosity),
        effective_stress=np.einsum("eq,eqij->eij", weight, effective),
        total_stress=np.einsum("eq,eqij->eij", weight, total),
        fluid_velocity=np.einsum("eq,eqi->ei", weight, darcy)
        + np.einsum("a,eai->ei", _node_weights(s.nodes_u.shape[1]), v),
    )


@cache
def _node_weights(nodes: int) -> Array:
    """Returns the weight (a,) of each displacement node in the mean over its cell.

    The cell is a tetrahedron with 10 nodes or a brick with 27. The weights are exact for a cell that is a
    uniformly stretched reference cell.
    """
    element = {10: skfem.ElementTetP2, 27: skfem.ElementHex2}[nodes]()
    points, weight = skfem.quadrature.get_quadrature(element.refdom, 2 * element.maxdeg)
    return np.array([element.lbasis(points, i)[0] @ weight / weight.sum() for i in range(nodes)])


class StatesAt:
    """Keeps a run's unknowns at chosen times. To use it, pass its method `on_state` to `simulate`.

    Between two time steps the unknowns are interpolated linearly.

    times_s : the chosen times [s], in increasing order
    states : the unknowns (dofs,) at those of these times that the run has reached
    """

    def __init__(self, times_s: Sequence[float], problem: Problem, p_init_pa: float) -> None:
        self.times_s = tuple(times_s)
        self.states: list[Array] = []
        start = np.zeros(problem.space.dofs)
        start[3 * problem.space.n_nodes :] = p_init_pa
        self._before = 0.0, start

    def on_state(self, time_s: float, x: Array, force_n: float) -> None:
        """Receives the next state of the run."""
        before_s, before = self._before
        while len(self.states) < len(self.times_s) and self.times_s[len(self.states)] <= time_s + SLACK_S:
            span = time_s - before_s
            share = (self.times_s[len(self.states)] - before_s) / span if span > 0.0 else 1.0
            self.states.append((1.0 - min(share, 1.0)) * before + min(share, 1.0) * x)
        self._before = time_s, x.copy()


class FieldWriter:
    """Collects a run's states and writes them as one XDMF series.

    To use it, pass its method `on_state` to `simulate`, and call `write` when the run has ended.
    """

    def __init__(self, folder: Path | str, problem: Problem, theta: Mapping[str, float]) -> None:
        self.path = Path(folder) / "fields.xdmf"
        self._problem, self._theta = problem, dict(theta)
        self._states: list[tuple[float, Array]] = []

    def on_state(self, time_s: float, x: Array, force_n: float) -> None:
        """Keeps a state of the run."""
        self._states.append((time_s, x.copy()))

    def write(self) -> tuple[Path, Path]:
        """Writes the series and returns the paths of the XDMF file and of the HDF5 file.

        If writing fails, no incomplete file is left.
        """
        paths = self.path, self.path.with_suffix(".h5")
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=self.path.parent, prefix=".fields.") as partial:
            self._write_into(Path(partial))
            for path in reversed(paths):
                os.replace(Path(partial) / path.name, path)
        return paths

    def _write_into(self, directory: Path) -> None:
        """Writes both files into an existing folder."""
        mesh = self._problem.mesh.geometry
        kind = "hexahedron" if isinstance(mesh, skfem.MeshHex) else "tetra"
        corners = _corner_numbers(self._problem)
        order = list(_VTK_HEXAHEDRON) if kind == "hexahedron" else list(range(4))
        points = mesh.doflocs.T[: corners.max() + 1]
        # meshio opens the HDF5 file by its name alone, so the current folder must be the one of the file
        with contextlib.chdir(directory), meshio.xdmf.TimeSeriesWriter(self.path.name) as writer:
            writer.write_points_cells(points, [(kind, corners[:, order])])
            for (before_s, before), (time_s, x) in zip(
                [self._states[0], *self._states[:-1]], self._states, strict=True
            ):
                rate = (x - before) / (time_s - before_s) if time_s > before_s else np.zeros_like(x)
                fields = fields_of(self._problem, self._theta, x, rate)
                writer.write_data(
                    time_s,
                    point_data={"displacement": fields.displacement, "pressure": fields.pressure},
                    cell_data={
                        "porosity": [fields.porosity],
                        "effective_stress": [fields.effective_stress.reshape(-1, 9)],
                        "total_stress": [fields.total_stress.reshape(-1, 9)],
                        "fluid_velocity": [fields.fluid_velocity],
                        "cutis": [self._problem.mesh.cutis.astype(float)],
                    },
                )


# VTK's order of the corners of a brick, as numbers in scikit-fem's order
_VTK_HEXAHEDRON = (0, 3, 6, 2, 1, 5, 7, 4)


def _corner_numbers(problem: Problem) -> np.ndarray:
    """Returns the vertex numbers (e, 4 or 8) of each cell's corners, in the order of `nodes_p`."""
    return problem.mesh.geometry.t.T


def _corner_displacement(problem: Problem, x: Array) -> Array:
    """Returns the displacement (c, 3) [m] at the corners.

    It relies on the first shape functions of a cell being those of its corners.
    """
    s, corners = problem.space, _corner_numbers(problem)
    out = np.zeros((corners.max() + 1, 3))
    out[corners] = x[: 3 * s.n_nodes].reshape(-1, 3)[s.nodes_u[:, : corners.shape[1]]]
    return out
