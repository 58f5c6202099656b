"""Measures how the cost of the reduced model grows with its modes and its cubature points.

    OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 python benchmarks/reduced_cost.py

The first table has the CPU milliseconds of one residual and of one new tangent, as medians of many calls.
They are measured for the base model and for a set of three mechanisms of the shipped model, with some or all
of its modes and points. Two lines tell how many residuals and tangents a run of the article's protocol takes.
The last table has the cost of runs with larger sets of mechanisms that act weakly, without derivatives and
with the derivatives by all parameters.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np
import rows
from reduced_model import PROTOCOLS, Skin, held_out

from bayeskin.design import default_space
from bayeskin.finite_element.stepping import integrate
from bayeskin.forward.interface import change
from bayeskin.mechanisms import catalogue
from bayeskin.reduced import kernels, newton
from bayeskin.reduced.arrays import History
from bayeskin.reduced.equations import ReducedEquations
from bayeskin.reduced.files import load_reduced
from bayeskin.reduced.model import ReducedModel, reduced_space
from bayeskin.reduced.operators import Basis, Rule
from bayeskin.reduced.runs import binds_of, tissue_of
from bayeskin.reduced.simulate import simulate_reduced
from bayeskin.shipped import shipped
from bayeskin.types import ParameterSpace
from bayeskin.workflow.reducing import SHIPPED

SHARES = (0.5, 1.0)  # share of the modes
POINTS = (0.25, 0.5, 1.0)  # share of the points
REPEATS = 15
SETS = (2, 6, 11)  # number of mechanisms, taken in alphabetical order
WEAK = 0.03  # distance of the parameters from their neutral values, as a share of the prior's width


def equations(model: ReducedModel, skin: Skin, modes: float, points: float) -> ReducedEquations:
    """Returns the equations of a run with only the first modes and points; both are given as shares."""
    problem, basis = model.problem(), model.basis(tissue_of(skin.mechanisms))
    u, p = (int(modes * len(fields)) for fields in (basis.displacement, basis.pressure))
    smaller_basis = Basis(basis.moving, basis.dual, basis.displacement[:u], basis.pressure[:p])
    rule = model.cubatures.of(skin.mechanisms)
    count = int(points * len(rule.points))
    space = reduced_space(problem, smaller_basis, Rule(rule.points[:count], rule.factor[:count]))
    return ReducedEquations(space, skin.theta, binds_of(skin.mechanisms), PROTOCOLS["article"])


def median_ms(call: Callable[[], object]) -> float:
    """Returns the median CPU milliseconds of a call; a first call is not counted."""
    call()
    spent = []
    for _ in range(REPEATS):
        started = time.process_time()
        call()
        spent.append(time.process_time() - started)
    return 1e3 * float(np.median(spent))


def row(label: str, eq: ReducedEquations, p_init: float) -> list[str]:
    """Returns the table's row of one size: milliseconds of a residual and of a tangent."""
    state = eq.initial_state(p_init)
    past = History(state.volume, state.pressure, state.memory[0], state.x[: eq.space.modes[0]], 1.0, 1.0, 1.0)
    scratch, output, t = eq.make_room(), np.empty(len(state.x)), eq.tangent
    residual = median_ms(lambda: kernels.residual(eq.system, eq.packed, past, state.x, scratch, output))
    tangent = median_ms(
        lambda: newton.renew(
            eq.system, eq.packed, past, state.x, scratch, t.inverse, t.force_row, t.by_pads
        )
    )  # fmt: skip
    k, m = eq.space.modes
    return [label, f"{k - 2} + {m}", str(len(eq.space.at.weight)), f"{residual:.2f}", f"{tangent:.1f}"]


def counted(eq: ReducedEquations, p_init: float) -> str:
    """Returns as text how many residuals and tangents a run takes, or its error message."""
    message = integrate(eq, p_init, 1e-3, lambda step: None, falls_too=False)
    return message or f"{eq.spent[1]} residuals and {eq.spent[2]} tangents"


def set_row(model: ReducedModel, names: Sequence[str]) -> list[str]:
    """Returns the table's row of one set: CPU seconds of a run without and with derivatives."""
    mechanisms = [catalogue()[name] for name in names]
    space = ParameterSpace((*default_space().parameters, *(p for m in mechanisms for p in m.parameters)))
    neutral = {**held_out()[0].theta, **{key: value for m in mechanisms for key, value in m.neutral.items()}}
    unit = space.to_unit([neutral[name] for name in space.names])
    unit[5:] += np.where(unit[5:] < 0.5, WEAK, -WEAK)
    point = space.from_unit(unit)
    theta = dict(zip(space.names, map(float, point), strict=True))
    changes = dict(zip(space.names, map(float, change(space, point)), strict=True))
    cells = []
    for gradients in (None, changes):
        for _ in range(2):  # the first of two runs of a set prepares its space, the second is timed
            started = time.process_time()
            simulation = simulate_reduced(model, PROTOCOLS["article"], theta, mechanisms, gradients)
            spent_s = time.process_time() - started
        cells.append(f"{spent_s:.2f}" + ("" if simulation.status == "ok" else ", and fails"))
    modes = sum(model.space(tissue_of(sorted(names))).modes)
    return [str(len(names)), str(modes), cells[0], str(len(changes)), cells[1]]


def main() -> None:
    """Prints both tables."""
    model, table = load_reduced(shipped(SHIPPED)), list[list[str]]()
    skins: Sequence[tuple[str, Skin]] = [("base", held_out()[0]), ("three mechanisms", held_out()[19])]
    for label, skin in skins:
        for modes in SHARES:
            for points in POINTS:
                table.append(row(label, equations(model, skin, modes, points), skin.theta["p_init"]))
    print(rows.markdown(["model", "modes", "points", "residual [ms]", "tangent [ms]"], table))
    for label, skin in skins:
        all_equations = equations(model, skin, 1.0, 1.0)
        print(f"{', '.join(skin.mechanisms) or label}: {counted(all_equations, skin.theta['p_init'])}")
    names = sorted(model.trained.mechanisms)
    header = ["mechanisms", "modes", "run [CPU s]", "number of derivatives", "run with derivatives [CPU s]"]
    print(rows.markdown(header, [set_row(model, names[:count]) for count in SETS]))


if __name__ == "__main__":
    main()
