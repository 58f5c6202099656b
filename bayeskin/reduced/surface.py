"""The displacements of points on the surface in a run of the reduced model, with their derivatives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bayeskin.finite_element.surface_points import since_first, surface_displacement
from bayeskin.geometry import LENGTHS, Geometry, moved
from bayeskin.mechanisms import Mechanism
from bayeskin.mechanisms.mechanism import Tissue
from bayeskin.reduced.model import ReducedModel
from bayeskin.reduced.sensitivities import SENSITIVITY
from bayeskin.reduced.simulate import simulate_reduced
from bayeskin.types import Array, PadMotion, Simulation

_known: dict[object, Array] = {}
MOST_KNOWN = 32


@dataclass(frozen=True)
class SurfaceRun:
    """A run with the displacements of points since the first of some times, at the others.

    displacement_m (t - 1, p, 2) : displacements; None for a run that failed
    slopes_m (t - 1, p, 2, r) : derivatives by the parameters of the run's gradient, or None
    """

    simulation: Simulation
    displacement_m: Array | None = None
    slopes_m: Array | None = None


def simulate_surface(
    model: ReducedModel, motion: PadMotion, theta: Mapping[str, float], mechanisms: Sequence[Mechanism],
    gradients: Mapping[str, float] | None, points_m: Array, time_s: Array, least_stiffness: float,
    geometry: Geometry | None = None,
) -> SurfaceRun:  # fmt: skip
    """Returns a run of a reduced model with the displacements of points.

    points_m (p, 2) : places of the points before the test, as `surface_displacement` takes them
    time_s (t,) : the times at which the points are seen

    The other arguments are those of `simulate_reduced`.
    """
    states: list[Array] = []
    by_state: list[Array] = []

    def on_reduced_state(at_s: float, x: Array, by: Array | None) -> None:
        states.append(x)
        if by is not None:
            by_state.append(by)

    simulation = simulate_reduced(
        model, motion, theta, mechanisms, gradients, geometry, on_reduced_state=on_reduced_state,
        least_stiffness=least_stiffness,
    )  # fmt: skip
    if simulation.status != "ok":
        return SurfaceRun(simulation)
    tissue = sorted(m.name for m in mechanisms if isinstance(m.act, Tissue))
    lengths = geometry or model.trained.geometry
    matrix = _matrix(model, tissue, moved(lengths, theta), points_m)
    fields = matrix.shape[1]
    coefficients = np.array(states)[:, :fields]
    displacement_m = since_first(simulation, coefficients @ matrix.T, time_s)
    if gradients is None:
        return SurfaceRun(simulation, displacement_m)
    by_m = np.einsum("qk,nrk->nqr", matrix, np.array(by_state)[:, :, :fields])
    for column, (name, change) in enumerate(gradients.items()):
        if name in LENGTHS:  # the points stay where they are, but the nodes move
            step = SENSITIVITY.length_step * change
            ends = [moved(lengths, {**theta, name: theta[name] + way * step}) for way in (1.0, -1.0)]
            up, down = (_matrix(model, tissue, end, points_m) for end in ends)
            by_m[:, :, column] += coefficients @ (up - down).T / (2.0 * SENSITIVITY.length_step)
    return SurfaceRun(simulation, displacement_m, since_first(simulation, by_m, time_s))


def _matrix(model: ReducedModel, tissue: Sequence[str], geometry: Geometry, points_m: Array) -> Array:
    """Returns the matrix (2 p, k) that gives the displacements of points from the coefficients of a state."""
    key = id(model), tuple(tissue), geometry, points_m.tobytes()
    if key not in _known:
        while len(_known) >= MOST_KNOWN:
            del _known[next(iter(_known))]
        problem = model.problem(geometry)
        n = 3 * problem.space.n_nodes
        _known[key] = np.asarray(
            surface_displacement(problem, points_m)[:, :n] @ model.basis(tissue).fields.T
        )
    return _known[key]
