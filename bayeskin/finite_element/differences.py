"""Differentiates the residual at a stage's end by differences, one parameter after the other.

With further laws, and for lengths of the tissue, there is no exact tangent by the parameters (`directional`).
The derivative is then the difference of two residuals, of which the second belongs to the run with one
parameter changed (`Varied`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bayeskin.errors import InputError
from bayeskin.finite_element.balances import Evaluated
from bayeskin.finite_element.lagrangian import LagrangianModel
from bayeskin.finite_element.problem import Material, ProblemAt, material
from bayeskin.finite_element.series import Drive, Memories, on_the_way
from bayeskin.finite_element.stages import Stage, State
from bayeskin.finite_element.tissue import Bind, TissueLaw
from bayeskin.geometry import LENGTHS
from bayeskin.types import Array

EPSILON = 1e-5  # difference step, as a share of a parameter's change; error: truncation 1e-5, rounding 1e-9


@dataclass(frozen=True)
class Varied:
    """The constants of a run in which one parameter differs by EPSILON times its change.

    model : the model with its nodes at the changed positions; its material and laws do not change
    material, laws, drive : these at the changed parameter
    """

    model: LagrangianModel
    material: Material
    laws: tuple[TissueLaw, ...]
    drive: Drive


@dataclass(frozen=True)
class Slopes:
    """The derivatives of a `State` with respect to r parameters.

    x (dofs, r) : derivatives of the unknowns. If elements lie in series with the skin, a last column holds
        the response to the pads' travel
    volume, pressure (e, q, r) : derivatives of J and p
    memory (e q, m, r), lost (k, r) : derivatives of the memories of each law, and of each element in series
    """

    state: State
    x: Array
    volume: Array
    pressure: Array
    memory: tuple[Array, ...]
    lost: Memories


def vary(
    model: LagrangianModel, theta: Mapping[str, float], name: str, by: float, laws: Sequence[Bind],
    problem_at: ProblemAt,
) -> Varied:  # fmt: skip
    """Returns the constants of the run with the parameter `name` increased by `by`.

    Raises InputError if the change opens the pads before the test while in the run they were not opened.
    """
    values = {**theta, name: theta[name] + by}
    if name in LENGTHS:
        model = LagrangianModel(problem_at(values), model.material, model.protocol, model.laws)
    bound = tuple(sorted((bind(values, model.problem.sites) for bind in laws), key=lambda law: law.rank))
    drive = on_the_way(model.protocol, bound)
    if drive.starts_s != model.starts_s:
        raise InputError(
            f"gradients: {name}",
            f"a step from {theta[name]} opens the pads before the test",
            "start from a value with which the run opens them too",
        )
    return Varied(model, material(values, model.problem.mesh.cutis), bound, drive)


def material_rates(up: Sequence[Material], down: Sequence[Material]) -> tuple[Array, Array, Array]:
    """Returns the derivatives of mu, lam and mobility with respect to r parameters, (e, r) each.

    up, down : the materials with each parameter increased and decreased, for central differences
    """

    def rate(of: Callable[[Material], Array]) -> Array:
        pairs = zip(up, down, strict=True)
        return np.stack([(of(high) - of(low)) / (2.0 * EPSILON) for high, low in pairs], axis=1)

    return rate(lambda m: m.mu), rate(lambda m: m.lam), rate(lambda m: m.mobility)


class ResidualDifferences:
    """Derivatives at a stage's end with respect to r parameters, by differences of the residual.

    The fields have the names of those of `Evaluated`.

    before : derivatives of the stage's history
    x (dofs, r) : derivatives of the unknowns. A further column beyond r belongs to the pads' travel, on which
        the history does not depend
    """

    def __init__(
        self, model: LagrangianModel, varied: Sequence[Varied], stage: Stage, before: Slopes, x: Array
    ) -> None:
        self._base, self._columns = stage.state, []
        for r, column in enumerate(x.T):
            column_model, history, changed = model, stage.history, (model.material, model.laws)
            if r < len(varied):
                constants, history = varied[r], _moved_history(history, before, r)
                column_model, changed = constants.model, (constants.material, constants.laws)
            moved = self._base.x + EPSILON * column
            evaluated = column_model.residual(moved, stage.length_s, history, stage.elapsed_s, changed)
            # a cell has turned inside out, although the unknowns changed by only about a millionth
            if evaluated is None:
                at_s = self._base.time_s
                raise FloatingPointError(f"no derivative at t = {at_s:.3f} s: a cell is nearly flat")
            self._columns.append(evaluated)
        self.residual = self._slope(lambda f: f.residual, stage.residual)

    @property
    def volume(self) -> Array:
        return self._slope(lambda f: f.volume, self._base.volume)

    @property
    def pressure(self) -> Array:
        return self._slope(lambda f: f.pressure, self._base.pressure)

    @property
    def memory(self) -> tuple[Array, ...]:
        return tuple(self._slope(lambda f, k=k: f.memory[k], m) for k, m in enumerate(self._base.memory))  # type: ignore[misc]

    def _slope(self, of: Callable[[Evaluated], Array], at: Array) -> Array:
        """Returns the derivatives of a quantity `of` the evaluations, from its value `at` the stage's end."""
        return np.stack([(of(evaluated) - at) / EPSILON for evaluated in self._columns], axis=-1)


def _moved_history(history: State, before: Slopes, r: int) -> State:
    """Returns a stage's history with parameter r increased by EPSILON times its change."""
    memory = zip(history.memory, before.memory, strict=True)
    return State(
        history.time_s,
        history.x,
        history.volume + EPSILON * before.volume[..., r],
        history.pressure + EPSILON * before.pressure[..., r],
        tuple(m + EPSILON * slope[..., r] for m, slope in memory),
    )
